//! Soft (maximum entropy) values: V = log Σ_a exp Q, Q = R + γ P V.
//!
//! Plain soft value iteration contracts by γ a sweep. The map is convex and its derivative is γP_π, so Newton's method (each
//! step one solve with I − γP_π, which is soft policy iteration) converges quadratically from anywhere (Rust 1987 solves
//! dynamic discrete choice in the same way). A [`SoftSolver`] keeps its last values as the start of the next solution.

use crate::mdp::linear::Resolvent;
use crate::mdp::numeric::{max, max_abs, norm};
use crate::mdp::plan::Plan;
use crate::mdp::{Policy, TabularMdp};

const MAX_STEPS: u32 = 200;
/// Wanted |V − log Σ exp Q|, relative to the largest value.
/// Little above rounding: the error of the values is up to 1/(1 − γ) times this.
const RELATIVE_TOLERANCE: f64 = 2e-15;
/// What rounding of the exponentials may leave of it.
const ROUNDING: f64 = 1e-13;

/// Solves for soft values again and again as the reward moves.
pub struct SoftSolver<'a> {
    mdp: &'a TabularMdp,
    discount: f64,
    state_values: Vec<f64>,
    action_values: Vec<f64>,
    policy: Vec<f64>,
    errors: Vec<f64>,
    resolvent: Resolvent,
    residual: f64,
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
            errors: vec![0.0; mdp.n_states()],
            resolvent: Resolvent::of_model(mdp, discount),
            residual: f64::INFINITY,
            iterations: 0,
            converged: false,
        }
    }

    /// Solves for R(s,a), shape (`n_states * n_actions`,), from the last solution on.
    pub fn solve(&mut self, reward: &[f64]) {
        let mut last = f64::INFINITY;
        // what Newton's step is bound to have left of the error, relative to the scale
        let mut promised = f64::INFINITY;
        self.iterations = 0;
        self.converged = false;
        loop {
            self.sweep(reward);
            let size = max_abs(&self.errors);
            let scale = 1.0 + max_abs(&self.state_values);
            self.residual = size;
            let at_rounding = size <= ROUNDING * scale && promised <= RELATIVE_TOLERANCE;
            if at_rounding || size <= RELATIVE_TOLERANCE * scale || (size <= 1e-9 * scale && size >= 0.5 * last) {
                self.converged = true;
                break;
            }
            if self.iterations == MAX_STEPS || !size.is_finite() {
                break;
            }
            last = size;
            self.iterations += 1;
            self.resolvent.set_policy(self.mdp, &self.policy);
            // far from the solution Newton's step is itself rough: its error is corrected by the next
            let rough = (1e-3 * size / scale).clamp(1e-8, 1e-4);
            let step = self.resolvent.solve_roughly(&self.errors, rough);
            for (v, d) in self.state_values.iter_mut().zip(&step.x) {
                *v += d;
            }
            // the second derivative of log Σ exp is a variance, at most a quarter of the squared range
            let reach = 2.0 * self.discount * max_abs(&step.x);
            let unsolved = step.residual * norm(&self.errors);
            promised = (0.125 * reach * reach + unsolved) / scale;
        }
    }

    /// Q, π and the errors log Σ exp Q − V of the present V.
    fn sweep(&mut self, reward: &[f64]) {
        let n_actions = self.mdp.n_actions();
        self.mdp.action_values_into(reward, self.discount, &self.state_values, &mut self.action_values);
        let rows = self.action_values.chunks_exact(n_actions).zip(self.policy.chunks_exact_mut(n_actions));
        for ((q, pi), (error, v)) in rows.zip(self.errors.iter_mut().zip(&self.state_values)) {
            let largest = max(q);
            let mut sum = 0.0;
            for (p, q) in pi.iter_mut().zip(q) {
                *p = (q - largest).exp();
                sum += *p;
            }
            let share = 1.0 / sum;
            for p in pi {
                *p *= share;
            }
            *error = largest + sum.ln() - v;
        }
    }

    /// x of (I − γP_π)ᵀ x = b for the policy of the last solution, shape (`n_states`,), and ‖b − (I − γP_π)ᵀ x‖ / ‖b‖.
    /// `start` may be the solution of a similar system.
    pub(crate) fn solve_transposed(&mut self, b: &[f64], start: Option<&[f64]>) -> (Vec<f64>, f64) {
        self.resolvent.set_policy(self.mdp, &self.policy);
        let solution = self.resolvent.solve_transposed_from(b, start);
        (solution.x, solution.residual)
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

    /// max |V − log Σ exp Q| of the last solution; V itself is at most 1/(1 − γ) times this away from the exact one.
    pub fn residual(&self) -> f64 {
        self.residual
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
