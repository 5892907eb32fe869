//! Threads that serve connections, each with a single-threaded runtime of its own.
//!
//! A connection stays with the worker that it was given: whatever happens to a step happens on one thread, without a
//! wake-up of another (docs/PERFORMANCE.md has what that saves). What takes long runs on threads for blocking work, so that
//! a connection does not wait for its neighbours' large batches.

use super::serve::ServeError;
use mazeway_serving::{
    connections::{Counted, Load},
    fair::Lane,
    listen::Accepted,
    spin::spin,
    transport::Transport,
};
use std::{io, thread, time::Duration};
use tokio::sync::{OwnedSemaphorePermit, mpsc, oneshot};
use tokio_util::{sync::CancellationToken, task::TaskTracker};

/// A connection on its way to its worker: there are never more than connections are admitted.
type Arrival = (Accepted, OwnedSemaphorePermit, Counted);

/// One thread.
pub struct Worker {
    arrivals: mpsc::UnboundedSender<Arrival>,
    load: Load,
    ended: oneshot::Receiver<()>,
}

impl Worker {
    /// Starts a thread that serves what it is given until `stopping`, and then for `grace` what is under way. It looks for
    /// more for as long as `most_spin` before it sleeps.
    pub fn start(
        transport: Transport,
        stopping: CancellationToken,
        grace: Duration,
        most_spin: Duration,
    ) -> Result<Self, ServeError> {
        let (arrivals, arriving) = mpsc::unbounded_channel();
        let (end, ended) = oneshot::channel();
        let (report, started) = std::sync::mpsc::channel();
        let work = move || {
            // Made where it runs: one must not be dropped by a task of another.
            let runtime = match tokio::runtime::Builder::new_current_thread().enable_all().build() {
                Ok(runtime) => runtime,
                Err(error) => return drop(report.send(Err(error))),
            };
            let _ = report.send(Ok(()));
            runtime.block_on(async {
                // Both end with the runtime.
                tokio::spawn(Lane::open());
                tokio::spawn(spin(most_spin));
                serve(transport, arriving, stopping, grace).await;
            });
            // What still runs on threads for blocking work ends by itself: nobody waits for its outcome.
            runtime.shutdown_background();
            let _ = end.send(());
        };
        thread::Builder::new().name("mazeway-worker".into()).spawn(work).map_err(ServeError::Threads)?;
        started.recv().map_err(io::Error::other).flatten().map_err(ServeError::Threads)?;
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
        (&mut self.ended).await.map_err(|_| ServeError::Threads(io::Error::other("a worker panicked")))
    }
}

async fn serve(
    transport: Transport,
    mut arriving: mpsc::UnboundedReceiver<Arrival>,
    stopping: CancellationToken,
    grace: Duration,
) {
    let connections = TaskTracker::new();
    loop {
        let arrived = tokio::select! {
            biased;
            () = stopping.cancelled() => break,
            arrived = arriving.recv() => arrived,
        };
        let Some((accepted, place, load)) = arrived else { break };
        let (transport, stopping) = (transport.clone(), stopping.clone());
        connections.spawn(async move { transport.serve(accepted, (place, load), &stopping, grace).await });
    }
    connections.close();
    connections.wait().await;
}
