//! What was learned in one model, used in another: a reward is planned on anew, a policy can only be repeated.
//!
//! States are matched by label, so that a cell of a maze stays that cell where a corridor is closed elsewhere. Where neither model
//! has labels, equal numbers of states are matched by index. Actions are matched by index, as one environment's are the same.

use crate::mdp::{PlanError, PlanOptions, PlannerKind, Policy, TabularMdp, plan};
use std::collections::HashMap;

/// For each state of one model, the state of another that is the same.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Matching {
    /// Shape (states of the model that is planned in,); `None` for a state that the other model does not have.
    pub sources: Vec<Option<usize>>,
    n_actions: usize,
}

/// Why two models cannot be matched.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
pub enum MatchError {
    /// Other actions.
    #[error("expected a model of {expected} actions, got {got}")]
    Actions {
        /// Of the model that was learned in.
        expected: usize,
        /// Of the other.
        got: usize,
    },
    /// Nothing to match states by.
    #[error("expected labels of all states in both models, or {expected} states in both, got {got} states")]
    States {
        /// Of the model that was learned in.
        expected: usize,
        /// Of the other.
        got: usize,
    },
    /// Labels that share nothing.
    #[error("expected models that have states in common, got none with the same label")]
    Disjoint,
}

impl Matching {
    /// Matches the states of `target` with those of `source`, each given with its labels.
    ///
    /// # Errors
    /// Other actions; no labels and another number of states; no state in common.
    pub fn new(source: (&TabularMdp, &[String]), target: (&TabularMdp, &[String])) -> Result<Self, MatchError> {
        let n_actions = source.0.n_actions();
        if target.0.n_actions() != n_actions {
            return Err(MatchError::Actions { expected: n_actions, got: target.0.n_actions() });
        }
        let (s, t) = (source.0.n_states(), target.0.n_states());
        let sources: Vec<Option<usize>> = if source.1.len() == s && target.1.len() == t {
            let by_label: HashMap<&str, usize> =
                source.1.iter().enumerate().map(|(state, label)| (label.as_str(), state)).collect();
            target.1.iter().map(|label| by_label.get(label.as_str()).copied()).collect()
        } else if s == t {
            (0..t).map(Some).collect()
        } else {
            return Err(MatchError::States { expected: s, got: t });
        };
        if sources.iter().all(Option::is_none) {
            return Err(MatchError::Disjoint);
        }
        Ok(Self { sources, n_actions })
    }

    /// States that the other model does not have.
    pub fn unmatched(&self) -> usize {
        self.sources.iter().filter(|source| source.is_none()).count()
    }

    /// R(s,a) where it is planned; a state that is new has the least reward of its action: nothing speaks for it.
    pub fn reward(&self, learned: &[f64]) -> Vec<f64> {
        let least: Vec<f64> = (0..self.n_actions)
            .map(|a| learned.iter().skip(a).step_by(self.n_actions).copied().fold(f64::INFINITY, f64::min))
            .collect();
        let row = |source: &Option<usize>| match source {
            Some(state) => learned[state * self.n_actions..(state + 1) * self.n_actions].to_vec(),
            None => least.clone(),
        };
        self.sources.iter().flat_map(row).collect()
    }

    /// π(a|s) carried over unchanged; uniform in a state that is new.
    pub fn policy(&self, learned: &[f64]) -> Vec<f64> {
        let uniform = vec![1.0 / self.n_actions as f64; self.n_actions];
        let row = |source: &Option<usize>| match source {
            Some(state) => learned[state * self.n_actions..(state + 1) * self.n_actions].to_vec(),
            None => uniform.clone(),
        };
        self.sources.iter().flat_map(row).collect()
    }

    /// The greedy policy of a learned reward in the model `target`.
    ///
    /// # Errors
    /// As [`plan`].
    pub fn plan(
        &self,
        target: &TabularMdp,
        learned_reward: &[f64],
        planner: PlannerKind,
        options: &PlanOptions,
    ) -> Result<Policy, PlanError> {
        Ok(plan(planner, target, &self.reward(learned_reward), options)?.greedy_policy())
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// A ring of states: action 0 stays, action 1 goes on.
    fn ring(n: usize) -> (TabularMdp, Vec<String>) {
        let next = (0..n).flat_map(|s| [s as u32, ((s + 1) % n) as u32]).collect();
        let mdp = TabularMdp::new(n, 2, (0..=2 * n).collect(), next, vec![1.0; 2 * n], None).expect("a model");
        (mdp, (0..n).map(|s| format!("place {s}")).collect())
    }

    #[test]
    fn states_are_matched_by_label() {
        let (small, labels) = ring(3);
        let (large, mut other) = ring(4);
        other.rotate_left(1);
        let matching = Matching::new((&small, &labels), (&large, &other)).expect("a matching");
        assert_eq!(matching.sources, [Some(1), Some(2), None, Some(0)]);
        assert_eq!(matching.unmatched(), 1);
        assert_eq!(matching.reward(&[1.0, 2.0, 3.0, 4.0, 5.0, 6.0]), [3.0, 4.0, 5.0, 6.0, 1.0, 2.0, 1.0, 2.0]);
        assert_eq!(matching.policy(&[1.0, 0.0, 0.0, 1.0, 1.0, 0.0])[4..6], [0.5, 0.5]);
        assert_eq!(Matching::new((&small, &labels), (&large, &[])), Err(MatchError::States { expected: 3, got: 4 }));
        let strange = vec!["x".to_owned(), "y".to_owned(), "z".to_owned()];
        assert_eq!(Matching::new((&small, &labels), (&small, &strange)), Err(MatchError::Disjoint));
    }

    #[test]
    fn a_reward_is_planned_on_anew_where_a_policy_is_repeated() {
        // the same places in another order: the way to the rewarded one changes
        let (mdp, labels) = ring(4);
        let shuffled: Vec<String> = [0, 2, 1, 3].map(|s| labels[s].clone()).to_vec();
        let matching = Matching::new((&mdp, &labels), (&mdp, &shuffled)).expect("a matching");
        let reward = [0.0, 0.0, 0.0, 0.0, 1.0, 1.0, 0.0, 0.0];
        let policy =
            matching.plan(&mdp, &reward, PlannerKind::PolicyIteration, &PlanOptions::default()).expect("a plan");
        assert_eq!(policy.probabilities(), [0.0, 1.0, 1.0, 0.0, 0.0, 1.0, 0.0, 1.0]);
    }
}
