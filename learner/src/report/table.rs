//! Tables for a terminal: drivers side by side, the fit in a glance, and what was learned in each state.
//!
//! Invariants: no line is wider than the terminal where a table can be made narrow enough, and no escape code is written unless colours are wanted.

use super::format::{METRICS, MISSING, alike, brief, clip, count, duration, fixed, interval, percent, stopped};
use super::space::{Heading, LANES, LaneChange, SPEEDS_MPS, TRAFFIC, highway_action, highway_state};
use super::{DriverMetrics, Report, ReportError};
use comfy_table::{Cell, CellAlignment, Color, ContentArrangement, LineStyle, Table, TableStyle};
use std::fmt::Write as _;
use std::io::IsTerminal;

/// States listed where the environment has no layout that is known here.
const MOST_STATES: usize = 40;
/// Weights listed at most.
const MOST_WEIGHTS: usize = 12;
const RULE: LineStyle = LineStyle::none().fill('─').junction('─');
const STYLE: TableStyle = TableStyle::new().top_border(RULE).header_separator(RULE).bottom_border(RULE);

/// How wide to write, and whether with colours.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Terminal {
    /// Columns.
    pub width: usize,
    /// Whether escape codes for colours are understood and wanted.
    pub colour: bool,
}

impl Terminal {
    /// What standard output is: the terminal's width, colours unless `NO_COLOR` is set or the terminal is dumb;
    /// 120 columns without colours where it is no terminal.
    pub fn stdout() -> Self {
        let tty = std::io::stdout().is_terminal();
        let set = |name: &str| std::env::var_os(name).is_some_and(|value| !value.is_empty());
        let dumb = std::env::var_os("TERM").is_some_and(|term| term == "dumb");
        let width = if tty { Table::new().width().map(usize::from).filter(|&w| w > 0) } else { None };
        Self { width: width.unwrap_or(120), colour: tty && !dumb && !set("NO_COLOR") }
    }

    fn table(self) -> Table {
        let mut table = Table::new();
        table
            .load_style(STYLE)
            .set_content_arrangement(ContentArrangement::Dynamic)
            .set_width(self.width.clamp(20, usize::from(u16::MAX)) as u16);
        if self.colour {
            table.enforce_styling();
        } else {
            table.force_no_tty();
        }
        table
    }

    fn paint(self, text: &str, code: &str) -> String {
        if self.colour { format!("\x1b[{code}m{text}\x1b[0m") } else { text.to_owned() }
    }

    fn heading(self, text: &str) -> String {
        self.paint(text, "1")
    }

    fn dim(self, text: &str) -> String {
        self.paint(text, "2")
    }
}

/// All tables of a report, one under another, ending with a newline.
///
/// # Errors
/// Arrays of the wrong shape.
pub fn render(report: &Report, terminal: Terminal) -> Result<String, ReportError> {
    report.check()?;
    let mut parts = Vec::new();
    parts.extend(drivers(report, terminal));
    parts.push(summary(report, terminal));
    parts.extend(features(report, terminal));
    parts.push(states(report, terminal));
    parts.extend(weights(report, terminal));
    parts.extend(reliability(report, terminal));
    parts.extend(transfer(report, terminal));
    if !report.warnings.is_empty() {
        let lines = report
            .warnings
            .iter()
            .map(|warning| format!("{} {}", terminal.paint("warning:", "33"), clip(warning, 2000)));
        parts.push(lines.collect::<Vec<_>>().join("\n"));
    }
    Ok(parts.join("\n\n") + "\n")
}

/// The weights with their intervals; `None` where none are known.
fn weights(report: &Report, terminal: Terminal) -> Option<String> {
    let uncertainty = report.uncertainty.as_ref()?;
    let shown = report.leading_weights(MOST_WEIGHTS);
    let mut table = terminal.table();
    table.set_header(["weight", "estimate", "standard deviation", "95 % interval"].map(head));
    for &weight in &shown {
        let sd = uncertainty.standard_deviations[weight];
        let sd = if sd.is_finite() { brief(sd) } else { "∞".to_owned() };
        let row = [report.weight_name(weight, 60), brief(report.weights[weight]), sd, uncertainty.interval(weight)]
            .map(Cell::new);
        table.add_row(row.map(|cell| if uncertainty.determined(weight) { cell } else { cell.fg(Color::DarkGrey) }));
    }
    right_align(&mut table, 1..4);
    let some = if shown.len() < report.weights.len() {
        format!("  the {} largest of {}", shown.len(), count(report.weights.len() as f64))
    } else {
        String::new()
    };
    Some(format!("{}{}\n{}", terminal.heading("Weights"), terminal.dim(&some), table.trim_fmt()))
}

/// Predicted against observed; `None` where nothing was held out.
fn reliability(report: &Report, terminal: Terminal) -> Option<String> {
    let validation = report.validation.as_ref()?;
    let mut table = terminal.table();
    table.set_header(["predicted", "came true", "predictions"].map(head));
    for bin in validation.calibration.bins.iter().filter(|bin| bin.predictions > 0) {
        table.add_row([fixed(bin.predicted, 3), fixed(bin.observed, 3), count(bin.predictions as f64)]);
    }
    right_align(&mut table, 0..3);
    let note = "  probabilities of actions on trajectories that the fit did not see";
    Some(format!("{}{}\n{}", terminal.heading("Calibration"), terminal.dim(note), table.trim_fmt()))
}

/// What was learned, in another model; `None` where none was asked for.
fn transfer(report: &Report, terminal: Terminal) -> Option<String> {
    let transfer = report.transfer.as_ref()?;
    let mut table = terminal.table();
    let known: Vec<&DriverMetrics> = transfer.rows.iter().filter_map(|row| row.metrics.as_ref()).collect();
    let truth = transfer.rows.iter().any(|row| row.expected_value_difference.is_some());
    let mut header = vec![head("acting on")];
    if truth {
        header.extend([head("agreement"), head("expected value difference")]);
    }
    if !known.is_empty() {
        header.extend(METRICS.iter().map(|metric| head(metric.name)));
    }
    let columns = header.len();
    table.set_header(header);
    for row in &transfer.rows {
        let mut cells = vec![clip(&row.name, 60)];
        if truth {
            cells.push(row.agreement.map_or_else(|| MISSING.to_owned(), percent));
            cells.push(row.expected_value_difference.map_or_else(|| MISSING.to_owned(), difference_text));
        }
        if !known.is_empty() {
            cells.extend(METRICS.iter().map(|metric| {
                row.metrics
                    .as_ref()
                    .map_or_else(|| MISSING.to_owned(), |m| interval((metric.of)(m), metric.decimals(&known)))
            }));
        }
        table.add_row(cells);
    }
    right_align(&mut table, 1..columns);
    let new = match transfer.new_states {
        0 => String::new(),
        n => format!(", {} new states", count(n as f64)),
    };
    let what = format!("  {}{new}", clip(&transfer.target, 200));
    Some(format!("{}{}\n{}", terminal.heading("In another model"), terminal.dim(&what), table.trim_fmt()))
}

/// A header cell.
fn head(text: impl Into<String>) -> Cell {
    Cell::new(text.into()).fg(Color::DarkGrey)
}

fn right_align(table: &mut Table, columns: impl IntoIterator<Item = usize>) {
    for column in columns {
        if let Some(column) = table.column_mut(column) {
            column.set_cell_alignment(CellAlignment::Right);
        }
    }
}

/// Expert, learned and random side by side; `None` where no driver was rolled out.
fn drivers(report: &Report, terminal: Terminal) -> Option<String> {
    let drivers = report.drivers.as_ref()?;
    let rows =
        [("expert", drivers.expert.as_ref()), ("learned", Some(&drivers.learned)), ("random", Some(&drivers.random))];
    let known: Vec<&DriverMetrics> = rows.iter().filter_map(|&(_, metrics)| metrics).collect();
    let mut table = terminal.table();
    table.set_header(std::iter::once(head("driver")).chain(METRICS.iter().map(|metric| head(metric.name))));
    for (name, metrics) in rows {
        let mut cells = vec![Cell::new(name)];
        for metric in &METRICS {
            let places = metric.decimals(&known);
            cells.push(Cell::new(metrics.map_or_else(|| MISSING.to_owned(), |m| interval((metric.of)(m), places))));
        }
        if name == "learned" {
            cells = cells.into_iter().map(|cell| cell.fg(Color::Cyan)).collect();
        }
        table.add_row(cells);
    }
    right_align(&mut table, 1..5);
    let note = report.evaluation.map_or_else(String::new, |evaluation| {
        format!(", {} episodes of {} steps each", count(evaluation.episodes as f64), count(evaluation.steps as f64))
    });
    Some(format!(
        "{}{}\n{}",
        terminal.heading("Drivers"),
        terminal.dim(&format!("  mean ± 95 % interval{note}")),
        table.trim_fmt()
    ))
}

/// An expected value difference; what rounding leaves of none is none.
pub(crate) fn difference_text(difference: f64) -> String {
    if difference.abs() < 1e-9 { "0".to_owned() } else { brief(difference) }
}

/// Weights of the features, and how much of each there is a step; `None` where the fit does not weigh any.
fn features(report: &Report, terminal: Terminal) -> Option<String> {
    if report.features.is_empty() {
        return None;
    }
    let mut table = terminal.table();
    table.set_header(["feature", "weight", "demonstrated", "learned", "random"].map(head));
    let column = |of: fn(&super::FeatureRow) -> f64| alike(report.features.iter().map(of));
    let (weight, means) = (
        column(|row| row.weight.mean),
        alike(report.features.iter().flat_map(|r| [r.demonstrated, r.learned, r.random])),
    );
    for row in &report.features {
        let (low, high) = (row.weight.low, row.weight.high);
        let ends = if low.is_finite() && high.is_finite() {
            format!(" [{}, {}]", weight(low), weight(high))
        } else {
            String::new()
        };
        let cells = [
            clip(&row.name, 40),
            format!("{}{ends}", weight(row.weight.mean)),
            means(row.demonstrated),
            means(row.learned),
            means(row.random),
        ];
        table.add_row(cells.map(Cell::new));
    }
    right_align(&mut table, 1..5);
    Some(format!(
        "{}{}\n{}",
        terminal.heading("Features"),
        terminal.dim(
            "  weight [95 % interval] and mean a step: demonstrated, of the learned policy in the model, at random"
        ),
        table.trim_fmt()
    ))
}

/// The fit in a glance, as names and values.
pub(crate) fn summary_rows(report: &Report) -> Vec<(&'static str, String)> {
    let share = |part: f64, of: f64| if of > 0.0 { format!(" ({})", percent(part / of)) } else { String::new() };
    let held_out = report.agreement_held_out.map(percent);
    let mut rows = if report.optimal_policy.is_some() {
        let mut rows =
            vec![("policy agreement", format!("{} of the states take an optimal action", percent(report.agreement)))];
        rows.extend(
            held_out.map(|share| ("on unseen steps", format!("{share} of the expert's actions, ties counted in part"))),
        );
        rows
    } else {
        let held_out = held_out.map_or_else(String::new, |share| format!("; {share} on unseen steps"));
        vec![("action agreement", format!("{} of the demonstrated steps{held_out}", percent(report.agreement)))]
    };
    if let Some(difference) = report.expected_value_difference {
        rows.push(("expected value difference", difference_text(difference)));
    }
    rows.push(("log-likelihood", {
        let held_out =
            report.log_likelihood_per_step_held_out.map(|value| format!("; {} on unseen steps", fixed(value, 3)));
        format!("{} a step{}", fixed(report.log_likelihood_per_step, 3), held_out.unwrap_or_default())
    }));
    if let Some(validation) = &report.validation {
        rows.push((
            "cross-validation",
            format!(
                "log-likelihood {} a step, agreement {} of the steps, calibration error {}; {} folds of {} trajectories",
                interval(&validation.held_out.log_likelihood, 3),
                interval(&validation.agreement, 3),
                fixed(validation.calibration.expected_error, 3),
                validation.folds,
                count(validation.trajectories as f64),
            ),
        ));
    }
    if let Some(uncertainty) = &report.uncertainty {
        rows.push(("uncertainty", uncertainty.summary()));
    }
    if !report.hyperparameters.is_empty() {
        let told = report.hyperparameters.iter().map(|h| format!("{} {}", clip(&h.name, 60), brief(h.value)));
        rows.push(("learned beside it", told.collect::<Vec<_>>().join(", ")));
    }
    rows.push(("states covered", {
        let (covered, all) = (f64::from(report.states_covered), f64::from(report.n_states));
        format!("{} of {}{}", count(covered), count(all), share(covered, all))
    }));
    rows.push((
        "stopped",
        match report.iterations {
            0 => stopped(report.stopped).to_owned(),
            1 => format!("{} after 1 iteration", stopped(report.stopped)),
            n => format!("{} after {} iterations", stopped(report.stopped), count(f64::from(n))),
        },
    ));
    rows.push(("time", format!("{} for the fit, {} in all", duration(report.fit_secs), duration(report.total_secs))));
    rows
}

fn summary(report: &Report, terminal: Terminal) -> String {
    let rows = summary_rows(report);
    let width = rows.iter().map(|row| row.0.chars().count()).max().unwrap_or(0);
    let what = format!(
        "{} on {} × {} steps of {}{}",
        clip(&report.method, 40),
        count(report.trajectories as f64),
        report.horizon,
        clip(&report.env_id, 40),
        if report.style.is_empty() { String::new() } else { format!(", {}", clip(&report.style, 40)) },
    );
    let mut text =
        format!("{}  {}", terminal.heading("Fit"), terminal.dim(&clip(&what, terminal.width.saturating_sub(5))));
    for (name, value) in rows {
        let _ = write!(text, "\n  {} {value}", terminal.dim(&format!("{name:width$}")));
    }
    text
}

fn states(report: &Report, terminal: Terminal) -> String {
    if report.is_highway() {
        highway(report, terminal)
    } else if let (Some(_), Some(headings)) = (&report.grid, report.headings()) {
        grid(report, &headings, terminal)
    } else {
        listing(report, terminal)
    }
}

/// `left → 30` in words of the highway.
pub(crate) fn highway_choice(report: &Report, state: usize) -> String {
    let choices = report.choices(&report.greedy_policy, state);
    let Some(&(action, _)) = choices.first() else { return MISSING.to_owned() };
    let (change, speed) = highway_action(action);
    let change = match change {
        LaneChange::Keep => "keep",
        LaneChange::Left => "left",
        LaneChange::Right => "right",
    };
    if choices.len() == report.actions() {
        return "any".to_owned();
    }
    format!("{change} {}{}", SPEEDS_MPS[speed], ties(&choices))
}

/// How many other actions are as good.
fn ties(choices: &[(usize, f64)]) -> String {
    if choices.len() > 1 { format!(" +{}", choices.len() - 1) } else { String::new() }
}

/// The 36 states, by lane and speed, three kinds of traffic to a line where there is room.
fn highway(report: &Report, terminal: Terminal) -> String {
    let plain = highway_table(report, Terminal { colour: false, ..terminal }, true).trim_fmt();
    let wide = plain.lines().all(|line| line.chars().count() <= terminal.width);
    let table = highway_table(report, terminal, wide).trim_fmt();
    let note = "action: lane change and speed in m/s; no visits: not seen by the learner";
    format!("{}\n{}\n{table}", terminal.heading("Learned policy and reward"), terminal.dim(note))
}

fn highway_table(report: &Report, terminal: Terminal, wide: bool) -> Table {
    let mut table = terminal.table();
    if wide {
        table.set_content_arrangement(ContentArrangement::Disabled);
    }
    let fields = ["action", "reward", "value", "visits"];
    if wide {
        let names = TRAFFIC.iter().flat_map(|traffic| fields.iter().map(move |field| (traffic, field)));
        table.set_header([head("lane"), head("m/s")].into_iter().chain(names.map(|(traffic, field)| {
            head(if *field == "action" { format!("{traffic}:\naction") } else { format!("\n{field}") })
        })));
    } else {
        table.set_header([head("lane"), head("m/s"), head("traffic")].into_iter().chain(fields.map(head)));
    }
    let reward = alike((0..report.states()).map(|state| report.greedy_reward(state)));
    let value = alike(report.state_values.iter().copied());
    let shade = |cell: Cell, state: usize| if report.visited(state) { cell } else { cell.fg(Color::DarkGrey) };
    let cells = |state: usize| {
        [
            highway_choice(report, state),
            reward(report.greedy_reward(state)),
            value(report.state_values[state]),
            count(report.state_visits[state]),
        ]
        .map(|text| shade(Cell::new(text), state))
    };
    for lane in (0..3).rev() {
        if lane < 2 {
            table.add_row([""]);
        }
        for (speed, mps) in SPEEDS_MPS.iter().enumerate() {
            let lane_name = if speed == 0 { LANES[lane] } else { "" };
            if wide {
                let row = (0..3).flat_map(|traffic| cells(highway_state(lane, speed, traffic)));
                table.add_row([Cell::new(lane_name), Cell::new(mps)].into_iter().chain(row));
            } else {
                for (traffic, name) in TRAFFIC.iter().enumerate() {
                    let first = if traffic == 0 { [lane_name.to_owned(), mps.to_string()] } else { Default::default() };
                    let row = cells(highway_state(lane, speed, traffic));
                    table.add_row(first.into_iter().chain([(*name).to_owned()]).map(Cell::new).chain(row));
                }
            }
        }
    }
    right_align(&mut table, if wide { vec![1, 3, 4, 5, 7, 8, 9, 11, 12, 13] } else { vec![1, 4, 5, 6] });
    if wide {
        // Three tables stand side by side: narrow gaps within each, wide ones between.
        for (i, column) in table.column_iter_mut().enumerate() {
            column.set_padding((if matches!(i, 2 | 6 | 10) { 2 } else { 0 }, 0));
        }
    }
    table
}

/// One character for what a policy does in a state of a grid.
fn arrow(choices: &[(usize, f64)], headings: &[Heading]) -> char {
    use Heading::{East, North, South, Stay, West};
    let mut set: Vec<Heading> = choices.iter().map(|&(action, _)| headings[action]).collect();
    set.sort_by_key(|heading| *heading as u8);
    set.dedup();
    match set.as_slice() {
        [North] => '↑',
        [South] => '↓',
        [East] => '→',
        [West] => '←',
        [Stay] => '•',
        [North, South] => '↕',
        [East, West] => '↔',
        [North, East] => '↗',
        [North, West] => '↖',
        [South, East] => '↘',
        [South, West] => '↙',
        [] => '?',
        _ => '+',
    }
}

/// The policy over the grid, the optimal one beside it where it is known.
fn grid(report: &Report, headings: &[Heading], terminal: Terminal) -> String {
    let layout = report.grid.as_ref().expect("the caller checked");
    let (rows, columns) = (layout.rows as usize, layout.columns as usize);
    let mut state_of = vec![None; rows * columns];
    for (state, &cell) in layout.cells.iter().enumerate() {
        state_of[cell as usize] = Some(state);
    }
    let draw = |policy: &[f64], row: usize| -> String {
        let cells = (0..columns).map(|column| match state_of[row * columns + column] {
            None => terminal.dim("█"),
            Some(state) => {
                let mark = arrow(&report.choices(policy, state), headings).to_string();
                if report.visited(state) { mark } else { terminal.dim(&mark) }
            }
        });
        cells.collect::<Vec<_>>().join(" ")
    };
    let panel = (2 * columns).saturating_sub(1).max(15);
    if 2 + panel > terminal.width || rows > 200 {
        return listing(report, terminal);
    }
    let gap = panel + 4 - (2 * columns).saturating_sub(1);
    let beside = report.optimal_policy.as_ref().filter(|_| 2 + 2 * panel + 4 <= terminal.width);
    let mut text =
        format!("{}{}\n  {:panel$}", terminal.heading("Learned policy"), terminal.dim("  █ wall, ↗ + ties"), "learned");
    if beside.is_some() {
        text += "    optimal";
    }
    for row in 0..rows {
        let _ = write!(text, "\n  {}", draw(&report.greedy_policy, row));
        if let Some(policy) = beside {
            let _ = write!(text, "{:gap$}{}", "", draw(policy, row));
        }
    }
    text.lines().map(str::trim_end).collect::<Vec<_>>().join("\n")
}

/// The states visited most, one a line.
fn listing(report: &Report, terminal: Terminal) -> String {
    let (states, all) = report.leading_states(MOST_STATES);
    let mut table = terminal.table();
    table.set_header(["state", "visits", "greedy action", "reward", "value"].map(head));
    let reward = alike(states.iter().map(|&state| report.greedy_reward(state)));
    let value = alike(states.iter().map(|&state| report.state_values[state]));
    for &state in &states {
        let choices = report.choices(&report.greedy_policy, state);
        let action = choices.first().map_or_else(|| MISSING.to_owned(), |&(action, _)| report.action_name(action, 24));
        let row = [
            report.state_name(state, 40),
            count(report.state_visits[state]),
            action + &ties(&choices),
            reward(report.greedy_reward(state)),
            value(report.state_values[state]),
        ];
        let grey = !report.visited(state);
        table.add_row(row.map(|text| if grey { Cell::new(text).fg(Color::DarkGrey) } else { Cell::new(text) }));
    }
    right_align(&mut table, [1, 3, 4]);
    let note = if all {
        String::new()
    } else {
        format!("  the {} visited most of {}", states.len(), count(f64::from(report.n_states)))
    };
    format!("{}{}\n{}", terminal.heading("Learned policy and reward"), terminal.dim(&note), table.trim_fmt())
}
