//! The highway's 36 states: a panel for each kind of traffic, lanes by speeds, as a driver sees them who drives to the right.

use super::canvas::{Canvas, Type};
use super::colour::{INK, MUTED, PAPER, RULE, Scale};
use super::panel::{BAR, MARGIN, TITLE, WIDTH, bar, not_visited, title};
use super::{Part, Picture};
use crate::report::format::{alike, count, unit};
use crate::report::space::{LANES, LaneChange, SPEEDS_MPS, TRAFFIC, highway_action, highway_state};
use crate::report::{Report, ReportError};
use plotters::style::{Color, RGBAColor, RGBColor};

const ROW: f64 = 36.0;
const LANE_NAMES: f64 = 58.0;
const COLUMN: f64 = (WIDTH - 2.0 * MARGIN - LANE_NAMES) / 4.0;
/// A panel with its name above and the gap below.
const PANEL: f64 = 22.0 + 3.0 * ROW + 10.0;
const AXIS: f64 = 36.0;
const SIZE: (f64, f64) = (WIDTH, TITLE + 3.0 * PANEL + AXIS + BAR);
const FOOT: f64 = TITLE + 3.0 * PANEL + AXIS;

/// All pictures of the highway; none for other environments.
pub(super) fn pictures(report: &Report) -> Result<Vec<Picture>, ReportError> {
    if !report.is_highway() {
        return Ok(Vec::new());
    }
    let rewards: Vec<f64> = (0..report.states()).map(|state| report.greedy_reward(state)).collect();
    let visits = &report.state_visits;
    Ok(vec![
        Picture {
            name: "policy",
            part: Part::Learned,
            title: "Learned policy",
            caption: "What the learned driver does in each state. A row is the lane it is in, a column the speed it has; the \
                      arrow is the lane change it makes as it drives to the right, the number the speed it takes up in m/s \
                      (darker is faster). Traffic is clear where the own lane is free for 45 m, passable where only a lane \
                      beside it is, boxed in where none is. Pale hatched states were not seen in the demonstrations."
                .into(),
            svg: Canvas::draw("policy", SIZE, "Learned greedy action in each of the 36 states", |canvas| {
                policy(canvas, report);
            })?,
        },
        Picture {
            name: "reward",
            part: Part::Learned,
            title: "Learned reward",
            caption: "The learned reward of the action that the policy takes in each state. A reward is known up to its scale \
                      only: compare states with each other. A state that the demonstrations do not visit says nothing."
                .into(),
            svg: Canvas::draw("reward", SIZE, "Learned reward of the greedy action in each of the 36 states", |canvas| {
                numbers(canvas, report, ("Learned reward", "of the greedy action in each state", "reward"), &rewards, Scale::from_zero);
            })?,
        },
        Picture {
            name: "visits",
            part: Part::Seen,
            title: "Visits",
            caption: "How often the demonstrations visit each state: all that the learner knows of the expert.".into(),
            svg: Canvas::draw("visits", SIZE, "Visits of each of the 36 states by the demonstrations", |canvas| {
                let scale = Scale::from_zero(visits.iter().copied());
                let note = format!("steps of the demonstrations in each state, {} in all", count(visits.iter().sum()));
                heat(canvas, report, ("Visits", &note, "visits"), (visits, scale, count));
            })?,
        },
        Picture {
            name: "values",
            part: Part::Learned,
            title: "State values",
            caption: "How good it is to be in each state: the expected discounted sum of the learned reward.".into(),
            svg: Canvas::draw("values", SIZE, "Value of each of the 36 states under the learned reward", |canvas| {
                let names = ("State values", "expected discounted sum of the learned reward", "value");
                numbers(canvas, report, names, &report.state_values, Scale::over);
            })?,
        },
    ])
}

/// Top left corner of a state's cell.
fn corner(lane: usize, speed: usize, traffic: usize) -> (f64, f64) {
    let top = TITLE + traffic as f64 * PANEL + 22.0;
    (MARGIN + LANE_NAMES + speed as f64 * COLUMN, top + (2 - lane) as f64 * ROW)
}

/// Every state with its cell's corner.
fn cells() -> impl Iterator<Item = (usize, (f64, f64))> {
    (0..36).map(|i| {
        let (lane, speed, traffic) = (i / 12, i / 3 % 4, i % 3);
        (highway_state(lane, speed, traffic), corner(lane, speed, traffic))
    })
}

/// Titles of the panels, names of lanes and speeds.
fn frame(canvas: &Canvas<'_>, report: &Report, name: &str, note: &str) {
    title(canvas, MARGIN, 0.0, WIDTH - 2.0 * MARGIN, name, note);
    let muted = Type::new(11.0).colour(MUTED);
    for (traffic, name) in TRAFFIC.iter().enumerate() {
        let (x, top) = corner(2, 0, traffic);
        let visits: f64 = (0..12).map(|i| report.state_visits[highway_state(i / 4, i % 4, traffic)]).sum();
        canvas.text(x, top - 10.0, &format!("traffic {name}"), Type::new(12.0).bold());
        canvas.text(x + 4.0 * COLUMN, top - 10.0, &format!("{} steps seen", count(visits)), muted.right());
        for (lane, name) in LANES.iter().enumerate() {
            let (x, y) = corner(lane, 0, traffic);
            canvas.text(x - 8.0, y + ROW / 2.0, name, muted.right());
        }
    }
    let (left, foot) = (MARGIN + LANE_NAMES, TITLE + 3.0 * PANEL);
    for (speed, mps) in SPEEDS_MPS.iter().enumerate() {
        canvas.text(left + (speed as f64 + 0.5) * COLUMN, foot, &mps.to_string(), muted.centred());
    }
    canvas.text(left + 2.0 * COLUMN, foot + 16.0, "present speed, m/s", muted.centred());
    canvas.text(left - 8.0, foot, "lane", muted.right());
}

/// A heat map of numbers in a unit in which they are short.
fn numbers(
    canvas: &Canvas<'_>,
    report: &Report,
    (name, note, what): (&str, &str, &str),
    values: &[f64],
    scale: impl Fn(Vec<f64>) -> Scale,
) {
    let (factor, unit) = unit(values);
    let values: Vec<f64> = values.iter().map(|value| value / factor).collect();
    let write = alike(values.iter().copied());
    heat(canvas, report, (name, note, &format!("{what}{unit}")), (&values, scale(values.clone()), write));
}

fn heat(
    canvas: &Canvas<'_>,
    report: &Report,
    (name, note, unit): (&str, &str, &str),
    (values, scale, write): (&[f64], Scale, impl Fn(f64) -> String),
) {
    frame(canvas, report, name, note);
    for (state, (x, y)) in cells() {
        let value = values[state];
        if report.visited(state) {
            canvas.rect(x, y, COLUMN, ROW, scale.colour(value));
            canvas.text(
                x + COLUMN / 2.0,
                y + ROW / 2.0,
                &write(value),
                Type::new(12.0).centred().colour(scale.ink(value)),
            );
        } else {
            canvas.hatch(x, y, COLUMN, ROW);
        }
        canvas.outline(x, y, COLUMN, ROW, RULE, 0.7);
    }
    let unvisited = (0..36).any(|state| !report.visited(state));
    bar(canvas, MARGIN, FOOT, WIDTH - 2.0 * MARGIN, &scale, unit, unvisited);
}

/// Ground of a cell that takes up a speed level: the lighter third of the scale, so that ink reads on it.
fn speed_colour(level: usize) -> RGBColor {
    Scale::from_zero([1.0]).at([0.02, 0.13, 0.25, 0.37][level.min(3)])
}

/// Direction of a lane change on the page: the road runs to the right, its left lane is on top.
fn direction(change: LaneChange) -> (f64, f64) {
    let diagonal = std::f64::consts::FRAC_1_SQRT_2;
    match change {
        LaneChange::Keep => (1.0, 0.0),
        LaneChange::Left => (diagonal, -diagonal),
        LaneChange::Right => (diagonal, diagonal),
    }
}

fn policy(canvas: &Canvas<'_>, report: &Report) {
    frame(canvas, report, "Learned policy", "greedy lane change and speed in each state");
    for (state, (x, y)) in cells() {
        let choices = report.choices(&report.greedy_policy, state);
        let seen = report.visited(state);
        let (middle, set) = (y + ROW / 2.0, Type::new(13.0));
        match choices.as_slice() {
            [] => canvas.text(x + COLUMN / 2.0, middle, "–", set.centred().colour(MUTED)),
            all if all.len() == report.actions() => {
                canvas.hatch(x, y, COLUMN, ROW);
                // A patch of paper keeps the word free of the hatching.
                canvas.rect(x + COLUMN / 2.0 - 15.0, middle - 8.0, 30.0, 16.0, PAPER);
                canvas.text(x + COLUMN / 2.0, middle, "any", Type::new(11.0).centred().colour(MUTED));
            }
            [(action, _), others @ ..] => {
                let (change, level) = highway_action(*action);
                let (ink, text): (RGBAColor, RGBColor) =
                    if seen { (INK.mix(1.0), INK) } else { (INK.mix(0.45), MUTED) };
                if seen {
                    canvas.rect(x, y, COLUMN, ROW, speed_colour(level));
                } else {
                    canvas.hatch(x, y, COLUMN, ROW);
                    canvas.rect(x + COLUMN / 2.0 - 26.0, middle - 11.0, 54.0, 22.0, PAPER);
                }
                canvas.arrow((x + COLUMN / 2.0 - 13.0, middle), direction(change), 21.0, ink);
                canvas.text(x + COLUMN / 2.0 + 5.0, middle, &SPEEDS_MPS[level].to_string(), set.colour(text));
                if !others.is_empty() {
                    let note = format!("+{}", others.len());
                    canvas.text(x + COLUMN - 4.0, y + 9.0, &note, Type::new(9.0).right().colour(MUTED));
                }
            }
        }
        canvas.outline(x, y, COLUMN, ROW, RULE, 0.7);
    }
    let muted = Type::new(10.5).colour(MUTED);
    let mut x = MARGIN;
    for (change, name) in [(LaneChange::Left, "left"), (LaneChange::Keep, "keep lane"), (LaneChange::Right, "right")] {
        canvas.arrow((x + 8.0, FOOT + 10.0), direction(change), 16.0, INK.mix(1.0));
        canvas.text(x + 20.0, FOOT + 10.0, name, muted);
        x += if change == LaneChange::Keep { 82.0 } else { 54.0 };
    }
    if (0..36).any(|state| !report.visited(state)) {
        not_visited(canvas, x + 2.0, FOOT + 10.0);
    }
    canvas.text(MARGIN, FOOT + 30.0, "takes up", muted);
    for (level, mps) in SPEEDS_MPS.iter().enumerate() {
        let x = MARGIN + 54.0 + level as f64 * 40.0;
        canvas.rect(x, FOOT + 22.0, 36.0, 16.0, speed_colour(level));
        canvas.outline(x, FOOT + 22.0, 36.0, 16.0, RULE, 0.7);
        canvas.text(x + 18.0, FOOT + 30.0, &mps.to_string(), Type::new(10.5).centred());
    }
    canvas.text(MARGIN + 54.0 + 166.0, FOOT + 30.0, "m/s", muted);
}
