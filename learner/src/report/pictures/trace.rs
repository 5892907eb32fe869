//! How the fit converged: the objective, and the change that the stopping rule watches, over the iterations.

use super::canvas::{Canvas, Type, text_width};
use super::colour::{ACCENT, MUTED, RULE};
use super::panel::{MARGIN, TITLE, WIDTH, title};
use super::{Part, Picture};
use crate::report::format::{brief, count, stopped};
use crate::report::{Report, ReportError};
use plotters::style::Color;

/// Points drawn at most; more iterations are thinned evenly.
const MOST_POINTS: usize = 800;
/// Height of one chart with its name and its axis.
const CHART: f64 = 196.0;
/// Width of the numbers beside a chart.
const LABELS: f64 = 50.0;
const SIZE: (f64, f64) = (WIDTH, TITLE + 2.0 * CHART + 22.0);

/// The picture; `None` where there is nothing finite to draw.
pub(super) fn picture(report: &Report) -> Result<Option<Picture>, ReportError> {
    let objective = series(report, |entry| entry.objective);
    let change = series(report, |entry| entry.change.abs());
    let positive: Vec<_> = change.iter().copied().filter(|&(_, y)| y > 0.0).collect();
    if objective.is_empty() && change.is_empty() {
        return Ok(None);
    }
    let last = report.trace.iter().map(|entry| f64::from(entry.iteration)).fold(1.0, f64::max);
    let note = match report.iterations {
        1 => format!("{} after 1 iteration", stopped(report.stopped)),
        n => format!("{} after {} iterations", stopped(report.stopped), count(f64::from(n))),
    };
    // A change that spans more than a factor of thirty is read on a logarithmic axis.
    let (low, high) = range(&positive);
    let logarithmic = positive.len() > 1 && high > 30.0 * low;
    let caption = format!(
        "Above, what the method maximises; below, the change that its stopping rule watches{}, until it falls below the \
         tolerance ({:e}, dashed) or nothing improves any more.",
        if logarithmic { " on a logarithmic axis" } else { "" },
        report.options.tolerance
    );
    let svg = Canvas::draw("trace", SIZE, &format!("Convergence of the fit: {note}"), |canvas| {
        title(canvas, MARGIN, 0.0, WIDTH - 2.0 * MARGIN, "Convergence", &note);
        chart(canvas, TITLE, "objective", last, (&Axis::padded(&objective), &objective), None);
        let top = TITLE + CHART;
        if logarithmic {
            let tolerance = report.options.tolerance;
            let mark = (tolerance > low * 1e-3 && tolerance < high).then_some(tolerance);
            let floor = mark.map_or(low, |mark| mark.min(low));
            let axis = Axis { low: floor * 0.7, high: high * 1.5, logarithmic };
            chart(canvas, top, "change, logarithmic", last, (&axis, &positive), mark);
        } else {
            chart(canvas, top, "change", last, (&Axis::padded(&change), &change), None);
        }
        canvas.text(WIDTH / 2.0, SIZE.1 - 14.0, "iteration", Type::new(11.0).centred().colour(MUTED));
    })?;
    Ok(Some(Picture { name: "trace", part: Part::Fit, title: "Convergence", caption, svg }))
}

/// Finite points (iteration, value), thinned.
fn series(report: &Report, value: impl Fn(&crate::irl::TraceEntry) -> f64) -> Vec<(f64, f64)> {
    let points: Vec<_> = report.trace.iter().map(|entry| (f64::from(entry.iteration), value(entry))).collect();
    let points: Vec<_> = points.into_iter().filter(|(_, y)| y.is_finite() && y.abs() < 1e100).collect();
    let stride = points.len().div_ceil(MOST_POINTS).max(1);
    let last = points.len().saturating_sub(1);
    points.into_iter().enumerate().filter(|&(i, _)| i % stride == 0 || i == last).map(|(_, point)| point).collect()
}

fn range(points: &[(f64, f64)]) -> (f64, f64) {
    points.iter().fold((f64::INFINITY, f64::NEG_INFINITY), |(low, high), &(_, y)| (low.min(y), high.max(y)))
}

/// What an axis spans.
pub(super) struct Axis {
    pub(super) low: f64,
    pub(super) high: f64,
    pub(super) logarithmic: bool,
}

impl Axis {
    /// An even axis with some air above and below.
    fn padded(points: &[(f64, f64)]) -> Self {
        let (low, high) = range(points);
        if low > high {
            return Self { low: 0.0, high: 1.0, logarithmic: false };
        }
        let air = if high > low { 0.06 * (high - low) } else { 0.1 * high.abs().max(1e-6) };
        Self { low: low - air, high: high + air, logarithmic: false }
    }

    /// Where a value lies between the ends, in [0, 1].
    pub(super) fn share(&self, value: f64) -> f64 {
        let scaled = |x: f64| if self.logarithmic { x.max(f64::MIN_POSITIVE).log10() } else { x };
        let (low, high) = (scaled(self.low), scaled(self.high));
        ((scaled(value) - low) / (high - low)).clamp(0.0, 1.0)
    }

    /// Powers of ten, or steps of 1, 2 or 5 times one; about `most` of them.
    pub(super) fn ticks(&self, most: u32) -> Vec<f64> {
        if self.logarithmic {
            let (low, high) = (self.low.log10().ceil() as i32, self.high.log10().floor() as i32);
            let step = (high - low) / most as i32 + 1;
            return (low..=high).filter(|power| power.rem_euclid(step) == 0).map(|power| 10f64.powi(power)).collect();
        }
        let rough = (self.high - self.low) / f64::from(most);
        let power = 10f64.powf(rough.log10().floor());
        let step = [1.0, 2.0, 5.0].map(|k| k * power).into_iter().find(|&step| step >= rough).unwrap_or(10.0 * power);
        let first = (self.low / step).ceil();
        (0..=2 * most).map(|i| (first + f64::from(i)) * step).take_while(|&y| y <= self.high).collect()
    }
}

/// Label of a tick: powers of ten are written so.
pub(super) fn tick(value: f64) -> String {
    let power = value.log10().round();
    if value > 0.0 && (value / 10f64.powf(power) - 1.0).abs() < 1e-9 && !(-2.0..4.0).contains(&power) {
        return format!("1e{power}").replace('-', "−");
    }
    let text = brief((value * 1e9).round() / 1e9);
    if text.contains('.') && !text.contains('e') {
        return text.trim_end_matches('0').trim_end_matches('.').to_owned();
    }
    text
}

/// One line over the iterations with its axes, `CHART` high.
fn chart(
    canvas: &Canvas<'_>,
    top: f64,
    name: &str,
    last: f64,
    (axis, points): (&Axis, &[(f64, f64)]),
    mark: Option<f64>,
) {
    let (left, right, foot) = (MARGIN + LABELS, WIDTH - MARGIN, top + CHART - 30.0);
    let (ceiling, muted) = (top + 20.0, Type::new(10.5).colour(MUTED));
    let across = if last > 1.0 {
        Axis { low: 1.0, high: last, logarithmic: false }
    } else {
        Axis { low: 0.0, high: 2.0, logarithmic: false }
    };
    let x = |iteration: f64| left + (right - left) * across.share(iteration);
    let y = |value: f64| foot - (foot - ceiling) * axis.share(value);

    canvas.text(MARGIN, top + 6.0, name, Type::new(11.5));
    for value in axis.ticks(4) {
        canvas.path(&[(left, y(value)), (right, y(value))], RULE, 0.8);
        canvas.text(left - 7.0, y(value), &tick(value), muted.right());
    }
    canvas.path(&[(left, foot), (right, foot)], MUTED, 0.8);
    let mut free = f64::NEG_INFINITY;
    for iteration in std::iter::once(1.0).chain(across.ticks(5)).filter(|&i| i >= 1.0 && i <= last && i.fract() == 0.0)
    {
        let text = count(iteration);
        let half = text_width(&text, 10.5) / 2.0;
        if x(iteration) - half > free + 4.0 {
            canvas.text(x(iteration), foot + 13.0, &text, muted.centred());
            canvas.path(&[(x(iteration), foot), (x(iteration), foot + 4.0)], MUTED, 0.8);
            free = x(iteration) + half;
        }
    }
    if let Some(mark) = mark {
        let dash = (right - left) / 51.0;
        for i in (0..51).step_by(2).map(f64::from) {
            canvas.path(&[(left + i * dash, y(mark)), (left + (i + 1.0) * dash, y(mark))], MUTED, 1.0);
        }
    }
    let line: Vec<_> = points.iter().map(|&(i, value)| (x(i), y(value))).collect();
    if line.len() > 1 {
        canvas.path(&line, ACCENT, 1.8);
    }
    let radius = if points.len() > 60 { 0.0 } else { 2.2 };
    for (i, &(x, y)) in line.iter().enumerate() {
        let end = i + 1 == line.len();
        if end || radius > 0.0 {
            canvas.disc(x, y, if end { 3.2 } else { radius }, ACCENT.mix(1.0));
        }
    }
}
