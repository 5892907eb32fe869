//! What a comparison leaves behind: tables, CSV, JSON and pictures, and the line that says whether the default holds.

use super::job::Job;
use crate::cli::error::CliError;
use comfy_table::{CellAlignment, ContentArrangement, LineStyle, Table, TableStyle};
use mazeway_learner::{
    eval::{
        Interval,
        comparison::{Comparison, Difference, Row, Verdict},
    },
    report::{self, pictures, write::replace},
};
use serde::Serialize;
use std::{
    fmt::Write as _,
    path::{Path, PathBuf},
};

/// From this number of demonstrations on, the default is meant to be beaten by none.
pub const FEWEST: u32 = 5;

const RULE: LineStyle = LineStyle::none().fill('─').junction('─');
const STYLE: TableStyle = TableStyle::new().header_separator(RULE);

/// The array for programs, without a final newline.
pub fn json(comparison: &Comparison) -> String {
    serde_json::to_string(&comparison.rows).expect("plain structs of numbers and text serialise")
}

/// Differences to the baseline, for programs.
#[derive(Serialize)]
struct Paired<'a> {
    baseline: &'a str,
    pairs: &'a [mazeway_learner::eval::comparison::Pair],
    verdict: String,
    verdict_of_all: String,
}

/// Writes everything into a directory; returns the files.
///
/// # Errors
/// A picture cannot be drawn, a file cannot be written.
pub fn write(job: &Job, comparison: &Comparison, out: &Path) -> Result<Vec<PathBuf>, CliError> {
    let fail = |error: report::ReportError| {
        CliError::failure(error.to_string(), "choose a directory that you may write to with --out DIR")
    };
    let paired = Paired {
        baseline: &comparison.baseline,
        pairs: &comparison.pairs,
        verdict: comparison.verdict(FEWEST),
        verdict_of_all: comparison.verdict(1),
    };
    let paired = serde_json::to_string_pretty(&paired).expect("plain structs of numbers and text serialise") + "\n";
    let mut files = vec![
        ("table.txt".to_owned(), table(job, comparison).into_bytes()),
        ("comparison.csv".to_owned(), csv(comparison).into_bytes()),
        ("paired.json".to_owned(), paired.into_bytes()),
    ];
    for picture in pictures::comparison(comparison, &title(job)).map_err(fail)? {
        let message = |message| report::ReportError::Picture { picture: picture.name, message };
        files.push((format!("{}.png", picture.name), pictures::png(&picture.svg).map_err(message).map_err(fail)?));
        files.push((format!("{}.svg", picture.name), picture.svg.into_bytes()));
    }
    // The array comes last: where it is, the others are.
    files.push(("comparison.json".to_owned(), (json(comparison) + "\n").into_bytes()));
    files.into_iter().map(|(name, content)| replace(out, &name, &content).map_err(fail)).collect()
}

/// What was compared, in a few words.
fn title(job: &Job) -> String {
    let options: Vec<String> = job
        .env_options
        .iter()
        .filter(|(name, _)| *name != "layout")
        .map(|(name, value)| format!(", {name} {value}"))
        .collect();
    let layout = if job.env_options.contains_key("layout") { ", own layout" } else { "" };
    let style = job.style.as_deref().map_or_else(String::new, |style| format!(", {style}"));
    format!(
        "{}{style}{layout}{}: {} steps each, discount {}, {} seeds",
        job.env_id,
        options.concat(),
        job.horizon,
        job.discount(),
        job.seeds
    )
}

/// All tables, for people.
pub fn table(job: &Job, comparison: &Comparison) -> String {
    let known = comparison.rows.iter().any(|row| row.evd.is_some());
    let mut text = format!("{}\n\n", title(job));
    let mut part = |heading: &str, cell: &dyn Fn(&Row) -> String| {
        let _ = writeln!(text, "{heading}\n{}\n", grid(job, comparison, cell));
    };
    let mark = |difference: Option<Difference>| match difference.map(|d| d.verdict) {
        Some(Verdict::Better) => " ▲",
        Some(Verdict::Worse) => " ▼",
        Some(Verdict::Open) | None => "  ",
    };
    let pair = |row: &Row| comparison.pair(&row.method, row.trajectories);
    let agreement = if known {
        "Agreement: share of the states whose action is optimal, by number of demonstrations"
    } else {
        "Agreement: share of the expert's unseen steps, by number of demonstrations"
    };
    part(agreement, &|row| {
        let told = row.agreement.map(|interval| number(interval, 3));
        told.map_or_else(|| "refused".to_owned(), |told| told + mark(pair(row).and_then(|pair| pair.agreement)))
    });
    if known {
        part("EVD: expected value difference", &|row| {
            let told = row.evd.map(|interval| number(interval, 3));
            told.map_or_else(|| "refused".to_owned(), |told| told + mark(pair(row).and_then(|pair| pair.evd)))
        });
    } else {
        part("Log-likelihood of the expert's unseen steps, per step", &|row| {
            let told = row.log_likelihood.map(|interval| number(interval, 3));
            let marked = |told: String| told + mark(pair(row).and_then(|pair| pair.log_likelihood));
            told.map_or_else(|| "refused".to_owned(), marked)
        });
    }
    part("Time of a fit on one core, median", &|row| {
        row.fit_secs.map_or_else(|| "refused".to_owned(), |secs| time(secs) + "  ")
    });
    let _ = writeln!(
        text,
        "mean ± half of the 95 % interval (Student's t over {} seeds); ▲ significantly better, ▼ significantly worse than {} on \
         paired seeds",
        job.seeds, comparison.baseline
    );
    for row in comparison.rows.iter().filter(|row| row.refused.is_some()) {
        let reason = row.refused.as_deref().unwrap_or_default();
        let all = if row.seeds == 0 { "" } else { " on some seeds" };
        let _ = writeln!(text, "refused: {} at L = {}{all}: {reason}", row.method, row.trajectories);
    }
    if job.entries.len() > 1 {
        let _ = writeln!(text, "verdict: {}", comparison.verdict(FEWEST));
        if job.trajectories.first().is_some_and(|&l| l < FEWEST) {
            let _ = writeln!(text, "at any L: {}", comparison.verdict(1));
        }
    }
    text
}

/// A time as it compares: `4.2 µs`, `12 ms`, `3.1 s`.
fn time(secs: f64) -> String {
    match secs {
        _ if secs < 1e-3 => format!("{:.0} µs", secs * 1e6),
        _ if secs < 1.0 => format!("{:.1} ms", secs * 1e3),
        _ => format!("{secs:.2} s"),
    }
}

/// Methods down, numbers of demonstrations across.
fn grid(job: &Job, comparison: &Comparison, cell: &dyn Fn(&Row) -> String) -> String {
    let mut table = Table::new();
    table.load_style(STYLE).force_no_tty().set_content_arrangement(ContentArrangement::Disabled);
    table.set_header(std::iter::once("L".to_owned()).chain(job.trajectories.iter().map(|l| format!("{l}  "))));
    for entry in &job.entries {
        let cells = job.trajectories.iter().map(|&l| comparison.row(&entry.name, l).map(cell).unwrap_or_default());
        table.add_row(std::iter::once(entry.name.clone()).chain(cells));
    }
    for column in table.column_iter_mut().skip(1) {
        column.set_cell_alignment(CellAlignment::Right);
    }
    table.trim_fmt()
}

/// `0.831 ± 0.042`.
fn number(interval: Interval, decimals: usize) -> String {
    let half = f64::midpoint(interval.high - interval.mean, interval.mean - interval.low);
    let mean = format!("{:.decimals$}", interval.mean);
    if half.is_finite() { format!("{mean} ± {half:.decimals$}") } else { mean }
}

/// One line a method and number of demonstrations.
fn csv(comparison: &Comparison) -> String {
    let mut text = "method,trajectories,seeds,agreement_mean,agreement_low,agreement_high,evd_mean,evd_low,evd_high,\
                    log_likelihood_mean,log_likelihood_low,log_likelihood_high,fit_secs,refused\n"
        .to_owned();
    let cell = |value: Option<f64>| value.filter(|v| v.is_finite()).map(|v| v.to_string()).unwrap_or_default();
    for row in &comparison.rows {
        let _ = write!(text, "{},{},{}", quoted(&row.method), row.trajectories, row.seeds);
        for interval in [row.agreement, row.evd, row.log_likelihood] {
            for value in [interval.map(|i| i.mean), interval.map(|i| i.low), interval.map(|i| i.high)] {
                let _ = write!(text, ",{}", cell(value));
            }
        }
        let _ = writeln!(text, ",{},{}", cell(row.fit_secs), quoted(row.refused.as_deref().unwrap_or_default()));
    }
    text
}

fn quoted(text: &str) -> String {
    if text.contains([',', '"', '\n', '\r']) { format!("\"{}\"", text.replace('"', "\"\"")) } else { text.to_owned() }
}
