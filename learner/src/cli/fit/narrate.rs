//! What a person reads while a fit runs: a line a step, and a bar for anything that may take longer than a second.
//!
//! With `--json` the lines are left out, since standard output carries one object alone. Bars are drawn on standard error, and only
//! where both it and standard output are terminals.

use indicatif::{ProgressBar, ProgressDrawTarget, ProgressStyle};
use mazeway_proto::learner::{FitQueued, fit_response::Event};
use std::{
    io::{self, IsTerminal, Write},
    time::Duration,
};

/// Tells what happens.
#[derive(Debug, Clone, Copy)]
pub struct Narrator {
    quiet: bool,
    bars: bool,
}

impl Narrator {
    /// Tells on standard output unless `json`.
    pub fn new(json: bool) -> Self {
        Self { quiet: json, bars: io::stdout().is_terminal() && io::stderr().is_terminal() }
    }

    /// Shows bars and tells nothing.
    pub fn quiet() -> Self {
        Self { quiet: true, ..Self::new(true) }
    }

    /// One thing that was done.
    pub fn step(self, what: &str, detail: impl std::fmt::Display) -> io::Result<()> {
        self.line(format_args!("{what:<12}{detail}"))
    }

    /// One line of text, or several.
    pub fn line(self, text: impl std::fmt::Display) -> io::Result<()> {
        if self.quiet { Ok(()) } else { writeln!(io::stdout().lock(), "{text}") }
    }

    /// A bar of known length.
    pub fn bar(self, what: &'static str, length: u64) -> ProgressBar {
        let style = ProgressStyle::with_template("{prefix:<12}{bar:40} {pos}/{len} {msg} {eta}")
            .unwrap_or_else(|_| ProgressStyle::default_bar());
        styled(ProgressBar::with_draw_target(Some(length), self.target()), what, style)
    }

    /// A spinner for work of unknown length.
    pub fn spinner(self, what: &'static str) -> ProgressBar {
        let style = ProgressStyle::with_template("{prefix:<12}{spinner} {msg} {elapsed}")
            .unwrap_or_else(|_| ProgressStyle::default_spinner());
        let bar = styled(ProgressBar::with_draw_target(None, self.target()), what, style);
        bar.enable_steady_tick(Duration::from_millis(120));
        bar
    }

    fn target(self) -> ProgressDrawTarget {
        if self.bars { ProgressDrawTarget::stderr() } else { ProgressDrawTarget::hidden() }
    }
}

fn styled(bar: ProgressBar, what: &'static str, style: ProgressStyle) -> ProgressBar {
    bar.set_style(style);
    bar.set_prefix(what);
    bar
}

/// What a spinner says of a fit that waits or goes on.
pub fn fit_event(event: &Event) -> Option<String> {
    match event {
        Event::Queued(FitQueued { place, length }) => Some(format!("waiting: {} of {length}", ordinal(*place))),
        Event::Progress(progress) => {
            Some(format!("iteration {}, objective {:.6}", progress.iteration, progress.objective))
        }
        Event::Fit(_) => None,
    }
}

fn ordinal(number: u32) -> String {
    let ending = match (number % 10, number % 100) {
        (_, 11..=13) => "th",
        (1, _) => "st",
        (2, _) => "nd",
        (3, _) => "rd",
        _ => "th",
    };
    format!("{number}{ending}")
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_place_in_the_queue_reads_as_one() {
        let said = |place| fit_event(&Event::Queued(FitQueued { place, length: 200 })).expect("a message");
        assert_eq!(said(3), "waiting: 3rd of 200");
        let words = [1, 2, 4, 11, 12, 13, 21, 101, 111, 122].map(ordinal);
        assert_eq!(words, ["1st", "2nd", "4th", "11th", "12th", "13th", "21st", "101st", "111th", "122nd"]);
    }
}
