//! What a person reads while a fit runs: a line a step, and a bar for anything that may take longer than a second.
//!
//! With `--json` the lines are left out, since standard output carries one object alone. Bars are drawn on standard error, and only
//! where both it and standard output are terminals.

use indicatif::{ProgressBar, ProgressDrawTarget, ProgressStyle};
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
