//! Gaussian approximation of the posterior around the optimum, and the strength of a Gaussian prior by its evidence.
//!
//! With free weights under L2 the posterior is N(w, (H + αI)⁻¹), H the information −d²ℓ/dw² and α the strength. Empirical
//! Bayes chooses α: at the maximum of the evidence α |w|² = Σ h/(h + α) over the eigenvalues h of H (MacKay 1992). Under L1 a
//! weight at its bound falls off exponentially with the slope g of the log posterior there: its mean and deviation are 1/g.

use super::optimum::{self, Optimum};
use super::{SoftLikelihood, strength};
use crate::irl::{FitError, Penalty, Posterior, Problem, Trace};
use nalgebra::{DMatrix, SymmetricEigen};

const MAX_ROUNDS: u32 = 20;
/// Relative change of α at which it is settled.
const SETTLED: f64 = 1e-3;
/// α stays within these.
const RANGE: (f64, f64) = (1e-8, 1e8);
/// A slope below this is rounding.
const LEAST_SLOPE: f64 = 1e-6;
/// Half-width of a central 95% interval of a Gaussian in standard deviations.
const NORMAL_975: f64 = 1.959_963_984_540_054;

/// The optimum under L2 whose strength maximises the evidence.
pub(super) fn evidence(
    problem: &Problem<'_>,
    likelihood: &mut dyn SoftLikelihood,
    n_basis: usize,
    trace: &mut Trace<'_>,
) -> Result<Optimum, FitError> {
    let mut found = optimum::find(problem, likelihood, vec![0.0; n_basis], strength(problem.options), trace)?;
    for _ in 0..MAX_ROUNDS {
        trace.check()?;
        let norm: f64 = found.weights.iter().map(|w| w * w).sum();
        let eigen = SymmetricEigen::new(information(likelihood, &found.weights));
        let effective: f64 = eigen.eigenvalues.iter().map(|h| h.max(0.0) / (h.max(0.0) + found.strength)).sum();
        let next = if norm > 0.0 { (effective / norm).clamp(RANGE.0, RANGE.1) } else { RANGE.1 };
        if (next.ln() - found.strength.ln()).abs() <= SETTLED {
            break;
        }
        found = optimum::find(problem, likelihood, found.weights, next, trace)?;
    }
    Ok(found)
}

/// Mean of the weights and their posterior.
pub(super) fn around(
    problem: &Problem<'_>,
    likelihood: &mut dyn SoftLikelihood,
    weights: &[f64],
    strength: f64,
) -> (Vec<f64>, Posterior) {
    let n = weights.len();
    let l1 = problem.options.penalty == Penalty::L1;
    let slopes: Vec<f64> = likelihood.value_and_gradient(weights).1.iter().map(|g| strength - g).collect();
    let mut precision = information(likelihood, weights);
    let free: Vec<usize> = (0..n).filter(|&b| !l1 || weights[b] > 0.0).collect();
    if !l1 {
        (0..n).for_each(|b| precision[(b, b)] += strength);
    }
    let precision = precision.select_rows(free.iter()).select_columns(free.iter());
    let variances = variances(&precision);
    let mut mean = weights.to_vec();
    let (mut deviations, mut low, mut high) = (vec![0.0; n], vec![0.0; n], vec![0.0; n]);
    for (&b, variance) in free.iter().zip(variances) {
        deviations[b] = variance.sqrt();
        low[b] = weights[b] - NORMAL_975 * deviations[b];
        high[b] = weights[b] + NORMAL_975 * deviations[b];
        if l1 {
            low[b] = low[b].max(0.0);
        }
    }
    if l1 {
        for b in (0..n).filter(|&b| weights[b] <= 0.0) {
            let scale = 1.0 / slopes[b].max(LEAST_SLOPE);
            (mean[b], deviations[b]) = (scale, scale);
            low[b] = -(-0.025_f64).ln_1p() * scale;
            high[b] = -(0.025_f64).ln() * scale;
        }
    }
    (mean, Posterior { standard_deviations: deviations, low, high, diagnostics: None })
}

/// −d²ℓ/dw², symmetric.
fn information(likelihood: &mut dyn SoftLikelihood, weights: &[f64]) -> DMatrix<f64> {
    let hessian = likelihood.hessian_and_terms(weights).0;
    (&hessian + hessian.transpose()) * -0.5
}

/// Diagonal of the inverse; infinite along directions of no precision.
fn variances(precision: &DMatrix<f64>) -> Vec<f64> {
    if precision.is_empty() {
        return Vec::new();
    }
    let eigen = SymmetricEigen::new(precision.clone());
    let largest = eigen.eigenvalues.iter().copied().fold(0.0, f64::max);
    (0..precision.nrows())
        .map(|b| {
            let share = |k: usize| eigen.eigenvectors[(b, k)].powi(2);
            let terms = eigen.eigenvalues.iter().enumerate().map(|(k, &h)| {
                if h > 1e-12 * largest {
                    share(k) / h
                } else if share(k) > 1e-9 {
                    f64::INFINITY
                } else {
                    0.0
                }
            });
            terms.sum()
        })
        .collect()
}
