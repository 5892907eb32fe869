//! A transition model from transitions that were seen, for processes whose dynamics nobody wrote down.
//!
//! The rows are posterior means under a Dirichlet prior. With n(s,a,s') the number of times that s' was seen to follow (s,a),
//! n(s,a) and n(s) its sums over s' and over both, and α the strength of the prior,
//!
//! P(s'|s,a) = (n(s,a,s') + α m(s'|s)) / (n(s,a) + α), with the prior mean m(s'|s) = Σ_a n(s,a,s') / n(s):
//!
//! what is not known of an action is taken to be what the state's other actions do. The prior is worth α transitions. Its
//! support are the successors that were seen, so that the model is as sparse as the data. Where nothing was seen:
//!
//! - a pair whose state was left by another action has the row m(·|s);
//! - a state that was never left keeps its place: it is absorbing.
//!
//! Both are guesses, and [`EstimatedMdp::visits`] is 0 there. Deliberately absent: any smoothness between states.

use super::{MdpError, TabularMdp};
use std::collections::BTreeMap;

/// How often each transition was seen.
#[derive(Debug, Clone, PartialEq, Eq, Default)]
pub struct TransitionCounts {
    counts: BTreeMap<(u32, u32, u32), u64>,
    starts: BTreeMap<u32, u64>,
}

/// A model and what it rests on.
#[derive(Debug, Clone, PartialEq)]
pub struct EstimatedMdp {
    /// The model; it starts as the trajectories did.
    pub mdp: TabularMdp,
    /// n(s,a), shape (`n_states * n_actions`,): 0 where the row is a guess.
    pub visits: Vec<u64>,
}

/// Why there is no estimate.
#[derive(Debug, Clone, PartialEq, thiserror::Error)]
pub enum EstimateError {
    /// Nothing to estimate from.
    #[error("expected at least one transition to estimate a model from, got none")]
    Empty,
    /// Not a strength.
    #[error("expected a finite strength of the prior that is not negative, got {0}")]
    Prior(f64),
    /// A transition outside the process.
    #[error(
        "expected states below {n_states} and actions below {n_actions}, got ({state}, {action}) followed by {next_state}"
    )]
    OutOfRange {
        /// Number of states.
        n_states: usize,
        /// Number of actions.
        n_actions: usize,
        /// What came.
        state: u32,
        /// What came.
        action: u32,
        /// What came.
        next_state: u32,
    },
    /// The sizes are none.
    #[error(transparent)]
    Model(#[from] MdpError),
}

impl TransitionCounts {
    /// Counts a transition.
    pub fn add(&mut self, state: u32, action: u32, next_state: u32) {
        *self.counts.entry((state, action, next_state)).or_default() += 1;
    }

    /// Counts the first state of a trajectory.
    pub fn add_start(&mut self, state: u32) {
        *self.starts.entry(state).or_default() += 1;
    }

    /// Transitions in all.
    pub fn total(&self) -> u64 {
        self.counts.values().sum()
    }

    /// Different transitions.
    pub fn distinct(&self) -> usize {
        self.counts.len()
    }

    /// The same counts under other numbers of states and actions.
    #[must_use]
    pub fn renumbered(&self, states: &[u32], actions: &[u32]) -> Self {
        let (s, a) = (|i: u32| states[i as usize], |i: u32| actions[i as usize]);
        Self {
            counts: self.counts.iter().map(|(&(from, by, to), &n)| ((s(from), a(by), s(to)), n)).collect(),
            starts: self.starts.iter().map(|(&state, &n)| (s(state), n)).collect(),
        }
    }

    /// The posterior mean under a prior that is worth `strength` transitions; starts are taken as they were seen.
    ///
    /// # Errors
    /// No transition, a strength that is none, indices outside the sizes.
    pub fn estimate(&self, n_states: usize, n_actions: usize, strength: f64) -> Result<EstimatedMdp, EstimateError> {
        if self.counts.is_empty() {
            return Err(EstimateError::Empty);
        }
        if !(strength.is_finite() && strength >= 0.0) {
            return Err(EstimateError::Prior(strength));
        }
        let inside = |&(s, a, next): &(u32, u32, u32)| {
            (s as usize) < n_states && (a as usize) < n_actions && (next as usize) < n_states
        };
        if let Some(&(state, action, next_state)) = self.counts.keys().find(|key| !inside(key)) {
            return Err(EstimateError::OutOfRange { n_states, n_actions, state, action, next_state });
        }
        let n_rows = n_states
            .checked_mul(n_actions)
            .filter(|&n| u32::try_from(n).is_ok())
            .ok_or(MdpError::TooLarge { n_states, n_actions })?;
        let mut visits = vec![0_u64; n_rows];
        let mut pooled = vec![BTreeMap::<u32, u64>::new(); n_states];
        for (&(state, action, next), &n) in &self.counts {
            visits[state as usize * n_actions + action as usize] += n;
            *pooled[state as usize].entry(next).or_default() += n;
        }
        let (mut offsets, mut next_states, mut probabilities) = (vec![0], Vec::new(), Vec::new());
        for (state, successors) in pooled.iter().enumerate() {
            let left: u64 = successors.values().sum();
            for action in 0..n_actions {
                let seen = visits[state * n_actions + action] as f64;
                let begin = probabilities.len();
                for (&next, &n) in successors {
                    let key = (state as u32, action as u32, next);
                    let own = self.counts.get(&key).copied().unwrap_or(0) as f64;
                    let mean = n as f64 / left as f64;
                    let p = if seen + strength > 0.0 { (own + strength * mean) / (seen + strength) } else { mean };
                    if p > 0.0 {
                        next_states.push(next);
                        probabilities.push(p);
                    }
                }
                if successors.is_empty() {
                    next_states.push(state as u32);
                    probabilities.push(1.0);
                }
                // Rounding must not add up over many successors.
                let sum: f64 = probabilities[begin..].iter().sum();
                for p in &mut probabilities[begin..] {
                    *p /= sum;
                }
                offsets.push(next_states.len());
            }
        }
        let mdp = TabularMdp::new(n_states, n_actions, offsets, next_states, probabilities, self.initial(n_states))?;
        Ok(EstimatedMdp { mdp, visits })
    }

    fn initial(&self, n_states: usize) -> Option<Vec<f64>> {
        let total: u64 = self.starts.values().sum();
        (total > 0).then(|| {
            let mut initial = vec![0.0; n_states];
            for (&state, &n) in self.starts.iter().filter(|(state, _)| (**state as usize) < n_states) {
                initial[state as usize] = n as f64 / total as f64;
            }
            initial
        })
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    fn counts(transitions: &[(u32, u32, u32)]) -> TransitionCounts {
        let mut counts = TransitionCounts::default();
        for &(state, action, next) in transitions {
            counts.add(state, action, next);
        }
        counts
    }

    #[test]
    fn rows_are_posterior_means() {
        // state 0: action 0 led to 1 three times and to 2 once; action 1 to 2 twice; action 2 was not seen
        let mut seen = counts(&[(0, 0, 1), (0, 0, 1), (0, 0, 1), (0, 0, 2), (0, 1, 2), (0, 1, 2), (1, 0, 0)]);
        seen.add_start(0);
        seen.add_start(0);
        seen.add_start(1);
        let found = seen.estimate(3, 3, 2.0).expect("a model");
        let row = |pair: usize| found.mdp.row(pair).1.to_vec();
        let close = |got: &[f64], want: &[f64]| got.iter().zip(want).all(|(g, w)| (g - w).abs() < 1e-12);
        // m(·|0) = (3, 3) / 6
        assert!(close(&row(0), &[(3.0 + 1.0) / 6.0, (1.0 + 1.0) / 6.0]), "{:?}", row(0));
        assert!(close(&row(1), &[1.0 / 4.0, 3.0 / 4.0]), "{:?}", row(1));
        assert!(close(&row(2), &[0.5, 0.5]), "{:?}", row(2));
        assert_eq!(found.mdp.row(3), ([0].as_slice(), [1.0].as_slice()));
        // state 2 was never left
        assert_eq!(found.mdp.row(8), ([2].as_slice(), [1.0].as_slice()));
        assert_eq!(found.visits, [4, 2, 0, 1, 0, 0, 0, 0, 0]);
        assert!(close(found.mdp.initial_distribution(), &[2.0 / 3.0, 1.0 / 3.0, 0.0]));
        assert_eq!((seen.total(), seen.distinct()), (7, 4));
    }

    #[test]
    fn without_a_prior_they_are_frequencies() {
        let found = counts(&[(0, 0, 1), (0, 0, 0), (0, 1, 1)]).estimate(2, 2, 0.0).expect("a model");
        assert_eq!(found.mdp.row(0), ([0, 1].as_slice(), [0.5, 0.5].as_slice()));
        assert_eq!(found.mdp.row(1), ([1].as_slice(), [1.0].as_slice()));
        assert_eq!(found.mdp.initial_distribution(), [0.5, 0.5]);
    }

    #[test]
    fn what_is_no_data_is_refused() {
        let seen = counts(&[(0, 0, 1)]);
        assert_eq!(TransitionCounts::default().estimate(2, 1, 1.0), Err(EstimateError::Empty));
        assert!(matches!(seen.estimate(2, 1, f64::NAN), Err(EstimateError::Prior(_))));
        assert!(matches!(seen.estimate(1, 1, 1.0), Err(EstimateError::OutOfRange { next_state: 1, .. })));
        assert!(matches!(seen.estimate(usize::MAX, 2, 1.0), Err(EstimateError::Model(_))));
    }

    proptest! {
        #[test]
        fn every_estimate_is_a_model_and_follows_the_data(
            seen in prop::collection::vec((0_u32..6, 0_u32..3, 0_u32..6), 1..60),
            strength in prop_oneof![Just(0.0), 0.0..10.0_f64],
            turn in 0_u32..6,
        ) {
            let seen_counts = counts(&seen);
            let found = seen_counts.estimate(6, 3, strength).expect("a model");
            prop_assert_eq!(found.visits.iter().sum::<u64>(), seen.len() as u64);
            // What was seen is possible.
            for &(state, action, next) in &seen {
                prop_assert!(found.mdp.row(state as usize * 3 + action as usize).0.contains(&next));
            }
            // Other names of the states, the same model under them.
            let turned: Vec<u32> = (0..6).map(|state| (state + turn) % 6).collect();
            let other = seen_counts.renumbered(&turned, &[0, 1, 2]).estimate(6, 3, strength).expect("a model");
            for pair in 0..18 {
                let (states, probabilities) = found.mdp.row(pair);
                let (other_states, other_probabilities) = other.mdp.row(turned[pair / 3] as usize * 3 + pair % 3);
                for (s, p) in states.iter().zip(probabilities) {
                    let at = other_states.iter().position(|other| *other == turned[*s as usize]);
                    prop_assert!(at.is_some_and(|at| (other_probabilities[at] - p).abs() < 1e-12));
                }
            }
        }
    }
}
