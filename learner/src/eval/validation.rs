//! Cross-validation over trajectories: how likely is what a fit has not seen?
//!
//! Trajectory i is in fold i mod N, whatever the seed and the machine; each fold is scored by a fit on all the others. The folds
//! run in parallel and are put together in order. Whole trajectories are held out, since the steps of one depend on each other.

use super::{
    HeldOut, Interval, PROBABILITY_FLOOR,
    calibration::{Calibration, CalibrationBuilder},
    ratio_interval,
};
use crate::irl::{self, FitError, FitOptions, Method, Problem};
use crate::mdp::{Features, TabularMdp};
use crate::statistics::Statistics;
use crate::trajectory::{Demonstrations, Trajectory};
use rayon::prelude::*;
use serde::{Deserialize, Serialize};
use std::ops::ControlFlow;

/// What cross-validation found.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct Validation {
    /// Number of folds N.
    pub folds: u32,
    /// Trajectories in all.
    pub trajectories: u64,
    /// Log-likelihood of the steps that the fits did not see.
    pub held_out: HeldOut,
    /// Share of these steps whose action the greedy policy takes, with its interval over trajectories.
    pub agreement: Interval,
    /// Whether the predicted probabilities of actions come true on these steps.
    pub calibration: Calibration,
}

/// Why there is no cross-validation.
#[derive(Debug, Clone, PartialEq, thiserror::Error)]
pub enum ValidationError {
    /// A fold would be empty.
    #[error("expected 2 to {trajectories} folds, as many as there are trajectories at most, got {folds}")]
    Folds {
        /// What came.
        folds: u32,
        /// Trajectories with steps and actions.
        trajectories: usize,
    },
    /// A fit on part of the data failed.
    #[error("fold {fold}: {error}")]
    Fit {
        /// From 0 on.
        fold: u32,
        /// What the method says.
        error: FitError,
    },
    /// The data belong to another process.
    #[error("{0}")]
    Data(String),
}

/// Fold of the trajectory at `index`.
pub fn fold_of(index: usize, folds: u32) -> u32 {
    (index % folds.max(1) as usize) as u32
}

/// Cross-validates a method.
///
/// # Errors
/// Fewer than two folds or more than there are trajectories; a method that refuses; data of another process.
pub fn cross_validate(
    method: &dyn Method,
    (mdp, features): (&TabularMdp, Option<&Features>),
    options: &FitOptions,
    trajectories: &[Trajectory],
    folds: u32,
) -> Result<Validation, ValidationError> {
    if folds < 2 || folds as usize > trajectories.len() {
        return Err(ValidationError::Folds { folds, trajectories: trajectories.len() });
    }
    let parts = (0..folds)
        .into_par_iter()
        .map(|fold| one(method, (mdp, features), options, trajectories, (fold, folds)))
        .collect::<Vec<_>>();
    let mut calibration = CalibrationBuilder::default();
    let mut scores = Vec::new();
    for part in parts {
        let part = part?;
        calibration.merge(&part.calibration);
        scores.extend(part.scores);
    }
    // In the order of the trajectories, so that sums do not depend on how they were put into folds.
    scores.sort_by_key(|score| score.index);
    let interval = |of: fn(&Score) -> f64| {
        ratio_interval(&scores.iter().map(|score| (of(score), score.steps as f64)).collect::<Vec<_>>())
    };
    let empty = || ValidationError::Data("expected at least one step, got none".to_owned());
    Ok(Validation {
        folds,
        trajectories: trajectories.len() as u64,
        held_out: HeldOut {
            log_likelihood: interval(|score| score.log_likelihood).ok_or_else(empty)?,
            impossible_steps: scores.iter().map(|score| score.impossible).sum(),
            steps: scores.iter().map(|score| score.steps).sum(),
        },
        agreement: interval(|score| score.agreed).ok_or_else(empty)?,
        calibration: calibration.finish().ok_or_else(empty)?,
    })
}

/// What one trajectory scores under the fit that did not see it.
struct Score {
    index: usize,
    steps: u64,
    log_likelihood: f64,
    agreed: f64,
    impossible: u64,
}

struct Part {
    scores: Vec<Score>,
    calibration: CalibrationBuilder,
}

fn one(
    method: &dyn Method,
    (mdp, features): (&TabularMdp, Option<&Features>),
    options: &FitOptions,
    trajectories: &[Trajectory],
    (fold, folds): (u32, u32),
) -> Result<Part, ValidationError> {
    let (n_actions, horizon) = (mdp.n_actions(), options.horizon.map_or(usize::MAX, |k| k as usize));
    let of_fold = |held_out: bool| {
        let all = trajectories.iter().enumerate();
        all.filter(move |(index, _)| (fold_of(*index, folds) == fold) == held_out)
    };
    let data = |error: &dyn std::fmt::Display| ValidationError::Data(error.to_string());
    let mut builder = Statistics::builder(mdp.n_states(), n_actions, options.horizon);
    builder.extend(of_fold(false).map(|(_, trajectory)| trajectory)).map_err(|e| data(&e))?;
    let statistics = builder.finish().map_err(|e| data(&e))?;
    let demonstrations =
        Demonstrations::new(of_fold(false).map(|(_, trajectory)| trajectory.truncated(horizon)).collect());
    let problem = Problem { mdp, options, statistics: &statistics, demonstrations: Some(&demonstrations), features };
    let fit = irl::fit(method, &problem, &mut |_| ControlFlow::Continue(()))
        .map_err(|error| ValidationError::Fit { fold, error })?;
    let mut part = Part { scores: Vec::new(), calibration: CalibrationBuilder::default() };
    for (index, trajectory) in of_fold(true) {
        let mut score = Score { index, steps: 0, log_likelihood: 0.0, agreed: 0.0, impossible: 0 };
        let steps = trajectory.states().iter().zip(trajectory.actions()).take(horizon);
        for (&state, &action) in steps {
            let row = state as usize * n_actions..(state as usize + 1) * n_actions;
            if row.end > fit.policy.len() || action as usize >= n_actions {
                return Err(data(&format!("state {state} or action {action} lies outside the model")));
            }
            let p = fit.policy[row.clone()][action as usize];
            score.steps += 1;
            score.impossible += u64::from(p < PROBABILITY_FLOOR);
            score.log_likelihood += p.max(PROBABILITY_FLOOR).ln();
            score.agreed += fit.greedy_policy[row.clone()][action as usize];
            part.calibration.add(&fit.policy[row], action as usize);
        }
        part.scores.push(score);
    }
    Ok(part)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn folds_are_by_index_and_even() {
        let sizes = |n: usize, folds| {
            let mut sizes = vec![0; folds as usize];
            (0..n).for_each(|i| sizes[fold_of(i, folds) as usize] += 1);
            sizes
        };
        assert_eq!(sizes(10, 3), [4, 3, 3]);
        assert_eq!(sizes(4, 4), [1; 4]);
    }

    /// One state, two actions; `bc` predicts the frequencies of the other folds.
    fn trajectories(actions: &[u32]) -> Vec<Trajectory> {
        actions.iter().map(|&a| Trajectory::new(vec![0], vec![a], None, 1, 2).expect("a trajectory")).collect()
    }

    #[test]
    fn leaving_one_out_of_a_frequency_is_known() {
        let mdp = TabularMdp::new(1, 2, vec![0, 1, 2], vec![0, 0], vec![1.0; 2], None).expect("a model");
        let options = FitOptions { smoothing: 1.0, ..FitOptions::default() };
        let bc = irl::method("bc").expect("a method");
        let data = trajectories(&[0, 0, 0, 1]);
        let validation = cross_validate(bc, (&mdp, None), &options, &data, 4).expect("a validation");
        // each 0 is predicted from two 0 and a 1, the 1 from three 0; a pseudo-count of one on each
        let expected = (3.0 * (3.0_f64 / 5.0).ln() + (1.0_f64 / 5.0).ln()) / 4.0;
        assert!((validation.held_out.log_likelihood.mean - expected).abs() < 1e-12);
        assert!((validation.agreement.mean - 0.75).abs() < 1e-12);
        assert_eq!((validation.held_out.steps, validation.held_out.impossible_steps), (4, 0));
    }

    #[test]
    fn impossible_numbers_of_folds_are_refused() {
        let mdp = TabularMdp::new(1, 2, vec![0, 1, 2], vec![0, 0], vec![1.0; 2], None).expect("a model");
        let bc = irl::method("bc").expect("a method");
        for folds in [0, 1, 5] {
            let error = cross_validate(bc, (&mdp, None), &FitOptions::default(), &trajectories(&[0, 1, 0, 1]), folds)
                .expect_err("refused");
            assert_eq!(error, ValidationError::Folds { folds, trajectories: 4 });
        }
    }
}
