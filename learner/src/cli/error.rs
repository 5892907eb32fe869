//! What a person reads when a command fails: one `error:` line, one `hint:` line with the next thing to do.

use clap::error::{ContextKind, ContextValue, ErrorKind};
use std::{io, process::ExitCode};

/// Exit code of a failed command.
const FAILURE: u8 = 1;
/// Exit code of a command that was called wrongly.
const USAGE: u8 = 2;

/// Why a command failed.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct CliError {
    /// What was expected and what came; one line, lower case, no full stop.
    pub message: String,
    /// What to do next; one line.
    pub hint: String,
    /// Exit code: 2 for wrong usage, 1 for a failure, 0 where nobody reads any more.
    pub code: u8,
}

impl CliError {
    /// The command was called rightly and failed all the same.
    pub fn failure(message: impl Into<String>, hint: impl Into<String>) -> Self {
        Self { message: message.into(), hint: hint.into(), code: FAILURE }
    }

    /// The command was called wrongly.
    #[expect(dead_code, reason = "the first caller comes with the other subcommands")]
    pub fn usage(message: impl Into<String>, hint: impl Into<String>) -> Self {
        Self { message: message.into(), hint: hint.into(), code: USAGE }
    }

    /// Prints the error and gives the exit code.
    pub fn report(&self) -> ExitCode {
        if self.code != 0 {
            eprintln!("error: {}", one_line(&self.message));
            eprintln!("hint: {}", one_line(&self.hint));
        }
        ExitCode::from(self.code)
    }
}

impl From<io::Error> for CliError {
    /// An error of writing results. A closed pipe is not a failure: the reader has seen enough.
    fn from(error: io::Error) -> Self {
        if error.kind() == io::ErrorKind::BrokenPipe {
            return Self { message: "standard output was closed".into(), hint: String::new(), code: 0 };
        }
        Self::failure(format!("could not write: {error}"), "check that the disk has room and that you may write there")
    }
}

/// Prints what clap has to say: help and version as they are, errors as one line and one hint.
pub fn report_usage(error: &clap::Error) -> ExitCode {
    if matches!(error.kind(), ErrorKind::DisplayHelp | ErrorKind::DisplayVersion) {
        // A closed pipe while printing help is nobody's failure.
        let _ = error.print();
        return ExitCode::SUCCESS;
    }
    usage_error(error).report()
}

/// clap's several paragraphs in two lines.
fn usage_error(error: &clap::Error) -> CliError {
    if error.kind() == ErrorKind::DisplayHelpOnMissingArgumentOrSubcommand {
        return CliError {
            message: "expected a command, got none".into(),
            hint: "try 'learner fit --style aggressive', or 'learner --help' for all commands".into(),
            code: USAGE,
        };
    }
    let text = error.to_string();
    let first = text.split("\n\n").next().unwrap_or_default();
    let first = first.strip_prefix("error: ").unwrap_or(first);
    let values = |kind| match error.get(kind) {
        Some(ContextValue::String(value)) => vec![value.clone()],
        Some(ContextValue::Strings(values)) => values.clone(),
        _ => Vec::new(),
    };
    let mut suggestions = values(ContextKind::SuggestedSubcommand);
    suggestions.extend(values(ContextKind::SuggestedArg));
    suggestions.extend(values(ContextKind::SuggestedValue));
    // The usage line reads "Usage: learner fit [OPTIONS]": its leading lower-case words are the command to ask.
    let command = text.lines().find_map(|line| line.strip_prefix("Usage: ")).map_or_else(
        || "learner".to_owned(),
        |usage| {
            let words = usage.split(' ').take_while(|w| w.chars().all(|c| c.is_ascii_lowercase() || c == '-'));
            words.filter(|w| !w.starts_with('-')).collect::<Vec<_>>().join(" ")
        },
    );
    let hint = if suggestions.is_empty() {
        format!("see '{command} --help'")
    } else {
        format!("did you mean '{}'? see '{command} --help'", suggestions.join("' or '"))
    };
    CliError { message: first.to_owned(), hint, code: USAGE }
}

/// Joins the lines of a message.
fn one_line(text: &str) -> String {
    text.split_whitespace().collect::<Vec<_>>().join(" ")
}
