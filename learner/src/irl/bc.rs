//! Behaviour cloning: the demonstrated frequencies. The floor that every other method must beat.

use super::{Fit, FitError, FitOptions, Method, Problem, Progress, Stopped, Trace};
use crate::mdp::Policy;

/// π(a|s) = (N(s,a) + smoothing) / (N(s) + `n_actions` · smoothing); uniform where a state was never visited.
pub(super) struct Bc;

impl Method for Bc {
    fn id(&self) -> &'static str {
        "bc"
    }

    fn description(&self) -> &'static str {
        "behaviour cloning: the demonstrated action frequencies, no reward"
    }

    fn log_prior(&self, options: &FitOptions, fit: &Fit) -> f64 {
        if options.smoothing == 0.0 { 0.0 } else { options.smoothing * fit.policy.iter().map(|p| p.ln()).sum::<f64>() }
    }

    fn fit(&self, problem: &Problem<'_>, progress: Progress<'_>) -> Result<Fit, FitError> {
        problem.check()?;
        let mut trace = Trace::new(progress);
        let (n_states, n_actions) = (problem.mdp.n_states(), problem.mdp.n_actions());
        let smoothing = problem.options.smoothing;
        let counts = problem.statistics.counts(problem.options.horizon);
        let mut policy = vec![0.0; counts.len()];
        let mut log_likelihood = 0.0;
        let mut unvisited = 0;
        for (pi, n) in policy.chunks_exact_mut(n_actions).zip(counts.chunks_exact(n_actions)) {
            let visits: f64 = n.iter().sum();
            unvisited += usize::from(visits == 0.0);
            let total = visits + smoothing * n_actions as f64;
            for (p, n) in pi.iter_mut().zip(n) {
                *p = if total > 0.0 { (n + smoothing) / total } else { 1.0 / n_actions as f64 };
                if *n > 0.0 {
                    log_likelihood += n * p.ln();
                }
            }
        }
        trace.record(log_likelihood, 0.0)?;
        let mut warnings =
            vec!["behaviour cloning learns no reward: weights, reward and values are empty or zero".to_owned()];
        if unvisited > 0 {
            warnings
                .push(format!("{unvisited} of {n_states} states were never demonstrated: the policy is uniform there"));
        }
        Ok(Fit {
            weights: Vec::new(),
            reward: vec![0.0; n_states * n_actions],
            greedy_policy: Policy::greedy(n_actions, &policy).into_probabilities(),
            policy,
            state_values: vec![0.0; n_states],
            standard_errors: None,
            posterior: None,
            hyperparameters: Vec::new(),
            trace: trace.entries,
            stopped: Stopped::ClosedForm,
            iterations: 1,
            warnings,
        })
    }
}
