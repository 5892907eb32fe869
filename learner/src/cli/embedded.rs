//! Services that live as long as one command: the real ones, on loopback ports, talked to through the real client.

use super::error::CliError;
use mazeway_client::channel;
use std::{fmt::Display, future::Future, net::SocketAddr, path::Path, time::Duration};
use tokio::{net::TcpListener, task::JoinHandle, time::sleep};
use tokio_util::sync::{CancellationToken, DropGuard};
use tonic_health::pb::{HealthCheckRequest, health_client::HealthClient};

/// Pause between two questions whether a service is ready.
const POLL: Duration = Duration::from_millis(5);

/// A service in this process. Dropped, it begins to stop; [`Embedded::stop`] waits until it has.
#[derive(Debug)]
pub struct Embedded {
    address: SocketAddr,
    stop: DropGuard,
    task: JoinHandle<Result<(), CliError>>,
}

/// Starts a learner service on the recordings of a directory.
///
/// # Errors
/// The directory cannot be used.
pub async fn learner(data: &Path) -> Result<Embedded, CliError> {
    let config = mazeway_learner::Config::new(data);
    Embedded::start(|listener, shutdown| mazeway_learner::serve(config, listener, shutdown)).await
}

/// Starts an environment server.
///
/// # Errors
/// No port can be bound.
pub async fn environments() -> Result<Embedded, CliError> {
    let config = mazeway_server::Config::default();
    let serve = |listener, shutdown| async {
        let failed =
            |error: mazeway_server::ServeError| CliError::failure(error.to_string(), "set RUST_LOG=info to see more");
        mazeway_server::serve(config, listener, shutdown).await.map_err(failed)
    };
    Embedded::start(serve).await
}

impl Embedded {
    async fn start<F, E>(
        serve: impl FnOnce(TcpListener, tokio_util::sync::WaitForCancellationFutureOwned) -> F,
    ) -> Result<Self, CliError>
    where
        F: Future<Output = Result<(), E>> + Send + 'static,
        E: Into<CliError>,
    {
        let no_port = |error: &dyn Display| {
            CliError::failure(
                format!("no free port on 127.0.0.1: {error}"),
                "close programs that hold many connections",
            )
        };
        let listener = TcpListener::bind("127.0.0.1:0").await.map_err(|e| no_port(&e))?;
        let address = listener.local_addr().map_err(|e| no_port(&e))?;
        let stopping = CancellationToken::new();
        let service = serve(listener, stopping.clone().cancelled_owned());
        let mut task = tokio::spawn(async move { service.await.map_err(Into::into) });
        tokio::select! {
            outcome = &mut task => Err(match outcome {
                Ok(Err(error)) => error,
                Ok(Ok(())) | Err(_) => CliError::failure("a service ended as it began", "set RUST_LOG=info to see more"),
            }),
            () = ready(address) => Ok(Self { address, stop: stopping.drop_guard(), task }),
        }
    }

    /// Where it listens, for clients.
    pub fn address(&self) -> String {
        self.address.to_string()
    }

    /// Stops it and waits until it is down and all it accepted is on stable storage.
    ///
    /// # Errors
    /// It failed meanwhile.
    pub async fn stop(self) -> Result<(), CliError> {
        drop(self.stop);
        self.task.await.unwrap_or_else(|error| {
            Err(CliError::failure(format!("a service failed: {error}"), "report this as a defect"))
        })
    }
}

/// Waits until the service says that it serves.
async fn ready(address: SocketAddr) {
    loop {
        if let Ok(channel) = channel(&address.to_string()).await
            && HealthClient::new(channel).check(HealthCheckRequest::default()).await.is_ok()
        {
            return;
        }
        sleep(POLL).await;
    }
}
