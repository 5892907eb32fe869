//! The stream of a fit: waits its turn, runs on a thread of its own, tells of its progress, stores the result.
//!
//! Invariants: turns are taken in the order of the calls; progress is dropped rather than waited for, so a slow reader
//! never slows a fit; a fit whose caller has gone stops at its next iteration and is not stored.

use super::{blocking, fit_job::FitJob, fit_job::progress_message, status::CallError};
use crate::{
    config::Limits,
    irl::TraceEntry,
    store::{Store, StoreError},
};
use mazeway_proto::learner::{self as pb, fit_response::Event};
use std::{
    ops::ControlFlow,
    sync::Arc,
    time::{Duration, Instant},
};
use tokio::sync::{Semaphore, mpsc};
use tokio_util::sync::CancellationToken;
use tonic::Status;

/// Least time between two messages of progress.
const PROGRESS_PERIOD: Duration = Duration::from_millis(100);
/// Messages of progress that wait for the reader.
const PROGRESS_QUEUE: usize = 8;

/// What a fit's stream carries.
pub type Response = Result<pb::FitResponse, Status>;

/// Where fits wait and run.
#[derive(Debug)]
pub struct FitQueue {
    running: Arc<Semaphore>,
    admitted: Arc<Semaphore>,
    limit: usize,
    /// Cancelled when no further fit may begin.
    stopping: CancellationToken,
    /// Cancelled when running fits must end.
    aborting: CancellationToken,
}

impl FitQueue {
    pub fn new(limits: &Limits, stopping: CancellationToken, aborting: CancellationToken) -> Self {
        let running = limits.max_concurrent_fits.max(1);
        let limit = limits.max_queued_fits;
        Self {
            running: Arc::new(Semaphore::new(running)),
            admitted: Arc::new(Semaphore::new(running + limit)),
            limit,
            stopping,
            aborting,
        }
    }

    /// Takes a place in the queue, or refuses, and returns the stream that will tell how it goes.
    pub fn submit(&self, job: FitJob, store: Store) -> Result<mpsc::Receiver<Response>, CallError> {
        let Ok(admitted) = Arc::clone(&self.admitted).try_acquire_owned() else {
            let (limit, got) = (self.limit as u64, self.limit as u64 + 1);
            return Err(CallError::Limit { field: "method".into(), what: "fits that wait their turn", limit, got });
        };
        let (events, stream) = mpsc::channel(PROGRESS_QUEUE);
        let running = Arc::clone(&self.running);
        let (stopping, aborting) = (self.stopping.clone(), self.aborting.clone());
        tokio::spawn(async move {
            let _admitted = admitted;
            let _running = tokio::select! {
                permit = running.acquire_owned() => permit,
                () = events.closed() => return,
                () = stopping.cancelled() => {
                    let _ = events.send(Err(CallError::ShuttingDown.into())).await;
                    return;
                }
            };
            let outcome = run(job, store, events.clone(), aborting).await;
            // A caller that has gone reads no more.
            let _ = events.send(outcome.map(|fit| response(Event::Fit(fit))).map_err(Status::from)).await;
        });
        Ok(stream)
    }
}

async fn run(
    job: FitJob,
    store: Store,
    events: mpsc::Sender<Response>,
    aborting: CancellationToken,
) -> Result<pb::Fit, CallError> {
    let reader = store.clone();
    let cancelled = {
        let events = events.clone();
        move || events.is_closed() || aborting.is_cancelled()
    };
    let (fit, ids) = blocking({
        let (events, cancelled) = (events.clone(), cancelled.clone());
        move || {
            let mut last: Option<Instant> = None;
            let progress = |entry: &TraceEntry| {
                if cancelled() {
                    return ControlFlow::Break(());
                }
                if last.is_none_or(|last| last.elapsed() >= PROGRESS_PERIOD) {
                    last = Some(Instant::now());
                    // A queue that is full has a reader that is slow: the next message will do as well.
                    let _ = events.try_send(Ok(response(Event::Progress(progress_message(entry)))));
                }
                ControlFlow::Continue(())
            };
            job.run(&reader, progress, &cancelled)
        }
    })
    .await?;
    if cancelled() {
        return Err(CallError::Cancelled);
    }
    let mut unstored = fit.clone();
    match store.put_fit(fit, ids).await {
        Err(error @ StoreError::DiskFull { .. }) => {
            // What was worked out is given all the same.
            tracing::warn!(%error, fit_id = unstored.fit_id, "a fit could not be stored");
            unstored.warnings.push("this fit is not stored: the disk is full".into());
            Ok(unstored)
        }
        stored => Ok(stored?),
    }
}

fn response(event: Event) -> pb::FitResponse {
    pb::FitResponse { event: Some(event) }
}
