//! What the store has done, in numbers, and whether it can still write.

use super::{Recording, StoreError};
use mazeway_serving::telemetry::{
    Telemetry,
    numbers::{Counter, Times},
};
use std::sync::atomic::{AtomicBool, Ordering::Relaxed};

/// Numbers of a store since it was opened.
#[derive(Debug)]
pub struct Activity {
    trajectories: Counter,
    steps: Counter,
    bytes: Counter,
    jobs: Counter,
    failures: Counter,
    commits: Times,
    writable: AtomicBool,
}

/// Recordings that are written and not committed yet.
#[derive(Debug, Clone, Copy, Default)]
pub(super) struct Recorded {
    trajectories: u64,
    steps: u64,
    bytes: u64,
}

impl Recorded {
    /// One more.
    pub(super) fn add(&mut self, recording: &Recording) {
        self.trajectories += 1;
        self.steps += u64::from(recording.steps());
        self.bytes += recording.packed_bytes() as u64;
    }

    /// Bytes of their arrays.
    pub(super) fn bytes(&self) -> u64 {
        self.bytes
    }

    /// All of the other too.
    pub(super) fn join(&mut self, other: Self) {
        self.trajectories += other.trajectories;
        self.steps += other.steps;
        self.bytes += other.bytes;
    }
}

impl Default for Activity {
    fn default() -> Self {
        Self {
            trajectories: Counter::default(),
            steps: Counter::default(),
            bytes: Counter::default(),
            jobs: Counter::default(),
            failures: Counter::default(),
            commits: Times::of_disks(),
            writable: AtomicBool::new(true),
        }
    }
}

impl Activity {
    /// Shows the numbers.
    pub fn show(&self, telemetry: &Telemetry) {
        telemetry.add(
            "recorded_trajectories",
            "Trajectories stored, repeated ones not counted",
            self.trajectories.clone(),
        );
        telemetry.add("recorded_steps", "Steps of the trajectories stored", self.steps.clone());
        telemetry.add("recorded_bytes", "Bytes of the arrays stored", self.bytes.clone());
        let help = "Time of a commit, which ends when all of it is on stable storage";
        telemetry.add("commit_seconds", help, self.commits.clone());
        let help = "Requests that shared the commits: divided by their number, the size of a group";
        telemetry.add("commit_requests", help, self.jobs.clone());
        telemetry.add(
            "commit_failures",
            "Commits and requests that the disk, its room or the quota refused",
            self.failures.clone(),
        );
    }

    /// False from a write that failed for lack of room or of a working disk to the next that succeeds.
    pub fn is_writable(&self) -> bool {
        self.writable.load(Relaxed)
    }

    /// A commit of so many jobs has returned.
    pub(super) fn committed(&self, jobs: usize, recorded: Recorded, took: std::time::Duration) {
        self.commits.observe(took);
        self.jobs.add(jobs as u64);
        self.trajectories.add(recorded.trajectories);
        self.steps.add(recorded.steps);
        self.bytes.add(recorded.bytes);
    }

    /// Takes note of how writing went: of an error that is no fault of what was to be written, or that there was none.
    pub(super) fn note(&self, error: Option<&StoreError>) {
        let failed = match error {
            None => false,
            Some(
                StoreError::DiskFull { .. }
                | StoreError::QuotaReached { .. }
                | StoreError::Database { .. }
                | StoreError::Corrupt { .. },
            ) => true,
            Some(_) => return,
        };
        self.failures.add(u64::from(failed));
        self.writable.store(!failed, Relaxed);
    }
}
