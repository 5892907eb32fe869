//! Soft (maximum entropy) values: V = log Σ_a exp Q, Q = R + γ P V.
//!
//! Plain soft value iteration contracts by γ a sweep. The map is convex and its derivative is γP_π, so Newton's method (each
//! step one solve with I − γP_π, which is soft policy iteration) converges quadratically from anywhere (Rust 1987 solves
//! dynamic discrete choice in the same way). A [`SoftSolver`] keeps its last values as the start of the next solution.

use crate::mdp::linear::Resolvent;
use crate::mdp::numeric::{log_sum_exp, max_abs};
use crate::mdp::plan::Plan;
use crate::mdp::{Policy, TabularMdp};

const MAX_STEPS: u32 = 200;
/// Wanted |V − log Σ exp Q|, relative to the largest value.
/// Little above rounding: the error of the values is up to 1/(1 − γ) times this.
const RELATIVE_TOLERANCE: f64 = 2e-15;

/// Solves for soft values again and again as the reward moves.
pub struct SoftSolver<'a> {
    mdp: &'a TabularMdp,
    discount: f64,
    state_values: Vec<f64>,
    action_values: Vec<f64>,
    policy: Vec<f64>,
    iterations: u32,
    converged: bool,
}

impl<'a> SoftSolver<'a> {
    /// Starts from V = 0.
    ///
    /// # Panics
    /// Where `discount` is not in [0, 1).
    pub fn new(mdp: &'a TabularMdp, discount: f64) -> Self {
        assert!((0.0..1.0).contains(&discount), "expected a discount in [0, 1), got {discount}");
        Self {
            mdp,
            discount,
            state_values: vec![0.0; mdp.n_states()],
            action_values: vec![0.0; mdp.n_pairs()],
            policy: vec![0.0; mdp.n_pairs()],
            iterations: 0,
            converged: false,
        }
    }

    /// Solves for R(s,a), shape (`n_states * n_actions`,), from the last solution on.
    pub fn solve(&mut self, reward: &[f64]) {
        let n_actions = self.mdp.n_actions();
        let mut residual = vec![0.0; self.mdp.n_states()];
        let mut last = f64::INFINITY;
        self.iterations = 0;
        self.converged = false;
        loop {
            self.mdp.action_values_into(reward, self.discount, &self.state_values, &mut self.action_values);
            let rows = self.action_values.chunks_exact(n_actions).zip(self.policy.chunks_exact_mut(n_actions));
            for ((q, pi), (r, v)) in rows.zip(residual.iter_mut().zip(&self.state_values)) {
                let value = log_sum_exp(q);
                *r = value - v;
                for (p, q) in pi.iter_mut().zip(q) {
                    *p = (q - value).exp();
                }
            }
            let size = max_abs(&residual);
            let scale = 1.0 + max_abs(&self.state_values);
            if size <= RELATIVE_TOLERANCE * scale || (size <= 1e-9 * scale && size >= 0.5 * last) {
                self.converged = true;
                break;
            }
            if self.iterations == MAX_STEPS {
                break;
            }
            last = size;
            self.iterations += 1;
            // far from the solution Newton's step is itself rough: its error is corrected by the next
            let rough = (1e-3 * size / scale).clamp(1e-8, 1e-4);
            let step = Resolvent::new(self.mdp, &self.policy, self.discount).solve_roughly(&residual, rough);
            for (v, d) in self.state_values.iter_mut().zip(step) {
                *v += d;
            }
        }
    }

    /// V(s), shape (`n_states`,).
    pub fn state_values(&self) -> &[f64] {
        &self.state_values
    }

    /// Q(s,a), shape (`n_states * n_actions`,).
    pub fn action_values(&self) -> &[f64] {
        &self.action_values
    }

    /// π(a|s) = exp(Q − V), shape (`n_states * n_actions`,).
    pub fn policy(&self) -> &[f64] {
        &self.policy
    }

    /// True where the last solution satisfies its equation.
    pub fn converged(&self) -> bool {
        self.converged
    }
}

/// Soft values of one reward.
pub(crate) fn plan(mdp: &TabularMdp, reward: &[f64], discount: f64) -> Plan {
    let mut solver = SoftSolver::new(mdp, discount);
    solver.solve(reward);
    let policy = Policy::boltzmann(mdp.n_actions(), &solver.action_values, 1.0);
    Plan {
        state_values: solver.state_values,
        action_values: solver.action_values,
        policy,
        iterations: solver.iterations,
        converged: solver.converged,
    }
}
