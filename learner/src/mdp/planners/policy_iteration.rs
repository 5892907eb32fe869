//! Howard's policy iteration.

use crate::mdp::linear::Resolvent;
use crate::mdp::numeric::{max, max_abs};
use crate::mdp::plan::Plan;
use crate::mdp::{Policy, TIE_TOLERANCE, TabularMdp};

/// Improvements after which it stops all the same; tens are usual.
const MAX_IMPROVEMENTS: u32 = 1000;

/// Policy iteration from the actions that are best for the next step alone.
pub(crate) fn plan(mdp: &TabularMdp, reward: &[f64], discount: f64) -> Plan {
    improve(mdp, reward, discount, reward, 0)
}

/// Policy iteration from the greedy policy of `action_values`.
///
/// An action replaces the one in force only where it is better by more than rounding, so ties cannot make it cycle.
pub(super) fn improve(mdp: &TabularMdp, reward: &[f64], discount: f64, action_values: &[f64], before: u32) -> Plan {
    let n_actions = mdp.n_actions();
    let mut chosen: Vec<usize> = action_values.chunks_exact(n_actions).map(first_best).collect();
    let mut iterations = before;
    let mut resolvent = Resolvent::of_model(mdp, discount);
    loop {
        iterations += 1;
        let state_values = evaluate(&mut resolvent, mdp, reward, &chosen);
        let action_values = mdp.action_values(reward, discount, &state_values);
        // well below what counts as a tie and above the rounding of the solve
        let margin = 1e-3 * TIE_TOLERANCE * max_abs(&action_values);
        let mut stable = true;
        for (choice, q) in chosen.iter_mut().zip(action_values.chunks_exact(n_actions)) {
            if max(q) > q[*choice] + margin {
                *choice = first_best(q);
                stable = false;
            }
        }
        let converged = stable;
        if converged || iterations >= before + MAX_IMPROVEMENTS {
            let policy = Policy::greedy(n_actions, &action_values);
            return Plan { state_values, action_values, policy, iterations, converged };
        }
    }
}

fn evaluate(resolvent: &mut Resolvent, mdp: &TabularMdp, reward: &[f64], chosen: &[usize]) -> Vec<f64> {
    let mut policy = vec![0.0; mdp.n_pairs()];
    let mut received = vec![0.0; mdp.n_states()];
    for (state, &action) in chosen.iter().enumerate() {
        policy[mdp.pair(state, action)] = 1.0;
        received[state] = reward[mdp.pair(state, action)];
    }
    resolvent.set_policy(mdp, &policy);
    resolvent.solve(&received)
}

fn first_best(values: &[f64]) -> usize {
    let mut best = 0;
    for (action, &q) in values.iter().enumerate() {
        if q > values[best] {
            best = action;
        }
    }
    best
}
