//! `em-tied`: Hahn & Zoubir's (2015) Q with the policy tied to the reward.
//!
//! Their Q holds Σ_n log π(a_n|s_n) with a free policy. Tied, π_w(a|s) = exp(Q_w(s,a) − V_w(s)) is the soft-optimal policy of
//! θ = wᵀΦ (any temperature is part of w), and the objective Σ_l Σ_n log π_w(a_n|s_n) − penalty is maximised by a
//! quasi-Newton method with bounds. With free weights and no penalty this is the maximum-likelihood estimator of dynamic
//! discrete choice (Rust 1987), and standard errors come from the exact Hessian.
//!
//! The greedy policy takes the best actions under the soft Q itself, not those of a hard planner on the learned reward: the
//! two agree where the reward is large against the temperature, and where data are few the soft one follows them better.

mod finite;
mod likelihood;
mod standard_errors;

pub use finite::FiniteLikelihood;
pub(super) use likelihood::of as soft_likelihood;
pub use likelihood::{Likelihood, SoftLikelihood};
pub use standard_errors::{MAX_STANDARD_ERRORS, standard_errors};

use super::bounded::{self, Settings};
use super::{Basis, Fit, FitError, FitOptions, Method, Penalty, PlannerKind, Problem, Progress, Trace};
use crate::mdp::Policy;

/// The policy tied to the reward.
pub struct EmTied;

impl Method for EmTied {
    fn id(&self) -> &'static str {
        "em-tied"
    }

    fn description(&self) -> &'static str {
        "maximum likelihood of the soft-optimal policy, penalised; the most accurate"
    }

    fn log_prior(&self, options: &FitOptions, fit: &Fit) -> f64 {
        let strength = options.penalty_strength.unwrap_or(1.0);
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

/// Fits with any basis; `problem.options.basis` is not looked at.
///
/// # Errors
/// As [`Method::fit`]. With a discount of 1 the policy is the one of K steps, K the options' horizon or the longest
/// trajectory's, and the fit's policy and values are those of the first step.
pub fn fit_with_basis(problem: &Problem<'_>, basis: &Basis, progress: Progress<'_>) -> Result<Fit, FitError> {
    problem.check()?;
    let options = problem.options;
    let mut trace = Trace::new(progress);
    let mut likelihood = likelihood::of(problem, basis)?;
    let strength = options.penalty_strength.unwrap_or(1.0);
    let settings = Settings {
        lower: if options.penalty == Penalty::L1 { 0.0 } else { f64::NEG_INFINITY },
        tolerance: options.tolerance,
        max_iterations: options.max_iterations,
    };
    let minimum = bounded::minimise(
        &settings,
        vec![0.0; basis.len()],
        |weights| {
            let (log_likelihood, mut gradient) = likelihood.value_and_gradient(weights);
            let mut value = -log_likelihood;
            for (g, w) in gradient.iter_mut().zip(weights) {
                *g = -*g;
                match options.penalty {
                    Penalty::L1 => {
                        value += strength * w;
                        *g += strength;
                    }
                    Penalty::L2 => {
                        value += 0.5 * strength * w * w;
                        *g += strength * w;
                    }
                    Penalty::None => {}
                }
            }
            (value, gradient)
        },
        |value, decrease| trace.record(-value, decrease),
    )?;

    let weights = minimum.x;
    likelihood.value_and_gradient(&weights);
    let mut warnings = Vec::new();
    if matches!(options.planner, PlannerKind::PolicyIteration | PlannerKind::ExpectationMaximization) {
        warnings
            .push("em-tied has no planner to choose: its policy is the soft-optimal one by construction".to_owned());
    }
    let mut errors = None;
    if options.penalty == Penalty::None {
        if basis.len() <= MAX_STANDARD_ERRORS {
            let found = standard_errors(&mut *likelihood, &weights);
            let undetermined = found.iter().filter(|e| e.is_infinite()).count();
            if undetermined > 0 {
                warnings.push(format!(
                    "the demonstrations do not determine {undetermined} of {} weights: their standard errors are infinite",
                    basis.len()
                ));
            }
            errors = Some(found);
        } else {
            warnings.push(format!(
                "no standard errors: expected at most {MAX_STANDARD_ERRORS} basis functions, got {}",
                basis.len()
            ));
        }
    }
    if !likelihood.converged() {
        warnings.push("the soft values stopped before they converged".to_owned());
    }
    let n_actions = problem.mdp.n_actions();
    let iterations = trace.entries.len() as u32;
    Ok(Fit {
        reward: basis.reward(&weights),
        policy: Policy::boltzmann(n_actions, likelihood.action_values(), 1.0).into_probabilities(),
        greedy_policy: Policy::greedy(n_actions, likelihood.action_values()).into_probabilities(),
        state_values: likelihood.state_values().to_vec(),
        standard_errors: errors,
        posterior: None,
        hyperparameters: Vec::new(),
        weights,
        trace: trace.entries,
        stopped: minimum.stopped,
        iterations,
        warnings,
    })
}
