//! Apprenticeship learning, Abbeel & Ng (2004): rewards under which the expert does better than every policy found so far.
//!
//! Both methods look for the point μ̄ in the hull of the policies' feature expectations that is nearest to the demonstrated ones
//! μ_E, and take w = μ_E − μ̄ as the next reward; they differ in how they get there. Every w of the way is an answer, and the
//! paper leaves to the user which to take. Here it is the one whose greedy policy takes the largest share of the demonstrated
//! *actions* (of equals, the one whose Boltzmann policy gives them the largest likelihood): no truth is needed for that, and the
//! last one is seldom it.

mod expectations;
mod max_margin;
mod projection;

pub(super) use max_margin::MaxMargin;
pub(super) use projection::Projection;

use super::temperature::most_likely_boltzmann;
use super::{Fit, FitError, Hyperparameter, Problem, Progress, Stopped, Trace};
use crate::eval::step_agreement;
use crate::mdp::{Policy, plan};
use expectations::Expectations;

/// Iterates without a better answer after which the search ends.
const PATIENCE: u32 = 30;
/// Distance to the hull, relative to |μ_E|, that counts as none.
const INSIDE: f64 = 1e-12;

/// The best reward so far.
struct Answer {
    /// Share of the demonstrated steps whose action its greedy policy takes.
    agreement: f64,
    likelihood: f64,
    weights: Vec<f64>,
    iteration: u32,
}

/// Learns with `approach`, which moves the mean μ̄ when a new policy's expectations are found: μ_E, μ̄, the new ones.
fn learn(
    problem: &Problem<'_>,
    progress: Progress<'_>,
    mut approach: impl FnMut(&[f64], &mut Vec<f64>, Vec<f64>),
) -> Result<Fit, FitError> {
    problem.check()?;
    let mut trace = Trace::new(progress);
    let (mdp, options) = (problem.mdp, problem.options);
    let n_actions = mdp.n_actions();
    let basis = problem.basis();
    let expectations = Expectations::new(problem, &basis);
    let counts = problem.statistics.counts(options.horizon);
    let demonstrated = expectations.demonstrated();
    let mut mean = expectations.of(&Policy::uniform(mdp.n_states(), n_actions));
    let first = mean.clone();
    approach(demonstrated, &mut mean, first);
    let mut best = Answer {
        agreement: f64::NEG_INFINITY,
        likelihood: f64::NEG_INFINITY,
        weights: vec![0.0; basis.len()],
        iteration: 0,
    };
    let mut stopped = Stopped::MaxIterations;
    for iteration in 1..=options.max_iterations {
        let margin = distance(demonstrated, &mean);
        if margin <= INSIDE * distance(demonstrated, &vec![0.0; basis.len()]) {
            // nothing distinguishes the expert any more; without a first answer, no reward is the answer
            trace.record(-margin, 0.0)?;
            stopped = Stopped::Converged;
            break;
        }
        let weights: Vec<f64> = demonstrated.iter().zip(&mean).map(|(d, m)| (d - m) / margin).collect();
        let planned = plan(options.planner, mdp, &basis.reward(&weights), &problem.plan_options())?;
        let greedy = planned.greedy_policy();
        let found = expectations.of(&greedy);
        // how far the new policy reaches beyond the mean in the direction of the expert: no more distance can be won
        let reach: f64 = weights.iter().zip(&found).zip(&mean).map(|((w, f), m)| w * (f - m)).sum();
        let agreement = step_agreement(greedy.probabilities(), &counts);
        if agreement >= best.agreement {
            let likelihood = log_likelihood(n_actions, &planned.action_values, &counts);
            if agreement > best.agreement || likelihood > best.likelihood {
                best = Answer { agreement, likelihood, weights, iteration };
            }
        }
        approach(demonstrated, &mut mean, found);
        let after = distance(demonstrated, &mean);
        trace.record(-after, margin - after)?;
        if reach <= options.tolerance * margin || margin - after <= 1e-3 * options.tolerance * margin {
            stopped = Stopped::Converged;
            break;
        }
        if iteration >= best.iteration + PATIENCE {
            stopped = Stopped::Stalled;
            break;
        }
    }
    let mut fit = Fit::planned(problem, &basis, best.weights, trace, stopped, Vec::new())?;
    fit.hyperparameters.push(Hyperparameter { name: "best_iteration".to_owned(), value: f64::from(best.iteration) });
    Ok(fit)
}

fn distance(a: &[f64], b: &[f64]) -> f64 {
    a.iter().zip(b).map(|(a, b)| (a - b).powi(2)).sum::<f64>().sqrt()
}

/// Of the demonstrated actions under the Boltzmann policy that explains them best.
fn log_likelihood(n_actions: usize, action_values: &[f64], counts: &[f64]) -> f64 {
    let (policy, _) = most_likely_boltzmann(n_actions, action_values, counts);
    let terms = policy.probabilities().iter().zip(counts).filter(|(_, n)| **n > 0.0);
    terms.map(|(p, n)| n * p.max(f64::MIN_POSITIVE).ln()).sum()
}

#[cfg(test)]
mod tests;
