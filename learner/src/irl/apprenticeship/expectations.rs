//! Feature expectations of policies and of the demonstrations, over the same starts, steps and ends.

use crate::irl::visits::Visits;
use crate::irl::{Basis, Problem};
use crate::mdp::{Policy, TabularMdp, state_action_occupancy};

/// μ(π) = E[Σ_k γ^k Φ(s_k,a_k)] from the demonstrated starts on, in units of the demonstrations' total discounted time.
pub(super) struct Expectations<'a> {
    mdp: &'a TabularMdp,
    basis: &'a Basis,
    visits: Visits<'a>,
    discount: f64,
    scale: f64,
    demonstrated: Vec<f64>,
}

impl<'a> Expectations<'a> {
    pub(super) fn new(problem: &Problem<'a>, basis: &'a Basis) -> Self {
        let visits = Visits::new(problem);
        let counts = visits.discounted_counts();
        let scale = 1.0 / counts.iter().sum::<f64>();
        let demonstrated = basis.project(&counts).into_iter().map(|f| scale * f).collect();
        Self { mdp: problem.mdp, basis, visits, discount: problem.options.discount, scale, demonstrated }
    }

    /// μ_E, shape (`n_basis`,).
    pub(super) fn demonstrated(&self) -> &[f64] {
        &self.demonstrated
    }

    /// μ(π), shape (`n_basis`,). A walk ends after step k with the probability with which the demonstrations do.
    pub(super) fn of(&self, policy: &Policy) -> Vec<f64> {
        let mut total = vec![0.0; self.mdp.n_states()];
        let mut walking = self.visits.starts();
        for k in 0..self.visits.steps() {
            for (total, w) in total.iter_mut().zip(&walking) {
                *total += self.scale * w;
            }
            let kept = self.discount * self.visits.continuing(k);
            walking = self.mdp.propagate(&state_action_occupancy(policy, &walking));
            for w in &mut walking {
                *w *= kept;
            }
        }
        self.basis.project(&state_action_occupancy(policy, &total))
    }
}
