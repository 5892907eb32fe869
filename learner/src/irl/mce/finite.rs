//! The dual of maximum causal entropy over the steps of the demonstrations, for a discount of 1.

use crate::irl::visits::Visits;
use crate::irl::{Basis, FitError};
use crate::mdp::{TabularMdp, log_sum_exp};

/// Most soft action values (steps times pairs) that are kept, 400 MB.
const MAX_VALUES: usize = 50_000_000;

/// wᵀf − Σ_s N_0(s) V_0(s), f = Σ_k Σ N_k(s,a) Φ(s,a), V_k = log Σ_a exp(R + ρ_k P V_{k+1}), nothing after the last step.
///
/// ρ_k is the share of trajectories with a step k that have a step k + 1: the rest has ended, and earns nothing.
pub(super) struct FiniteDual<'a> {
    mdp: &'a TabularMdp,
    basis: &'a Basis,
    counts: Vec<f64>,
    /// N_0(s), shape (`n_states`,).
    starts: Vec<f64>,
    /// ρ_k, shape (steps,); the last is 0.
    continuing: Vec<f64>,
    /// Q_k, shape (steps, `n_states * n_actions`).
    action_values: Vec<f64>,
    /// V_k, shape (steps, `n_states`).
    state_values: Vec<f64>,
}

impl<'a> FiniteDual<'a> {
    pub(super) fn new(mdp: &'a TabularMdp, basis: &'a Basis, visits: &Visits<'_>) -> Result<Self, FitError> {
        let steps = visits.steps();
        let got = steps.saturating_mul(mdp.n_pairs());
        if got > MAX_VALUES {
            return Err(FitError::TooLarge { what: "soft action values (steps times pairs)", limit: MAX_VALUES, got });
        }
        Ok(Self {
            mdp,
            basis,
            counts: visits.counts(),
            starts: visits.starts(),
            continuing: (0..steps).map(|k| visits.continuing(k)).collect(),
            action_values: vec![0.0; got],
            state_values: vec![0.0; steps * mdp.n_states()],
        })
    }

    /// The dual and its gradient, shape (`n_basis`,): demonstrated features minus expected ones.
    pub(super) fn value_and_gradient(&mut self, weights: &[f64]) -> (f64, Vec<f64>) {
        let (n, n_pairs, n_actions) = (self.mdp.n_states(), self.mdp.n_pairs(), self.mdp.n_actions());
        let reward = self.basis.reward(weights);
        let steps = self.continuing.len();
        let mut next = vec![0.0; n];
        for k in (0..steps).rev() {
            let q = &mut self.action_values[k * n_pairs..(k + 1) * n_pairs];
            self.mdp.action_values_into(&reward, self.continuing[k], &next, q);
            for (v, q) in next.iter_mut().zip(q.chunks_exact(n_actions)) {
                *v = log_sum_exp(q);
            }
            self.state_values[k * n..(k + 1) * n].copy_from_slice(&next);
        }
        let gained: f64 = reward.iter().zip(&self.counts).map(|(r, n)| r * n).sum();
        let expected: f64 = next.iter().zip(&self.starts).map(|(v, n)| v * n).sum();
        let mut gap = self.counts.clone();
        let mut occupancy = self.starts.clone();
        let mut flow = vec![0.0; n_pairs];
        for k in 0..steps {
            let (q, v) = (&self.action_values[k * n_pairs..], &self.state_values[k * n..]);
            for (pair, (flow, gap)) in flow.iter_mut().zip(&mut gap).enumerate() {
                let state = pair / n_actions;
                let visits = occupancy[state] * (q[pair] - v[state]).exp();
                *gap -= visits;
                *flow = self.continuing[k] * visits;
            }
            if k + 1 < steps {
                occupancy = self.mdp.propagate(&flow);
            }
        }
        (gained - expected, self.basis.project(&gap))
    }

    /// Q and V of the first step under the weights last evaluated.
    pub(super) fn first_step(&self) -> (&[f64], &[f64]) {
        (&self.action_values[..self.mdp.n_pairs()], &self.state_values[..self.mdp.n_states()])
    }
}
