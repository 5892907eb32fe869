//! The dual of maximum causal entropy over all time, for a discount below 1.

use crate::irl::Basis;
use crate::irl::visits::Visits;
use crate::mdp::{Resolvent, SoftSolver, TabularMdp};

/// wᵀf − Σ_s ν(s) V_w(s), with demonstrated features f = Σ_k γ^k Σ N_k(s,a) Φ(s,a) and ν = starts − Σ_k γ^(k+1) ends.
///
/// What would have come after a trajectory's end is filled in with what π_w expects from there, which is what the ends in ν do:
/// demonstrations of a few steps are then not taken for an expert that does nothing afterwards. Where no trajectory ends before
/// γ^k is negligible, ν is the demonstrated start and the dual is the convex one of the paper. Warm-starts the soft values
/// from one call to the next.
pub(super) struct Dual<'a> {
    mdp: &'a TabularMdp,
    basis: &'a Basis,
    discount: f64,
    /// Σ_k γ^k N_k, shape (`n_states * n_actions`,).
    counts: Vec<f64>,
    /// ν, shape (`n_states`,).
    starts: Vec<f64>,
    solver: SoftSolver<'a>,
}

impl<'a> Dual<'a> {
    pub(super) fn new(mdp: &'a TabularMdp, basis: &'a Basis, visits: &Visits<'_>, discount: f64) -> Self {
        let starts = visits.starts().iter().zip(visits.ends(mdp)).map(|(start, end)| start - end).collect();
        let counts = visits.discounted_counts();
        Self { mdp, basis, discount, counts, starts, solver: SoftSolver::new(mdp, discount) }
    }

    /// The dual and its gradient, shape (`n_basis`,): demonstrated features minus expected ones.
    pub(super) fn value_and_gradient(&mut self, weights: &[f64]) -> (f64, Vec<f64>) {
        let reward = self.basis.reward(weights);
        self.solver.solve(&reward);
        let gained: f64 = reward.iter().zip(&self.counts).map(|(r, n)| r * n).sum();
        let expected: f64 = self.solver.state_values().iter().zip(&self.starts).map(|(v, n)| v * n).sum();
        let policy = self.solver.policy();
        let occupancy = Resolvent::new(self.mdp, policy, self.discount).solve_transposed(&self.starts);
        let n_actions = self.mdp.n_actions();
        let gap: Vec<f64> = self
            .counts
            .iter()
            .zip(policy)
            .enumerate()
            .map(|(pair, (n, p))| n - occupancy[pair / n_actions] * p)
            .collect();
        (gained - expected, self.basis.project(&gap))
    }

    /// Soft values and policy of the weights last evaluated.
    pub(super) fn solver(&self) -> &SoftSolver<'a> {
        &self.solver
    }
}
