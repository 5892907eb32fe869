//! `learner serve`: the learner service until it is told to stop.

use super::{data_directory, error::CliError};
use clap::Args;
use mazeway_learner::{Config, config::Limits, store::Store};
use std::{io::Write as _, net::SocketAddr, path::PathBuf};
use tokio::net::TcpListener;

/// Where to listen, and on what data.
#[derive(Debug, Args)]
pub struct ServeArgs {
    /// Address to listen on; port 0 takes a free one. One line with the address goes to standard output
    #[arg(long, env = "MAZEWAY_LEARNER_LISTEN", default_value = "127.0.0.1:50052", value_name = "HOST:PORT")]
    listen: SocketAddr,
    /// Directory of the recordings, models and fits [default: the platform's data directory]
    #[arg(long, value_name = "DIR", env = "MAZEWAY_DATA")]
    data: Option<PathBuf>,
    /// Listen on an address that other machines reach, although nothing is encrypted and nobody is asked who they are
    #[arg(long, env = "MAZEWAY_INSECURE")]
    insecure: bool,
    #[command(flatten)]
    limits: Limits,
}

/// Serves until SIGINT or SIGTERM, then lets running calls end.
pub async fn run(args: ServeArgs) -> Result<(), CliError> {
    let ServeArgs { listen, data, insecure, limits } = args;
    if !listen.ip().is_loopback() && !insecure {
        return Err(CliError::usage(
            format!("{listen} is reached from other machines, and nothing on it is encrypted or authenticated"),
            "listen on 127.0.0.1, or add --insecure where the network is trusted",
        ));
    }
    let data = data_directory(data)?;
    // A directory that cannot be used is said before the address is: who reads the line may connect.
    drop(Store::open(&data)?);
    let cannot = |error: std::io::Error| {
        CliError::failure(format!("cannot listen on {listen}: {error}"), "take a free port: --listen 127.0.0.1:0")
    };
    let no_signals =
        |error| CliError::failure(format!("cannot watch for signals: {error}"), "raise the limit on open files");
    let stopped = stop_signal().map_err(no_signals)?;
    let listener = TcpListener::bind(listen).await.map_err(cannot)?;
    let address = listener.local_addr().map_err(cannot)?;
    // Whoever started this may have closed the other end; the service serves all the same.
    let _ = writeln!(std::io::stdout(), "listening on {address}").and_then(|()| std::io::stdout().flush());
    mazeway_learner::serve(Config { data, limits }, listener, stopped).await?;
    Ok(())
}

/// SIGINT or SIGTERM. They are watched from the call on, not only once the future is waited for.
fn stop_signal() -> std::io::Result<impl Future<Output = ()>> {
    #[cfg(unix)]
    {
        use tokio::signal::unix::{SignalKind, signal};
        let (mut interrupt, mut terminate) = (signal(SignalKind::interrupt())?, signal(SignalKind::terminate())?);
        Ok(async move {
            tokio::select! {
                _ = interrupt.recv() => {}
                _ = terminate.recv() => {}
            }
        })
    }
    #[cfg(not(unix))]
    Ok(async {
        let _ = tokio::signal::ctrl_c().await;
    })
}
