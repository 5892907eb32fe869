//! What a policy is worth.

use super::linear::Resolvent;
use super::policy::Policy;
use super::tabular::TabularMdp;

/// V^π(s) of R(s,a), shape (`n_states`,).
///
/// Without a horizon the discounted sum over all time, for `discount` < 1, from one linear solve. With a horizon the sum of
/// that many steps, for any `discount` in [0, 1].
///
/// # Panics
/// Where `discount` is 1 without a horizon: the sum has no limit.
pub fn evaluate_policy(
    mdp: &TabularMdp,
    policy: &Policy,
    reward: &[f64],
    discount: f64,
    horizon: Option<u32>,
) -> Vec<f64> {
    assert!(discount < 1.0 || horizon.is_some(), "expected a horizon where the discount is 1");
    let pi = policy.probabilities();
    let Some(horizon) = horizon else {
        return Resolvent::new(mdp, pi, discount).solve(&average(mdp, pi, reward));
    };
    let mut values = vec![0.0; mdp.n_states()];
    let mut action_values = vec![0.0; mdp.n_pairs()];
    for _ in 0..horizon {
        mdp.action_values_into(reward, discount, &values, &mut action_values);
        values = average(mdp, pi, &action_values);
    }
    values
}

/// Σ_a π(a|s) values(s,a), shape (`n_states`,).
pub(super) fn average(mdp: &TabularMdp, policy: &[f64], values: &[f64]) -> Vec<f64> {
    let n_actions = mdp.n_actions();
    policy
        .chunks_exact(n_actions)
        .zip(values.chunks_exact(n_actions))
        .map(|(pi, q)| pi.iter().zip(q).map(|(p, q)| p * q).sum())
        .collect()
}
