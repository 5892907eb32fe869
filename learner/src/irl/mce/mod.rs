//! `mce`: maximum causal entropy by matching visits, Ziebart, Bagnell & Dey (2010); `mce-likelihood`: by its own likelihood.
//!
//! The soft-optimal policy π_w of wᵀΦ is the one of largest causal entropy among those whose expected features are the
//! demonstrated ones; w are the multipliers of that constraint. `mce` maximises the dual, wᵀf − Σ_s ν(s) V_w(s), whose gradient is
//! demonstrated features minus those of π_w ([`dual`]). `mce-likelihood` maximises Σ N(s,a) log π_w(a|s): the same dual with the
//! chance in the demonstrated transitions taken out, since it needs no more than the actions.

mod dual;
mod finite;

use super::em_tied::{FiniteLikelihood, Likelihood, SoftLikelihood};
use super::penalty::{Maximum, Penalised, maximise};
use super::visits::Visits;
use super::{Basis, Fit, FitError, FitOptions, Method, PlannerKind, Problem, Progress, Trace};
use crate::mdp::Policy;
use dual::Dual;
use finite::FiniteDual;

/// Strength of the penalty of `mce` for one trajectory. It grows with √L, as the standard error of a visit count does.
const MATCHING_STRENGTH: f64 = 0.05;
/// Strength of the penalty of `mce-likelihood`.
const LIKELIHOOD_STRENGTH: f64 = 0.1;
/// Strength of the quadratic penalty of `mce` beside L1: visits that no policy reaches leave the dual without a maximum, and L1
/// strong enough to give it one would hide small rewards.
const RIDGE: f64 = 0.5;

/// Matching of visits.
pub(super) struct Mce;

/// Likelihood of actions.
pub(super) struct MceLikelihood;

impl Method for Mce {
    fn id(&self) -> &'static str {
        "mce"
    }

    fn description(&self) -> &'static str {
        "maximum causal entropy: the soft-optimal policy matches the demonstrated visits, Ziebart et al. (2010)"
    }

    fn fit(&self, problem: &Problem<'_>, progress: Progress<'_>) -> Result<Fit, FitError> {
        problem.check()?;
        let mut trace = Trace::new(progress);
        let basis = problem.basis();
        let root = (problem.statistics.n_trajectories() as f64).sqrt();
        let penalised = Penalised::new(problem.options, MATCHING_STRENGTH * root).with_ridge(RIDGE);
        let visits = Visits::new(problem);
        if problem.options.discount < 1.0 {
            let mut dual = Dual::new(problem.mdp, &basis, &visits, problem.options.discount);
            let found = maximise(problem, &penalised, &basis, &mut trace, |weights| dual.value_and_gradient(weights))?;
            dual.value_and_gradient(&found.weights);
            let soft = dual.solver();
            let values = (soft.action_values(), soft.state_values(), soft.converged());
            Ok(soft_fit(problem, &basis, found, trace, values))
        } else {
            let mut dual = FiniteDual::new(problem.mdp, &basis, &visits)?;
            let found = maximise(problem, &penalised, &basis, &mut trace, |weights| dual.value_and_gradient(weights))?;
            dual.value_and_gradient(&found.weights);
            let (action_values, state_values) = dual.first_step();
            Ok(soft_fit(problem, &basis, found, trace, (action_values, state_values, true)))
        }
    }
}

impl Method for MceLikelihood {
    fn id(&self) -> &'static str {
        "mce-likelihood"
    }

    fn description(&self) -> &'static str {
        "likelihood of the demonstrated actions under the soft-optimal policy, non-negative weights, a point estimate"
    }

    fn log_prior(&self, options: &FitOptions, fit: &Fit) -> f64 {
        Penalised::new(options, LIKELIHOOD_STRENGTH).log_prior(&fit.weights)
    }

    fn fit(&self, problem: &Problem<'_>, progress: Progress<'_>) -> Result<Fit, FitError> {
        problem.check()?;
        let mut trace = Trace::new(progress);
        let (mdp, options) = (problem.mdp, problem.options);
        let basis = problem.basis();
        let mut likelihood: Box<dyn SoftLikelihood> = if options.discount < 1.0 {
            let counts = problem.statistics.counts(options.horizon);
            Box::new(Likelihood::new(mdp, &basis, counts, options.discount))
        } else {
            Box::new(FiniteLikelihood::new(mdp, &basis, problem.statistics, problem.horizon())?)
        };
        let penalised = Penalised::new(options, LIKELIHOOD_STRENGTH);
        let found =
            maximise(problem, &penalised, &basis, &mut trace, |weights| likelihood.value_and_gradient(weights))?;
        likelihood.value_and_gradient(&found.weights);
        let values = (likelihood.action_values(), likelihood.state_values(), likelihood.converged());
        Ok(soft_fit(problem, &basis, found, trace, values))
    }
}

/// The fit of soft values: Q, V and whether they solve their equation.
fn soft_fit(
    problem: &Problem<'_>,
    basis: &Basis,
    found: Maximum,
    trace: Trace<'_>,
    (action_values, state_values, converged): (&[f64], &[f64], bool),
) -> Fit {
    let Maximum { weights, stopped, mut warnings } = found;
    if matches!(problem.options.planner, PlannerKind::PolicyIteration | PlannerKind::ExpectationMaximization) {
        warnings.push("there is no planner to choose: the policy is the soft-optimal one by construction".to_owned());
    }
    if !converged {
        warnings.push("the soft values stopped before they converged".to_owned());
    }
    let n_actions = problem.mdp.n_actions();
    let iterations = trace.entries.len() as u32;
    Fit {
        reward: basis.reward(&weights),
        policy: Policy::boltzmann(n_actions, action_values, 1.0).into_probabilities(),
        greedy_policy: Policy::greedy(n_actions, action_values).into_probabilities(),
        state_values: state_values.to_vec(),
        standard_errors: None,
        posterior: None,
        hyperparameters: Vec::new(),
        weights,
        trace: trace.entries,
        stopped,
        iterations,
        warnings,
    }
}

#[cfg(test)]
mod tests;
