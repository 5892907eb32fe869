//! `em-tied`: Hahn & Zoubir's (2015) Q with the policy tied to the reward.
//!
//! Their Q holds Σ_n log π(a_n|s_n) with a free policy. Tied, π_w(a|s) = exp(Q_w(s,a) − V_w(s)) is the soft-optimal policy of
//! θ = wᵀΦ (any temperature is part of w), and the objective Σ_l Σ_n log π_w(a_n|s_n) − penalty is maximised by a
//! quasi-Newton method with bounds. With free weights and no penalty this is the maximum-likelihood estimator of dynamic
//! discrete choice (Rust 1987), and standard errors come from the exact Hessian.
//!
//! The optimum is a point; with few demonstrations many rewards explain them. Under the penalty L1 the default goes on to the
//! posterior under a sparse prior (`spike_slab`) and acts on its mean, which minimises the expected loss of value over all
//! rewards that may be true (Ramachandran & Amir 2007, theorem 3). Without a posterior the greedy policy takes the best
//! actions under the soft Q itself, not those of a hard planner on the learned reward.

mod finite;
mod laplace;
mod likelihood;
mod optimum;
mod places;
mod posterior;
mod prior;
mod soft_process;
mod spike_slab;
mod standard_errors;

pub use finite::FiniteLikelihood;
pub(super) use likelihood::of as soft_likelihood;
pub use likelihood::{Likelihood, SoftLikelihood};
pub use standard_errors::{MAX_STANDARD_ERRORS, standard_errors};

use super::{Basis, Fit, FitError, FitOptions, Method, Penalty, PlannerKind, PosteriorKind, Problem, Progress, Trace};
use crate::mdp::Policy;

/// The policy tied to the reward.
pub struct EmTied;

impl Method for EmTied {
    fn id(&self) -> &'static str {
        "em-tied"
    }

    fn description(&self) -> &'static str {
        "the policy tied to the reward: posterior mean under a sparse prior, or maximum likelihood"
    }

    fn log_prior(&self, options: &FitOptions, fit: &Fit) -> f64 {
        let strength = strength(options);
        match options.penalty {
            Penalty::L1 => -strength * fit.weights.iter().sum::<f64>(),
            Penalty::L2 => -0.5 * strength * fit.weights.iter().map(|w| w * w).sum::<f64>(),
            Penalty::None => 0.0,
        }
    }

    fn fit(&self, problem: &Problem<'_>, progress: Progress<'_>) -> Result<Fit, FitError> {
        fit_with_basis(problem, &problem.basis(), progress)
    }
}

/// Fits with any basis; `problem.options.basis` says only which functions lie near each other.
///
/// # Errors
/// As [`Method::fit`]. With a discount of 1 the policy is the one of K steps, K the options' horizon or the longest
/// trajectory's, and the fit's policy and values are those of the first step.
pub fn fit_with_basis(problem: &Problem<'_>, basis: &Basis, progress: Progress<'_>) -> Result<Fit, FitError> {
    problem.check()?;
    let options = problem.options;
    let mut trace = Trace::new(progress);
    let mut likelihood = likelihood::of(problem, basis)?;
    let optimum = match (options.penalty, options.posterior, options.penalty_strength) {
        (Penalty::L2, PosteriorKind::Laplace | PosteriorKind::Mcmc, None) if basis.len() <= MAX_STANDARD_ERRORS => {
            laplace::evidence(problem, &mut *likelihood, basis.len(), &mut trace)?
        }
        _ => optimum::find(problem, &mut *likelihood, vec![0.0; basis.len()], strength(options), &mut trace)?,
    };
    likelihood.value_and_gradient(&optimum.weights);
    let mut warnings = Vec::new();
    if options.posterior == PosteriorKind::None
        && matches!(options.planner, PlannerKind::PolicyIteration | PlannerKind::ExpectationMaximization)
    {
        warnings.push("em-tied without a posterior has no planner to choose: its policy is soft-optimal".to_owned());
    }
    if !likelihood.converged() {
        warnings.push("the soft values stopped before they converged".to_owned());
    }
    let n_actions = problem.mdp.n_actions();
    let mut fit = Fit {
        reward: basis.reward(&optimum.weights),
        policy: Policy::boltzmann(n_actions, likelihood.action_values(), 1.0).into_probabilities(),
        greedy_policy: Policy::greedy(n_actions, likelihood.action_values()).into_probabilities(),
        state_values: likelihood.state_values().to_vec(),
        standard_errors: None,
        posterior: None,
        hyperparameters: Vec::new(),
        weights: optimum.weights,
        trace: Vec::new(),
        stopped: optimum.stopped,
        iterations: trace.entries.len() as u32,
        warnings,
    };
    if options.penalty == Penalty::None {
        add_standard_errors(&mut *likelihood, &mut fit);
    } else if options.posterior != PosteriorKind::None {
        posterior::add(problem, basis, &mut *likelihood, optimum.strength, &mut fit, &mut trace)?;
    }
    fit.trace = trace.entries;
    Ok(fit)
}

/// Strength of the penalty of the optimum.
fn strength(options: &FitOptions) -> f64 {
    options.penalty_strength.unwrap_or(1.0)
}

fn add_standard_errors(likelihood: &mut dyn SoftLikelihood, fit: &mut Fit) {
    let n_basis = fit.weights.len();
    if n_basis > MAX_STANDARD_ERRORS {
        fit.warnings
            .push(format!("no standard errors: expected at most {MAX_STANDARD_ERRORS} basis functions, got {n_basis}"));
        return;
    }
    let found = standard_errors(likelihood, &fit.weights);
    let undetermined = found.iter().filter(|e| e.is_infinite()).count();
    if undetermined > 0 {
        fit.warnings.push(format!(
            "the demonstrations do not determine {undetermined} of {n_basis} weights: their standard errors are infinite"
        ));
    }
    fit.standard_errors = Some(found);
}
