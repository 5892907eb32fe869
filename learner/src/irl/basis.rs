//! Basis functions Φ(s,a) of the reward R = wᵀΦ.

use crate::mdp::{Features, TabularMdp};

/// Φ, one sparse row a state-action pair.
#[derive(Debug, Clone, PartialEq)]
pub struct Basis {
    n_pairs: usize,
    n_functions: usize,
    kind: Kind,
}

#[derive(Debug, Clone, PartialEq)]
enum Kind {
    /// Φ_b(s,a) = [s = b].
    State { n_actions: usize },
    /// Φ_b(s,a) = [(s,a) = b].
    StateAction,
    /// A user's table.
    Features(Features),
}

impl Basis {
    /// Dirac on states, `n_states` functions.
    #[must_use]
    pub fn state(mdp: &TabularMdp) -> Self {
        Self { n_pairs: mdp.n_pairs(), n_functions: mdp.n_states(), kind: Kind::State { n_actions: mdp.n_actions() } }
    }

    /// Dirac on state-action pairs, `n_states * n_actions` functions.
    #[must_use]
    pub fn state_action(mdp: &TabularMdp) -> Self {
        Self { n_pairs: mdp.n_pairs(), n_functions: mdp.n_pairs(), kind: Kind::StateAction }
    }

    /// A user's features, one function each.
    #[must_use]
    pub fn features(features: &Features) -> Self {
        let n_functions = features.len();
        Self { n_pairs: features.n_pairs(), n_functions, kind: Kind::Features(features.clone()) }
    }

    /// Number of basis functions B.
    pub fn len(&self) -> usize {
        self.n_functions
    }

    /// Never: a basis has at least one function.
    pub fn is_empty(&self) -> bool {
        self.n_functions == 0
    }

    /// Calls `visit` with each basis function that is not zero at a pair, and its value there.
    pub fn for_each(&self, pair: usize, mut visit: impl FnMut(usize, f64)) {
        match &self.kind {
            Kind::State { n_actions } => visit(pair / n_actions, 1.0),
            Kind::StateAction => visit(pair, 1.0),
            Kind::Features(features) => {
                let (columns, values) = features.row(pair);
                for (&column, &value) in columns.iter().zip(values) {
                    visit(column as usize, value);
                }
            }
        }
    }

    /// R(s,a) = wᵀΦ(s,a), shape (`n_states * n_actions`,).
    pub fn reward(&self, weights: &[f64]) -> Vec<f64> {
        let mut reward = vec![0.0; self.n_pairs];
        for (pair, r) in reward.iter_mut().enumerate() {
            self.for_each(pair, |b, value| *r += value * weights[b]);
        }
        reward
    }

    /// Brings `reward` up to date after the weights of some functions changed: the very numbers of [`Basis::reward`].
    pub(super) fn update_reward(&self, weights: &[f64], changed: impl Iterator<Item = usize>, reward: &mut [f64]) {
        match &self.kind {
            Kind::State { n_actions } => {
                changed.for_each(|b| reward[b * n_actions..(b + 1) * n_actions].fill(weights[b]));
            }
            Kind::StateAction => changed.for_each(|b| reward[b] = weights[b]),
            Kind::Features(_) => reward.copy_from_slice(&self.reward(weights)),
        }
    }

    /// Σ_{s,a} values(s,a) Φ(s,a), shape (`n_basis`,).
    pub fn project(&self, values: &[f64]) -> Vec<f64> {
        let mut projected = vec![0.0; self.n_functions];
        for (pair, &v) in values.iter().enumerate() {
            if v != 0.0 {
                self.for_each(pair, |b, value| projected[b] += value * v);
            }
        }
        projected
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn rewards_and_projections_are_adjoint() {
        let mdp = TabularMdp::new(2, 2, vec![0, 1, 2, 3, 4], vec![0, 1, 1, 0], vec![1.0; 4], None).expect("a model");
        let table = [1.0, 0.0, -2.0, 0.0, 3.0, 0.5, 0.0, 0.0, 4.0, 1.0, 1.0, 1.0];
        let names = ["x", "y", "z"].map(str::to_owned).to_vec();
        let features = Features::of_pairs(4, names, &table).expect("features");
        let all = [Basis::state(&mdp), Basis::state_action(&mdp), Basis::features(&features)];
        assert_eq!(all.each_ref().map(Basis::len), [2, 4, 3]);
        for basis in all {
            let weights: Vec<f64> = (0..basis.len()).map(|b| 1.0 + b as f64).collect();
            let values = [0.5, -1.0, 2.0, 0.25];
            let left: f64 = basis.reward(&weights).iter().zip(values).map(|(r, v)| r * v).sum();
            let right: f64 = basis.project(&values).iter().zip(&weights).map(|(p, w)| p * w).sum();
            assert!((left - right).abs() < 1e-12);
        }
    }
}
