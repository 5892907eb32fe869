//! Log-density of Ramachandran & Amir's (2007) posterior on a scale without bounds, with its gradient and its metric.
//!
//! Each weight w in [0, 1] is Φ(x), the normal distribution function of a free x: a uniform prior of w is a standard normal
//! one of x, and no wall stands in a sampler's way. The likelihood is continuous in w and has kinks where the optimal policy
//! changes; its gradient is exact everywhere else, and so is its Hessian −Jᵀ F J (J = dQ*/dw, F the covariance of the Boltzmann
//! choices), because Q* is linear between kinks.

use super::optimum::{Optimum, dot};
use crate::irl::{Basis, RewardPrior};
use crate::mdp::TabularMdp;
use nalgebra::DMatrix;

/// Rate of the exponential prior: mean 0.19 on [0, 1].
pub(super) const EXPONENTIAL_RATE: f64 = 5.0;

/// What decides the posterior.
#[derive(Clone, Copy)]
pub(super) struct Model<'a> {
    pub mdp: &'a TabularMdp,
    pub basis: &'a Basis,
    /// N(s,a).
    pub counts: &'a [f64],
    pub discount: f64,
    pub horizon: u32,
    /// β.
    pub rationality: f64,
    pub prior: RewardPrior,
}

/// The posterior at one point.
pub(super) struct Point {
    /// Log-density of x up to a constant.
    pub log_density: f64,
    /// Its gradient, shape (`n_basis`,).
    pub gradient: Vec<f64>,
    /// Log-posterior of w up to a constant: likelihood and prior, without the change of scale.
    pub log_posterior: f64,
    /// w, shape (`n_basis`,).
    pub weights: Vec<f64>,
}

impl Point {
    pub(super) fn is_finite(&self) -> bool {
        self.log_density.is_finite() && self.gradient.iter().all(|g| g.is_finite())
    }
}

/// Evaluates the posterior of one chain.
pub(super) struct Target<'a> {
    model: Model<'a>,
    optimum: Optimum<'a>,
    visits: Vec<f64>,
    /// Power of the likelihood, 1 but for the beginning of the warm-up.
    power: f64,
    /// dℓ/dQ.
    by_value: Vec<f64>,
}

impl<'a> Target<'a> {
    pub(super) fn new(model: Model<'a>) -> Self {
        let visits = model.counts.chunks_exact(model.mdp.n_actions()).map(|n| n.iter().sum()).collect();
        let optimum = Optimum::new(model.mdp, model.discount, model.horizon);
        Self { model, optimum, visits, power: 1.0, by_value: vec![0.0; model.mdp.n_pairs()] }
    }

    /// Takes the likelihood to a power in [0, 1].
    pub(super) fn temper(&mut self, share: f64) {
        // early steps matter more: a power of 0.1 still tells most of what a thousand steps say
        self.power = if share >= 1.0 { 1.0 } else { share.max(0.0).powi(3) };
    }

    pub(super) fn evaluate(&mut self, x: &[f64]) -> Point {
        let weights: Vec<f64> = x.iter().map(|&x| normal_cdf(x)).collect();
        self.optimum.solve(&self.model.basis.reward(&weights));
        let log_likelihood = self.likelihood();
        let by_reward = self.optimum.pull_back(&self.by_value);
        let mut gradient = self.model.basis.project(&by_reward);
        let (mut log_prior, mut log_scale) = (0.0, 0.0);
        for ((g, &x), &w) in gradient.iter_mut().zip(x).zip(&weights) {
            let density = normal_density(x);
            log_scale -= 0.5 * x * x;
            *g *= density;
            match self.model.prior {
                RewardPrior::Uniform => {}
                RewardPrior::Exponential => {
                    log_prior -= EXPONENTIAL_RATE * w;
                    *g -= EXPONENTIAL_RATE * density;
                }
                RewardPrior::Beta => {
                    let rest = normal_cdf(-x);
                    log_prior -= 0.5 * (w.ln() + rest.ln());
                    *g -= 0.5 * (density / w - density / rest);
                }
            }
            *g -= x;
        }
        let log_posterior = log_likelihood + log_prior;
        Point { log_density: log_posterior + log_scale, gradient, log_posterior, weights }
    }

    /// Σ N(s,a) log p(a|s), p(a|s) ∝ exp(β Q*(s,a)); leaves dℓ/dQ behind.
    fn likelihood(&mut self) -> f64 {
        let (n_actions, beta) = (self.model.mdp.n_actions(), self.model.rationality);
        let mut log_likelihood = 0.0;
        let rows = self.optimum.action_values().chunks_exact(n_actions).zip(self.by_value.chunks_exact_mut(n_actions));
        for ((q, by_value), (n, &visits)) in rows.zip(self.model.counts.chunks_exact(n_actions).zip(&self.visits)) {
            if visits == 0.0 {
                continue;
            }
            let largest = q.iter().copied().fold(f64::NEG_INFINITY, f64::max);
            let mut mass = 0.0;
            for (p, &q) in by_value.iter_mut().zip(q) {
                *p = (beta * (q - largest)).exp();
                mass += *p;
            }
            let log_mass = mass.ln();
            for ((p, &q), &n) in by_value.iter_mut().zip(q).zip(n) {
                if n > 0.0 {
                    log_likelihood += self.power * n * (beta * (q - largest) - log_mass);
                }
                *p = self.power * beta * (n - visits * *p / mass);
            }
        }
        log_likelihood
    }

    /// Rows √(N(s) p(a|s)) β (dQ*(s,a)/dx − mean), one after another: their sum of squares is the Hessian of −ℓ at the point last
    /// evaluated, `x`, without the curvature of the scale.
    fn for_each_information_row(&self, x: &[f64], mut visit: impl FnMut(&[f64])) {
        let (n_actions, beta) = (self.model.mdp.n_actions(), self.model.rationality);
        let densities: Vec<f64> = x.iter().map(|&x| normal_density(x)).collect();
        let mut row = vec![0.0; x.len()];
        self.optimum.for_each_sensitivity(
            self.model.basis,
            |s| self.visits[s] > 0.0,
            |state, sensitivities| {
                let q = &self.optimum.action_values()[state * n_actions..(state + 1) * n_actions];
                let largest = q.iter().copied().fold(f64::NEG_INFINITY, f64::max);
                let masses: Vec<f64> = q.iter().map(|q| (beta * (q - largest)).exp()).collect();
                let mass: f64 = masses.iter().sum();
                let mut mean = vec![0.0; x.len()];
                for (m, sensitivity) in masses.iter().zip(sensitivities) {
                    super::optimum::axpy(m / mass, sensitivity, &mut mean);
                }
                for (m, sensitivity) in masses.iter().zip(sensitivities) {
                    let scale = beta * (self.power * self.visits[state] * m / mass).sqrt();
                    if scale > 0.0 {
                        for ((r, d), (s, mean)) in row.iter_mut().zip(&densities).zip(sensitivity.iter().zip(&mean)) {
                            *r = scale * d * (s - mean);
                        }
                        visit(&row);
                    }
                }
            },
        );
    }

    /// Hessian of −ℓ with respect to x at the point last evaluated, the curvature of the scale left out.
    pub(super) fn information(&self, x: &[f64]) -> DMatrix<f64> {
        let mut rows = Vec::new();
        self.for_each_information_row(x, |row| rows.extend_from_slice(row));
        let n_rows = rows.len() / x.len();
        let transposed = DMatrix::from_vec(x.len(), n_rows, rows);
        &transposed * transposed.transpose()
    }

    /// The diagonal of [`Target::information`], in memory of one row.
    pub(super) fn information_diagonal(&self, x: &[f64]) -> Vec<f64> {
        let mut diagonal = vec![0.0; x.len()];
        self.for_each_information_row(x, |row| {
            for (d, r) in diagonal.iter_mut().zip(row) {
                *d += r * r;
            }
        });
        diagonal
    }

    /// Multiplications that one evaluation takes, about.
    pub(super) fn cost(model: &Model<'_>) -> usize {
        let n = model.mdp.n_states();
        let transitions = model.mdp.next_states().len();
        let steps = if model.discount < 1.0 { 1 } else { model.horizon as usize };
        4 * n * n + 4 * transitions * steps + 40 * model.mdp.n_pairs() + 60 * model.basis.len()
    }
}

fn normal_cdf(x: f64) -> f64 {
    0.5 * libm::erfc(-x * std::f64::consts::FRAC_1_SQRT_2)
}

fn normal_density(x: f64) -> f64 {
    (-0.5 * x * x).exp() * 0.398_942_280_401_432_7
}

/// ½ a·b, for kinetic energies.
pub(super) fn half_dot(a: &[f64], b: &[f64]) -> f64 {
    0.5 * dot(a, b)
}
