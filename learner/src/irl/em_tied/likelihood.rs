//! Log-likelihood of the soft-optimal policy with its exact gradient and Hessian.

use super::FiniteLikelihood;
use crate::irl::{Basis, FitError, Problem};
use crate::mdp::{Resolvent, SoftSolver, TabularMdp, log_sum_exp};
use nalgebra::DMatrix;

/// A log-likelihood of soft-optimal behaviour as a function of the weights.
pub trait SoftLikelihood {
    /// ℓ(w) and dℓ/dw, shape (`n_basis`,).
    fn value_and_gradient(&mut self, weights: &[f64]) -> (f64, Vec<f64>);

    /// d²ℓ/dw², shape (`n_basis`, `n_basis`), and for each b the sum of the absolute terms whose differences make its diagonal
    /// entry: rounding hides anything much smaller.
    fn hessian_and_terms(&mut self, weights: &[f64]) -> (DMatrix<f64>, Vec<f64>);

    /// Q of the weights last evaluated, shape (`n_states * n_actions`,); of the first step where there is a horizon.
    fn action_values(&self) -> &[f64];

    /// V of the weights last evaluated, shape (`n_states`,); of the first step where there is a horizon.
    fn state_values(&self) -> &[f64];

    /// π = exp(Q − V), shape (`n_states * n_actions`,); of the first step where there is a horizon.
    fn policy(&self) -> &[f64];

    /// True where the values satisfy their equation.
    fn converged(&self) -> bool;
}

/// The likelihood that a problem asks for: over all time, or over K steps where the discount is 1.
pub(in crate::irl) fn of<'a>(
    problem: &Problem<'a>,
    basis: &'a Basis,
) -> Result<Box<dyn SoftLikelihood + 'a>, FitError> {
    let (mdp, options) = (problem.mdp, problem.options);
    Ok(if options.discount < 1.0 {
        let counts = problem.statistics.counts(options.horizon);
        Box::new(Likelihood::new(mdp, basis, counts, options.discount))
    } else {
        Box::new(FiniteLikelihood::new(mdp, basis, problem.statistics, problem.horizon())?)
    })
}

/// ℓ(w) = Σ_{s,a} N(s,a) log π_w(a|s) of given counts. Warm-starts the soft values from one call to the next.
pub struct Likelihood<'a> {
    mdp: &'a TabularMdp,
    basis: &'a Basis,
    discount: f64,
    /// N(s,a).
    counts: Vec<f64>,
    /// γ Σ_{s,a} N(s,a) P(·|s,a) − N(·): the derivative of ℓ with respect to V.
    value_weights: Vec<f64>,
    solver: SoftSolver<'a>,
    /// The v of the last gradient, from which the next one is solved.
    adjoint: Vec<f64>,
    residual: f64,
}

impl<'a> Likelihood<'a> {
    /// `counts` has shape (`n_states * n_actions`,).
    ///
    /// # Panics
    /// Where `discount` is not in [0, 1).
    pub fn new(mdp: &'a TabularMdp, basis: &'a Basis, counts: Vec<f64>, discount: f64) -> Self {
        let mut value_weights: Vec<f64> = mdp.propagate(&counts).into_iter().map(|n| discount * n).collect();
        for (weight, row) in value_weights.iter_mut().zip(counts.chunks_exact(mdp.n_actions())) {
            *weight -= row.iter().sum::<f64>();
        }
        let solver = SoftSolver::new(mdp, discount);
        Self { mdp, basis, discount, counts, value_weights, solver, adjoint: vec![0.0; mdp.n_states()], residual: 0.0 }
    }

    /// ℓ(w) and dℓ/dw, shape (`n_basis`,).
    ///
    /// With M = I − γP_π and Mᵀv = γ Σ N P − N, the derivative with respect to R(s,a) is N(s,a) + π(a|s) v(s): one solve.
    pub fn value_and_gradient(&mut self, weights: &[f64]) -> (f64, Vec<f64>) {
        self.solver.solve(&self.basis.reward(weights));
        let n_actions = self.mdp.n_actions();
        let q = self.solver.action_values().chunks_exact(n_actions);
        let log_likelihood = q
            .zip(self.counts.chunks_exact(n_actions))
            .filter(|(_, n)| n.iter().any(|n| *n > 0.0))
            .map(|(q, n)| {
                let value = log_sum_exp(q);
                q.iter().zip(n).map(|(q, n)| if *n > 0.0 { n * (q - value) } else { 0.0 }).sum::<f64>()
            })
            .sum();
        (self.adjoint, self.residual) = self.solver.solve_transposed(&self.value_weights, Some(&self.adjoint));
        let mut by_reward = self.counts.clone();
        let rows = by_reward.chunks_exact_mut(n_actions).zip(self.solver.policy().chunks_exact(n_actions));
        for ((row, pi), v) in rows.zip(&self.adjoint) {
            for (g, p) in row.iter_mut().zip(pi) {
                *g += p * v;
            }
        }
        (log_likelihood, self.basis.project(&by_reward))
    }

    /// d²ℓ/dw², shape (`n_basis`, `n_basis`).
    ///
    /// With J_b = dV/dw_b = M⁻¹ Σ_a π Φ_b and g_b = dQ/dw_b = Φ_b + γ P J_b, the second derivative of V solves M V'' = Cov_π(g_b,
    /// g_c) state by state, so d²ℓ/dw_b dw_c = Σ_s v(s) Cov_{a ~ π(s)}(g_b, g_c) with the v of the gradient.
    pub fn hessian(&mut self, weights: &[f64]) -> DMatrix<f64> {
        self.hessian_and_terms(weights).0
    }

    /// The Hessian, and for each b the sum of the absolute terms whose differences make its diagonal entry: rounding hides
    /// anything much smaller.
    pub(super) fn hessian_and_terms(&mut self, weights: &[f64]) -> (DMatrix<f64>, Vec<f64>) {
        self.solver.solve(&self.basis.reward(weights));
        let (mdp, n_basis, n_actions) = (self.mdp, self.basis.len(), self.mdp.n_actions());
        let policy = self.solver.policy();
        let mut resolvent = Resolvent::new(mdp, policy, self.discount);
        let v = resolvent.solve_transposed(&self.value_weights);
        let mut received = vec![vec![0.0; mdp.n_states()]; n_basis];
        for (pair, &p) in policy.iter().enumerate() {
            self.basis.for_each(pair, |b, value| received[b][pair / n_actions] += p * value);
        }
        let sensitivities: Vec<Vec<f64>> = received.iter().map(|b| resolvent.solve(b)).collect();
        let mut hessian = DMatrix::zeros(n_basis, n_basis);
        let mut terms = vec![0.0; n_basis];
        let mut centred = DMatrix::zeros(n_basis, n_actions);
        for state in 0..mdp.n_states() {
            for action in 0..n_actions {
                let pair = mdp.pair(state, action);
                for (b, sensitivity) in sensitivities.iter().enumerate() {
                    centred[(b, action)] = self.discount * mdp.expected(pair, sensitivity) - sensitivity[state];
                    terms[b] += (v[state] * policy[pair]).abs() * sensitivity[state].powi(2);
                }
                self.basis.for_each(pair, |b, value| centred[(b, action)] += value);
            }
            let weighted = DMatrix::from_fn(n_basis, n_actions, |b, action| {
                v[state] * policy[mdp.pair(state, action)] * centred[(b, action)]
            });
            hessian.gemm(1.0, &weighted, &centred.transpose(), 1.0);
        }
        (hessian, terms)
    }

    /// Relative residual ‖b − Mᵀv‖ / ‖b‖ of the last gradient's linear system; that of its soft values is
    /// [`SoftSolver::residual`].
    pub fn residual(&self) -> f64 {
        self.residual
    }

    /// Soft values and policy of the weights last evaluated.
    pub fn solver(&self) -> &SoftSolver<'a> {
        &self.solver
    }
}

impl SoftLikelihood for Likelihood<'_> {
    fn value_and_gradient(&mut self, weights: &[f64]) -> (f64, Vec<f64>) {
        Likelihood::value_and_gradient(self, weights)
    }

    fn hessian_and_terms(&mut self, weights: &[f64]) -> (DMatrix<f64>, Vec<f64>) {
        Likelihood::hessian_and_terms(self, weights)
    }

    fn action_values(&self) -> &[f64] {
        self.solver.action_values()
    }

    fn state_values(&self) -> &[f64] {
        self.solver.state_values()
    }

    fn policy(&self) -> &[f64] {
        self.solver.policy()
    }

    fn converged(&self) -> bool {
        self.solver.converged()
    }
}
