//! What a person reads when a command fails: one `error:` line, one `hint:` line with the next thing to do.

use clap::error::{ContextKind, ContextValue, ErrorKind};
use mazeway_client::{ClientError, Code};
use mazeway_learner::{ServeError, store::StoreError};
use std::{io, io::Write as _, process::ExitCode};

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
    pub fn usage(message: impl Into<String>, hint: impl Into<String>) -> Self {
        Self { message: message.into(), hint: hint.into(), code: USAGE }
    }

    /// Prints the error and gives the exit code.
    pub fn report(&self) -> ExitCode {
        if self.code != 0 {
            let (message, hint) = (one_line(&self.message), one_line(&self.hint));
            // Nobody is left to be told where standard error is closed.
            let _ = write!(io::stderr(), "error: {message}\nhint: {hint}\n");
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

impl From<ClientError> for CliError {
    fn from(error: ClientError) -> Self {
        let message = match error.field() {
            Some(field) if !error.to_string().contains(field) => format!("{field}: {error}"),
            _ => error.to_string(),
        };
        let hint = match &error {
            ClientError::Address { .. } => "give the address as HOST:PORT, such as 127.0.0.1:50052",
            ClientError::Connect { .. } => {
                "check the address, start a service with 'learner serve', or leave out --addr to use one started here"
            }
            _ => match error.code() {
                Code::NotFound | Code::FailedPrecondition => "see what is stored with 'learner list'",
                Code::InvalidArgument | Code::AlreadyExists => "see 'learner --help'",
                Code::ResourceExhausted => "free some disk space, or raise the limit where the service is started",
                Code::Unavailable | Code::Cancelled | Code::DeadlineExceeded => {
                    "try again; what was acknowledged is stored"
                }
                Code::Unauthenticated | Code::PermissionDenied => {
                    "name a file with a token that is good for this: --token-file, or MAZEWAY_TOKEN_FILE"
                }
                Code::DataLoss => {
                    "see what is damaged with 'learner verify'; 'learner repair' takes over what is sound"
                }
                _ => "set RUST_LOG=info to see more",
            },
        };
        Self::failure(message, hint)
    }
}

impl From<StoreError> for CliError {
    fn from(error: StoreError) -> Self {
        let hint = match &error {
            StoreError::Directory { kind: io::ErrorKind::PermissionDenied, .. } => {
                "run it as the directory's owner, or use another directory with --data DIR"
            }
            StoreError::Directory { .. } | StoreError::Foreign { .. } => "use another directory with --data DIR",
            StoreError::NewerSchema { .. } => "install the newer release, or use another directory with --data DIR",
            StoreError::DiskFull { .. } => "free some disk space, or use another directory with --data DIR",
            StoreError::QuotaReached { .. } => {
                "delete recordings with 'learner delete', or raise --max-store-bytes where the service is started"
            }
            StoreError::AllowanceSpent { .. } => "raise max_recorded_bytes of the caller's token",
            StoreError::Busy { .. } => "stop the other program, or use another directory with --data DIR",
            StoreError::Corrupt { .. } => {
                "see what is damaged with 'learner verify'; 'learner repair' takes over what is sound"
            }
            StoreError::TrajectoryExists { .. }
            | StoreError::ModelExists { .. }
            | StoreError::AmbiguousFit { .. }
            | StoreError::Closed
            | StoreError::Database { .. } => "check that you may write there, or use another directory with --data DIR",
        };
        Self::failure(error.to_string(), hint)
    }
}

impl From<ServeError> for CliError {
    fn from(error: ServeError) -> Self {
        match error {
            ServeError::Store(error) => error.into(),
            ServeError::Threads(_) => Self::failure(error.to_string(), "raise the limit on processes (ulimit -u)"),
            ServeError::Door(error) => Self::usage(error.to_string(), "see SECURITY.md for how such files are made"),
            ServeError::Reflection(_) => Self::failure(error.to_string(), "set RUST_LOG=info to see more"),
        }
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
    let command = match std::env::args().nth(1) {
        Some(word) if super::is_command(&word) => format!("learner {word}"),
        _ => "learner".to_owned(),
    };
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
