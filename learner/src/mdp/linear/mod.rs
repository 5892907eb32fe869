//! Linear systems in M = I − γP_π: policy evaluation, discounted occupancies, gradients of soft values.
//!
//! The pattern of M is merged from the model's rows once; a policy only fills in the numbers. Where elimination in a good
//! order stays about as sparse as the model (small models, mazes) M is factored (`direct`); otherwise it is solved by
//! preconditioned BiCGSTAB (`iterative`), because a sweep-by-sweep solution would need 1/(1 − γ) times as many passes.
//!
//! Where the incomplete factorisation, the cheap preconditioner, has cost as many iterations as a whole one takes time, the
//! whole one is made (`lasting`), and serves for the policies that follow as well, which are seldom far away: it is made anew
//! once its age has cost as much as itself. What is counted are operations, not seconds: the same calls give the same
//! numbers. Where even a whole factorisation is too much, plain sweeps with the incomplete one improve what there is, in a
//! bounded number of passes. Every solution comes with its true residual. Memory is proportional to the transitions of the
//! model, but for the factorisation, whose fill is bounded.
//!
//! M is a strictly diagonally dominant M-matrix for γ < 1, so neither factorisation needs pivots (Meijerink & van der Vorst
//! 1977), and the order of elimination is free. Deliberately absent: threads; one solve is one core's work.

mod direct;
mod factored;
mod iterative;
mod lasting;
mod pattern;

use super::tabular::TabularMdp;
use direct::{Factor, Symbolic};
pub(crate) use factored::Factored;
use lasting::Iterative;
use pattern::Matrix;

/// Up to this many states an order of elimination is looked for at once.
const DIRECT_STATES: usize = 5000;
/// A factorisation of so many multiplications is always worth it…
const DIRECT_MULTIPLICATIONS: u64 = 50_000;
/// … and so is one of this many times the entries of the matrix, for each decade that 1 − γ lies below 1 beyond the first:
/// the passes of an iteration that it replaces.
const DIRECT_PER_ENTRY: f64 = 100.0;
/// Down to this 1 − γ, a hundred times the rounding of single precision, factors are kept in it.
const SINGLE_PRECISION: f64 = 1e-5;
/// Wanted residual, relative to the right-hand side.
const RELATIVE_TOLERANCE: f64 = 1e-13;

/// A solution and how good it is.
#[derive(Debug, Clone, PartialEq)]
pub(crate) struct Solution {
    /// x, shape (`n_states`,).
    pub x: Vec<f64>,
    /// ‖b − M x‖ / ‖b‖ (Euclidean), computed from x itself; 0 where b = 0.
    pub residual: f64,
}

/// The matrix I − γP_π of a policy, for 0 ≤ γ < 1, ready to be solved against.
pub(crate) struct Resolvent {
    discount: f64,
    matrix: Matrix,
    solver: Solver,
}

enum Solver {
    Direct(Box<Factor>),
    Iterative(Box<Iterative<f32>>),
    /// As [`Solver::Iterative`], where single precision would hide what tells M from a singular matrix.
    IterativeInDouble(Box<Iterative<f64>>),
}

impl Resolvent {
    /// `policy` has shape (`n_states * n_actions`,).
    pub(crate) fn new(mdp: &TabularMdp, policy: &[f64], discount: f64) -> Self {
        let mut resolvent = Self::of_model(mdp, discount);
        resolvent.set_policy(mdp, policy);
        resolvent
    }

    /// Merges and orders the rows of a model; [`Resolvent::set_policy`] makes the matrix, again and again.
    pub(crate) fn of_model(mdp: &TabularMdp, discount: f64) -> Self {
        let matrix = Matrix::of_model(mdp);
        let decades = (-(1.0 - discount).log10() - 1.0).max(0.0);
        let bearable = DIRECT_MULTIPLICATIONS.max((DIRECT_PER_ENTRY * decades * matrix.n_entries() as f64) as u64);
        let symbolic = if matrix.n_states() <= DIRECT_STATES { Symbolic::of(&matrix, bearable) } else { None };
        let solver = match symbolic {
            Some(symbolic) => Solver::Direct(Box::new(Factor::new(symbolic))),
            None if 1.0 - discount >= SINGLE_PRECISION => Solver::Iterative(Box::default()),
            None => Solver::IterativeInDouble(Box::default()),
        };
        Self { discount, matrix, solver }
    }

    /// Takes another policy of the model that the pattern was made from.
    pub(crate) fn set_policy(&mut self, mdp: &TabularMdp, policy: &[f64]) {
        self.matrix.fill(mdp, policy, self.discount);
        match &mut self.solver {
            Solver::Direct(factor) => factor.factorise(&self.matrix),
            Solver::Iterative(iterative) => iterative.set_policy(&self.matrix),
            Solver::IterativeInDouble(iterative) => iterative.set_policy(&self.matrix),
        }
    }

    /// x of (I − γP_π) x = b, shape (`n_states`,).
    pub(crate) fn solve(&mut self, b: &[f64]) -> Vec<f64> {
        self.solution(b, false, RELATIVE_TOLERANCE, None).x
    }

    /// As [`Resolvent::solve`], to a residual of `tolerance` relative to b where that saves time.
    pub(crate) fn solve_roughly(&mut self, b: &[f64], tolerance: f64) -> Solution {
        self.solution(b, false, tolerance.max(RELATIVE_TOLERANCE), None)
    }

    /// x of (I − γP_π)ᵀ x = b, shape (`n_states`,).
    pub(crate) fn solve_transposed(&mut self, b: &[f64]) -> Vec<f64> {
        self.solve_transposed_from(b, None).x
    }

    /// As [`Resolvent::solve_transposed`], with its residual, and where that saves time from the solution of a similar system
    /// on.
    pub(crate) fn solve_transposed_from(&mut self, b: &[f64], start: Option<&[f64]>) -> Solution {
        self.solution(b, true, RELATIVE_TOLERANCE, start)
    }

    fn solution(&mut self, b: &[f64], transposed: bool, tolerance: f64, start: Option<&[f64]>) -> Solution {
        let x = match &mut self.solver {
            Solver::Direct(factor) => factor.solve(b, transposed),
            Solver::Iterative(iterative) => iterative.solve(&self.matrix, b, transposed, tolerance, start),
            Solver::IterativeInDouble(iterative) => iterative.solve(&self.matrix, b, transposed, tolerance, start),
        };
        let residual = self.matrix.relative_residual(&x, b, transposed);
        Solution { x, residual }
    }
}

#[cfg(test)]
mod tests;
