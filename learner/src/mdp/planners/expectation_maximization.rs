//! Planning as inference: Toussaint & Storkey (2006), "Probabilistic inference for solving discrete and continuous state
//! Markov decision processes".
//!
//! The value of a policy is the likelihood of a binary reward at the end of a mixture of processes of T = 1..K steps with
//! prior p(T), where p(r = 1 | s, a) is the reward scaled into [0, 1]. The E-step sends messages forward (α_t, where the
//! process is after t steps) and backward (β_τ, the chance of the reward τ steps on); the M-step raises the likelihood.
//!
//! - Under the geometric prior without end, Σ_t γ^t α_t and Σ_τ γ^τ β_τ are linear solves, and the expected complete
//!   likelihood is maximised by the greedy policy in β (their section on the greedy M-step).
//! - Under a finite prior a stationary policy's greedy M-step need not raise the likelihood. It is taken where it does, and
//!   otherwise π(a|s) is multiplied by its posterior, the plain M-step, which never lowers it.

use crate::mdp::evaluation::average;
use crate::mdp::linear::Resolvent;
use crate::mdp::numeric::dot;
use crate::mdp::plan::{Plan, PlanError};
use crate::mdp::{Policy, TabularMdp};

const MAX_ITERATIONS: u32 = 2000;
/// Messages kept at once: 512 MB.
const MAX_MESSAGES: usize = 64 << 20;

/// Without a horizon: geometric prior without end, γ < 1. With one: p(T) uniform over 1..`horizon`.
pub(crate) fn plan(mdp: &TabularMdp, reward: &[f64], discount: f64, horizon: Option<u32>) -> Result<Plan, PlanError> {
    let low = reward.iter().copied().fold(f64::INFINITY, f64::min);
    let high = reward.iter().copied().fold(f64::NEG_INFINITY, f64::max);
    let scale = if high > low { high - low } else { 1.0 };
    let likelihood: Vec<f64> = reward.iter().map(|r| (r - low) / scale).collect();
    let Some(horizon) = horizon else {
        return Ok(geometric(mdp, reward, &likelihood, discount));
    };
    let messages = (horizon as usize).saturating_mul(mdp.n_states());
    if messages > MAX_MESSAGES {
        return Err(PlanError::TooLarge { limit: MAX_MESSAGES, got: messages });
    }
    Ok(uniform(mdp, &likelihood, low, scale, horizon as usize))
}

fn geometric(mdp: &TabularMdp, reward: &[f64], likelihood: &[f64], discount: f64) -> Plan {
    let n_actions = mdp.n_actions();
    let mut policy = Policy::uniform(mdp.n_states(), n_actions);
    let mut last = f64::NEG_INFINITY;
    let mut iterations = 0;
    loop {
        iterations += 1;
        // E-step: β(s) = Σ_τ γ^τ β_τ(s), and through it β(s,a).
        let mut resolvent = Resolvent::new(mdp, policy.probabilities(), discount);
        let backward = resolvent.solve(&average(mdp, policy.probabilities(), likelihood));
        let backward_pairs = mdp.action_values(likelihood, discount, &backward);
        // M-step. Every state counts: one that the start cannot reach is planned for all the same.
        let improved = Policy::greedy(n_actions, &backward_pairs);
        let value: f64 = backward.iter().sum();
        let converged = improved == policy || value <= last + 1e-13 * last.abs();
        last = value.max(last);
        policy = improved;
        if converged || iterations == MAX_ITERATIONS {
            let mut resolvent = Resolvent::new(mdp, policy.probabilities(), discount);
            let state_values = resolvent.solve(&average(mdp, policy.probabilities(), reward));
            let action_values = mdp.action_values(reward, discount, &state_values);
            return Plan { state_values, action_values, policy, iterations, converged };
        }
    }
}

/// Sums of messages under the uniform prior.
struct Messages {
    /// P(reward = 1): Σ_T p(T) Σ_s p(s₁) β_{T−1}(s).
    likelihood: f64,
    /// Σ_T p(T) Σ_t α_t(s) β_{T−1−t}(s,a), shape (`n_states * n_actions`,).
    posterior: Vec<f64>,
    /// Σ_T p(T) Σ_t α_t(s): expected passages through each state, shape (`n_states`,).
    passages: Vec<f64>,
    /// Σ_τ p(τ) β_τ(s,a), shape (`n_states * n_actions`,).
    backward: Vec<f64>,
}

fn e_step(mdp: &TabularMdp, reward: &[f64], policy: &Policy, horizon: usize) -> Messages {
    let n = mdp.n_states();
    let prior = 1.0 / horizon as f64;
    // forward[t](s) = Σ_{t' ≤ t} α_t'(s)
    let mut forward: Vec<f64> = Vec::with_capacity(horizon * n);
    for (t, now) in crate::mdp::state_occupancies_by_step(mdp, policy).take(horizon).enumerate() {
        for (s, p) in now.into_iter().enumerate() {
            let before = if t == 0 { 0.0 } else { forward[(t - 1) * n + s] };
            forward.push(before + p);
        }
    }
    let mut messages = Messages {
        likelihood: 0.0,
        posterior: vec![0.0; mdp.n_pairs()],
        passages: vec![0.0; n],
        backward: vec![0.0; mdp.n_pairs()],
    };
    let mut backward_pairs = reward.to_vec();
    for tau in 0..horizon {
        let reach = &forward[(horizon - 1 - tau) * n..(horizon - tau) * n];
        for (total, r) in messages.passages.iter_mut().zip(reach) {
            *total += prior * r;
        }
        for (pair, &b) in backward_pairs.iter().enumerate() {
            messages.posterior[pair] += prior * reach[pair / mdp.n_actions()] * b;
            messages.backward[pair] += prior * b;
        }
        let backward = average(mdp, policy.probabilities(), &backward_pairs);
        messages.likelihood += prior * dot(mdp.initial_distribution(), &backward);
        for (pair, b) in backward_pairs.iter_mut().enumerate() {
            *b = mdp.expected(pair, &backward);
        }
    }
    messages
}

fn uniform(mdp: &TabularMdp, likelihood: &[f64], low: f64, scale: f64, horizon: usize) -> Plan {
    let n_actions = mdp.n_actions();
    let mut policy = Policy::uniform(mdp.n_states(), n_actions);
    let mut messages = e_step(mdp, likelihood, &policy, horizon);
    let mut iterations = 0;
    let mut converged = false;
    while iterations < MAX_ITERATIONS && !converged {
        iterations += 1;
        let mut next = Policy::greedy(n_actions, &per_state(&messages, n_actions));
        let mut next_messages = e_step(mdp, likelihood, &next, horizon);
        if next_messages.likelihood <= messages.likelihood && next != policy {
            next = multiply(&policy, &messages.posterior);
            next_messages = e_step(mdp, likelihood, &next, horizon);
        }
        converged = next_messages.likelihood <= messages.likelihood * (1.0 + 1e-12);
        if next_messages.likelihood >= messages.likelihood {
            (policy, messages) = (next, next_messages);
        }
    }
    // back into the reward's unit: the mean reward at the end of the mixture
    let action_values: Vec<f64> = per_state(&messages, n_actions).iter().map(|b| low + scale * b).collect();
    let state_values = average(mdp, policy.probabilities(), &action_values);
    Plan { state_values, action_values, policy, iterations, converged }
}

/// Expected reward after each action, averaged over the times at which its state is passed; over all times where it is never
/// passed.
fn per_state(messages: &Messages, n_actions: usize) -> Vec<f64> {
    let mut values = messages.backward.clone();
    for (state, row) in values.chunks_exact_mut(n_actions).enumerate() {
        let passages = messages.passages[state];
        if passages > 0.0 {
            for (v, p) in row.iter_mut().zip(&messages.posterior[state * n_actions..]) {
                *v = p / passages;
            }
        }
    }
    values
}

fn multiply(policy: &Policy, posterior: &[f64]) -> Policy {
    let n_actions = policy.n_actions();
    let mut probabilities = policy.probabilities().to_vec();
    for (pi, weight) in probabilities.chunks_exact_mut(n_actions).zip(posterior.chunks_exact(n_actions)) {
        let sum = dot(pi, weight);
        if sum > 0.0 {
            for (p, w) in pi.iter_mut().zip(weight) {
                *p *= w / sum;
            }
        }
    }
    Policy::new(n_actions, probabilities).unwrap_or_else(|_| policy.clone())
}
