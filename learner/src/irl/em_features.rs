//! `em` with a user's features: C = Σ_k p(k) Σ_l Φ Φᵀ is a full matrix then.
//!
//! The paper reads R(s,a) = wᵀΦ(s,a) as a probability, so features must not be negative; where they exceed 1, a reward may too,
//! which a warning says. Eq. 10 is solved as for the Dirac bases, by non-negative least squares with rows C_i − C_r. The exact
//! maximiser of Q on the simplex is a least-squares problem of its own: with one row √n Φ(s,a)ᵀ a demonstrated pair of weight n,
//! C = AᵀA and c = Aᵀb, and since 1ᵀw = 1 it is the point of least norm in the convex hull of the columns of A − b 1ᵀ
//! (Wolfe 1976). Scaling that point's weights so that they minimise ‖(A − b 1ᵀ) u‖² + (1ᵀu − 1)² over u ≥ 0 changes no ratio.

use super::em::{LOST, lost, responsibilities};
use super::{Basis, BasisKind, Fit, FitError, MStep, Problem, Responsibility, Stopped, Trace, nnls};
use nalgebra::{DMatrix, DVector};

/// Features that dense matrices may have on either side (128 MB each).
const MAX_FEATURES: usize = 4000;
/// Rows of demonstrated pairs that are factorised at once.
const BLOCK: usize = 1024;

pub(super) fn fit(problem: &Problem<'_>, basis: &Basis, mut trace: Trace<'_>) -> Result<Fit, FitError> {
    let options = problem.options;
    let n_features = basis.len();
    if n_features > MAX_FEATURES {
        return Err(FitError::TooLarge { what: "features", limit: MAX_FEATURES, got: n_features });
    }
    let highest = highest(problem)?;
    let steps = problem.horizon().min(problem.statistics.longest()) as usize;
    let prior = options.horizon_prior.probabilities(options.discount, problem.horizon(), steps);
    let counts = problem.statistics.weighted_counts(steps, |k| prior[k]);
    let gram = gram(basis, &counts);
    if let Some(b) = (0..n_features).find(|&b| !gram[(b, b)].is_finite()) {
        let message = format!("expected features whose squares can be added, got too large ones in feature {b}");
        return Err(FitError::InvalidOption { field: "basis", message });
    }

    let mut weights = vec![1.0 / n_features as f64; n_features];
    let mut objective = f64::NEG_INFINITY;
    let mut stopped = Stopped::MaxIterations;
    let mut kept = 1.0;
    for _ in 0..options.max_iterations {
        let weighted = match options.responsibility {
            Responsibility::Approximate => counts.clone(),
            Responsibility::Exact => {
                let rho = responsibilities(problem, &basis.reward(&weights), steps);
                problem.statistics.weighted_counts(steps, |k| prior[k] * rho[k])
            }
        };
        kept = weighted.iter().sum::<f64>() / counts.iter().sum::<f64>();
        let linear = basis.project(&weighted);
        weights = match options.m_step {
            MStep::Nnls => stationary(&linear, &gram, options.reference_basis as usize),
            MStep::Simplex => simplex(basis, &counts, &weighted, &gram),
        };
        let w = DVector::from_column_slice(&weights);
        let now = w.dot(&DVector::from_vec(linear)) - 0.5 * w.dot(&(&gram * &w));
        let change = if objective.is_finite() { (now - objective).abs() } else { now.abs() };
        trace.record(now, change)?;
        let first = !objective.is_finite();
        objective = now;
        if !first && change <= options.tolerance {
            stopped = Stopped::Converged;
            break;
        }
    }

    let mut warnings = Vec::new();
    if highest > 1.0 {
        warnings.push(format!(
            "a feature reaches {highest}: the paper's rewards are probabilities, and features above 1 may make them larger; \
             scale the features to [0, 1]"
        ));
    }
    let absent = (0..n_features).filter(|&b| gram[(b, b)] <= 0.0).count();
    if absent > 0 {
        warnings.push(format!("{absent} of {n_features} features are 0 wherever the demonstrations go"));
    }
    if options.responsibility == Responsibility::Exact && kept < LOST {
        warnings.push(lost(kept, problem.statistics.n_trajectories()));
    }
    Fit::planned(problem, basis, weights, trace, stopped, warnings)
}

/// The highest value of any feature; 0 for a Dirac basis.
///
/// # Errors
/// A negative one.
pub(super) fn highest(problem: &Problem<'_>) -> Result<f64, FitError> {
    let mut highest: f64 = 0.0;
    let (BasisKind::Features, Some(features)) = (problem.options.basis, problem.features) else { return Ok(highest) };
    for pair in 0..features.n_pairs() {
        let (columns, values) = features.row(pair);
        for (&column, &value) in columns.iter().zip(values) {
            if value < 0.0 {
                let (state, action) = (pair / problem.mdp.n_actions(), pair % problem.mdp.n_actions());
                let name = &features.names()[column as usize];
                let message = format!(
                    "expected features that are not negative, for the method takes rewards as probabilities, got {value} \
                     of {name} at state {state}, action {action}"
                );
                return Err(FitError::InvalidOption { field: "basis", message });
            }
            highest = highest.max(value);
        }
    }
    Ok(highest)
}

/// Σ counts(s,a) Φ Φᵀ.
fn gram(basis: &Basis, counts: &[f64]) -> DMatrix<f64> {
    let mut gram = DMatrix::zeros(basis.len(), basis.len());
    let mut row = Vec::new();
    for (pair, &count) in counts.iter().enumerate().filter(|(_, count)| **count > 0.0) {
        row.clear();
        basis.for_each(pair, |b, value| row.push((b, value)));
        for &(i, x) in &row {
            for &(j, y) in &row {
                gram[(i, j)] += count * x * y;
            }
        }
    }
    gram
}

/// Eq. 10; features that were never shown share one unknown, as in `em::stationary`.
fn stationary(linear: &[f64], gram: &DMatrix<f64>, reference: usize) -> Vec<f64> {
    let shown: Vec<usize> = (0..linear.len()).filter(|&b| gram[(b, b)] > 0.0).collect();
    let hidden = linear.len() - shown.len();
    let (columns, rows) = (shown.len() + usize::from(hidden > 0), shown.len() + 2);
    let mut a = DMatrix::zeros(rows, columns);
    let mut b = DVector::zeros(rows);
    for (row, &i) in shown.iter().enumerate() {
        for (column, &j) in shown.iter().enumerate() {
            a[(row, column)] = gram[(i, j)] - gram[(reference, j)];
        }
        b[row] = linear[i] - linear[reference];
    }
    if hidden > 0 {
        let weight = (hidden as f64).sqrt();
        for (column, &j) in shown.iter().enumerate() {
            a[(shown.len(), column)] = -weight * gram[(reference, j)];
        }
        b[shown.len()] = -weight * linear[reference];
    }
    a.row_mut(rows - 1).fill(1.0);
    b[rows - 1] = 1.0;
    let solution = nnls::nnls(&a, &b).solution;
    spread(&shown, hidden, &solution, linear.len())
}

/// argmin ½ wᵀC w − cᵀw on the simplex, for C of `counts` and c of `weighted`.
fn simplex(basis: &Basis, counts: &[f64], weighted: &[f64], gram: &DMatrix<f64>) -> Vec<f64> {
    let shown: Vec<usize> = (0..basis.len()).filter(|&b| gram[(b, b)] > 0.0).collect();
    let hidden = basis.len() - shown.len();
    let columns = shown.len() + usize::from(hidden > 0);
    let triangle = triangle(basis, counts, weighted, &shown);
    let side = triangle.column(shown.len()).into_owned();
    // a feature that was never shown is a column of zeros before b is taken off
    let mut hull = DMatrix::from_fn(triangle.nrows() + 1, columns, |i, j| {
        if i == triangle.nrows() {
            0.0
        } else if j < shown.len() {
            triangle[(i, j)] - side[i]
        } else {
            -side[i]
        }
    });
    let scale = hull.column_iter().map(|column| column.norm()).fold(0.0, f64::max);
    if scale > 0.0 {
        hull /= scale;
    }
    let rows = hull.nrows();
    hull.row_mut(rows - 1).fill(1.0);
    let mut one = DVector::zeros(rows);
    one[rows - 1] = 1.0;
    let mut solution = nnls::nnls(&hull, &one).solution;
    let sum: f64 = solution.iter().sum();
    for u in &mut solution {
        *u /= sum;
    }
    spread(&shown, hidden, &solution, basis.len())
}

/// R of a QR factorisation of the rows √n (Φ(s,a)ᵀ, n'/n), shape (at most `shown` + 1, `shown` + 1), block by block.
fn triangle(basis: &Basis, counts: &[f64], weighted: &[f64], shown: &[usize]) -> DMatrix<f64> {
    let width = shown.len() + 1;
    let mut place = vec![None; basis.len()];
    for (column, &b) in shown.iter().enumerate() {
        place[b] = Some(column);
    }
    let pairs: Vec<usize> = (0..counts.len()).filter(|&pair| counts[pair] > 0.0).collect();
    let mut triangle = DMatrix::zeros(0, width);
    for block in pairs.chunks(BLOCK.max(width)) {
        let kept = triangle.nrows();
        let mut stacked = triangle.resize_vertically(kept + block.len(), 0.0);
        for (i, &pair) in block.iter().enumerate() {
            let root = counts[pair].sqrt();
            basis.for_each(pair, |b, value| {
                if let Some(column) = place[b] {
                    stacked[(kept + i, column)] = root * value;
                }
            });
            stacked[(kept + i, width - 1)] = weighted[pair] / root;
        }
        triangle = if stacked.nrows() > width { stacked.qr().r() } else { stacked };
    }
    triangle
}

fn spread(shown: &[usize], hidden: usize, solution: &[f64], n_features: usize) -> Vec<f64> {
    let share = if hidden > 0 { solution[shown.len()] / hidden as f64 } else { 0.0 };
    let mut weights = vec![share; n_features];
    for (&b, &w) in shown.iter().zip(solution) {
        weights[b] = w;
    }
    weights
}
