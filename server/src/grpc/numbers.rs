//! What an environment server counts of its own: sessions, environments, steps, roll-outs, refusals.

use super::status::CallError;
use crate::{
    registry::RegistryError,
    sessions::{SessionError, Sessions},
};
use mazeway_serving::telemetry::{
    Telemetry,
    numbers::{Counter, Times},
};
use prometheus_client::{encoding::EncodeLabelSet, metrics::family::Family};
use std::{sync::Arc, time::Duration};

/// Why a session was refused.
#[derive(Debug, Clone, PartialEq, Eq, Hash, EncodeLabelSet)]
struct Reason {
    reason: &'static str,
}

/// Every reason that there is: shown from the start, so that the first refusal is seen to come.
const REASONS: [&str; 7] = ["sessions", "environments", "lease", "options", "unknown_environment", "stopping", "other"];

/// Numbers that calls and streams add to.
#[derive(Debug)]
pub struct Numbers {
    steps: Counter,
    step_times: Times,
    rollout_steps: Counter,
    refused: Family<Reason, Counter>,
}

impl Numbers {
    /// Shows them, and what the sessions say of themselves.
    pub fn new(telemetry: &Telemetry, sessions: &Arc<Sessions>) -> Self {
        let numbers = Self {
            steps: Counter::default(),
            step_times: Times::of_steps(),
            rollout_steps: Counter::default(),
            refused: Family::default(),
        };
        telemetry.add("steps", "Steps of environments, those of a batch counted one by one", numbers.steps.clone());
        for reason in REASONS {
            drop(numbers.refused.get_or_create(&Reason { reason }));
        }
        let help = "Time in which the server steps a batch and writes the answer, without the wire";
        telemetry.add("step_seconds", help, numbers.step_times.clone());
        telemetry.add("rollout_steps", "Steps of roll-outs that were sent", numbers.rollout_steps.clone());
        telemetry.add("sessions_refused", "Sessions that were not made, by reason", numbers.refused.clone());
        let count = |name, help, read: fn(&Sessions) -> u64| {
            let sessions = Arc::clone(sessions);
            telemetry.count(name, help, move || read(&sessions));
        };
        count("sessions_created", "Sessions made", |sessions| sessions.tally().created);
        count("sessions_expired", "Sessions whose lease ran out", |sessions| sessions.tally().expired);
        let gauge = |name, help, read: fn(&Sessions) -> usize| {
            let sessions = Arc::clone(sessions);
            telemetry.read(name, help, move || read(&sessions) as i64);
        };
        gauge("sessions", "Sessions that live", Sessions::len);
        gauge("environments", "Environments of the sessions that live", Sessions::total_envs);
        numbers
    }

    /// A batch of so many was stepped.
    pub fn stepped(&self, num_envs: usize, took: Duration) {
        self.steps.add(num_envs as u64);
        self.step_times.observe(took);
    }

    /// A message of a roll-out holds so many steps.
    pub fn rolled_out(&self, steps: u64) {
        self.rollout_steps.add(steps);
    }

    /// A session was refused.
    pub fn refused(&self, error: &CallError) {
        let reason = match error {
            CallError::Session(SessionError::Limit { field: "sessions", .. }) => "sessions",
            CallError::Session(SessionError::Limit { .. }) | CallError::Limit { .. } => "environments",
            CallError::Session(SessionError::Lease { .. }) => "lease",
            CallError::Registry(RegistryError::UnknownEnvironment { .. }) => "unknown_environment",
            CallError::Registry(_) | CallError::Malformed { .. } => "options",
            CallError::ShuttingDown => "stopping",
            _ => "other",
        };
        self.refused.get_or_create(&Reason { reason }).add(1);
    }
}
