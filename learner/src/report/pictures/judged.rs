//! What judges a fit: the weights with their intervals, and whether predicted probabilities come true.

use super::canvas::{Canvas, Type, fit, text_width};
use super::colour::{ACCENT, INK, MUTED, RULE};
use super::panel::{MARGIN, TITLE, WIDTH, title};
use super::trace::tick;
use super::{Part, Picture};
use crate::report::format::{brief, count};
use crate::report::uncertainty::UncertaintySource;
use crate::report::{Report, ReportError};
use plotters::style::Color;
use std::fmt::Write as _;

/// Weights drawn at most.
const MOST: usize = 48;
const ROW: f64 = 16.0;
/// Room for the names of the weights at most.
const NAMES: f64 = 170.0;
const SET: f64 = 10.5;

/// Weights with error bars, and the reliability of the predictions, where there are any.
pub(super) fn pictures(report: &Report) -> Result<Vec<Picture>, ReportError> {
    let mut pictures = Vec::new();
    pictures.extend(weights(report)?);
    pictures.extend(calibration(report)?);
    Ok(pictures)
}

/// A dot and a bar for each weight; a dotted line from edge to edge where the data do not determine it.
fn weights(report: &Report) -> Result<Option<Picture>, ReportError> {
    let Some(uncertainty) = &report.uncertainty else { return Ok(None) };
    let shown = report.leading_weights(MOST);
    if shown.is_empty() {
        return Ok(None);
    }
    let longest = shown.iter().map(|&w| text_width(&report.weight_name(w, 60), SET)).fold(40.0, f64::max);
    let left = MARGIN + (longest + 10.0).min(NAMES);
    let right = WIDTH - MARGIN;
    let ends = |w: usize| [report.weights[w], uncertainty.low[w], uncertainty.high[w]];
    // A few very long bars must not make all the others points: they are cut off at the edge.
    let most = shown.iter().map(|&w| report.weights[w].abs()).filter(|w| w.is_finite()).fold(0.0, f64::max);
    let edge = if most > 0.0 { 4.0 * most } else { f64::INFINITY };
    let finite = shown.iter().flat_map(|&w| ends(w)).filter(|x| x.is_finite()).map(|x| x.clamp(-edge, edge));
    let (low, high) = finite.fold((0.0_f64, 0.0_f64), |(low, high), x| (low.min(x), high.max(x)));
    let span = if high > low { high - low } else { 1.0 };
    let x = |value: f64| left + 6.0 + (right - left - 12.0) * ((value - low) / span).clamp(0.0, 1.0);
    let height = ROW * shown.len() as f64;
    let mut note = match uncertainty.source {
        UncertaintySource::StandardErrors => "estimate ± 1.96 standard errors".to_owned(),
        UncertaintySource::Posterior => "posterior mean and 95 % interval".to_owned(),
    };
    if shown.len() < report.weights.len() {
        let _ = write!(note, "; {} of {} weights", shown.len(), count(report.weights.len() as f64));
    }
    let svg = Canvas::draw("weights", (WIDTH, TITLE + height + 40.0), &format!("Weights: {note}"), |canvas| {
        title(canvas, MARGIN, 0.0, WIDTH - 2.0 * MARGIN, "Weights and what is open", &note);
        let foot = TITLE + height;
        for value in [low, 0.0, high].into_iter().filter(|&v| v == 0.0 || (x(v) - x(0.0)).abs() > 30.0) {
            canvas.path(&[(x(value), TITLE), (x(value), foot)], RULE, 0.8);
            canvas.text(x(value), foot + 14.0, &brief(value), Type::new(SET).centred().colour(MUTED));
        }
        for (i, &weight) in shown.iter().enumerate() {
            let y = TITLE + (i as f64 + 0.5) * ROW;
            let determined = uncertainty.determined(weight);
            let name = fit(&report.weight_name(weight, 60), SET, left - MARGIN - 8.0);
            let colour = if determined { INK } else { MUTED };
            canvas.text(left - 8.0, y, &name, Type::new(SET).right().colour(colour));
            if determined {
                let (from, to) = (x(uncertainty.low[weight]), x(uncertainty.high[weight]));
                canvas.path(&[(from, y), (to, y)], ACCENT, 1.3);
                for (end, value) in [(from, uncertainty.low[weight]), (to, uncertainty.high[weight])] {
                    if value >= low && value <= high {
                        canvas.path(&[(end, y - 3.0), (end, y + 3.0)], ACCENT, 1.3);
                    }
                }
                canvas.disc(x(report.weights[weight]), y, 3.0, ACCENT.mix(1.0));
            } else {
                let mut at = left + 6.0;
                while at < right - 82.0 {
                    canvas.path(&[(at, y), (at + 3.0, y)], MUTED, 1.0);
                    at += 8.0;
                }
                canvas.text(right, y - 0.5, "not determined", Type::new(9.5).right().colour(MUTED));
            }
        }
        canvas.path(&[(x(0.0), TITLE), (x(0.0), foot)], MUTED, 0.8);
    })?;
    let caption =
        "The weights of the reward with their 95 % intervals. A long bar is a weight of which the demonstrations say \
                   little, a dotted line one of which they say nothing."
            .to_owned();
    Ok(Some(Picture { name: "weights", part: Part::Learned, title: "Weights and what is open", caption, svg }))
}

/// Predicted probabilities against how often they came true.
fn calibration(report: &Report) -> Result<Option<Picture>, ReportError> {
    let Some(validation) = &report.validation else { return Ok(None) };
    let calibration = &validation.calibration;
    let note = format!(
        "expected calibration error {}, {} folds",
        crate::report::format::fixed(calibration.expected_error, 3),
        validation.folds
    );
    let side = WIDTH - 2.0 * MARGIN - 40.0;
    let (left, top) = (MARGIN + 40.0, TITLE + 6.0);
    let (right, foot) = (left + side, top + side);
    let size = (WIDTH, foot + 46.0);
    let svg = Canvas::draw("calibration", size, &format!("Calibration: {note}"), |canvas| {
        title(canvas, MARGIN, 0.0, WIDTH - 2.0 * MARGIN, "Calibration", &note);
        let muted = Type::new(SET).colour(MUTED);
        for i in 0..=5 {
            let share = f64::from(i) / 5.0;
            let (x, y) = (left + side * share, foot - side * share);
            canvas.path(&[(left, y), (right, y)], RULE, 0.7);
            canvas.path(&[(x, top), (x, foot)], RULE, 0.7);
            canvas.text(left - 9.0, y, &tick(share), muted.right());
            canvas.text(x, foot + 16.0, &tick(share), muted.centred());
        }
        canvas.path(&[(left, foot), (right, top)], MUTED, 1.0);
        canvas.text(f64::midpoint(left, right), foot + 35.0, "predicted probability", muted.centred());
        canvas.text(MARGIN - 4.0, f64::midpoint(top, foot), "share that came true", muted.centred().upright());
        let most = calibration.bins.iter().map(|bin| bin.predictions).max().unwrap_or(1).max(1) as f64;
        let points: Vec<_> = calibration.bins.iter().filter(|bin| bin.predictions > 0).collect();
        let at = |predicted: f64, observed: f64| (left + side * predicted, foot - side * observed);
        let line: Vec<_> = points.iter().map(|bin| at(bin.predicted, bin.observed)).collect();
        if line.len() > 1 {
            canvas.path(&line, ACCENT, 1.6);
        }
        for bin in points {
            let (x, y) = at(bin.predicted, bin.observed);
            canvas.disc(x, y, 3.0 + 6.0 * (bin.predictions as f64 / most).sqrt(), ACCENT.mix(0.85));
        }
    })?;
    let caption =
        "How often actions predicted with a probability were taken, on trajectories that the fit did not see; on the \
                   diagonal predictions come true. Large dots are many predictions."
            .to_owned();
    Ok(Some(Picture { name: "calibration", part: Part::Fit, title: "Calibration", caption, svg }))
}
