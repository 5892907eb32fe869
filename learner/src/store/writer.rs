//! The one thread that writes, and why it is one: everything that arrives while a commit waits for the disk goes into
//! the next commit, so that a hundred clients cost about as many syncs as one.
//!
//! Invariant: an answer is given only after the commit that holds it has returned. A job that fails takes back its own
//! changes and nobody else's.

use super::{Activity, StoreError, activity::Recorded, trajectories::CollectionCache};
use rusqlite::{Connection, TransactionBehavior};
use std::{
    path::{Path, PathBuf},
    sync::Arc,
    thread,
    time::Instant,
};
use tokio::sync::{mpsc, oneshot};

/// Jobs that wait for the writer at most; more wait in their callers.
const QUEUED_JOBS: usize = 1024;
/// Jobs in one commit at most.
const JOBS_A_COMMIT: usize = 512;

/// What a job works with.
pub(super) struct Work<'a> {
    pub(super) connection: &'a Connection,
    pub(super) path: &'a Path,
    pub(super) collections: &'a mut CollectionCache,
    /// What was stored and is not committed yet.
    pub(super) recorded: &'a mut Recorded,
    /// Why the job failed.
    failed: Option<StoreError>,
}

/// Tells the caller how it went, once it is known how the commit went.
type Answer = Box<dyn FnOnce(Result<(), StoreError>) + Send>;
/// Runs in a transaction, or hears that there is none.
type Shared = Box<dyn FnOnce(Result<&mut Work<'_>, StoreError>) -> Answer + Send>;
/// Runs between transactions.
type Alone = Box<dyn FnOnce(&Connection) + Send>;

/// What the writing thread is asked for.
enum Job {
    /// Shares a transaction with others.
    Shared(Shared),
    /// Cannot run in a transaction.
    Alone(Alone),
}

/// Takes jobs to the writing thread.
#[derive(Debug)]
pub(super) struct Writer {
    path: PathBuf,
    jobs: Option<mpsc::Sender<Job>>,
    thread: Option<thread::JoinHandle<()>>,
}

impl Writer {
    pub(super) fn start(connection: Connection, path: PathBuf, activity: Arc<Activity>) -> Result<Self, StoreError> {
        let (jobs, queue) = mpsc::channel(QUEUED_JOBS);
        let thread = thread::Builder::new()
            .name("store-writer".into())
            .spawn({
                let path = path.clone();
                move || write(connection, &path, queue, &activity)
            })
            .map_err(|e| StoreError::directory(&path, &e))?;
        Ok(Self { path, jobs: Some(jobs), thread: Some(thread) })
    }

    /// Queues `job` for a transaction, behind all that was queued before. What it gives is the job's result once that
    /// is on stable storage.
    pub(super) async fn queue<T: Send + 'static>(
        &self,
        job: impl FnOnce(&mut Work<'_>) -> Result<T, StoreError> + Send + 'static,
    ) -> Result<Pending<T>, StoreError> {
        let (answer, result) = oneshot::channel();
        let job: Shared = Box::new(move |work| {
            let outcome = work.and_then(|work| in_savepoint(work, job));
            Box::new(move |commit| {
                // A caller that has gone does not want its answer.
                let _ = answer.send(outcome.and_then(|value| commit.map(|()| value)));
            })
        });
        self.send(Job::Shared(job)).await?;
        Ok(Pending(result))
    }

    /// Runs `job` outside any transaction, behind all that was queued before.
    pub(super) async fn queue_alone(
        &self,
        job: impl FnOnce(&Connection) -> rusqlite::Result<()> + Send + 'static,
    ) -> Result<(), StoreError> {
        let (answer, result) = oneshot::channel();
        let path = self.path.clone();
        let job: Alone = Box::new(move |connection| {
            // A caller that has gone does not want its answer.
            let _ = answer.send(job(connection).map_err(|e| StoreError::from_sqlite(&path, &e)));
        });
        self.send(Job::Alone(job)).await?;
        result.await.map_err(|_| StoreError::Closed)?
    }

    async fn send(&self, job: Job) -> Result<(), StoreError> {
        let jobs = self.jobs.as_ref().ok_or(StoreError::Closed)?;
        jobs.send(job).await.map_err(|_| StoreError::Closed)
    }
}

/// A job that is queued.
#[derive(Debug)]
pub struct Pending<T>(oneshot::Receiver<Result<T, StoreError>>);

impl<T> Pending<T> {
    /// Waits for the commit. The job runs whether anybody waits or not.
    pub async fn committed(self) -> Result<T, StoreError> {
        self.0.await.map_err(|_| StoreError::Closed)?
    }
}

impl Drop for Writer {
    /// Waits for the jobs that are queued: what was submitted is written.
    fn drop(&mut self) {
        self.jobs.take();
        if let Some(thread) = self.thread.take()
            && thread.join().is_err()
        {
            tracing::error!("the store's writer panicked");
        }
    }
}

fn write(mut connection: Connection, path: &Path, mut queue: mpsc::Receiver<Job>, activity: &Activity) {
    let mut collections = CollectionCache::new();
    let mut next = None;
    while let Some(job) = next.take().or_else(|| queue.blocking_recv()) {
        let first = match job {
            Job::Shared(first) => first,
            Job::Alone(job) => {
                job(&connection);
                continue;
            }
        };
        let mut answers = Vec::new();
        let more = || match queue.try_recv() {
            Ok(Job::Shared(job)) => Some(job),
            // Its turn comes after the commit.
            Ok(alone @ Job::Alone(_)) => {
                next = Some(alone);
                None
            }
            Err(_) => None,
        };
        let result = commit_together(&mut connection, path, &mut collections, first, more, &mut answers, activity);
        activity.note(result.as_ref().err());
        let result = result.map(|refused| activity.note(refused.as_ref()));
        if let Err(error) = &result {
            tracing::error!(%error, jobs = answers.len(), "a commit failed");
            // Rows of collections that were made in it are gone.
            collections.clear();
        }
        for answer in answers {
            answer(result.clone());
        }
    }
}

/// Runs jobs in one transaction. Gives the error of the last that failed, which took back its own changes alone.
fn commit_together(
    connection: &mut Connection,
    path: &Path,
    collections: &mut CollectionCache,
    first: Shared,
    mut more: impl FnMut() -> Option<Shared>,
    answers: &mut Vec<Answer>,
    activity: &Activity,
) -> Result<Option<StoreError>, StoreError> {
    let fail = |e: rusqlite::Error| StoreError::from_sqlite(path, &e);
    let transaction = match connection.transaction_with_behavior(TransactionBehavior::Immediate) {
        Ok(transaction) => transaction,
        Err(error) => {
            let error = fail(error);
            answers.push(first(Err(error.clone())));
            return Err(error);
        }
    };
    let mut job = first;
    let (mut recorded, mut refused) = (Recorded::default(), None);
    loop {
        let mut work = Work { connection: &transaction, path, collections, recorded: &mut recorded, failed: None };
        answers.push(job(Ok(&mut work)));
        // Some errors, a full disk among them, make SQLite roll back the whole transaction and not the statement alone.
        if let Some(error) = work.failed {
            if transaction.is_autocommit() {
                return Err(error);
            }
            refused = Some(error);
        }
        if answers.len() >= JOBS_A_COMMIT {
            break;
        }
        match more() {
            Some(next) => job = next,
            None => break,
        }
    }
    let begun = Instant::now();
    transaction.commit().map_err(fail)?;
    activity.committed(answers.len(), recorded, begun.elapsed());
    Ok(refused)
}

/// Runs a job so that its failure leaves no trace.
fn in_savepoint<T>(
    work: &mut Work<'_>,
    job: impl FnOnce(&mut Work<'_>) -> Result<T, StoreError>,
) -> Result<T, StoreError> {
    let execute =
        |work: &Work<'_>, sql| work.connection.execute_batch(sql).map_err(|e| StoreError::from_sqlite(work.path, &e));
    let outcome = execute(work, "SAVEPOINT job").and_then(|()| job(work)).and_then(|value| {
        execute(work, "RELEASE job")?;
        Ok(value)
    });
    if let Err(error) = &outcome {
        work.failed = Some(error.clone());
        // Rows of collections that the job made are taken back with it.
        work.collections.clear();
        if !work.connection.is_autocommit() {
            execute(work, "ROLLBACK TO job; RELEASE job")?;
        }
    }
    outcome
}
