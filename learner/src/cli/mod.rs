//! The command line: arguments are parsed into flags, flags into a job that is checked without I/O, and the job is run.
//!
//! Invariants: results go to standard output, everything else to standard error; a failure is one `error:` line and one
//! `hint:` line; a closed pipe ends the program quietly.

mod compare;
mod connect;
pub mod embedded;
pub mod error;
mod export;
pub mod fit;
mod import;
mod list;
mod maintain;
mod models;
mod reproduce;
mod scene;
mod serve;
mod show;
mod table;

use clap::{Args, CommandFactory as _, Parser, Subcommand};
use directories::ProjectDirs;
use error::CliError;
use std::{path::PathBuf, process::ExitCode, time::Duration};
use tracing_subscriber::EnvFilter;

/// Watches experts act and works out what they want.
#[derive(Debug, Parser)]
#[command(name = "learner", version, about, propagate_version = true, disable_help_subcommand = true)]
struct Cli {
    #[command(subcommand)]
    command: Command,
}

#[derive(Debug, Subcommand)]
enum Command {
    /// Learn a reward and a policy from demonstrations, and report what was learned
    Fit(Box<fit::FitArgs>),
    /// Compare methods on the same demonstrations, over numbers of demonstrations and seeds
    Compare(Box<compare::CompareArgs>),
    /// Store a model and demonstrations from files
    Import(Box<import::ImportArgs>),
    /// Draw the paper's figures, its experiment with three styles, its weak points, and transfer to other models
    Reproduce(reproduce::ReproduceArgs),
    /// List recordings, models and fits
    List(list::ListArgs),
    /// Show a fit, a trajectory or a model
    Show(show::ShowArgs),
    /// Write trajectories as JSON lines, CSV or Parquet
    Export(export::ExportArgs),
    /// Delete trajectories or a fit
    Delete(export::DeleteArgs),
    /// Check everything that is stored, and name what is damaged
    Verify(maintain::MaintainArgs),
    /// Make a sound store of a damaged one; the damaged file is kept
    Repair(maintain::MaintainArgs),
    /// Copy the store, which services may use meanwhile, and check the copy
    Backup(maintain::BackupArgs),
    /// Give the room that deleting has left back to the disk
    Vacuum(maintain::MaintainArgs),
    /// Run the learner service
    Serve(serve::ServeArgs),
}

/// Which recordings and fits a command works on.
#[derive(Debug, Clone, Default, Args)]
pub struct StoreArgs {
    /// Directory of the recordings, models and fits [default: the platform's data directory]
    #[arg(long, value_name = "DIR", env = "MAZEWAY_DATA")]
    pub data: Option<PathBuf>,
    /// Address of a running learner service, such as 127.0.0.1:50052, which has its own directory
    #[arg(long, value_name = "HOST:PORT")]
    pub addr: Option<String>,
}

/// Whether a word names a command.
fn is_command(word: &str) -> bool {
    Cli::command().get_subcommands().any(|command| command.get_name() == word)
}

/// The data directory that is asked for, or the platform's.
///
/// # Errors
/// The platform has none, as where no home directory is known.
pub fn data_directory(asked: Option<PathBuf>) -> Result<PathBuf, CliError> {
    let platform = || ProjectDirs::from("", "", "mazeway").map(|project| project.data_dir().to_owned());
    asked.or_else(platform).ok_or_else(|| {
        CliError::failure("no data directory is known: there is no home directory", "name one with --data DIR")
    })
}

/// Parses the arguments, runs the command and says how it went.
pub fn main() -> ExitCode {
    let cli = match Cli::try_parse() {
        Ok(cli) => cli,
        Err(error) => return error::report_usage(&error),
    };
    let filter = EnvFilter::try_from_default_env().unwrap_or_else(|_| EnvFilter::new("error"));
    tracing_subscriber::fmt().with_env_filter(filter).with_writer(std::io::stderr).init();
    let runtime = match tokio::runtime::Builder::new_multi_thread().enable_all().build() {
        Ok(runtime) => runtime,
        Err(error) => {
            return CliError::failure(
                format!("could not start the runtime: {error}"),
                "check the limits on threads and open files (ulimit -a)",
            )
            .report();
        }
    };
    let outcome = runtime.block_on(run(cli.command));
    // A fit that was cut off ends at its next iteration; nobody waits for it.
    runtime.shutdown_timeout(Duration::from_secs(2));
    match outcome {
        Ok(()) => ExitCode::SUCCESS,
        Err(error) => error.report(),
    }
}

async fn run(command: Command) -> Result<(), CliError> {
    match command {
        Command::Fit(args) => fit::run(*args).await,
        Command::Compare(args) => compare::run(*args).await,
        Command::Import(args) => import::run(*args).await,
        Command::Reproduce(args) => Box::pin(reproduce::run(args)).await,
        Command::List(args) => list::run(args).await,
        Command::Show(args) => show::run(args).await,
        Command::Export(args) => export::export(args).await,
        Command::Delete(args) => export::delete(args).await,
        Command::Verify(args) => maintain::verify(args).await,
        Command::Repair(args) => maintain::repair(args).await,
        Command::Backup(args) => maintain::backup(args).await,
        Command::Vacuum(args) => maintain::vacuum(args).await,
        Command::Serve(args) => serve::run(args).await,
    }
}
