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
use mazeway_client::{ClientError, ConnectFiles, ConnectOptions};
use mazeway_serving::{
    settings::{self, Settings, SettingsError},
    telemetry::logs,
    token_command::TokenArgs,
};
use std::{path::PathBuf, process::ExitCode, time::Duration};
use tracing_subscriber::{Layer as _, filter::LevelFilter, layer::SubscriberExt as _, util::SubscriberInitExt as _};

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
    Serve(Box<serve::ServeArgs>),
    /// Print the configuration of the learner service as a file, with where each value comes from; takes the flags of serve
    Config(Box<serve::ServeArgs>),
    /// Make a token for the --tokens of a service, and show its secret once
    Token(TokenArgs),
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
    #[command(flatten)]
    pub access: AccessArgs,
}

/// How running services know this program, and it them.
#[derive(Debug, Clone, Default, Args)]
#[command(next_help_heading = "Access to running services")]
pub struct AccessArgs {
    /// File that holds a token, and nothing else [default: MAZEWAY_TOKEN_FILE, or the token itself in MAZEWAY_TOKEN]
    #[arg(long, value_name = "FILE")]
    token_file: Option<PathBuf>,
    /// Authorities, in PEM, that may vouch for an https:// address [default: MAZEWAY_TLS_CA, or the system's]
    #[arg(long, value_name = "FILE")]
    tls_ca: Option<PathBuf>,
    /// Certificate of this program, in PEM [default: MAZEWAY_TLS_CERT]
    #[arg(long, value_name = "FILE")]
    tls_cert: Option<PathBuf>,
    /// Private key of that certificate, in PEM [default: MAZEWAY_TLS_KEY]
    #[arg(long, value_name = "FILE")]
    tls_key: Option<PathBuf>,
    /// Send the token unencrypted to addresses beyond this machine
    #[arg(long)]
    token_in_clear: bool,
}

impl AccessArgs {
    /// How to connect to an address.
    ///
    /// # Errors
    /// A file that cannot be read; certificates for an address that has none.
    pub fn options(&self, address: &str) -> Result<ConnectOptions, CliError> {
        let files = ConnectFiles {
            token: self.token_file.clone(),
            ca: self.tls_ca.clone(),
            cert: self.tls_cert.clone(),
            key: self.tls_key.clone(),
        };
        let options = files.read(address).map_err(|error| {
            let hint = "give readable files: --token-file, --tls-ca, --tls-cert and --tls-key";
            CliError::usage(error.to_string(), hint)
        })?;
        Ok(ConnectOptions { insecure: self.token_in_clear, ..options })
    }
}

/// What went wrong on the way to a service; `start` says how one is started.
pub fn unreachable(error: &ClientError, start: impl Into<String>) -> CliError {
    match error {
        ClientError::Argument { field: "token", .. } => CliError::usage(
            error.to_string(),
            "give an https:// address, or --token-in-clear where the network is trusted",
        ),
        ClientError::Argument { .. } => CliError::usage(
            error.to_string(),
            "give an address such as 127.0.0.1:50052, or https://host:port with --tls-ca",
        ),
        _ => CliError::failure(error.to_string(), start),
    }
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
    let parsed = settings::parse(Cli::command(), serve::VARIABLES, &serve::PLACES, std::env::args_os());
    let (cli, settings) = match parsed.and_then(|settings| Ok((settings.typed::<Cli>()?, settings))) {
        Ok(parsed) => parsed,
        Err(SettingsError::Usage(error)) => return error::report_usage(&error),
        Err(error) => return CliError::usage(error.to_string(), "see what there is with 'learner config'").report(),
    };
    if !matches!(cli.command, Command::Serve(_)) {
        // What a service that was started for this command logs is told by the error and its hint.
        let writing = tracing_subscriber::fmt::layer().with_writer(std::io::stderr);
        tracing_subscriber::registry().with(writing.with_filter(logs::asked(LevelFilter::OFF))).init();
    }
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
    let outcome = runtime.block_on(run(cli.command, &settings));
    // A fit that was cut off ends at its next iteration; nobody waits for it.
    runtime.shutdown_timeout(Duration::from_secs(2));
    match outcome {
        Ok(()) => ExitCode::SUCCESS,
        Err(error) => error.report(),
    }
}

async fn run(command: Command, settings: &Settings) -> Result<(), CliError> {
    match command {
        Command::Fit(args) => Box::pin(fit::run(*args)).await,
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
        Command::Serve(args) => {
            let spans = logs::start(args.telemetry(), "mazeway-learner").map_err(|error| {
                CliError::usage(format!("no spans can be exported: {error}"), "see 'learner serve --help'")
            })?;
            settings.warn_of_strangers();
            let outcome = serve::run(*args).await;
            spans.flush().await;
            outcome
        }
        Command::Config(_) => serve::print(&settings.effective()),
        Command::Token(args) => serve::token(&args),
    }
}

/// Bytes as a digest is written.
fn hexadecimal(bytes: &[u8]) -> String {
    use std::fmt::Write as _;
    bytes.iter().fold(String::with_capacity(64), |mut text, byte| {
        // Writing to a string cannot fail.
        let _ = write!(text, "{byte:02x}");
        text
    })
}
