//! Closed-loop roll-outs: a scripted driver or a tabular policy drives episodes of an environment.
//!
//! Invariants: episode i depends on `seed + i` alone, never on the number of threads or the size of a chunk; the dynamics and
//! the controller draw from separate streams, so that replaying an episode's actions in a session seeded alike gives the
//! same episode. Memory is bounded by one chunk. Deliberately absent: time limits, as a roll-out says how long it is.

use crate::sim::{
    Configured, Driver, EnvSpec, Rng, Simulator,
    rng::{Purpose, stream, uniform},
};
use rayon::prelude::*;

/// How far a row of a policy may be from summing to 1.
pub const ROW_SUM_TOLERANCE: f64 = 1e-6;

/// Steps after which a long episode looks whether anyone still waits for it.
const CANCEL_CHECK_STEPS: u32 = 4096;

/// A checked policy over the tabular states, ready to be drawn from.
#[derive(Debug, Clone, PartialEq)]
pub struct TabularPolicy {
    n_actions: usize,
    /// Running sums of each row, shape `(n_states, n_actions)`.
    cumulative: Vec<f64>,
}

impl TabularPolicy {
    /// Checks π(a|s), shape `(n_states, n_actions)`.
    ///
    /// # Errors
    /// Another length, an entry that is negative or not finite, a row that does not sum to 1 within
    /// [`ROW_SUM_TOLERANCE`].
    pub fn new(probabilities: &[f64], n_states: u32, n_actions: u32) -> Result<Self, RolloutError> {
        let expected = n_states as usize * n_actions as usize;
        if probabilities.len() != expected {
            return Err(RolloutError::PolicyShape { expected, got: probabilities.len(), n_states, n_actions });
        }
        let mut cumulative = Vec::with_capacity(expected);
        for (state, row) in probabilities.chunks_exact(n_actions as usize).enumerate() {
            let mut sum = 0.0;
            for (action, &value) in row.iter().enumerate() {
                if !value.is_finite() || value < 0.0 {
                    return Err(RolloutError::PolicyEntry { state, action, value });
                }
                sum += value;
                cumulative.push(sum);
            }
            if (sum - 1.0).abs() > ROW_SUM_TOLERANCE {
                return Err(RolloutError::PolicyRow { state, sum });
            }
        }
        Ok(Self { n_actions: n_actions as usize, cumulative })
    }

    /// Draws an action in `state` by the inverse of the cumulative distribution.
    #[inline]
    pub fn draw(&self, state: u32, rng: &mut Rng) -> u32 {
        let row = &self.cumulative[state as usize * self.n_actions..][..self.n_actions];
        let total = row[self.n_actions - 1];
        let u = uniform(rng) * total;
        // The product may round up to the total: then it is the last action of positive probability.
        row.iter().position(|&sum| u < sum).unwrap_or_else(|| row.partition_point(|&sum| sum < total)) as u32
    }
}

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
                if policy.cumulative.len() == expected && policy.n_actions == n_actions as usize {
                    Ok(())
                } else {
                    Err(RolloutError::PolicyShape { expected, got: policy.cumulative.len(), n_states, n_actions })
                }
            }
        }
    }
}

/// A refused roll-out.
#[derive(Debug, Clone, PartialEq, thiserror::Error)]
pub enum RolloutError {
    /// A count that must be positive.
    #[error("expected at least 1, got 0")]
    Zero {
        /// Which.
        field: &'static str,
    },
    /// No such driver.
    #[error("expected a driver among {}, got {name:?}", known.join(", "))]
    UnknownDriver {
        /// What came.
        name: String,
        /// What there is.
        known: Vec<&'static str>,
    },
    /// Neither driver nor policy.
    #[error("expected a driver or a policy, got neither")]
    NoController,
    /// A policy whose bytes are no whole float64 values.
    #[error("expected packed float64 values, got {got} bytes")]
    PolicyBytes {
        /// Bytes that came.
        got: usize,
    },
    /// A policy of another shape.
    #[error("expected {expected} probabilities, shape ({n_states}, {n_actions}), got {got}")]
    PolicyShape {
        /// Values expected.
        expected: usize,
        /// Values that came.
        got: usize,
        /// Number of states.
        n_states: u32,
        /// Number of actions.
        n_actions: u32,
    },
    /// An entry that is no probability.
    #[error("expected a probability for state {state} and action {action}, got {value}")]
    PolicyEntry {
        /// Row.
        state: usize,
        /// Column.
        action: usize,
        /// What came.
        value: f64,
    },
    /// A row that does not sum to 1.
    #[error("expected the probabilities of state {state} to sum to 1 within 1e-6, got {sum}")]
    PolicyRow {
        /// Row.
        state: usize,
        /// Its sum.
        sum: f64,
    },
}

impl RolloutError {
    /// The field of the request that is wrong.
    pub fn field(&self) -> String {
        match self {
            Self::Zero { field } => (*field).into(),
            Self::UnknownDriver { .. } => "driver".into(),
            Self::NoController => "controller".into(),
            Self::PolicyBytes { .. } | Self::PolicyShape { .. } => "policy.probabilities".into(),
            Self::PolicyEntry { state, action, .. } => format!("policy.probabilities[{state}][{action}]"),
            Self::PolicyRow { state, .. } => format!("policy.probabilities[{state}]"),
        }
    }
}

/// One recorded episode.
#[derive(Debug, Clone, Default, PartialEq)]
struct Episode {
    length: u32,
    states: Vec<u32>,
    actions: Vec<u32>,
    rewards: Vec<f64>,
    final_state: u32,
    terminated: bool,
    total_reward: f64,
    totals: Vec<f64>,
}

/// Consecutive episodes of a roll-out.
#[derive(Debug, Clone, Default, PartialEq)]
pub struct EpisodeChunk {
    /// Rank of the first.
    pub first_episode: u32,
    /// Steps of each, shape `(episodes,)`.
    pub lengths: Vec<u32>,
    /// Tabular state before each step, episode after episode; empty where totals alone were asked for.
    pub states: Vec<u32>,
    /// Action of each step, likewise.
    pub actions: Vec<u32>,
    /// Reward of each step, likewise.
    pub rewards: Vec<f64>,
    /// Tabular state after the last step of each, shape `(episodes,)`.
    pub final_states: Vec<u32>,
    /// The episode came to an end of its own, shape `(episodes,)`.
    pub terminated: Vec<bool>,
    /// Sum of each episode's rewards, shape `(episodes,)`.
    pub returns: Vec<f64>,
    /// Names of the summed info columns.
    pub total_names: Vec<&'static str>,
    /// Sums of each summed column, shape `(columns, episodes)`.
    pub totals: Vec<Vec<f64>>,
}

/// Runs a checked plan and hands over the chunks in order, until `emit` returns false or `cancelled` true.
///
/// Computes the episodes of a chunk in parallel on the current rayon pool.
pub fn roll_out<S: Simulator>(
    configured: &Configured<S>,
    plan: &RolloutPlan,
    cancelled: &(dyn Fn() -> bool + Sync),
    emit: &mut dyn FnMut(EpisodeChunk) -> bool,
) {
    let spec = &configured.spec;
    let summed: Vec<usize> = (0..spec.info_columns.len()).filter(|&i| spec.info_columns[i].summed).collect();
    let mut first = 0;
    while first < plan.episodes {
        let last = first.saturating_add(plan.chunk_episodes.max(1)).min(plan.episodes);
        let episodes: Option<Vec<Episode>> =
            (first..last).into_par_iter().map(|rank| run_episode(configured, plan, &summed, rank, cancelled)).collect();
        let Some(episodes) = episodes else { return };
        if !emit(gather(spec, &summed, first, episodes)) {
            return;
        }
        first = last;
    }
}

fn gather(spec: &EnvSpec, summed: &[usize], first_episode: u32, episodes: Vec<Episode>) -> EpisodeChunk {
    let mut chunk = EpisodeChunk {
        first_episode,
        total_names: summed.iter().map(|&column| spec.info_columns[column].name).collect(),
        totals: vec![Vec::with_capacity(episodes.len()); summed.len()],
        ..EpisodeChunk::default()
    };
    for episode in episodes {
        chunk.lengths.push(episode.length);
        chunk.states.extend(episode.states);
        chunk.actions.extend(episode.actions);
        chunk.rewards.extend(episode.rewards);
        chunk.final_states.push(episode.final_state);
        chunk.terminated.push(episode.terminated);
        chunk.returns.push(episode.total_reward);
        for (totals, total) in chunk.totals.iter_mut().zip(episode.totals) {
            totals.push(total);
        }
    }
    chunk
}

enum Acting<'a, S> {
    Driver(Box<dyn Driver<S>>),
    Policy(&'a TabularPolicy),
}

impl<'a, S: Simulator> Acting<'a, S> {
    fn new(controller: &'a Controller, simulator: &S) -> Self {
        match controller {
            Controller::Driver(name) => Self::Driver(simulator.driver(name).expect("the plan was checked")),
            Controller::Policy(policy) => Self::Policy(policy),
        }
    }

    #[inline]
    fn act(&mut self, simulator: &S, rng: &mut Rng) -> u32 {
        match self {
            Self::Driver(driver) => driver.act(simulator, rng),
            Self::Policy(policy) => policy.draw(simulator.tabular_state(), rng),
        }
    }
}

/// `None` where it was cancelled.
fn run_episode<S: Simulator>(
    configured: &Configured<S>,
    plan: &RolloutPlan,
    summed: &[usize],
    rank: u32,
    cancelled: &(dyn Fn() -> bool + Sync),
) -> Option<Episode> {
    let seed = plan.seed.wrapping_add(u64::from(rank));
    let (mut dynamics, mut choices) = (stream(seed, Purpose::Dynamics), stream(seed, Purpose::Controller));
    let mut simulator = configured.prototype.clone();
    simulator.reset(&mut dynamics);
    let mut acting = Acting::new(&plan.controller, &simulator);
    let gone = |step: u32| step.is_multiple_of(CANCEL_CHECK_STEPS) && cancelled();
    for step in 0..plan.burn_in_steps {
        if gone(step) {
            return None;
        }
        let action = acting.act(&simulator, &mut choices);
        if simulator.step(action, &mut dynamics).terminated {
            simulator.reset(&mut dynamics);
            acting = Acting::new(&plan.controller, &simulator);
        }
    }
    let capacity = if plan.totals_only { 0 } else { plan.steps as usize };
    let mut episode = Episode {
        states: Vec::with_capacity(capacity),
        actions: Vec::with_capacity(capacity),
        rewards: Vec::with_capacity(capacity),
        totals: vec![0.0; summed.len()],
        ..Episode::default()
    };
    for step in 0..plan.steps {
        if gone(step) {
            return None;
        }
        let state = simulator.tabular_state();
        let action = acting.act(&simulator, &mut choices);
        let outcome = simulator.step(action, &mut dynamics);
        if !plan.totals_only {
            episode.states.push(state);
            episode.actions.push(action);
            episode.rewards.push(outcome.reward);
        }
        episode.length += 1;
        episode.total_reward += outcome.reward;
        for (total, &column) in episode.totals.iter_mut().zip(summed) {
            *total += simulator.info_value(column);
        }
        if outcome.terminated {
            episode.terminated = true;
            break;
        }
    }
    episode.final_state = simulator.tabular_state();
    Some(episode)
}

#[cfg(test)]
mod tests;
