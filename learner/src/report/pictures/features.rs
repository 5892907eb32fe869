//! The weights of the features, each with its interval: what the data do not determine is wide.

use super::canvas::{Canvas, Type, fit, text_width};
use super::colour::{ACCENT, MUTED, RULE};
use super::panel::{MARGIN, TITLE, WIDTH, title};
use super::{Part, Picture};
use crate::report::format::alike;
use crate::report::{Report, ReportError};
use plotters::style::Color;

/// Features drawn at most: those with the largest weights.
const MOST: usize = 40;
const ROW: f64 = 26.0;
const SET: f64 = 11.5;

/// The picture; `None` where the fit weighs no features.
pub(super) fn picture(report: &Report) -> Result<Option<Picture>, ReportError> {
    if report.features.is_empty() {
        return Ok(None);
    }
    let mut shown: Vec<usize> = (0..report.features.len()).collect();
    shown.sort_by(|&i, &j| {
        let size = |rank: usize| report.features[rank].weight.mean.abs();
        size(j).total_cmp(&size(i)).then(i.cmp(&j))
    });
    shown.truncate(MOST);
    shown.sort_unstable();
    let rows: Vec<_> = shown.iter().map(|&rank| &report.features[rank]).collect();
    let intervals = rows.iter().any(|row| row.weight.low.is_finite() && row.weight.high.is_finite());
    let note = if intervals { "weight of each feature, with its 95 % interval" } else { "weight of each feature" };
    let left = rows.iter().map(|row| text_width(&row.name, SET)).fold(0.0, f64::max).min(140.0) + MARGIN + 10.0;
    let ends = rows.iter().flat_map(|row| [row.weight.mean, row.weight.low, row.weight.high]).filter(|x| x.is_finite());
    let (low, high) = ends.fold((0.0f64, 0.0f64), |(low, high), x| (low.min(x), high.max(x)));
    let span = if high > low { high - low } else { 1.0 };
    let write = alike(rows.iter().map(|row| row.weight.mean));
    let numbers = rows.iter().map(|row| text_width(&write(row.weight.mean), SET)).fold(0.0, f64::max);
    let room = WIDTH - MARGIN - left - numbers - 12.0;
    let x = |value: f64| left + room * (value - low) / span;
    let height = ROW * rows.len() as f64;
    let size = (WIDTH, TITLE + height + MARGIN);
    let svg = Canvas::draw("features", size, &format!("Weights of the features: {note}"), |canvas| {
        title(canvas, MARGIN, 0.0, WIDTH - 2.0 * MARGIN, "Weights of the features", note);
        for (i, row) in rows.iter().enumerate() {
            let top = TITLE + i as f64 * ROW;
            let middle = top + ROW / 2.0;
            let weight = row.weight;
            canvas.text(MARGIN, middle, &fit(&row.name, SET, left - MARGIN - 8.0), Type::new(SET));
            let mean = if weight.mean.is_finite() { weight.mean } else { 0.0 };
            let (begin, end, head, foot) = (x(0.0), x(mean), top + 6.0, top + ROW - 6.0);
            canvas.polygon(&[(begin, head), (end, head), (end, foot), (begin, foot)], ACCENT.mix(0.55));
            if weight.low.is_finite() && weight.high.is_finite() {
                let (from, to) = (x(weight.low), x(weight.high));
                canvas.path(&[(from, middle), (to, middle)], MUTED, 1.6);
                for end in [from, to] {
                    canvas.path(&[(end, middle - 4.0), (end, middle + 4.0)], MUTED, 1.6);
                }
            }
            canvas.text(WIDTH - MARGIN, middle, &write(weight.mean), Type::new(SET).right().colour(MUTED));
        }
        canvas.path(&[(x(0.0), TITLE), (x(0.0), TITLE + height)], RULE, 1.0);
    })?;
    let omitted = report.features.len() - rows.len();
    let more = if omitted > 0 { format!(" The {omitted} smallest weights are left out.") } else { String::new() };
    let interval = if intervals {
        " The line over a bar is its 95 % interval: where it is wide, the demonstrations say little."
    } else {
        ""
    };
    let caption = format!(
        "How much the learned reward gains with a unit of each feature. Weights compare only as far as the units of the \
         features do.{interval}{more}"
    );
    Ok(Some(Picture { name: "features", part: Part::Learned, title: "Weights of the features", caption, svg }))
}
