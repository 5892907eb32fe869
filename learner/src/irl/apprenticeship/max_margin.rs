//! `max-margin`: Abbeel & Ng (2004) §3, the quadratic programme.
//!
//! max t such that wᵀμ_E ≥ wᵀμ_j + t for all policies found, |w| ≤ 1, has the dual min ½ |μ_E − Σ λ_j μ_j|² over the simplex: the
//! point of the hull nearest to μ_E, always feasible. Policies that carry no weight are dropped; they come back where they matter.

use super::learn;
use crate::irl::{Fit, FitError, Method, Problem, Progress};
use clarabel::algebra::CscMatrix;
use clarabel::solver::{DefaultSettingsBuilder, DefaultSolver, IPSolver, NonnegativeConeT, ZeroConeT};

/// Weight below which a policy is dropped.
const NEGLIGIBLE: f64 = 1e-7;

/// The quadratic programme, reporting its best iterate.
pub(in crate::irl) struct MaxMargin;

impl Method for MaxMargin {
    fn id(&self) -> &'static str {
        "max-margin"
    }

    fn description(&self) -> &'static str {
        "apprenticeship learning by maximum margin, best iterate, Abbeel & Ng (2004)"
    }

    fn fit(&self, problem: &Problem<'_>, progress: Progress<'_>) -> Result<Fit, FitError> {
        let mut found: Vec<Vec<f64>> = Vec::new();
        learn(problem, progress, |demonstrated, mean, new| nearest(demonstrated, mean, &mut found, new))
    }
}

/// Adds a policy and moves the mean to the point of the hull nearest to the demonstrated expectations.
fn nearest(demonstrated: &[f64], mean: &mut Vec<f64>, found: &mut Vec<Vec<f64>>, new: Vec<f64>) {
    found.push(new);
    let gaps: Vec<Vec<f64>> = found.iter().map(|f| demonstrated.iter().zip(f).map(|(d, f)| d - f).collect()).collect();
    let Some(shares) = nearest_to_origin(&gaps) else { return };
    let mut point = vec![0.0; mean.len()];
    for (share, f) in shares.iter().zip(found.iter()) {
        for (p, f) in point.iter_mut().zip(f) {
            *p += share * f;
        }
    }
    let square = |x: &[f64]| demonstrated.iter().zip(x).map(|(d, x)| (d - x).powi(2)).sum::<f64>();
    // the solver's last digits must not lead away from the expert
    if square(&point) <= square(mean) {
        *mean = point;
        let mut share = shares.iter();
        found.retain(|_| share.next().is_some_and(|s| *s > NEGLIGIBLE));
    }
}

/// Shares λ on the simplex that minimise |Σ λ_j x_j|; `None` where the solver fails.
fn nearest_to_origin(points: &[Vec<f64>]) -> Option<Vec<f64>> {
    let n = points.len();
    let dot = |a: &[f64], b: &[f64]| a.iter().zip(b).map(|(a, b)| a * b).sum::<f64>();
    let largest = points.iter().map(|p| dot(p, p)).fold(0.0, f64::max);
    if n == 1 || largest == 0.0 {
        return Some(vec![1.0 / n as f64; n]);
    }
    // upper triangle, column by column, in units of the largest square
    let (mut offsets, mut rows, mut values) = (vec![0], Vec::new(), Vec::new());
    for (j, x) in points.iter().enumerate() {
        for (i, y) in points[..=j].iter().enumerate() {
            rows.push(i);
            values.push(dot(x, y) / largest);
        }
        offsets.push(rows.len());
    }
    let squares = CscMatrix::new(n, n, offsets, rows, values);
    // Σ λ = 1, then −λ ≤ 0
    let constraints = CscMatrix::new(
        n + 1,
        n,
        (0..=n).map(|j| 2 * j).collect(),
        (0..n).flat_map(|j| [0, j + 1]).collect(),
        (0..n).flat_map(|_| [1.0, -1.0]).collect(),
    );
    let mut right = vec![0.0; n + 1];
    right[0] = 1.0;
    let settings =
        DefaultSettingsBuilder::default().verbose(false).tol_gap_abs(1e-12).tol_gap_rel(1e-12).build().ok()?;
    let cones = [ZeroConeT(1), NonnegativeConeT(n)];
    let mut solver = DefaultSolver::new(&squares, &vec![0.0; n], &constraints, &right, &cones, settings).ok()?;
    solver.solve();
    let shares: Vec<f64> = solver.solution.x.iter().map(|x| x.max(0.0)).collect();
    let sum: f64 = shares.iter().sum();
    (sum.is_finite() && sum > 0.5).then(|| shares.iter().map(|s| s / sum).collect())
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    proptest! {
        #[test]
        fn no_policy_reaches_beyond_the_nearest_point(
            points in proptest::collection::vec(proptest::collection::vec(-1.0..1.0_f64, 4), 1..12),
            demonstrated in proptest::collection::vec(-1.0..1.0_f64, 4),
        ) {
            let mut mean = points[0].clone();
            let mut found = Vec::new();
            let mut last = f64::INFINITY;
            for point in &points {
                nearest(&demonstrated, &mut mean, &mut found, point.clone());
                let square: f64 = demonstrated.iter().zip(&mean).map(|(d, m)| (d - m).powi(2)).sum();
                prop_assert!(square <= last);
                last = square;
            }
            // of those that were kept, and of the newest
            for point in found.iter().chain(points.last()) {
                let reach: f64 = (0..4).map(|i| (demonstrated[i] - mean[i]) * (point[i] - mean[i])).sum();
                prop_assert!(reach <= 1e-6, "{reach}");
            }
        }
    }
}
