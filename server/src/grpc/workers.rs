//! Threads that serve connections, each with a single-threaded runtime of its own.
//!
//! A connection stays with the worker that it was given: whatever happens to a step happens on one thread, without a
//! wake-up of another (docs/PERFORMANCE.md has what that saves). What takes long runs on threads for blocking work, so that
//! a connection does not wait for its neighbours' large batches.

use super::serve::ServeError;
use mazeway_serving::{
    connections::{Connection, Counted, Load},
    listen::Accepted,
};
use std::{io, thread, time::Duration};
use tokio::{
    sync::{OwnedSemaphorePermit, mpsc, oneshot},
    time::timeout,
};
use tokio_stream::{StreamExt as _, wrappers::UnboundedReceiverStream};
use tokio_util::sync::CancellationToken;
use tonic::{service::Routes, transport::Server};

/// A connection on its way to its worker: there are never more than connections are admitted.
type Arrival = (Accepted, OwnedSemaphorePermit, Counted);

/// One thread.
pub struct Worker {
    arrivals: mpsc::UnboundedSender<Arrival>,
    load: Load,
    ended: oneshot::Receiver<Result<(), ServeError>>,
}

impl Worker {
    /// Starts a thread that serves what it is given until `stopping`, and then for `grace` what is under way.
    pub fn start(
        server: Server,
        routes: Routes,
        stopping: CancellationToken,
        grace: Duration,
    ) -> Result<Self, ServeError> {
        let (arrivals, arriving) = mpsc::unbounded_channel();
        let (end, ended) = oneshot::channel();
        let runtime =
            tokio::runtime::Builder::new_current_thread().enable_all().build().map_err(ServeError::Threads)?;
        let work = move || {
            let outcome = runtime.block_on(serve(server, routes, arriving, stopping, grace));
            // What still runs on threads for blocking work ends by itself: nobody waits for its outcome.
            runtime.shutdown_background();
            let _ = end.send(outcome);
        };
        thread::Builder::new().name("mazeway-worker".into()).spawn(work).map_err(ServeError::Threads)?;
        Ok(Self { arrivals, load: Load::default(), ended })
    }

    /// How many connections it has.
    pub fn load(&self) -> usize {
        self.load.get()
    }

    /// Gives it a connection.
    pub fn give(&self, (connection, place): (Accepted, OwnedSemaphorePermit)) {
        // One that is stopping takes none, which closes it.
        let _ = self.arrivals.send((connection, place, self.load.add()));
    }

    /// Waits for its end.
    pub async fn ended(&mut self) -> Result<(), ServeError> {
        (&mut self.ended).await.unwrap_or_else(|_| Err(ServeError::Threads(io::Error::other("a worker panicked"))))
    }
}

async fn serve(
    mut server: Server,
    routes: Routes,
    arriving: mpsc::UnboundedReceiver<Arrival>,
    stopping: CancellationToken,
    grace: Duration,
) -> Result<(), ServeError> {
    let incoming = UnboundedReceiverStream::new(arriving).map(|(connection, place, load)| {
        Ok::<_, io::Error>(Connection { socket: connection.into_socket()?, place, load })
    });
    let stop = stopping.clone().cancelled_owned();
    let serving = server.add_routes(routes).serve_with_incoming_shutdown(incoming, stop);
    tokio::pin!(serving);
    tokio::select! {
        outcome = &mut serving => Ok(outcome?),
        // Calls that need longer are cut off.
        () = stopping.cancelled() => Ok(timeout(grace, serving).await.unwrap_or(Ok(()))?),
    }
}
