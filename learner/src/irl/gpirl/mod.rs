//! `gpirl`: a Gaussian process over rewards, after Levine, Popović & Koltun (2011).
//!
//! u ~ N(0, K(θ)) are the rewards of the points (states, pairs, or distinct rows of the user's features), and the expert follows
//! the soft-optimal policy of the reward, as in `em-tied`. The paper maximises log p(O | u) + log p(u | θ) + log p(θ) over u
//! and θ together, a density without bound as K and u vanish, which it mends with a prior on K. Here θ is learned from the
//! marginal likelihood instead, with u integrated out by Laplace's approximation: expectation maximisation, whose E-step is the
//! mode û and the covariance Σ = (K⁻¹ − ∇²ℓ)⁻¹ and whose M-step maximises E[log p(u | θ)] + log p(θ) by a quasi-Newton method with
//! exact gradients. All points are inducing points: this is for state sets of up to a thousand.

mod inputs;
mod kernel;

use self::inputs::Inputs;
use self::kernel::{Kernel, LARGEST_LOG, factor};
use super::bounded::{self, Settings};
use super::em_tied::{SoftLikelihood, soft_likelihood};
use super::{Basis, BasisKind, Fit, FitError, Hyperparameter, Method, Posterior, Problem, Progress, Stopped, Trace};
use crate::mdp::Policy;
use nalgebra::{Cholesky, DMatrix, DVector, SymmetricEigen};

/// EM iterations at most, where the options do not say fewer.
const MAX_ITERATIONS: u32 = 40;
/// Largest change of a logarithm of a hyperparameter that counts as none.
const SETTLED: f64 = 0.02;
/// Factor by which a step of EM is lengthened: it is a known slow walker along one direction.
const OVER_RELAXATION: f64 = 1.8;
/// Steps of the quasi-Newton method within one E-step or M-step.
const INNER_ITERATIONS: u32 = 100;
/// Largest discount below 1: beyond, rows that sum to 1 within 1e-9 leave the values undetermined.
const MAX_DISCOUNT: f64 = 1.0 - 1e-8;

/// Laplace approximation of a Gaussian-process posterior.
pub(super) struct Gpirl;

impl Method for Gpirl {
    fn id(&self) -> &'static str {
        "gpirl"
    }

    fn description(&self) -> &'static str {
        "Gaussian-process reward over features or the graph of the process, kernel learned, Levine et al. (2011)"
    }

    fn fit(&self, problem: &Problem<'_>, progress: Progress<'_>) -> Result<Fit, FitError> {
        problem.check()?;
        let options = problem.options;
        if options.discount > MAX_DISCOUNT && options.discount < 1.0 {
            let message =
                format!("expected at most {MAX_DISCOUNT}, or 1 to plan over the horizon, got {}", options.discount);
            return Err(FitError::InvalidOption { field: "discount", message });
        }
        let Inputs { basis, parts } = Inputs::new(problem.mdp, options.basis, problem.features)?;
        let kernel = Kernel::new(basis.len(), parts);
        let mut trace = Trace::new(progress);
        let mut likelihood = soft_likelihood(problem, &basis)?;
        let likelihood = &mut *likelihood;

        let mut theta = kernel.start();
        let mut laplace = Laplace::new(&kernel, &theta, likelihood, vec![0.0; basis.len()])?;
        let mut stopped = Stopped::MaxIterations;
        let mut relaxation = OVER_RELAXATION;
        let mut change = f64::INFINITY;
        for _ in 0..options.max_iterations.min(MAX_ITERATIONS) {
            trace.record(laplace.log_evidence, if change.is_finite() { change } else { 0.0 })?;
            if change < SETTLED {
                stopped = Stopped::Converged;
                break;
            }
            let proposed = m_step(&kernel, &theta, &laplace.second_moment())?;
            let step =
                |factor: f64| -> Vec<f64> { theta.iter().zip(&proposed).map(|(t, p)| t + factor * (p - t)).collect() };
            let mut next_theta = step(relaxation);
            let mut next = Laplace::new(&kernel, &next_theta, likelihood, laplace.mode.clone())?;
            if next.log_evidence < laplace.log_evidence && relaxation > 1.0 {
                relaxation = 1.0;
                next_theta = step(1.0);
                next = Laplace::new(&kernel, &next_theta, likelihood, laplace.mode.clone())?;
            }
            change = theta.iter().zip(&next_theta).fold(0.0, |m: f64, (a, b)| m.max((a - b).abs()));
            // Laplace's approximation moves with θ: where EM stops gaining, it is done
            if next.log_evidence < laplace.log_evidence {
                change = 0.0;
            } else {
                (theta, laplace) = (next_theta, next);
            }
        }
        finish(problem, &basis, &kernel, &theta, &laplace, likelihood, trace, stopped)
    }
}

/// The θ that explains rewards of this second moment best.
fn m_step(kernel: &Kernel, theta: &[f64], second_moment: &DMatrix<f64>) -> Result<Vec<f64>, FitError> {
    let settings = Settings { lower: f64::NEG_INFINITY, tolerance: 1e-4, max_iterations: INNER_ITERATIONS };
    let cost = |theta: &[f64]| kernel.expected_cost(theta, second_moment);
    Ok(bounded::minimise(&settings, theta.to_vec(), cost, |_, _| Ok(()))?.x)
}

/// N(û, Σ) in place of the posterior of the rewards given θ.
struct Laplace {
    mode: Vec<f64>,
    covariance: DMatrix<f64>,
    /// log p(O | θ) p(θ) by Laplace's approximation, up to a constant.
    log_evidence: f64,
    /// Whether −∇² of the log-posterior was positive definite at the mode.
    concave: bool,
}

impl Laplace {
    /// Searches the mode from `start` on, in coordinates z with u = Lz, K = LLᵀ, in which the prior is white.
    fn new(
        kernel: &Kernel,
        theta: &[f64],
        likelihood: &mut dyn SoftLikelihood,
        start: Vec<f64>,
    ) -> Result<Self, FitError> {
        let no_factor = || FitError::InvalidOption {
            field: "basis",
            message: "expected features whose covariance is positive definite, got one that is not".to_owned(),
        };
        let lower = factor(kernel.matrix(theta)).ok_or_else(no_factor)?.unpack();
        let z = lower.solve_lower_triangular(&DVector::from_vec(start)).ok_or_else(no_factor)?;
        let settings = Settings { lower: f64::NEG_INFINITY, tolerance: 1e-5, max_iterations: INNER_ITERATIONS };
        let negated = |z: &[f64]| {
            let z = DVector::from_column_slice(z);
            let (log_likelihood, gradient) = likelihood.value_and_gradient((&lower * &z).as_slice());
            let by_z = lower.tr_mul(&DVector::from_vec(gradient));
            (0.5 * z.norm_squared() - log_likelihood, (&z - by_z).as_slice().to_vec())
        };
        let found = bounded::minimise(&settings, z.as_slice().to_vec(), negated, |_, _| Ok(()))?;
        let z = DVector::from_vec(found.x);
        let mode = &lower * &z;
        let (log_likelihood, _) = likelihood.value_and_gradient(mode.as_slice());
        let mut curvature = -lower.tr_mul(&(likelihood.hessian_and_terms(mode.as_slice()).0 * &lower));
        curvature = (&curvature + curvature.transpose()) * 0.5;
        let n = curvature.nrows();
        let identity = DMatrix::identity(n, n);
        let (inverse, log_determinant, concave) = if let Some(factor) = Cholesky::new(&identity + &curvature) {
            (factor.inverse(), 2.0 * factor.l_dirty().diagonal().iter().map(|d| d.ln()).sum::<f64>(), true)
        } else {
            // the log-likelihood is not concave: where it bends upward, the prior's own precision counts
            let too_sharp = || FitError::InvalidOption {
                field: "discount",
                message: "expected a discount at which the curvature of the likelihood is a number, got one too near 1"
                    .to_owned(),
            };
            if curvature.iter().any(|c| !c.is_finite()) {
                return Err(too_sharp());
            }
            let eigen = SymmetricEigen::try_new(curvature, f64::EPSILON, 10_000).ok_or_else(too_sharp)?;
            let precisions = eigen.eigenvalues.map(|e| 1.0 + e.max(0.0));
            let scaled = DMatrix::from_diagonal(&precisions.map(|p| 1.0 / p));
            let inverse = &eigen.eigenvectors * scaled * eigen.eigenvectors.transpose();
            (inverse, precisions.iter().map(|p: &f64| p.ln()).sum::<f64>(), false)
        };
        let covariance = &lower * inverse * lower.transpose();
        let log_evidence = log_likelihood - 0.5 * z.norm_squared() - 0.5 * log_determinant + kernel.log_prior(theta);
        Ok(Self { mode: mode.as_slice().to_vec(), covariance, log_evidence, concave })
    }

    /// ⟨uuᵀ⟩, the second moment of the rewards.
    fn second_moment(&self) -> DMatrix<f64> {
        let mode = DVector::from_column_slice(&self.mode);
        &self.covariance + &mode * mode.transpose()
    }
}

#[expect(clippy::too_many_arguments, reason = "the pieces of one fit; private to this file")]
fn finish(
    problem: &Problem<'_>,
    points: &Basis,
    kernel: &Kernel,
    theta: &[f64],
    laplace: &Laplace,
    likelihood: &mut dyn SoftLikelihood,
    trace: Trace<'_>,
    stopped: Stopped,
) -> Result<Fit, FitError> {
    likelihood.value_and_gradient(&laplace.mode);
    let n_actions = problem.mdp.n_actions();
    let mut warnings = Vec::new();
    if !laplace.concave {
        warnings.push("the posterior is not concave at its mode: its intervals are rough".to_owned());
    }
    if !likelihood.converged() {
        warnings.push("the soft values stopped before they converged".to_owned());
    }
    let reward = points.reward(&laplace.mode);
    let (weights, covariance) = if problem.options.basis == BasisKind::Features {
        warnings.push(
            "the reward is a function of the features and no weighted sum: the weights are its best linear approximation"
                .to_owned(),
        );
        linear_approximation(&problem.basis(), points, &reward, &laplace.covariance)?
    } else {
        (laplace.mode.clone(), laplace.covariance.clone())
    };
    let standard_deviations: Vec<f64> = covariance.diagonal().iter().map(|v| v.max(0.0).sqrt()).collect();
    let end = |sign: f64| -> Vec<f64> {
        weights.iter().zip(&standard_deviations).map(|(w, sd)| w + sign * 1.959_963_985 * sd).collect()
    };
    let posterior = Posterior { low: end(-1.0), high: end(1.0), standard_deviations, diagnostics: None };
    let hyperparameters = kernel
        .names()
        .into_iter()
        .zip(theta)
        .map(|(name, theta)| Hyperparameter { name, value: theta.clamp(-LARGEST_LOG, LARGEST_LOG).exp() })
        .collect();
    let iterations = trace.entries.len() as u32;
    Ok(Fit {
        weights,
        reward,
        policy: Policy::boltzmann(n_actions, likelihood.action_values(), 1.0).into_probabilities(),
        greedy_policy: Policy::greedy(n_actions, likelihood.action_values()).into_probabilities(),
        state_values: likelihood.state_values().to_vec(),
        standard_errors: None,
        posterior: Some(posterior),
        hyperparameters,
        trace: trace.entries,
        stopped,
        iterations,
        warnings,
    })
}

/// The weights w that bring wᵀΦ nearest to the reward over all pairs, and their covariance: w = (ΦᵀΦ)⁺Φᵀ R.
fn linear_approximation(
    features: &Basis,
    points: &Basis,
    reward: &[f64],
    covariance: &DMatrix<f64>,
) -> Result<(Vec<f64>, DMatrix<f64>), FitError> {
    let n = features.len();
    // columns in units of their largest value: squares of a user's numbers may not overflow
    let mut unit = vec![0.0_f64; n];
    for pair in 0..reward.len() {
        features.for_each(pair, |b, value| unit[b] = unit[b].max(value.abs()));
    }
    for u in &mut unit {
        *u = if *u > 0.0 { 1.0 / *u } else { 0.0 };
    }
    let mut gram = DMatrix::<f64>::zeros(n, n);
    let mut to_points = DMatrix::<f64>::zeros(n, points.len());
    let mut projected = DVector::<f64>::zeros(n);
    for (pair, r) in reward.iter().enumerate() {
        let mut row = Vec::new();
        features.for_each(pair, |b, value| row.push((b, value * unit[b])));
        for &(b, x) in &row {
            projected[b] += x * r;
            for &(c, y) in &row {
                gram[(b, c)] += x * y;
            }
            points.for_each(pair, |p, value| to_points[(b, p)] += x * value);
        }
    }
    let size = gram.amax().max(f64::MIN_POSITIVE);
    let mut inverse = gram.pseudo_inverse(1e-12 * size).map_err(|message| FitError::InvalidOption {
        field: "basis",
        message: format!("expected features that can be inverted, got: {message}"),
    })?;
    for (mut row, u) in inverse.row_iter_mut().zip(&unit) {
        row *= *u;
    }
    let map = &inverse * to_points;
    let weights = &inverse * projected;
    Ok((weights.as_slice().to_vec(), &map * covariance * map.transpose()))
}
