//! Closed-loop roll-outs: a scripted driver or a tabular policy drives episodes of an environment.
//!
//! Invariants: episode i depends on `seed + i` alone, never on the number of threads or the size of a chunk; the dynamics and
//! the controller draw from separate streams, so that replaying an episode's actions in a session seeded alike gives the
//! same episode. Memory is bounded by one chunk. Deliberately absent: time limits, as a roll-out says how long it is.

mod chunk;
mod episode;
mod error;
mod policy;
mod rewards;
mod steps;

use crate::sim::{Configured, EnvSpec, Simulator};
pub use chunk::EpisodeChunk;
use chunk::Stopped;
pub use error::RolloutError;
pub use policy::{ROW_SUM_TOLERANCE, TabularPolicy};
pub use steps::{RewardFormat, StepFormat, Steps, Width};

/// Who acts.
#[derive(Debug, Clone, PartialEq)]
pub enum Controller {
    /// A scripted driver by name.
    Driver(String),
    /// A policy over the tabular states.
    Policy(TabularPolicy),
}

/// What to roll out.
#[derive(Debug, Clone, PartialEq)]
pub struct RolloutPlan {
    /// Who acts.
    pub controller: Controller,
    /// Episode i is seeded with seed + i, wrapping around.
    pub seed: u64,
    /// Number of episodes; at least 1.
    pub episodes: u32,
    /// Steps recorded of each; at least 1.
    pub steps: u32,
    /// Steps driven before.
    pub burn_in_steps: u32,
    /// Leave out the arrays of every step.
    pub totals_only: bool,
    /// Pack the arrays of every step in as few bytes as hold every value.
    pub compact: bool,
    /// Episodes computed together, and the most that an [`EpisodeChunk`] holds; at least 1.
    pub chunk_episodes: u32,
}

impl RolloutPlan {
    /// Checks the plan against an environment.
    ///
    /// # Errors
    /// Unknown driver, a policy of another shape, no episodes or steps.
    pub fn check(&self, spec: &EnvSpec) -> Result<(), RolloutError> {
        if self.episodes == 0 {
            return Err(RolloutError::Zero { field: "episodes" });
        }
        if self.steps == 0 {
            return Err(RolloutError::Zero { field: "steps" });
        }
        match &self.controller {
            Controller::Driver(name) if spec.drivers.iter().any(|(known, _)| known == name) => Ok(()),
            Controller::Driver(name) => Err(RolloutError::UnknownDriver {
                name: name.clone(),
                known: spec.drivers.iter().map(|(name, _)| *name).collect(),
            }),
            Controller::Policy(policy) => {
                let expected = spec.n_states as usize * spec.n_actions as usize;
                let (n_states, n_actions) = (spec.n_states, spec.n_actions);
                if policy.len() == expected && policy.n_actions() == n_actions {
                    Ok(())
                } else {
                    Err(RolloutError::PolicyShape { expected, got: policy.len(), n_states, n_actions })
                }
            }
        }
    }
}

/// Runs a checked plan and hands over the chunks in order, until `emit` returns false or `cancelled` true.
///
/// Computes the episodes of a chunk in parallel on the current rayon pool; `emit` is called on the caller's thread, which may
/// wait in it for as long as it likes.
pub fn roll_out<S: Simulator>(
    configured: &Configured<S>,
    plan: &RolloutPlan,
    cancelled: &(dyn Fn() -> bool + Sync),
    emit: &mut dyn FnMut(EpisodeChunk) -> bool,
) {
    let mut format = StepFormat::of(plan, &configured.spec);
    let mut first = 0;
    while first < plan.episodes {
        let last = first.saturating_add(plan.chunk_episodes.max(1)).min(plan.episodes);
        match chunk::run(configured, plan, format, first..last, cancelled) {
            Ok(chunk) => {
                if !emit(chunk) {
                    return;
                }
                first = last;
            }
            // Episodes depend on their seeds alone: once more, as whole values from here on.
            Err(Stopped::ManyRewards) => format.rewards = RewardFormat::Values,
            Err(Stopped::Cancelled) => return,
        }
    }
}

#[cfg(test)]
mod tests;
