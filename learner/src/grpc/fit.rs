//! The stream of a fit: waits its turn, runs on a thread for fits, tells of its place and its progress, stores the result.
//!
//! Invariants: turns go round between callers (see `turns`); progress is dropped rather than waited for, so a slow reader
//! never slows a fit; a fit whose caller has gone leaves the queue at once, or stops at its next iteration, and is not stored;
//! whoever waits for one is told when the service stops, whatever the fit is at.

mod numbers;
mod pool;
mod turns;

use super::{fit_job::FitJob, fit_job::progress_message, models::unless, status::CallError};
use crate::{
    config::Limits,
    irl::TraceEntry,
    store::{IdList, Store, StoreError},
};
use mazeway_proto::learner::{self as pb, fit_response::Event};
use mazeway_serving::{Caller, telemetry::Telemetry};
use numbers::{BEGUN, CANCELLED, Fits, STOPPED};
use pool::{Place, Pool, Stand};
use std::{
    io,
    ops::ControlFlow,
    sync::{
        Arc,
        atomic::{AtomicBool, Ordering::Relaxed},
    },
    time::{Duration, Instant},
};
use tokio::sync::{mpsc, oneshot};
use tokio_util::sync::CancellationToken;
use tonic::Status;
use turns::Full;

pub use pool::yield_to_others;

/// Least time between two messages of progress.
const PROGRESS_PERIOD: Duration = Duration::from_millis(100);
/// Messages of progress that wait for the reader.
const PROGRESS_QUEUE: usize = 8;

/// What a fit's stream carries.
pub type Response = Result<pb::FitResponse, Status>;
/// A fit and the ids of the trajectories that it used.
type Fitted = (pb::Fit, IdList);

/// Where fits wait and run.
#[derive(Debug)]
pub struct FitQueue {
    pool: Arc<Pool>,
    fits: Fits,
    /// Cancelled when no further fit may begin.
    stopping: CancellationToken,
    /// Cancelled when running fits must end.
    aborting: CancellationToken,
}

impl FitQueue {
    /// Starts the threads.
    ///
    /// # Errors
    /// There are none to be had.
    pub fn new(
        limits: &Limits,
        telemetry: &Telemetry,
        stopping: CancellationToken,
        aborting: CancellationToken,
    ) -> io::Result<Self> {
        let pool = Arc::new(Pool::start(limits.max_concurrent_fits, limits.max_queued_fits)?);
        let read = |name, help, read: fn(&Pool) -> usize| {
            // The numbers may be shown for longer than there are threads.
            let pool = Arc::downgrade(&pool);
            telemetry.read(name, help, move || pool.upgrade().map_or(0, |pool| read(&pool) as i64));
        };
        read("fits_waiting", "Fits that wait their turn", Pool::waiting);
        read("fits_running", "Fits that run", Pool::running);
        Ok(Self { pool, fits: Fits::new(telemetry), stopping, aborting })
    }

    /// Takes note of one that is refused for what it asks.
    pub fn refuses(&self, error: &CallError) {
        self.fits.refuses(error);
    }

    /// Takes a place in the queue, or refuses, and returns the stream that will tell how it goes. `quota` is how many fits
    /// the caller may have, those that wait and those that run.
    pub fn submit(
        &self,
        caller: &Caller,
        quota: Option<usize>,
        job: FitJob,
        store: Store,
    ) -> Result<mpsc::Receiver<Response>, CallError> {
        let (events, stream) = mpsc::channel(PROGRESS_QUEUE);
        let (done, outcome) = oneshot::channel();
        let cancelled = {
            let (events, aborting) = (events.clone(), self.aborting.clone());
            move || events.is_closed() || aborting.is_cancelled()
        };
        let queued = Arc::new(AtomicBool::new(false));
        let work = {
            let (events, store, fits, aborting) =
                (events.clone(), store.clone(), self.fits.clone(), self.aborting.clone());
            let wait = Wait {
                fits: fits.clone(),
                since: Instant::now(),
                queued: Arc::clone(&queued),
                is_over: false,
                stopping: self.stopping.clone(),
            };
            move || {
                wait.end();
                let (method, begun) = (job.method_id(), Instant::now());
                let outcome = run(job, &store, &events, cancelled).map_err(|error| match error {
                    CallError::Cancelled if aborting.is_cancelled() => CallError::ShuttingDown,
                    error => error,
                });
                fits.ended(method, &outcome, begun.elapsed());
                // A caller that has gone wants nothing.
                let _ = done.send(outcome);
            }
        };
        let place = self.pool.submit(caller, quota, Box::new(work));
        let mut place = place.inspect_err(|full| self.fits.finds_no_place(*full)).map_err(no_place)?;
        queued.store(true, Relaxed);
        let (stopping, aborting) = (self.stopping.clone(), self.aborting.clone());
        tokio::spawn(async move {
            let last = match wait(&mut place, &events, &stopping).await {
                // Its thread may be long in coming to its next iteration.
                Ok(()) => match unless(&aborting, outcome).await {
                    Ok(Ok(fit)) => keep(fit, &store).await,
                    Ok(Err(_)) => Err(CallError::Internal("the fit panicked".into())),
                    Err(stopped) => Err(stopped),
                },
                Err(error) => Err(error),
            };
            drop(place);
            // A caller that has gone reads no more.
            let _ = events.send(last.map(|fit| response(Event::Fit(fit))).map_err(Status::from)).await;
        });
        Ok(stream)
    }
}

/// A fit in the queue. Dropped before its turn, its caller has gone or the service stops.
struct Wait {
    fits: Fits,
    since: Instant,
    /// False where it did not come to wait.
    queued: Arc<AtomicBool>,
    /// True once its turn has come.
    is_over: bool,
    stopping: CancellationToken,
}

impl Wait {
    /// Its turn has come.
    fn end(mut self) {
        self.is_over = true;
        self.fits.waited(BEGUN, self.since.elapsed());
    }
}

impl Drop for Wait {
    fn drop(&mut self) {
        if !self.is_over && self.queued.load(Relaxed) {
            let outcome = if self.stopping.is_cancelled() { STOPPED } else { CANCELLED };
            self.fits.waited(outcome, self.since.elapsed());
        }
    }
}

fn no_place(full: Full) -> CallError {
    let (field, what, limit) = match full {
        Full::Queue { limit } => ("method", "fits that wait their turn", limit),
        Full::Share { waiting } => {
            ("method", "fits of one caller that wait their turn, now that the queue is so long", waiting)
        }
        Full::Quota { limit } => ("max_fits", "fits of this caller at a time, those that wait included", limit),
    };
    CallError::Limit { field: field.into(), what, limit: limit as u64, got: limit as u64 + 1 }
}

/// Waits for the turn and tells where it is.
async fn wait(
    place: &mut Place,
    events: &mpsc::Sender<Response>,
    stopping: &CancellationToken,
) -> Result<(), CallError> {
    let mut stand = place.stand();
    while let Stand::Waiting { place: rank, length } = stand {
        let queued = pb::FitQueued { place: rank as u32, length: length as u32 };
        // A queue that is full has a reader that is slow: the next place will do as well.
        let _ = events.try_send(Ok(response(Event::Queued(queued))));
        stand = tokio::select! {
            moved = place.moved() => moved,
            () = events.closed() => return Err(CallError::Cancelled),
            () = stopping.cancelled() => return Err(CallError::ShuttingDown),
        };
    }
    Ok(())
}

/// Fits; blocks.
fn run(
    job: FitJob,
    store: &Store,
    events: &mpsc::Sender<Response>,
    cancelled: impl Fn() -> bool,
) -> Result<Fitted, CallError> {
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
    let fit = job.run(store, progress, &cancelled)?;
    if cancelled() { Err(CallError::Cancelled) } else { Ok(fit) }
}

/// Stores a fit that came to an end.
async fn keep(fitted: Result<Fitted, CallError>, store: &Store) -> Result<pb::Fit, CallError> {
    let (fit, ids) = fitted?;
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
