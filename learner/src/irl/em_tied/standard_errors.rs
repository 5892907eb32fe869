//! Standard errors of the unpenalised estimator from the observed information.

use super::Likelihood;
use nalgebra::SymmetricEigen;

/// Most basis functions whose Hessian is decomposed.
pub const MAX_STANDARD_ERRORS: usize = 1000;
/// Eigenvalues below this share of the largest count as zero: the data say nothing along them.
const RELATIVE_RANK: f64 = 1e-10;
/// Share of a weight's direction that may lie where the data say nothing.
const LEAKAGE: f64 = 1e-6;

/// Square roots of the diagonal of the pseudo-inverse of −d²ℓ/dw², shape (`n_basis`,).
///
/// A reward is identified only up to directions that leave the policy unchanged (a constant, unvisited states). A weight with
/// a part in such a direction has an infinite standard error: it is undetermined.
pub fn standard_errors(likelihood: &mut Likelihood<'_>, weights: &[f64]) -> Vec<f64> {
    let information = -likelihood.hessian(weights);
    // scaled to a unit diagonal, so that the rank does not depend on the features' units
    let scale: Vec<f64> = information.diagonal().iter().map(|&d| if d > 0.0 { d.sqrt() } else { 0.0 }).collect();
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
            if scale[b] == 0.0 || unknown > LEAKAGE { f64::INFINITY } else { variance.sqrt() / scale[b] }
        })
        .collect()
}
