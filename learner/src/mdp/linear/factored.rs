//! A factorisation for callers that solve one small system after another and cannot wait for memory.

use super::direct::{Factor, Symbolic};
use super::pattern::Matrix;
use crate::mdp::tabular::TabularMdp;

/// M = I − γP_π of one policy after another, factored; for 0 ≤ γ < 1. Nothing is allocated after the construction.
#[derive(Clone)]
pub(crate) struct Factored {
    discount: f64,
    matrix: Matrix,
    factor: Factor,
    work: Vec<f64>,
}

impl Factored {
    /// The pattern and order of a model; `None` where a factorisation would take more than `bearable` multiplications.
    /// Solves nothing before [`Factored::set_policy`].
    pub(crate) fn of_model(mdp: &TabularMdp, discount: f64, bearable: u64) -> Option<Self> {
        let matrix = Matrix::of_model(mdp);
        let factor = Factor::new(Symbolic::of(&matrix, bearable)?);
        Some(Self { discount, factor, work: vec![0.0; matrix.n_states()], matrix })
    }

    /// Takes a policy, shape (`n_states * n_actions`,), of the model that the pattern was made from.
    pub(crate) fn set_policy(&mut self, mdp: &TabularMdp, policy: &[f64]) {
        self.matrix.fill(mdp, policy, self.discount);
        self.factor.factorise(&self.matrix);
    }

    /// x of M x = b, or of Mᵀ x = b, both of shape (`n_states`,).
    pub(crate) fn solve_into(&mut self, b: &[f64], transposed: bool, x: &mut [f64]) {
        self.factor.solve_into(b, transposed, &mut self.work, x);
    }
}
