//! Counts of transitions whose actions were not seen, per step.
//!
//! What [`Statistics`](crate::statistics::Statistics) keeps of demonstrations that hold the states alone: how often each s → s'
//! was seen in step k. Memory is bounded by the transitions that occur and the horizon, never by the amount of data.

use std::collections::BTreeMap;

/// A transition s → s' and how often it was seen.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct TransitionCount {
    /// s.
    pub state: u32,
    /// s'.
    pub next_state: u32,
    /// How often.
    pub count: f64,
}

/// Gathers [`TransitionCounts`].
#[derive(Debug, Clone, Default)]
pub(crate) struct TransitionCountsBuilder {
    steps: Vec<BTreeMap<(u32, u32), u64>>,
}

impl TransitionCountsBuilder {
    /// Counts the transitions of a trajectory, the first on.
    pub(crate) fn add(&mut self, transitions: impl Iterator<Item = (u32, u32)>) {
        for (k, transition) in transitions.enumerate() {
            if self.steps.len() == k {
                self.steps.push(BTreeMap::new());
            }
            *self.steps[k].entry(transition).or_insert(0) += 1;
        }
    }

    /// Ends the gathering.
    pub(crate) fn finish(self) -> TransitionCounts {
        let count = |((state, next_state), n)| TransitionCount { state, next_state, count: n as f64 };
        TransitionCounts { steps: self.steps.into_iter().map(|step| step.into_iter().map(count).collect()).collect() }
    }
}

/// `N_k(s,s')`, for each step the transitions in rising order.
#[derive(Debug, Clone, PartialEq, Default)]
pub struct TransitionCounts {
    steps: Vec<Vec<TransitionCount>>,
}

impl TransitionCounts {
    /// True where there is none.
    pub fn is_empty(&self) -> bool {
        self.steps.is_empty()
    }

    /// Number of steps in which there is one.
    pub fn n_steps(&self) -> usize {
        self.steps.len()
    }

    /// Multiplies every count.
    pub(crate) fn scale(&mut self, factor: f64) {
        for transition in self.steps.iter_mut().flatten() {
            transition.count *= factor;
        }
    }

    /// `N_k(s,s')` of step `k` = 0, 1, …; empty beyond the last.
    pub fn step(&self, k: usize) -> &[TransitionCount] {
        self.steps.get(k).map_or(&[], Vec::as_slice)
    }

    /// Those of the first `horizon` steps (all where `None`), with their steps.
    pub fn iter(&self, horizon: Option<u32>) -> impl Iterator<Item = (usize, TransitionCount)> + '_ {
        let horizon = horizon.map_or(usize::MAX, |k| k as usize);
        self.steps.iter().take(horizon).enumerate().flat_map(|(k, step)| step.iter().map(move |&t| (k, t)))
    }

    /// Number of transitions in the first `horizon` steps (all where `None`).
    pub fn total(&self, horizon: Option<u32>) -> f64 {
        self.iter(horizon).map(|(_, t)| t.count).sum()
    }
}
