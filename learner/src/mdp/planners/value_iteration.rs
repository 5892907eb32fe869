//! Value iteration, finished exactly.
//!
//! The number of sweeps to a given error grows with 1/(1 − γ): at γ = 0.9999 it takes hundreds of thousands. The greedy
//! policy is mostly right much sooner, so sweeps stop once the span of the change says that the values are nearly right up to a
//! constant (MacQueen 1966; Puterman 1994, §6.6), or at a cap, and exact evaluation takes over from the greedy policy: a
//! solve costs less than the sweeps that it replaces.

use super::policy_iteration;
use crate::mdp::TabularMdp;
use crate::mdp::numeric::max;
use crate::mdp::plan::Plan;

const MAX_SWEEPS: u32 = 200;
/// Span of a sweep's changes, relative to the values, at which exact evaluation takes over.
const SPAN: f64 = 1e-3;

/// Synchronous sweeps V ← max_a R + γ P V, then exact evaluation and, where it finds one, improvement.
pub(crate) fn plan(mdp: &TabularMdp, reward: &[f64], discount: f64) -> Plan {
    let n_actions = mdp.n_actions();
    let mut values = vec![0.0; mdp.n_states()];
    let mut action_values = vec![0.0; mdp.n_pairs()];
    let mut sweeps = 0;
    loop {
        mdp.action_values_into(reward, discount, &values, &mut action_values);
        sweeps += 1;
        let (mut low, mut high, mut size) = (f64::INFINITY, f64::NEG_INFINITY, 0.0_f64);
        for (v, q) in values.iter_mut().zip(action_values.chunks_exact(n_actions)) {
            let next = max(q);
            low = low.min(next - *v);
            high = high.max(next - *v);
            size = size.max(next.abs());
            *v = next;
        }
        if high - low <= SPAN * size || sweeps == MAX_SWEEPS {
            return policy_iteration::improve(mdp, reward, discount, &action_values, sweeps);
        }
    }
}
