//! Standard errors of the unpenalised estimator from the observed information.

use super::SoftLikelihood;
use nalgebra::SymmetricEigen;

/// Most basis functions whose Hessian is decomposed.
pub const MAX_STANDARD_ERRORS: usize = 1000;
/// Eigenvalues below this share of the largest count as zero: the data say nothing along them.
const RELATIVE_RANK: f64 = 1e-10;
/// A diagonal entry below this share of the terms it is made of is rounding: squares of relative errors of 1e-10.
const ROUNDING: f64 = 1e-20;
/// Share of a weight's variance that may hide in directions of which the data say nothing.
const HIDDEN: f64 = 0.1;

/// Square roots of the diagonal of the pseudo-inverse of −d²ℓ/dw², shape (`n_basis`,).
///
/// A reward is identified only up to directions that leave the policy unchanged (a constant, unvisited states). A weight with
/// a part in such a direction has an infinite standard error: it is undetermined.
pub fn standard_errors(likelihood: &mut dyn SoftLikelihood, weights: &[f64]) -> Vec<f64> {
    let (hessian, terms) = likelihood.hessian_and_terms(weights);
    let information = -hessian;
    // scaled to a unit diagonal, so that the rank does not depend on the features' units
    let diagonal = information.diagonal();
    let scale: Vec<f64> =
        diagonal.iter().zip(terms).map(|(&d, terms)| if d > ROUNDING * terms { d.sqrt() } else { 0.0 }).collect();
    let n = scale.len();
    let mut scaled = information;
    for i in 0..n {
        for j in 0..n {
            let s = scale[i] * scale[j];
            scaled[(i, j)] = if s > 0.0 { scaled[(i, j)] / s } else { 0.0 };
        }
    }
    let symmetric = (&scaled + scaled.transpose()) * 0.5;
    let eigen = SymmetricEigen::new(symmetric);
    let largest = eigen.eigenvalues.iter().copied().fold(0.0, f64::max);
    (0..n)
        .map(|b| {
            let (mut variance, mut unknown) = (0.0, 0.0);
            for (k, &value) in eigen.eigenvalues.iter().enumerate() {
                let share = eigen.eigenvectors[(b, k)].powi(2);
                if value > RELATIVE_RANK * largest && value > 0.0 {
                    variance += share / value;
                } else {
                    unknown += share;
                }
            }
            // along an unknown direction the variance is at least that of the smallest eigenvalue that counts
            let hidden = unknown / (RELATIVE_RANK * largest);
            let known = scale[b] > 0.0 && largest > 0.0 && hidden <= HIDDEN * variance;
            if known { variance.sqrt() / scale[b] } else { f64::INFINITY }
        })
        .collect()
}
