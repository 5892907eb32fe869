//! Demonstrations whose actions were not seen: expectation maximisation around any method that works on counts.
//!
//! With a known model the actions are latent variables (Dempster, Laird & Rubin 1977). E-step: an expert of policy π that went
//! from s to s' took a with probability p(a|s,s') ∝ π(a|s) P(s'|s,a), which turns counts of transitions into expected counts
//! N(s,a). M-step: the method itself on these and on the pairs that were seen. The objective is the log-likelihood of all that
//! was seen, Σ log π(a|s) + Σ log Σ_a π(a|s) P(s'|s,a), with the method's own penalty: a method that maximises the (penalised)
//! likelihood of actions never lowers it. Of any other the best iterate is returned.
//!
//! Deliberately absent: methods that need whole trajectories, and a discount of 1, where the policy differs from step to step.

use super::{Fit, FitError, FitOptions, Method, PosteriorKind, Problem, Progress, Stopped, Trace};
use crate::mdp::{Policy, TabularMdp};
use crate::statistics::Statistics;
use std::collections::HashMap;
use std::ops::ControlFlow;

/// A fit that is not improved on for so many iterations has stalled: only a method that is no likelihood method does that.
const PATIENCE: u32 = 10;
/// A policy's probabilities count as at least this: nothing that the model allows is impossible.
const FLOOR: f64 = 1e-300;

/// The transitions of demonstrations whose actions were not seen, with what may have made them.
#[derive(Debug)]
pub struct LatentActions<'a> {
    statistics: &'a Statistics,
    n_actions: usize,
    horizon: Option<u32>,
    /// Where the actions of each distinct transition begin, and where the last one's end.
    offsets: Vec<usize>,
    /// State-action pairs that lead there, and P(s'|s,a).
    pairs: Vec<(u32, f64)>,
    /// Per step: transitions and how often they were seen.
    steps: Vec<Vec<(usize, f64)>>,
}

impl<'a> LatentActions<'a> {
    /// Looks at the first `horizon` steps (all where `None`).
    ///
    /// # Errors
    /// Transitions that no action of the model makes.
    pub fn new(mdp: &TabularMdp, statistics: &'a Statistics, horizon: Option<u32>) -> Result<Self, FitError> {
        let mut known: HashMap<(u32, u32), usize> = HashMap::new();
        let (mut offsets, mut pairs, mut steps) = (vec![0], Vec::new(), Vec::new());
        let mut impossible: Option<(f64, usize, u32, u32)> = None;
        for (k, seen) in statistics.latent().iter(horizon) {
            let index = *known.entry((seen.state, seen.next_state)).or_insert_with(|| {
                for action in 0..mdp.n_actions() {
                    let pair = mdp.pair(seen.state as usize, action);
                    let (next, probabilities) = mdp.row(pair);
                    if let Ok(entry) = next.binary_search(&seen.next_state)
                        && probabilities[entry] > 0.0
                    {
                        pairs.push((pair as u32, probabilities[entry]));
                    }
                }
                offsets.push(pairs.len());
                offsets.len() - 2
            });
            if offsets[index] == offsets[index + 1] {
                impossible.get_or_insert((0.0, k, seen.state, seen.next_state)).0 += seen.count;
            }
            if steps.len() <= k {
                steps.resize_with(k + 1, Vec::new);
            }
            steps[k].push((index, seen.count));
        }
        if let Some((count, step, state, next_state)) = impossible {
            return Err(FitError::ImpossibleTransitions { count: count as u64, step, state, next_state });
        }
        Ok(Self { statistics, n_actions: mdp.n_actions(), horizon, offsets, pairs, steps })
    }

    /// The E-step: the statistics with the actions that an expert of policy π(a|s), shape (`n_states * n_actions`,), is expected
    /// to have taken.
    pub fn complete(&self, policy: &[f64]) -> Statistics {
        let infer = |step: &Vec<(usize, f64)>| {
            let mut counts = Vec::new();
            for &(index, count) in step {
                let actions = &self.pairs[self.offsets[index]..self.offsets[index + 1]];
                let likelihood = self.likelihood(index, policy);
                counts.extend(
                    actions.iter().map(|&(pair, p)| (pair, count * policy[pair as usize].max(FLOOR) * p / likelihood)),
                );
            }
            counts
        };
        self.statistics.completed(self.steps.iter().map(infer).collect())
    }

    /// Σ log π(a|s) over the pairs and Σ log Σ_a π(a|s) P(s'|s,a) over the transitions that were seen.
    pub fn log_likelihood(&self, policy: &[f64]) -> f64 {
        let counts = self.statistics.counts(self.horizon);
        let seen = counts.iter().zip(policy).filter(|(n, _)| **n > 0.0).map(|(n, p)| n * p.max(FLOOR).ln());
        let inferred = self.steps.iter().flatten().map(|&(index, count)| count * self.likelihood(index, policy).ln());
        seen.sum::<f64>() + inferred.sum::<f64>()
    }

    /// Σ_a π(a|s) P(s'|s,a), above 0.
    fn likelihood(&self, index: usize, policy: &[f64]) -> f64 {
        let actions = &self.pairs[self.offsets[index]..self.offsets[index + 1]];
        actions.iter().map(|&(pair, p)| policy[pair as usize].max(FLOOR) * p).sum()
    }

    fn n_states(&self) -> usize {
        self.statistics.n_states()
    }
}

/// Fits where the statistics hold transitions without actions.
pub(super) fn fit(method: &dyn Method, problem: &Problem<'_>, progress: Progress<'_>) -> Result<Fit, FitError> {
    problem.check_options()?;
    let options = problem.options;
    if method.needs_demonstrations() {
        return Err(FitError::NeedsActions { method: method.id() });
    }
    if options.discount == 1.0 {
        let message = "expected a number below 1 for demonstrations without actions, got 1".to_owned();
        return Err(FitError::InvalidOption { field: "discount", message });
    }
    let latent = LatentActions::new(problem.mdp, problem.statistics, options.horizon)?;
    // the optimum alone while the actions are open, and precise enough not to hide what an iteration gains
    let inner = FitOptions { posterior: PosteriorKind::None, tolerance: 0.1 * options.tolerance, ..options.clone() };
    let mut trace = Trace::new(progress);
    let mut policy = Policy::uniform(latent.n_states(), latent.n_actions).into_probabilities();
    let mut last = f64::NEG_INFINITY;
    let mut best: Option<(f64, u32, Fit)> = None;
    let mut stopped = Stopped::MaxIterations;
    for iteration in 1..=options.max_iterations {
        let found = m_step(method, problem, &inner, &latent.complete(&policy))?;
        let objective = latent.log_likelihood(&found.policy) + method.log_prior(&inner, &found);
        let change = if last.is_finite() { objective - last } else { objective.abs() };
        trace.record(objective, change)?;
        last = objective;
        policy.clone_from(&found.policy);
        if best.as_ref().is_none_or(|best| objective > best.0) {
            best = Some((objective, iteration, found));
        }
        if iteration > 1 && change.abs() <= options.tolerance {
            stopped = Stopped::Converged;
            break;
        }
        if best.as_ref().is_some_and(|best| iteration - best.1 >= PATIENCE) {
            stopped = Stopped::Stalled;
            break;
        }
    }
    let Some((_, _, mut fit)) = best else { unreachable!("at least one iteration") };
    if inner.posterior != options.posterior {
        let completed = latent.complete(&fit.policy);
        fit = m_step(method, problem, options, &completed)?;
    }
    let (unseen, all) =
        (problem.statistics.latent().total(options.horizon), problem.statistics.n_steps(options.horizon));
    fit.warnings
        .push(format!("the actions of {unseen} of {all} steps were not seen: they are inferred from the model"));
    if fit.standard_errors.is_some() || fit.posterior.is_some() {
        fit.warnings.push("uncertainty takes the inferred actions for seen ones: it is understated".to_owned());
    }
    fit.iterations = trace.entries.len() as u32;
    fit.trace = trace.entries;
    fit.stopped = stopped;
    Ok(fit)
}

/// The method on completed counts; only the iterations around it are told to the caller.
fn m_step(
    method: &dyn Method,
    problem: &Problem<'_>,
    options: &FitOptions,
    completed: &Statistics,
) -> Result<Fit, FitError> {
    let problem = Problem { options, statistics: completed, demonstrations: None, ..*problem };
    method.fit(&problem, &mut |_| ControlFlow::Continue(()))
}
