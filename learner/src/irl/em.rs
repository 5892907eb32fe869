//! `em`: Hahn & Zoubir (2015), eq. 4–10.
//!
//! The reward is a mixture of basis functions. With C = Σ_k p(k) Σ_l Φ Φᵀ and c = Σ_k p(k) ρ_k Σ_l Φ at the pairs that the L
//! demonstrations pass in step k, the stationarity of their eq. 8 is c − C w = λ 1 on the simplex. The E-step weighs the
//! steps by the responsibilities ρ_k, the M-step solves for w, and the planner turns R = wᵀΦ into a policy.
//!
//! The objective is the part of Q that depends on the reward, cᵀw − ½ wᵀC w. C is diagonal for the Dirac bases; for a user's
//! features it is full, see [`em_features`].

use super::stationary::Stationarity;
use super::{
    BasisKind, Fit, FitError, MStep, Method, Problem, Progress, Responsibility, Stopped, Trace, em_features, nnls,
    simplex,
};
use nalgebra::{DMatrix, DVector};

/// Demonstrated basis functions that the dense least-squares problem may hold (512 MB).
const MAX_DEMONSTRATED: usize = 8000;
/// Share of the data's weight below which the exact product counts as having lost it.
pub(super) const LOST: f64 = 1e-6;

/// The paper's algorithm.
pub(super) struct Em;

impl Method for Em {
    fn id(&self) -> &'static str {
        "em"
    }

    fn description(&self) -> &'static str {
        "expectation maximisation in a mixture model, Hahn & Zoubir (2015)"
    }

    fn fit(&self, problem: &Problem<'_>, progress: Progress<'_>) -> Result<Fit, FitError> {
        problem.check()?;
        let mut trace = Trace::new(progress);
        let options = problem.options;
        let basis = problem.basis();
        if options.reference_basis as usize >= basis.len() {
            let message = format!("expected a basis function below {}, got {}", basis.len(), options.reference_basis);
            return Err(FitError::InvalidOption { field: "reference_basis", message });
        }
        if options.basis == BasisKind::Features {
            return em_features::fit(problem, &basis, trace);
        }
        let steps = problem.horizon().min(problem.statistics.longest()) as usize;
        let prior = options.horizon_prior.probabilities(options.discount, problem.horizon(), steps);
        let curvature = basis.project(&problem.statistics.weighted_counts(steps, |k| prior[k]));

        let mut weights = vec![1.0 / basis.len() as f64; basis.len()];
        let mut objective = f64::NEG_INFINITY;
        let mut stopped = Stopped::MaxIterations;
        let mut kept = 1.0;
        for _ in 0..options.max_iterations {
            let linear = match options.responsibility {
                Responsibility::Approximate => curvature.clone(),
                Responsibility::Exact => {
                    let rho = responsibilities(problem, &basis.reward(&weights), steps);
                    basis.project(&problem.statistics.weighted_counts(steps, |k| prior[k] * rho[k]))
                }
            };
            kept = linear.iter().sum::<f64>() / curvature.iter().sum::<f64>();
            weights = match options.m_step {
                MStep::Nnls => stationary(&linear, &curvature, options.reference_basis as usize)?,
                MStep::Simplex => simplex::minimise(&linear, &curvature),
            };
            let now = quality(&weights, &linear, &curvature);
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
        if options.responsibility == Responsibility::Exact && kept < LOST {
            warnings.push(lost(kept, problem.statistics.n_trajectories()));
        }
        Fit::planned(problem, &basis, weights, trace, stopped, warnings)
    }
}

/// What a fit says whose exact product kept next to nothing of the data.
pub(super) fn lost(kept: f64, n_trajectories: u64) -> String {
    format!(
        "the exact product of rewards over {n_trajectories} trajectories keeps a share of {kept:.1e} of the data: the weights \
         follow 1/counts (all is on what was never demonstrated, where there is any) and not the demonstrations"
    )
}

/// ρ_k = Π_l R(s_k, a_k) over the demonstrations, from the sum of logarithms; a reward above 1 counts as 1.
pub(super) fn responsibilities(problem: &Problem<'_>, reward: &[f64], steps: usize) -> Vec<f64> {
    (0..steps)
        .map(|k| {
            let counts = problem.statistics.step_counts(k).iter();
            counts.map(|&(pair, n)| n * reward[pair as usize].min(1.0).ln()).sum::<f64>().exp()
        })
        .collect()
}

fn quality(weights: &[f64], linear: &[f64], curvature: &[f64]) -> f64 {
    weights.iter().zip(linear).zip(curvature).map(|((w, l), c)| l * w - 0.5 * c * w * w).sum()
}

/// Eq. 10 by non-negative least squares: rows C_i w_i − C_r w_r = c_i − c_r for all i but the reference r, and 1ᵀw = 1.
///
/// Functions that were never demonstrated have the same column and the same row, so they are taken as one unknown and one
/// row (with the weight of all) and share its value evenly: the least-norm solution, and the same for any order of states.
fn stationary(linear: &[f64], curvature: &[f64], reference: usize) -> Result<Vec<f64>, FitError> {
    let others: Vec<usize> = (0..curvature.len()).filter(|&i| curvature[i] > 0.0 && i != reference).collect();
    let of_others = |values: &[f64]| others.iter().map(|&i| values[i]).collect::<Vec<_>>();
    let reference_shown = curvature[reference] > 0.0;
    let hidden = curvature.len() - others.len() - usize::from(reference_shown);
    let problem = Stationarity {
        linear: &of_others(linear),
        curvature: &of_others(curvature),
        reference: reference_shown.then(|| (linear[reference], curvature[reference])),
        hidden,
    };
    let Some(found) = problem.minimise() else { return by_exchanges(linear, curvature, reference) };
    let mut weights = vec![found.hidden / hidden.max(1) as f64; curvature.len()];
    for (&i, &w) in others.iter().zip(&found.shown) {
        weights[i] = w;
    }
    if reference_shown {
        weights[reference] = found.reference;
    }
    Ok(weights)
}

/// [`stationary`] by exchanges on the dense matrix (Lawson & Hanson), where its active sets cycle.
fn by_exchanges(linear: &[f64], curvature: &[f64], reference: usize) -> Result<Vec<f64>, FitError> {
    let shown: Vec<usize> = (0..curvature.len()).filter(|&i| curvature[i] > 0.0).collect();
    if shown.len() > MAX_DEMONSTRATED {
        let (limit, got) = (MAX_DEMONSTRATED, shown.len());
        return Err(FitError::TooLarge {
            what: "demonstrated basis functions (m_step simplex has no limit)",
            limit,
            got,
        });
    }
    let hidden = curvature.len() - shown.len();
    let columns = shown.len() + usize::from(hidden > 0);
    let rows = shown.len() + 2;
    let mut a = DMatrix::zeros(rows, columns);
    let mut b = DVector::zeros(rows);
    let reference_column = shown.iter().position(|&i| i == reference);
    for (row, &i) in shown.iter().enumerate() {
        if i != reference {
            a[(row, row)] = curvature[i];
            b[row] = linear[i] - linear[reference];
            if let Some(column) = reference_column {
                a[(row, column)] = -curvature[reference];
            }
        }
    }
    if let Some(column) = reference_column {
        let weight = (hidden as f64).sqrt();
        a[(shown.len(), column)] = -weight * curvature[reference];
        b[shown.len()] = -weight * linear[reference];
    }
    a.row_mut(rows - 1).fill(1.0);
    b[rows - 1] = 1.0;
    let solution = nnls::nnls(&a, &b).solution;
    let mut weights = vec![0.0; curvature.len()];
    if hidden > 0 {
        weights.fill(solution[columns - 1] / hidden as f64);
    }
    for (&i, &w) in shown.iter().zip(&solution) {
        weights[i] = w;
    }
    Ok(weights)
}
