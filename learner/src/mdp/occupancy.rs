//! Where a policy spends its time.

use super::linear::Resolvent;
use super::policy::Policy;
use super::tabular::TabularMdp;

/// d(s) = Σ_t γ^t P(s_t = s | π), t from 0, shape (`n_states`,). Sums to 1/(1 − γ).
///
/// # Panics
/// Where `discount` is 1: the sum has no limit.
pub fn discounted_occupancy(mdp: &TabularMdp, policy: &Policy, discount: f64) -> Vec<f64> {
    assert!(discount < 1.0, "expected a discount below 1, got {discount}");
    Resolvent::new(mdp, policy.probabilities(), discount).solve_transposed(mdp.initial_distribution())
}

/// Σ_{t<T} γ^t P(s_t = s | π), shape (`n_states`,). Sums to (1 − γᵀ)/(1 − γ), and to T where γ = 1.
pub fn finite_horizon_occupancy(mdp: &TabularMdp, policy: &Policy, discount: f64, horizon: u32) -> Vec<f64> {
    let mut total = vec![0.0; mdp.n_states()];
    let mut weight = 1.0;
    for step in state_occupancies_by_step(mdp, policy).take(horizon as usize) {
        for (t, p) in total.iter_mut().zip(&step) {
            *t += weight * p;
        }
        weight *= discount;
    }
    total
}

/// P(s_t = s | π) for t = 0, 1, …, without end; each of shape (`n_states`,).
pub fn state_occupancies_by_step<'a>(mdp: &'a TabularMdp, policy: &'a Policy) -> impl Iterator<Item = Vec<f64>> + 'a {
    let first = mdp.initial_distribution().to_vec();
    std::iter::successors(Some(first), move |now| Some(mdp.propagate(&state_action_occupancy(policy, now))))
}

/// d(s,a) = d(s) π(a|s), shape (`n_states * n_actions`,).
pub fn state_action_occupancy(policy: &Policy, state_occupancy: &[f64]) -> Vec<f64> {
    let n_actions = policy.n_actions();
    policy.probabilities().iter().enumerate().map(|(pair, p)| p * state_occupancy[pair / n_actions]).collect()
}
