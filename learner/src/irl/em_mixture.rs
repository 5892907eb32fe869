//! `em-mixture`: Hahn & Zoubir (2015), eq. 2–5, with a latent length per trajectory.
//!
//! Maximises Σ_l log Σ_k p(k) wᵀΦ(s_k,a_k) over the simplex. With a_l = Σ_k p(k) Φ(s_k,a_k) this is the mixing proportions of a
//! finite mixture: concave, and EM multiplies w_b by the mean responsibility of b. The stopping rule watches a bound:
//! by concavity, no w on the simplex is better than the present one by more than max_b g_b − L, g the gradient. Features may
//! have any unit but no negative value: wᵀΦ is a likelihood.

use super::{Fit, FitError, Method, Problem, Progress, Stopped, Trace, em_features};
use crate::mdp::max_abs;
use std::collections::BTreeMap;

/// Mixing proportions by EM.
pub(super) struct EmMixture;

impl Method for EmMixture {
    fn id(&self) -> &'static str {
        "em-mixture"
    }

    fn description(&self) -> &'static str {
        "the mixture's own likelihood with a latent length per trajectory, Hahn & Zoubir (2015) eq. 2-5"
    }

    fn needs_demonstrations(&self) -> bool {
        true
    }

    fn fit(&self, problem: &Problem<'_>, progress: Progress<'_>) -> Result<Fit, FitError> {
        problem.check()?;
        let mut trace = Trace::new(progress);
        let options = problem.options;
        let demonstrations = problem
            .demonstrations
            .filter(|demonstrations| !demonstrations.is_empty())
            .ok_or(FitError::NeedsDemonstrations { method: self.id() })?;
        let basis = problem.basis();
        em_features::highest(problem)?;
        let n_actions = problem.mdp.n_actions();
        let steps = problem.horizon().min(problem.statistics.longest()) as usize;
        let prior = options.horizon_prior.probabilities(options.discount, problem.horizon(), steps);
        let mut rows: Vec<Vec<(usize, f64)>> = Vec::with_capacity(demonstrations.len());
        let mut units = 0.0;
        for trajectory in demonstrations {
            let mut row = BTreeMap::new();
            let pairs = trajectory.states().iter().zip(trajectory.actions());
            for ((&state, &action), p) in pairs.zip(&prior) {
                let (state, action) = (state as usize, action as usize);
                if state >= problem.mdp.n_states() || action >= n_actions {
                    return Err(FitError::Mismatch {
                        n_states: problem.mdp.n_states(),
                        n_actions,
                        got_states: state + 1,
                        got_actions: action + 1,
                    });
                }
                basis.for_each(problem.mdp.pair(state, action), |b, value| *row.entry(b).or_insert(0.0) += p * value);
            }
            // a trajectory's unit changes its likelihood by a constant
            let unit = row.values().copied().fold(0.0, f64::max);
            if unit > 0.0 {
                units += unit.ln();
                rows.push(row.into_iter().map(|(b, a)| (b, a / unit)).collect());
            }
        }
        let featureless = demonstrations.len() - rows.len();
        if rows.is_empty() {
            let message = "expected a feature that is not 0 where the demonstrations go, got none".to_owned();
            return Err(FitError::InvalidOption { field: "basis", message });
        }
        let mut warnings = Vec::new();
        if featureless > 0 {
            warnings.push(format!(
                "all features are 0 along {featureless} of {} trajectories: no reward explains them, they are left out",
                demonstrations.len()
            ));
        }

        let n_trajectories = rows.len() as f64;
        let mut weights = vec![1.0 / basis.len() as f64; basis.len()];
        let mut stopped = Stopped::MaxIterations;
        for _ in 0..options.max_iterations {
            let mut gradient = vec![0.0; basis.len()];
            let mut log_likelihood = 0.0;
            for row in &rows {
                let likelihood: f64 = row.iter().map(|&(b, a)| weights[b] * a).sum();
                log_likelihood += likelihood.ln();
                for &(b, a) in row {
                    gradient[b] += a / likelihood;
                }
            }
            let gap = max_abs(&gradient) - n_trajectories;
            trace.record(log_likelihood + units, gap)?;
            if gap <= options.tolerance {
                stopped = Stopped::Converged;
                break;
            }
            for (w, g) in weights.iter_mut().zip(&gradient) {
                *w *= g / n_trajectories;
            }
        }

        Fit::planned(problem, &basis, weights, trace, stopped, warnings)
    }
}
