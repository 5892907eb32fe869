//! Backward induction over a finite horizon: what planning means where γ = 1.

use crate::mdp::numeric::{log_sum_exp, max};
use crate::mdp::plan::Plan;
use crate::mdp::{Policy, TabularMdp};

/// Undiscounted values of `horizon` ≥ 1 steps, and the first step's policy; with `soft`, log-sum-exp in place of max.
pub(crate) fn plan(mdp: &TabularMdp, reward: &[f64], horizon: u32, soft: bool) -> Plan {
    let n_actions = mdp.n_actions();
    let mut state_values = vec![0.0; mdp.n_states()];
    let mut action_values = vec![0.0; mdp.n_pairs()];
    for _ in 0..horizon {
        mdp.action_values_into(reward, 1.0, &state_values, &mut action_values);
        for (v, q) in state_values.iter_mut().zip(action_values.chunks_exact(n_actions)) {
            *v = if soft { log_sum_exp(q) } else { max(q) };
        }
    }
    let policy = if soft {
        Policy::boltzmann(n_actions, &action_values, 1.0)
    } else {
        Policy::greedy(n_actions, &action_values)
    };
    Plan { state_values, action_values, policy, iterations: horizon, converged: true }
}
