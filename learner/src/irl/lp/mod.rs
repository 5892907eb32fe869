//! `lp`: inverse reinforcement learning by linear programming, Ng & Russell (2000), made to stand sampled demonstrations.
//!
//! Theirs takes a policy that is known everywhere and asks for a reward under which it is optimal, as clearly as possible: the
//! sum over states of the smallest margin by which the policy's action beats another is maximised, less a penalty λ |R|₁,
//! with |R| ≤ R_max (their eq. 5–7). Here the policy is the demonstrated one where there is one, and elsewhere the soonest way
//! to the demonstrated states (`bc-planning`); a state's margin counts as often as the state was visited, may be negative
//! (sampled policies need not be optimal for any reward), and leaves out the actions that were demonstrated beside the most
//! frequent one, since they may be as good. With the L1 penalty, 0 ≤ w ≤ 1; otherwise |w| ≤ 1.

mod programme;
mod solver;

use super::bc_planning::discounted_arrival;
use super::penalty::Penalised;
use super::{Fit, FitError, Method, Penalty, Problem, Progress, Stopped, Trace};
use crate::mdp::Policy;
use programme::Programme;

/// Strength λ of the penalty where the options name none, in visits.
const STRENGTH: f64 = 3.0;

/// The linear programme.
pub(super) struct Lp;

impl Method for Lp {
    fn id(&self) -> &'static str {
        "lp"
    }

    fn description(&self) -> &'static str {
        "linear programming with visit-weighted soft margins, Ng & Russell (2000)"
    }

    fn fit(&self, problem: &Problem<'_>, progress: Progress<'_>) -> Result<Fit, FitError> {
        problem.check()?;
        let mut trace = Trace::new(progress);
        let (mdp, options) = (problem.mdp, problem.options);
        let basis = problem.basis();
        let counts = problem.statistics.counts(options.horizon);
        let penalised = Penalised::new(options, STRENGTH);
        let mut policy = Policy::greedy(mdp.n_actions(), &discounted_arrival(problem, &counts)?).into_probabilities();
        for (row, n) in policy.chunks_exact_mut(mdp.n_actions()).zip(counts.chunks_exact(mdp.n_actions())) {
            let visits: f64 = n.iter().sum();
            if visits > 0.0 {
                for (p, n) in row.iter_mut().zip(n) {
                    *p = n / visits;
                }
            }
        }
        let programme = Programme::new(problem, &basis, &counts, &policy, &penalised)?;
        let found = solver::solve(&programme, options, |objective, gap| trace.record(objective, gap))?;
        let lower = if options.penalty == Penalty::L1 { 0.0 } else { -1.0 };
        let mut weights = vec![0.0; basis.len()];
        for (w, x) in weights.iter_mut().zip(&found.x) {
            // the interior point method stops a hair off the bounds
            let clamped = x.clamp(lower, 1.0);
            *w = if clamped.abs() < ROUNDING { 0.0 } else { clamped };
        }
        let mut warnings = Vec::new();
        if found.stopped == Stopped::Stalled {
            warnings.push("the linear programme was not solved to its tolerance".to_owned());
        }
        if weights.iter().all(|w| *w == 0.0) {
            warnings
                .push("no reward tells the demonstrated actions from the others by more than the penalty".to_owned());
        }
        Fit::planned(problem, &basis, weights, trace, found.stopped, warnings)
    }
}

/// Weights below this, of at most 1, are the solver's tolerance.
const ROUNDING: f64 = 1e-7;

#[cfg(test)]
mod tests;
