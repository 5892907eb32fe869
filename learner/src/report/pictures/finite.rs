//! Any finite process: states by actions as a heat map, the states visited most where there are many.

use super::canvas::{Canvas, Type, fit, text_width};
use super::colour::{ACCENT, EMPTY, MUTED, RULE, Scale};
use super::panel::{BAR, MARGIN, TITLE, WIDTH, bar, title};
use super::{Part, Picture};
use crate::report::format::{alike, count, unit};
use crate::report::{Report, ReportError};
use plotters::style::Color;
use std::fmt::Write as _;

/// States and actions drawn at most.
const MOST_STATES: usize = 60;
const MOST_ACTIONS: usize = 24;
/// Room for the names of the states at most.
const STATE_NAMES: f64 = 176.0;
const SET: f64 = 10.5;

/// What all pictures of a process share.
struct Layout {
    states: Vec<usize>,
    actions: Vec<usize>,
    row: f64,
    column: f64,
    /// Height of the actions' names.
    names: f64,
    /// Left edge of the first column.
    left: f64,
}

impl Layout {
    fn new(report: &Report) -> Self {
        let (states, _) = report.leading_states(MOST_STATES);
        let mut actions: Vec<usize> = (0..report.actions()).collect();
        // Actions that the policy takes most often come first where not all have room.
        let weight =
            |action: usize| -> f64 { states.iter().map(|&s| report.policy[s * report.actions() + action]).sum() };
        if actions.len() > MOST_ACTIONS {
            actions.sort_by(|&i, &j| weight(j).total_cmp(&weight(i)).then(i.cmp(&j)));
            actions.truncate(MOST_ACTIONS);
            actions.sort_unstable();
        }
        let longest = states.iter().map(|&s| text_width(&report.state_name(s, 60), SET)).fold(40.0, f64::max);
        let left = MARGIN + (longest + 10.0).min(STATE_NAMES);
        let column = ((WIDTH - MARGIN - left) / actions.len().max(1) as f64).min(96.0);
        let row = if states.len() > 20 { 15.0 } else { 22.0 };
        let longest = actions.iter().map(|&a| text_width(&report.action_name(a, 22), SET)).fold(0.0, f64::max);
        Self { states, actions, row, column, left, names: if longest < column - 4.0 { 20.0 } else { longest + 12.0 } }
    }

    fn height(&self) -> f64 {
        self.row * self.states.len() as f64
    }

    /// What is shown, and of how many states (and actions, for `pairs`) it is a part.
    fn note(&self, report: &Report, what: &str, pairs: bool) -> String {
        let mut note = what.to_owned();
        if self.states.len() < report.states() {
            let _ = write!(note, "; {} of {} states", self.states.len(), count(f64::from(report.n_states)));
        }
        if pairs && self.actions.len() < report.actions() {
            let _ = write!(note, "; {} of {} actions", self.actions.len(), count(f64::from(report.n_actions)));
        }
        note
    }

    /// What to add to a caption where not everything is shown.
    fn omission(&self, report: &Report) -> &'static str {
        if self.states.len() < report.states() || self.actions.len() < report.actions() {
            " Shown are the states visited most and the actions taken most; the table has more."
        } else {
            ""
        }
    }

    /// Names of the states, `top` being the upper edge of the first row.
    fn state_names(&self, canvas: &Canvas<'_>, report: &Report, top: f64) {
        for (i, &state) in self.states.iter().enumerate() {
            let name = fit(&report.state_name(state, 60), SET, self.left - MARGIN - 8.0);
            let colour = if report.visited(state) { super::colour::INK } else { MUTED };
            let y = top + (i as f64 + 0.5) * self.row;
            canvas.text(self.left - 8.0, y, &name, Type::new(SET).right().colour(colour));
        }
    }
}

/// Reward and policy over states and actions, and visits where `visits` is set.
pub(super) fn pictures(report: &Report, visits: bool) -> Result<Vec<Picture>, ReportError> {
    let layout = Layout::new(report);
    let mut pictures = vec![
        pairs(
            report,
            &layout,
            ("policy_table", "Policy", "probability of each action"),
            &report.policy,
            "The probability with which the learned policy, as it explains the demonstrations, takes each action; each row sums to 1.",
        )?,
        pairs(
            report,
            &layout,
            ("reward_table", "Reward", "learned reward of each action"),
            &report.reward,
            "The learned reward of each action in each state. A reward is known up to its scale only; names in grey are states \
             that the demonstrations do not visit.",
        )?,
    ];
    if visits {
        pictures.push(bars(
            report,
            &layout,
            ("visits", Part::Seen, "Visits", "demonstrated steps in each state"),
            &report.state_visits,
            "How often the demonstrations visit each state: all that the learner knows of the expert.",
        )?);
        pictures.push(bars(
            report,
            &layout,
            ("values", Part::Learned, "State values", "expected discounted reward"),
            &report.state_values,
            "How good it is to be in each state under the learned reward.",
        )?);
    }
    Ok(pictures)
}

fn pairs(
    report: &Report,
    layout: &Layout,
    (name, heading, what): (&'static str, &'static str, &str),
    values: &[f64],
    caption: &str,
) -> Result<Picture, ReportError> {
    let size = (WIDTH, TITLE + layout.names + layout.height() + BAR);
    let note = layout.note(report, what, true);
    // Probabilities keep their own scale, from 0 to 1.
    let probabilities = name == "policy_table";
    let (factor, unit) = if probabilities { (1.0, String::new()) } else { unit(values) };
    let values: Vec<f64> = values.iter().map(|value| value / factor).collect();
    let svg = Canvas::draw(name, size, &format!("{heading}: {note}"), |canvas| {
        title(canvas, MARGIN, 0.0, WIDTH - 2.0 * MARGIN, heading, &note);
        let scale = Scale::from_zero(if probabilities { vec![1.0] } else { values.clone() });
        let (left, top) = (layout.left, TITLE + layout.names);
        for (j, &action) in layout.actions.iter().enumerate() {
            let (x, text) = (left + (j as f64 + 0.5) * layout.column, report.action_name(action, 22));
            let set = Type::new(SET).colour(MUTED);
            if text_width(&text, SET) < layout.column - 4.0 && layout.names <= 20.0 {
                canvas.text(x, top - 10.0, &text, set.centred());
            } else {
                canvas.text(x, top - 6.0, &text, set.upright());
            }
        }
        layout.state_names(canvas, report, top);
        let write = alike(values.iter().copied());
        for (i, &state) in layout.states.iter().enumerate() {
            for (j, &action) in layout.actions.iter().enumerate() {
                let value = values[state * report.actions() + action];
                let (x, y) = (left + j as f64 * layout.column, top + i as f64 * layout.row);
                canvas.rect(x, y, layout.column, layout.row, scale.colour(value));
                let text = write(value);
                if value != 0.0 && text_width(&text, 10.0) < layout.column - 4.0 && layout.row > 12.0 {
                    let set = Type::new(10.0).centred().colour(scale.ink(value));
                    canvas.text(x + layout.column / 2.0, y + layout.row / 2.0, &text, set);
                }
            }
        }
        let width = layout.column * layout.actions.len() as f64;
        canvas.outline(left, top, width, layout.height(), RULE, 0.8);
        for j in 1..layout.actions.len() {
            let x = left + j as f64 * layout.column;
            canvas.path(&[(x, top), (x, top + layout.height())], EMPTY, 0.8);
        }
        bar(
            canvas,
            left,
            top + layout.height(),
            WIDTH - MARGIN - left,
            &scale,
            &format!("{}{unit}", heading.to_lowercase()),
            false,
        );
    })?;
    Ok(Picture {
        name,
        part: Part::Learned,
        title: heading,
        caption: format!("{caption}{}", layout.omission(report)),
        svg,
    })
}

/// A number of each state as a bar; bars start at zero.
fn bars(
    report: &Report,
    layout: &Layout,
    (name, part, heading, what): (&'static str, Part, &'static str, &str),
    values: &[f64],
    caption: &str,
) -> Result<Picture, ReportError> {
    let size = (WIDTH, TITLE + layout.height() + MARGIN);
    let note = layout.note(report, what, false);
    let svg = Canvas::draw(name, size, &format!("{heading}: {note}"), |canvas| {
        title(canvas, MARGIN, 0.0, WIDTH - 2.0 * MARGIN, heading, &note);
        layout.state_names(canvas, report, TITLE);
        let shown = || layout.states.iter().map(|&state| values[state]).filter(|x| x.is_finite());
        let (low, high) = shown().fold((0.0f64, 0.0f64), |(low, high), x| (low.min(x), high.max(x)));
        let span = if high > low { high - low } else { 1.0 };
        let write = alike(shown());
        let write = |value: f64| if part == Part::Seen { count(value) } else { write(value) };
        let longest = shown().map(|x| text_width(&write(x), SET)).fold(0.0, f64::max);
        let room = WIDTH - MARGIN - layout.left - longest - 8.0;
        let zero = layout.left - room * low / span;
        for (i, &state) in layout.states.iter().enumerate() {
            let y = TITLE + i as f64 * layout.row;
            let value = values[state];
            let end = zero + if value.is_finite() { room * value / span } else { 0.0 };
            let (top, foot) = (y + 2.0, y + layout.row - 2.0);
            canvas.polygon(&[(zero, top), (end, top), (end, foot), (zero, foot)], ACCENT.mix(1.0));
            canvas.text(end.max(zero) + 6.0, y + layout.row / 2.0, &write(value), Type::new(SET).colour(MUTED));
        }
        canvas.path(&[(zero, TITLE), (zero, TITLE + layout.height())], MUTED, 0.8);
    })?;
    Ok(Picture { name, part, title: heading, caption: format!("{caption}{}", layout.omission(report)), svg })
}
