//! Soft values of one reward after another, each near the last: what a sampler evaluates thousands of times.
//!
//! V = log Σ_a exp(R + γPV) is solved by Newton's method, which begins on the tangent of V at the present reward: V is
//! convex, so from there on every step raises the values. The log-likelihood is linear in both, ℓ = N·R + c·V with
//! c = γ Σ N P − N (what arrives less what departs), so that its error is of second order in a step. c is seldom positive,
//! and ℓ falls as the values rise: a proposal that cannot be accepted is given up after a step or two.
//! I − γP_π is factored sparsely in an order found once, which in mazes takes no longer than the exponentials.
//!
//! Deliberately absent: processes whose factors are a burden; see [`MAX_MULTIPLICATIONS`].

use crate::mdp::{Factored, TabularMdp, max_abs};

/// Most multiplications of a factorisation, about a millisecond: 180 states that all lead everywhere, thousands in a maze.
const MAX_MULTIPLICATIONS: u64 = 2_000_000;
/// Most states, for the memory of chains.
const MAX_STATES: usize = 5000;
/// Wanted accuracy of the log-likelihood that decides, in nats; where a proposal is accepted it is taken to rounding.
const ACCURACY: f64 = 0.01;
/// ℓ rises after a step by so many times what the step itself raised somewhere, at most.
const SAFETY: f64 = 2.0;
const MAX_ROUNDS: u32 = 50;

/// A process at a reward, ready to be asked about others.
#[derive(Clone)]
pub(super) struct SoftProcess<'a> {
    mdp: &'a TabularMdp,
    discount: f64,
    /// N(s,a).
    counts: &'a [f64],
    /// c = γ Σ N P − N, shape (`n_states`,).
    value_weights: Vec<f64>,
    /// By how much ℓ may be wrong after a step, for its squared range.
    curvature: f64,
    present: Point,
    proposed: Point,
    action_values: Vec<f64>,
    residual: Vec<f64>,
    step: Vec<f64>,
}

/// A reward and its soft values.
#[derive(Clone)]
struct Point {
    reward: Vec<f64>,
    values: Vec<f64>,
    policy: Vec<f64>,
    jacobian: Factored,
    log_likelihood: f64,
    /// dℓ/dR(s,a).
    slopes: Vec<f64>,
}

impl<'a> SoftProcess<'a> {
    /// At the reward 0; `counts` are N(s,a), shape (`n_states * n_actions`,). `None` where the process is too large.
    pub(super) fn new(mdp: &'a TabularMdp, discount: f64, counts: &'a [f64]) -> Option<Self> {
        let (n_states, n_pairs, n_actions) = (mdp.n_states(), mdp.n_pairs(), mdp.n_actions());
        if n_states > MAX_STATES {
            return None;
        }
        let mut value_weights: Vec<f64> = mdp.propagate(counts).into_iter().map(|n| discount * n).collect();
        for (weight, row) in value_weights.iter_mut().zip(counts.chunks_exact(n_actions)) {
            *weight -= row.iter().sum::<f64>();
        }
        // the second derivative of log Σ exp is a variance, at most a quarter of the squared range
        let total: f64 = value_weights.iter().map(|c| c.abs()).sum();
        let curvature = total * discount * discount / (8.0 * (1.0 - discount));
        let present = Point {
            reward: vec![0.0; n_pairs],
            values: vec![(n_actions as f64).ln() / (1.0 - discount); n_states],
            policy: vec![1.0 / n_actions as f64; n_pairs],
            jacobian: Factored::of_model(mdp, discount, MAX_MULTIPLICATIONS)?,
            log_likelihood: f64::NEG_INFINITY,
            slopes: vec![0.0; n_pairs],
        };
        let mut process = Self {
            mdp,
            discount,
            counts,
            value_weights,
            curvature,
            proposed: present.clone(),
            present,
            action_values: vec![0.0; n_pairs],
            residual: vec![0.0; n_states],
            step: vec![0.0; n_states],
        };
        process.settle();
        process.accept();
        Some(process)
    }

    /// ℓ at the present reward.
    pub(super) fn log_likelihood(&self) -> f64 {
        self.present.log_likelihood
    }

    /// π(a|s) at the present reward, shape (`n_states * n_actions`,).
    pub(super) fn policy(&self) -> &[f64] {
        &self.present.policy
    }

    /// dℓ/dR(s,a) at the present reward, shape (`n_states * n_actions`,).
    pub(super) fn slopes(&self) -> &[f64] {
        &self.present.slopes
    }

    /// ℓ at another reward, to [`ACCURACY`]; `None` where it lies below `threshold`, or has no value.
    pub(super) fn propose(&mut self, reward: &[f64], threshold: f64) -> Option<f64> {
        self.proposed.reward.copy_from_slice(reward);
        self.follow_tangent();
        let of_reward = dot(self.counts, reward);
        for _ in 0..MAX_ROUNDS {
            self.advance();
            let (mut low, mut high, mut raised) = (f64::INFINITY, f64::NEG_INFINITY, 0.0);
            for (&d, c) in self.step.iter().zip(&self.value_weights) {
                low = if d < low { d } else { low };
                high = if d > high { d } else { high };
                raised += (c * d).max(0.0);
            }
            let log_likelihood = of_reward + dot(&self.value_weights, &self.proposed.values);
            if !log_likelihood.is_finite() || log_likelihood + SAFETY * raised < threshold {
                return None;
            }
            let range = high - low;
            let rounding = 1e-12 * (1.0 + max_abs(&self.proposed.values));
            if self.curvature * range * range <= ACCURACY || range <= rounding {
                self.proposed.log_likelihood = log_likelihood;
                return (log_likelihood >= threshold).then_some(log_likelihood);
            }
        }
        None
    }

    /// Brings the reward last proposed to the accuracy of one that is kept. Returns ℓ and dℓ/dR(s,a) there.
    pub(super) fn settle(&mut self) -> (f64, &[f64]) {
        self.advance();
        let proposed = &mut self.proposed;
        proposed.log_likelihood = dot(self.counts, &proposed.reward) + dot(&self.value_weights, &proposed.values);
        // Mᵀv = c; the derivative with respect to R(s,a) is N(s,a) + π(a|s) v(s)
        proposed.jacobian.solve_into(&self.value_weights, true, &mut self.step);
        let n_actions = self.mdp.n_actions();
        let rows = proposed.slopes.chunks_exact_mut(n_actions).zip(proposed.policy.chunks_exact(n_actions));
        for ((slopes, pi), (n, v)) in rows.zip(self.counts.chunks_exact(n_actions).zip(&self.step)) {
            for ((slope, p), n) in slopes.iter_mut().zip(pi).zip(n) {
                *slope = n + p * v;
            }
        }
        (proposed.log_likelihood, &proposed.slopes)
    }

    /// Moves to the reward last proposed and settled.
    pub(super) fn accept(&mut self) {
        std::mem::swap(&mut self.present, &mut self.proposed);
    }

    /// Values on the tangent at the present reward: a lower bound, exact to first order.
    fn follow_tangent(&mut self) {
        let n_actions = self.mdp.n_actions();
        let (present, proposed) = (&mut self.present, &mut self.proposed);
        let rewards = proposed.reward.chunks_exact(n_actions).zip(present.reward.chunks_exact(n_actions));
        for (change, ((new, old), pi)) in
            self.residual.iter_mut().zip(rewards.zip(present.policy.chunks_exact(n_actions)))
        {
            *change = pi.iter().zip(new.iter().zip(old)).map(|(p, (new, old))| p * (new - old)).sum();
        }
        present.jacobian.solve_into(&self.residual, false, &mut self.step);
        for (v, (old, d)) in proposed.values.iter_mut().zip(present.values.iter().zip(&self.step)) {
            *v = old + d;
        }
    }

    /// One step of Newton's method from the proposed values.
    fn advance(&mut self) {
        let Self { mdp, discount, proposed, action_values, residual, step, .. } = self;
        let n_actions = mdp.n_actions();
        mdp.action_values_into(&proposed.reward, *discount, &proposed.values, action_values);
        let rows = action_values.chunks_exact(n_actions).zip(proposed.policy.chunks_exact_mut(n_actions));
        for ((q, pi), (residual, v)) in rows.zip(residual.iter_mut().zip(&proposed.values)) {
            let largest = q.iter().copied().fold(f64::NEG_INFINITY, |a, b| if b > a { b } else { a });
            let mut mass = 0.0;
            for (p, q) in pi.iter_mut().zip(q) {
                *p = (q - largest).exp();
                mass += *p;
            }
            *residual = largest + mass.ln() - v;
            let share = 1.0 / mass;
            for p in pi {
                *p *= share;
            }
        }
        proposed.jacobian.set_policy(mdp, &proposed.policy);
        proposed.jacobian.solve_into(residual, false, step);
        for (v, d) in proposed.values.iter_mut().zip(step.iter()) {
            *v += d;
        }
    }
}

fn dot(a: &[f64], b: &[f64]) -> f64 {
    a.iter().zip(b).map(|(a, b)| a * b).sum()
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::irl::random::Stream;
    use crate::mdp::{SoftSolver, log_sum_exp};

    /// Twelve states in a ring; the actions go either way or stay, each slipping.
    fn ring() -> TabularMdp {
        let n = 12_u32;
        let (mut offsets, mut next, mut probabilities) = (vec![0], Vec::new(), Vec::new());
        for state in 0..n {
            for step in [1, n - 1, 0] {
                let mut row = vec![((state + step) % n, 0.8), ((state + 1) % n, 0.1), ((state + n - 1) % n, 0.1)];
                row.sort_by_key(|entry| entry.0);
                let mut merged: Vec<(u32, f64)> = Vec::new();
                for (s, p) in row {
                    match merged.last_mut() {
                        Some(last) if last.0 == s => last.1 += p,
                        _ => merged.push((s, p)),
                    }
                }
                for (s, p) in merged {
                    next.push(s);
                    probabilities.push(p);
                }
                offsets.push(next.len());
            }
        }
        TabularMdp::new(12, 3, offsets, next, probabilities, None).expect("a model")
    }

    fn exact(mdp: &TabularMdp, discount: f64, counts: &[f64], reward: &[f64]) -> f64 {
        let mut solver = SoftSolver::new(mdp, discount);
        solver.solve(reward);
        let rows = solver.action_values().chunks_exact(3).zip(counts.chunks_exact(3));
        rows.map(|(q, n)| n.iter().zip(q).map(|(n, x)| n * (x - log_sum_exp(q))).sum::<f64>()).sum()
    }

    #[test]
    fn a_walk_over_rewards_keeps_the_likelihood() {
        let mdp = ring();
        for discount in [0.0, 0.9, 0.999] {
            let mut stream = Stream::new(5, 0);
            let counts: Vec<f64> = (0..36).map(|_| (10.0 * stream.uniform()).floor()).collect();
            let mut reward = vec![0.0; 36];
            let mut process = SoftProcess::new(&mdp, discount, &counts).expect("a small process");
            for step in 0..400 {
                let before = reward.clone();
                let state = (12.0 * stream.uniform()) as usize;
                let worth = if stream.uniform() < 0.5 { 0.0 } else { 20.0 * stream.uniform() };
                reward[3 * state..3 * state + 3].fill(worth);
                let found = process.propose(&reward, f64::NEG_INFINITY).expect("a likelihood");
                let want = exact(&mdp, discount, &counts, &reward);
                assert!((found - want).abs() <= 2.0 * ACCURACY, "step {step} at {discount}: {found} for {want}");
                if stream.uniform() < 0.6 {
                    process.settle();
                    process.accept();
                    assert!((process.log_likelihood() - want).abs() < 1e-6 * (1.0 + want.abs()));
                } else {
                    reward = before;
                }
            }
        }
    }

    #[test]
    fn gives_up_only_what_lies_below() {
        let mdp = ring();
        let mut stream = Stream::new(6, 0);
        let counts: Vec<f64> = (0..36).map(|_| (10.0 * stream.uniform()).floor()).collect();
        let mut process = SoftProcess::new(&mdp, 0.95, &counts).expect("a small process");
        let (mut kept, mut given_up) = (0, 0);
        for _ in 0..300 {
            let mut reward = vec![0.0; 36];
            for pair in &mut reward {
                *pair = 3.0 * stream.uniform() * stream.uniform();
            }
            let want = exact(&mdp, 0.95, &counts, &reward);
            let threshold = want + 20.0 * (stream.uniform() - 0.5);
            let found = process.propose(&reward, threshold);
            if (want - threshold).abs() > 2.0 * ACCURACY {
                assert_eq!(found.is_some(), want > threshold);
            }
            if found.is_some() {
                kept += 1;
            } else {
                given_up += 1;
            }
        }
        assert!(kept > 50 && given_up > 50, "{kept} kept, {given_up} given up");
    }

    #[test]
    fn what_has_no_value_is_refused() {
        let mdp = ring();
        let counts = vec![1.0; 36];
        let mut process = SoftProcess::new(&mdp, 0.9, &counts).expect("a small process");
        assert_eq!(process.propose(&[f64::INFINITY; 36], f64::NEG_INFINITY), None);
        assert!(process.propose(&[1.0; 36], f64::NEG_INFINITY).is_some());
    }
}
