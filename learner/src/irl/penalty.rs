//! Penalised maximisation over the weights: what the duals and likelihoods here have in common.

use super::bounded::{self, Settings};
use super::{Basis, FitError, FitOptions, Penalty, Problem, Stopped, Trace};
use crate::mdp::max_abs;

/// Largest |R(s,a)| that is tried. A dual without a maximum (visits that no policy reaches) grows for ever; beyond this all
/// policies are the same to the last digit.
const LARGEST_REWARD: f64 = 1e6;

/// Where a penalised maximisation ended.
pub(super) struct Maximum {
    pub(super) weights: Vec<f64>,
    pub(super) stopped: Stopped,
    pub(super) warnings: Vec<String>,
}

/// Maximises an objective less the penalty, from w = 0 on; `value_and_gradient` is given the weights.
pub(super) fn maximise(
    problem: &Problem<'_>,
    penalised: &Penalised,
    basis: &Basis,
    trace: &mut Trace<'_>,
    mut value_and_gradient: impl FnMut(&[f64]) -> (f64, Vec<f64>),
) -> Result<Maximum, FitError> {
    let settings = Settings {
        lower: penalised.lower(),
        tolerance: problem.options.tolerance,
        max_iterations: problem.options.max_iterations,
    };
    let mut limited = false;
    let minimum = bounded::minimise(
        &settings,
        vec![0.0; basis.len()],
        |weights| {
            let beyond = max_abs(&basis.reward(weights)) > LARGEST_REWARD;
            limited |= beyond;
            if beyond {
                return (f64::INFINITY, vec![0.0; weights.len()]);
            }
            let (value, gradient) = value_and_gradient(weights);
            penalised.negate(value, gradient, weights)
        },
        |value, decrease| trace.record(-value, decrease),
    )?;
    let largest = max_abs(&basis.reward(&minimum.x));
    let mut warnings = Vec::new();
    let mut stopped = minimum.stopped;
    if limited && largest > 0.1 * LARGEST_REWARD {
        stopped = Stopped::Stalled;
        warnings.push(format!(
            "the reward grew to {largest:.1e} and would grow on: no finite one is best, a penalty would make one"
        ));
    }
    Ok(Maximum { weights: minimum.x, stopped, warnings })
}

/// What is added to a function of the weights that is minimised.
#[derive(Debug, Clone, Copy)]
pub(super) struct Penalised {
    penalty: Penalty,
    strength: f64,
    /// Quadratic penalty beside L1.
    ridge: f64,
}

impl Penalised {
    /// The penalty of the options, of the strength `own` where they name none.
    pub(super) fn new(options: &FitOptions, own: f64) -> Self {
        let strength = if options.penalty == Penalty::None { 0.0 } else { options.penalty_strength.unwrap_or(own) };
        Self { penalty: options.penalty, strength, ridge: 0.0 }
    }

    /// Adds ridge / 2 · |w|² to an L1 penalty.
    pub(super) fn with_ridge(self, ridge: f64) -> Self {
        Self { ridge, ..self }
    }

    /// Strength in force; 0 for none.
    pub(super) fn strength(&self) -> f64 {
        self.strength
    }

    /// Lower bound of every weight: L1 goes with weights that are not negative.
    pub(super) fn lower(&self) -> f64 {
        if self.penalty == Penalty::L1 { 0.0 } else { f64::NEG_INFINITY }
    }

    /// What the penalty subtracts, negated: the logarithm of the prior that it stands for, up to a constant.
    pub(super) fn log_prior(&self, weights: &[f64]) -> f64 {
        -self.negate(0.0, vec![0.0; weights.len()], weights).0
    }

    /// Turns an objective to be maximised, and its gradient, into the penalised function to be minimised.
    pub(super) fn negate(&self, objective: f64, mut gradient: Vec<f64>, weights: &[f64]) -> (f64, Vec<f64>) {
        let mut value = -objective;
        for (g, w) in gradient.iter_mut().zip(weights) {
            *g = -*g;
            match self.penalty {
                Penalty::L1 => {
                    value += self.strength * w + 0.5 * self.ridge * w * w;
                    *g += self.strength + self.ridge * w;
                }
                Penalty::L2 => {
                    value += 0.5 * self.strength * w * w;
                    *g += self.strength * w;
                }
                Penalty::None => {}
            }
        }
        (value, gradient)
    }
}
