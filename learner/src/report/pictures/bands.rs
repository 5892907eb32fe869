//! A comparison of methods: one line a method over the number of demonstrations, with bands for the confidence intervals.

use super::canvas::{Canvas, Type, fit, text_width};
use super::colour::{INK, MUTED, RULE};
use super::panel::{MARGIN, TITLE, title};
use super::trace::{Axis, tick};
use super::{Part, Picture};
use crate::eval::{
    Interval,
    comparison::{Comparison, Row},
};
use crate::report::ReportError;
use plotters::style::{Color, RGBColor};

/// Size of a sheet.
const SIZE: (f64, f64) = (720.0, 440.0);
/// Room for the names at the right, at least and at most.
const NAMES: (f64, f64) = (128.0, 250.0);
/// Room for the numbers at the left.
const LABELS: f64 = 44.0;
/// Below this an expected value difference is drawn at the foot of a logarithmic axis.
const FLOOR: f64 = 1e-3;

/// Told apart by lightness as well as by hue, after Paul Tol's and Okabe and Ito's colour-blind safe sets; the first is the
/// baseline's.
const HUES: [RGBColor; 16] = [
    RGBColor(0x00, 0x65, 0xa8),
    RGBColor(0xd5, 0x5e, 0x00),
    RGBColor(0x00, 0x9e, 0x73),
    RGBColor(0xaa, 0x33, 0x77),
    RGBColor(0x8a, 0x6d, 0x00),
    RGBColor(0x56, 0xb4, 0xe9),
    RGBColor(0x88, 0x22, 0x55),
    RGBColor(0x66, 0x99, 0x33),
    RGBColor(0xe6, 0x9f, 0x00),
    RGBColor(0x33, 0x22, 0x88),
    RGBColor(0xcc, 0x66, 0x77),
    RGBColor(0x77, 0x77, 0x77),
    RGBColor(0x7a, 0x4b, 0x2a),
    RGBColor(0x00, 0x80, 0x80),
    RGBColor(0xb5, 0x7e, 0xdc),
    RGBColor(0x14, 0x5a, 0x14),
];

/// One picture a measure; `what` says what was compared.
///
/// # Errors
/// What the drawing library says.
pub fn comparison(comparison: &Comparison, what: &str) -> Result<Vec<Picture>, ReportError> {
    let known = comparison.rows.iter().any(|row| row.evd.is_some());
    let mut pictures = Vec::new();
    let agreement = Measure {
        name: "agreement",
        title: if known { "Share of the states whose action is optimal" } else { "Share of the expert's unseen steps" },
        of: |row| row.agreement,
        share: true,
    };
    pictures.extend(picture(comparison, what, &agreement)?);
    let evd = Measure { name: "evd", title: "Expected value difference", of: |row| row.evd, share: false };
    pictures.extend(picture(comparison, what, &evd)?);
    let likelihood = Measure {
        name: "log_likelihood",
        title: "Log-likelihood of the expert's unseen steps, per step",
        of: |row| row.log_likelihood,
        share: false,
    };
    pictures.extend(picture(comparison, what, &likelihood)?);
    Ok(pictures)
}

struct Measure {
    name: &'static str,
    title: &'static str,
    of: fn(&Row) -> Option<Interval>,
    /// Between 0 and 1.
    share: bool,
}

/// A method's line: (L, mean and interval), L rising.
struct Line<'a> {
    name: &'a str,
    hue: RGBColor,
    baseline: bool,
    points: Vec<(f64, Interval)>,
}

fn lines<'a>(comparison: &'a Comparison, measure: &Measure) -> Vec<Line<'a>> {
    let mut names: Vec<&str> = Vec::new();
    for row in &comparison.rows {
        if !names.contains(&row.method.as_str()) {
            names.push(&row.method);
        }
    }
    // The baseline has the first hue, the others theirs in order.
    let mut hues = HUES.iter().skip(1).cycle();
    let mut lines: Vec<Line> = names
        .into_iter()
        .map(|name| {
            let baseline = name == comparison.baseline;
            let rows = comparison.rows.iter().filter(|row| row.method == name);
            let points = rows.filter_map(|row| Some((f64::from(row.trajectories), (measure.of)(row)?))).collect();
            let hue = if baseline { HUES[0] } else { *hues.next().unwrap_or(&HUES[11]) };
            Line { name, hue, baseline, points }
        })
        .filter(|line| !line.points.is_empty())
        .collect();
    // The baseline is painted last, over the others.
    lines.sort_by_key(|line| line.baseline);
    lines
}

fn picture(comparison: &Comparison, what: &str, measure: &Measure) -> Result<Option<Picture>, ReportError> {
    let lines = lines(comparison, measure);
    if lines.is_empty() {
        return Ok(None);
    }
    let means: Vec<f64> = lines.iter().flat_map(|line| line.points.iter().map(|(_, value)| value.mean)).collect();
    let (low, high) = means.iter().fold((f64::INFINITY, f64::NEG_INFINITY), |(l, h), &x| (l.min(x), h.max(x)));
    // Differences in value fall over orders of magnitude; read on a linear axis all the small ones would be zero.
    let logarithmic = !measure.share && low >= 0.0 && high > 30.0 * low.max(FLOOR);
    let axis = if measure.share {
        let least = ((low - 0.05).max(0.0) * 10.0).floor() / 10.0;
        Axis { low: least, high: 1.0, logarithmic: false }
    } else if logarithmic {
        Axis { low: (low.max(FLOOR)) * 0.7, high: high * 1.5, logarithmic: true }
    } else {
        let pad = 0.06 * (high - low).max(1e-9);
        Axis { low: if low >= 0.0 { 0.0 } else { low - pad }, high: high + pad, logarithmic: false }
    };
    let caption = format!(
        "{}: means over seeds with their 95 % confidence bands, by the number of demonstrations on a logarithmic axis.{}",
        measure.title,
        if logarithmic { " Values below the foot of the axis are drawn at it." } else { "" }
    );
    let svg = Canvas::draw(measure.name, SIZE, &format!("{} ({what})", measure.title), |canvas| {
        title(canvas, MARGIN, 0.0, SIZE.0 - 2.0 * MARGIN, measure.title, what);
        chart(canvas, &lines, &axis);
    })?;
    Ok(Some(Picture { name: measure.name, part: Part::Sheet, title: measure.title, caption, svg }))
}

fn chart(canvas: &Canvas<'_>, lines: &[Line<'_>], axis: &Axis) {
    let longest = lines.iter().map(|line| text_width(line.name, 12.0)).fold(0.0, f64::max);
    let room = (longest + 40.0).clamp(NAMES.0, NAMES.1);
    let (left, right) = (MARGIN + LABELS, SIZE.0 - MARGIN - room);
    let (ceiling, foot) = (TITLE + 12.0, SIZE.1 - 52.0);
    let muted = Type::new(11.0).colour(MUTED);
    let mut across: Vec<f64> = lines.iter().flat_map(|line| line.points.iter().map(|&(l, _)| l)).collect();
    across.sort_by(f64::total_cmp);
    across.dedup();
    let (least, most) = (across[0], across[across.len() - 1]);
    let x = |l: f64| {
        let share = if most > least { (l / least).ln() / (most / least).ln() } else { 0.5 };
        left + 8.0 + (right - left - 16.0) * share
    };
    let y = |value: f64| foot - (foot - ceiling) * axis.share(value.clamp(axis.low, axis.high));

    for value in axis.ticks(6) {
        canvas.path(&[(left, y(value)), (right, y(value))], RULE, 0.8);
        canvas.text(left - 7.0, y(value), &tick(value), muted.right());
    }
    canvas.path(&[(left, foot), (right, foot)], MUTED, 0.8);
    let mut free = f64::NEG_INFINITY;
    for &l in &across {
        let text = crate::report::format::count(l);
        let half = text_width(&text, 11.0) / 2.0;
        canvas.path(&[(x(l), foot), (x(l), foot + 4.0)], MUTED, 0.8);
        if x(l) - half > free + 4.0 {
            canvas.text(x(l), foot + 14.0, &text, muted.centred());
            free = x(l) + half;
        }
    }
    canvas.text(f64::midpoint(left, right), foot + 34.0, "demonstrations", muted.centred());

    for line in lines {
        let banded: Vec<_> =
            line.points.iter().filter(|(_, value)| value.low.is_finite() && value.high.is_finite()).collect();
        if banded.len() > 1 {
            let upper = banded.iter().map(|(l, value)| (x(*l), y(value.high)));
            let lower = banded.iter().rev().map(|(l, value)| (x(*l), y(value.low)));
            canvas.polygon(&upper.chain(lower).collect::<Vec<_>>(), line.hue.mix(0.13));
        } else if let [(l, value)] = banded.as_slice() {
            canvas.path(&[(x(*l), y(value.low)), (x(*l), y(value.high))], line.hue, 1.2);
        }
    }
    for line in lines {
        let points: Vec<_> = line.points.iter().map(|(l, value)| (x(*l), y(value.mean))).collect();
        if points.len() > 1 {
            canvas.path(&points, line.hue, if line.baseline { 3.0 } else { 1.7 });
        }
        for &(x, y) in &points {
            canvas.disc(x, y, if line.baseline { 3.6 } else { 2.4 }, line.hue.mix(1.0));
        }
    }
    names(canvas, lines, right + 14.0, (ceiling, foot), &|line| {
        line.points.last().map_or(foot, |(_, value)| y(value.mean))
    });
}

/// Names at the ends of the lines, moved apart where they would touch.
fn names(
    canvas: &Canvas<'_>,
    lines: &[Line<'_>],
    left: f64,
    (ceiling, foot): (f64, f64),
    end: &dyn Fn(&Line<'_>) -> f64,
) {
    let mut places: Vec<(f64, &Line)> = lines.iter().map(|line| (end(line), line)).collect();
    places.sort_by(|a, b| a.0.total_cmp(&b.0).then_with(|| a.1.name.cmp(b.1.name)));
    let step = 17.0_f64.min((foot - ceiling) / places.len() as f64);
    // Down from the top so that none overlaps, then up from the foot where that ran out of room.
    for i in 1..places.len() {
        places[i].0 = places[i].0.max(places[i - 1].0 + step);
    }
    let mut floor = foot;
    for place in places.iter_mut().rev() {
        place.0 = place.0.min(floor);
        floor = place.0 - step;
    }
    for (y, line) in places {
        let from = end(line);
        canvas.path(&[(left - 10.0, from), (left - 2.0, y)], RULE, 0.8);
        canvas.path(&[(left, y), (left + 12.0, y)], line.hue, if line.baseline { 3.0 } else { 1.7 });
        let set = Type::new(12.0).colour(INK);
        let set = if line.baseline { set.bold() } else { set };
        canvas.text(left + 17.0, y, &fit(line.name, 12.0, SIZE.0 - left - 17.0 - 4.0), set);
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::eval::comparison::{Cell, Outcome, Score};

    #[test]
    fn lines_bands_and_names_are_drawn() {
        let cells: Vec<Cell> = ["em-tied", "bc", "em"]
            .iter()
            .enumerate()
            .flat_map(|(m, method)| [1, 10].map(|l| (m, *method, l)))
            .flat_map(|(m, method, l)| (0..3).map(move |seed| (m, method, l, seed)))
            .map(|(m, method, l, seed)| {
                let agreement = 0.5 + 0.04 * f64::from(l) - 0.1 * m as f64 + 0.01 * f64::from(seed);
                let score = Score { agreement, evd: Some(1.0 - agreement), log_likelihood: -0.5, fit_secs: 0.1 };
                Cell { method: method.into(), trajectories: l, seed, outcome: Outcome::Fitted(score) }
            })
            .collect();
        let compared = Comparison::new(&cells, &["em-tied", "bc", "em"], &[1, 10], "em-tied");
        let pictures = comparison(&compared, "a maze").expect("pictures");
        assert_eq!(pictures.iter().map(|picture| picture.name).collect::<Vec<_>>(), ["agreement", "evd"]);
        for picture in pictures {
            for name in ["em-tied", "bc", "demonstrations", "polygon"] {
                assert!(picture.svg.contains(name), "{name} in {}", picture.name);
            }
            assert!(super::super::png(&picture.svg).expect("a picture").starts_with(b"\x89PNG"));
        }
        let one = Comparison::new(&cells[..1], &["em-tied"], &[1], "em-tied");
        assert_eq!(comparison(&one, "one fit").expect("pictures").len(), 2);
    }
}
