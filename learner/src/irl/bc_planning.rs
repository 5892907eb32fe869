//! `bc-planning`: behaviour cloning, and planning to the demonstrated states from everywhere else.
//!
//! Where a state was demonstrated the policy is the clone of `bc`. Elsewhere it takes the way that reaches a demonstrated
//! state soonest: the actions that maximise E[γ^T], T the number of steps until the first demonstrated state. It needs the
//! model and learns no reward: what it cannot know is which of the demonstrated states the expert would have made for.

use super::{Fit, FitError, Method, PlannerKind, Problem, Progress, Stopped, Trace};
use crate::mdp::{PlanOptions, Policy, TabularMdp, plan};

/// Cloning where there is something to clone, the soonest way there from elsewhere.
pub(super) struct BcPlanning;

impl Method for BcPlanning {
    fn id(&self) -> &'static str {
        "bc-planning"
    }

    fn description(&self) -> &'static str {
        "behaviour cloning, and planning to the demonstrated states where there is nothing to clone"
    }

    fn fit(&self, problem: &Problem<'_>, progress: Progress<'_>) -> Result<Fit, FitError> {
        problem.check()?;
        let mut trace = Trace::new(progress);
        let options = problem.options;
        let (n_states, n_actions) = (problem.mdp.n_states(), problem.mdp.n_actions());
        let mut counts = problem.statistics.counts(options.horizon);
        let arrival = discounted_arrival(problem, &counts)?;
        let way = Policy::greedy(n_actions, &arrival);
        let (mut unvisited, mut lost) = (0, 0);
        let mut log_likelihood = 0.0;
        let mut policy = vec![0.0; counts.len()];
        for state in 0..n_states {
            let row = state * n_actions..(state + 1) * n_actions;
            let demonstrated = counts[row.clone()].iter().any(|n| *n > 0.0);
            if !demonstrated {
                unvisited += 1;
                lost += usize::from(arrival[row.clone()].iter().all(|v| *v <= 0.0));
                // the way counts as one demonstrated step
                counts[row.clone()].copy_from_slice(way.row(state));
            }
            let n = &counts[row.clone()];
            let total = n.iter().sum::<f64>() + options.smoothing * n_actions as f64;
            for (p, n) in policy[row.clone()].iter_mut().zip(n) {
                *p = (n + options.smoothing) / total;
                if demonstrated && *n > 0.0 {
                    log_likelihood += n * p.ln();
                }
            }
        }
        trace.record(log_likelihood, 0.0)?;
        let mut warnings =
            vec!["behaviour cloning learns no reward: weights, reward and values are empty or zero".to_owned()];
        if unvisited > 0 {
            warnings.push(format!(
                "{unvisited} of {n_states} states were never demonstrated: the policy goes to the demonstrated ones from there"
            ));
        }
        if lost > 0 {
            warnings
                .push(format!("from {lost} of {n_states} states no demonstrated one can be reached: uniform there"));
        }
        if matches!(options.planner, PlannerKind::SoftValueIteration | PlannerKind::ExpectationMaximization) {
            warnings.push("bc-planning has no planner to choose: the soonest way is planned exactly".to_owned());
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

/// Largest E[γ^T] after each action, T the steps until a state with `counts`, shape (`n_states * n_actions`,); 1 in such states.
///
/// Where γ is 1 every way that arrives is as good, so the soonest is looked for with 1 − 1/(K + 1), a mean horizon of K + 1
/// steps; where γ is 0 no way counts, and one half stands for it.
pub(super) fn discounted_arrival(problem: &Problem<'_>, counts: &[f64]) -> Result<Vec<f64>, FitError> {
    let mdp = problem.mdp;
    let n_actions = mdp.n_actions();
    let discount = match problem.options.discount {
        d if d >= 1.0 => 1.0 - 1.0 / (1.0 + f64::from(problem.horizon())),
        d if d <= 0.0 => 0.5,
        d => d,
    };
    let visited: Vec<bool> = counts.chunks_exact(n_actions).map(|n| n.iter().any(|n| *n > 0.0)).collect();
    let ends = absorbing(mdp, &visited);
    let reward: Vec<f64> =
        (0..mdp.n_pairs()).map(|pair| if visited[pair / n_actions] { 1.0 - discount } else { 0.0 }).collect();
    let options = PlanOptions { discount, ..PlanOptions::default() };
    Ok(plan(PlannerKind::PolicyIteration, &ends, &reward, &options)?.action_values)
}

/// The same process, with the chosen states left by no action.
fn absorbing(mdp: &TabularMdp, chosen: &[bool]) -> TabularMdp {
    let (mut offsets, mut next, mut probabilities) = (vec![0], Vec::new(), Vec::new());
    for pair in 0..mdp.n_pairs() {
        let state = pair / mdp.n_actions();
        if chosen[state] {
            next.push(state as u32);
            probabilities.push(1.0);
        } else {
            let (states, p) = mdp.row(pair);
            next.extend_from_slice(states);
            probabilities.extend_from_slice(p);
        }
        offsets.push(next.len());
    }
    let initial = Some(mdp.initial_distribution().to_vec());
    TabularMdp::new(mdp.n_states(), mdp.n_actions(), offsets, next, probabilities, initial)
        .expect("rows of a checked model or single states")
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::irl::{self, FitOptions};
    use crate::statistics::Statistics;
    use crate::trajectory::Trajectory;
    use std::ops::ControlFlow;

    /// Five states in a row and an island; action 0 goes left, action 1 right.
    #[test]
    fn clones_where_it_can_and_goes_there_from_elsewhere() {
        let next = vec![0, 1, 0, 2, 1, 3, 2, 4, 3, 4, 5, 5];
        let mdp = TabularMdp::new(6, 2, (0..=12).collect(), next, vec![1.0; 12], None).expect("a model");
        let mut builder = Statistics::builder(6, 2, None);
        builder.add(&Trajectory::new(vec![1, 1], vec![0, 0], None, 6, 2).expect("a trajectory")).expect("counted");
        let statistics = builder.finish().expect("counts");
        for discount in [0.0, 0.5, 0.9999, 1.0] {
            let options = FitOptions { discount, ..FitOptions::default() };
            let problem =
                Problem { mdp: &mdp, options: &options, statistics: &statistics, demonstrations: None, features: None };
            let found = irl::fit(&BcPlanning, &problem, &mut |_| ControlFlow::Continue(())).expect("a fit");
            // from the left to the right, cloned, from the right to the left; from the island nowhere
            let want = [0.0, 1.0, 1.0, 0.0, 1.0, 0.0, 1.0, 0.0, 1.0, 0.0, 0.5, 0.5];
            assert_eq!(found.greedy_policy, want, "{discount}");
            assert!(found.warnings.iter().any(|w| w.contains("from 1 of 6 states")), "{:?}", found.warnings);
            let smooth = FitOptions { smoothing: 1.0, ..options.clone() };
            let problem = Problem { options: &smooth, ..problem };
            let found = irl::fit(&BcPlanning, &problem, &mut |_| ControlFlow::Continue(())).expect("a fit");
            assert_eq!(found.policy[2..6], [0.75, 0.25, 2.0 / 3.0, 1.0 / 3.0]);
        }
    }
}
