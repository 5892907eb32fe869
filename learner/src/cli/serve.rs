//! `learner serve`: the learner service until it is told to stop.

use super::{data_directory, error::CliError};
use clap::Args;
use mazeway_learner::{Config, config::Limits};
use mazeway_serving::{
    DoorConfig, ListenAddress, Listener, TelemetryConfig,
    running::until_stopped,
    telemetry::endpoint::{self, Endpoint},
    token_command::TokenArgs,
};
use std::{io::Write as _, path::PathBuf, sync::Arc};

/// Where to listen, and on what data.
#[derive(Debug, Args)]
#[command(
    after_help = "Every flag is also a variable, MAZEWAY_LEARNER_ and its name in capitals (--data: MAZEWAY_DATA), \
    and a key of the file of --config: a flag wins over the variable, the variable over the file."
)]
pub struct ServeArgs {
    /// File of settings, in TOML, each under the name of its flag
    #[arg(long, value_name = "FILE")]
    config: Option<PathBuf>,
    /// Address to listen on, or unix:PATH for a Unix socket that its owner alone may use; port 0 takes a free one. One line
    /// with the address goes to standard output
    #[arg(long, default_value = "127.0.0.1:50052", value_name = "ADDR")]
    listen: ListenAddress,
    /// Directory of the recordings, models and fits [default: the platform's data directory]
    #[arg(long, value_name = "DIR", env = "MAZEWAY_DATA")]
    data: Option<PathBuf>,
    /// Listen on an address that other machines reach, although not everything is encrypted and everybody asked who they
    /// are
    #[arg(long)]
    insecure: bool,
    #[command(flatten)]
    limits: Limits,
    #[command(flatten)]
    door: DoorConfig,
    #[command(flatten)]
    telemetry: TelemetryConfig,
}

impl ServeArgs {
    /// What is shown of the service.
    pub fn telemetry(&self) -> &TelemetryConfig {
        &self.telemetry
    }
}

/// What begins the name of every variable: `MAZEWAY_LEARNER_MAX_QUEUED_FITS` is `--max-queued-fits`.
pub const VARIABLES: &str = "MAZEWAY_LEARNER_";

/// Where the settings are among the commands.
pub const PLACES: [Option<&str>; 2] = [Some("serve"), Some("config")];

/// Makes a token, and shows its secret.
pub fn token(args: &TokenArgs) -> Result<(), CliError> {
    let text = args.run().map_err(|(error, hint)| CliError::failure(error, hint))?;
    print(&text)
}

/// Writes what was asked for.
pub fn print(text: &str) -> Result<(), CliError> {
    let mut out = std::io::stdout();
    Ok(out.write_all(text.as_bytes()).and_then(|()| out.flush())?)
}

/// Serves until SIGINT or SIGTERM, then lets running calls end.
pub async fn run(args: ServeArgs) -> Result<(), CliError> {
    let ServeArgs { config: _, listen, data, insecure, limits, door, telemetry } = args;
    door.check_exposed(&listen, insecure).map_err(|(error, hint)| CliError::usage(error, hint))?;
    door.check().map_err(mazeway_learner::ServeError::from)?;
    if !telemetry.is_local() && !insecure {
        return Err(CliError::usage(
            "the numbers of --metrics-listen would be reached from other machines, and nobody is asked who they are",
            "listen on 127.0.0.1, or add --insecure where the network is trusted",
        ));
    }
    let data = data_directory(data)?;
    let cannot =
        |error: std::io::Error| CliError::failure(format!("cannot listen on {listen}: {error}"), listen.otherwise());
    let no_signals =
        |error| CliError::failure(format!("cannot watch for signals: {error}"), "raise the limit on open files");
    let listener = Listener::bind(&listen).await.map_err(cannot)?;
    let address = listener.address().map_err(cannot)?;
    let numbers = Arc::new(mazeway_learner::telemetry());
    let shown = match telemetry.metrics_listen {
        None => None,
        Some(address) => Some(endpoint::start(address, Arc::clone(&numbers)).await.map_err(|error| {
            let hint = "take a free port: --metrics-listen 127.0.0.1:0";
            CliError::failure(format!("cannot show numbers on {address}: {error}"), hint)
        })?),
    };
    // Fits share the threads of this pool, where they have several chains or folds.
    let yielding = |_| mazeway_learner::yield_to_others();
    if let Err(error) = rayon::ThreadPoolBuilder::new().start_handler(yielding).build_global() {
        tracing::debug!(%error, "threads that compute have the priority of all others");
    }
    let stopped = until_stopped(address, shown.as_ref().map(Endpoint::address)).map_err(no_signals)?;
    mazeway_learner::serve_observed(Config { data, limits, door }, listener, numbers, stopped).await?;
    Ok(())
}
