//! The penalised maximum of the likelihood.

use super::SoftLikelihood;
use crate::irl::bounded::{self, Settings};
use crate::irl::{FitError, Penalty, Problem, Stopped, Trace};

/// Where the search ended.
pub(super) struct Optimum {
    pub weights: Vec<f64>,
    pub stopped: Stopped,
    /// Strength of the penalty.
    pub strength: f64,
}

/// Maximises ℓ(w) − penalty from `start` on, shape (`n_basis`,).
pub(super) fn find(
    problem: &Problem<'_>,
    likelihood: &mut dyn SoftLikelihood,
    start: Vec<f64>,
    strength: f64,
    trace: &mut Trace<'_>,
) -> Result<Optimum, FitError> {
    let options = problem.options;
    let settings = Settings {
        lower: if options.penalty == Penalty::L1 { 0.0 } else { f64::NEG_INFINITY },
        tolerance: options.tolerance,
        max_iterations: options.max_iterations,
    };
    let minimum = bounded::minimise(
        &settings,
        start,
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
    Ok(Optimum { weights: minimum.x, stopped: minimum.stopped, strength })
}
