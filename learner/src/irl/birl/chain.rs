//! One Markov chain: Hamiltonian Monte Carlo (Neal 2011) with a metric learned in the warm-up.
//!
//! The metric is 1 (the prior's precision) plus the information of the likelihood, averaged over points of the warm-up, so
//! that what the data determine sharply and what they leave open move at the same pace. Step sizes follow dual averaging
//! (Hoffman & Gelman 2014), the length of a trajectory is drawn anew for every draw. After the warm-up nothing adapts.
//! Invariant: a chain depends on its seed and index alone.

use super::optimum::{axpy, multiply};
use super::target::{Model, Point, Target, half_dot};
use crate::irl::random::Stream;
use nalgebra::{Cholesky, DMatrix};

/// Wanted acceptance.
const TARGET_ACCEPTANCE: f64 = 0.7;
/// Mean length of a trajectory in units of the metric: a quarter of the period of a Gaussian of unit metric.
const LENGTH: f64 = std::f64::consts::FRAC_PI_2;
/// Steps of one trajectory at most.
const MAX_STEPS: u32 = 64;
/// Up to this many weights the metric is dense.
const DENSE_METRIC: usize = 400;

pub(super) struct Chain<'a> {
    target: Target<'a>,
    stream: Stream,
    x: Vec<f64>,
    point: Point,
    metric: Metric,
    step: StepSize,
    warm_up: u32,
    iteration: u32,
    /// Kept draws of w, flat.
    pub(super) draws: Vec<f64>,
    /// Sum of acceptance probabilities of kept draws.
    pub(super) accepted: f64,
    /// Mean log-posterior of the block last made.
    pub(super) log_posterior: f64,
}

impl<'a> Chain<'a> {
    /// Starts from a draw of the uniform prior.
    pub(super) fn new(model: Model<'a>, seed: u64, index: u64, warm_up: u32) -> Self {
        let mut stream = Stream::new(seed, index);
        let mut target = Target::new(model);
        let n = model.basis.len();
        let x: Vec<f64> = (0..n).map(|_| stream.normal()).collect();
        if warm_up > 0 {
            target.temper(1.0 / f64::from(warm_up / 4 + 1));
        }
        let point = target.evaluate(&x);
        let mut chain = Self {
            target,
            stream,
            x,
            point,
            metric: Metric::unit(n),
            step: StepSize::new(),
            warm_up,
            iteration: 0,
            draws: Vec::new(),
            accepted: 0.0,
            log_posterior: 0.0,
        };
        chain.start_metric();
        chain
    }

    pub(super) fn is_finite(&self) -> bool {
        self.point.is_finite()
    }

    /// Makes `n` iterations.
    pub(super) fn advance(&mut self, n: u32) {
        let mut sum = 0.0;
        for _ in 0..n {
            let acceptance = self.iterate();
            self.iteration += 1;
            if self.iteration <= self.warm_up {
                self.adapt(acceptance);
            } else {
                self.accepted += acceptance;
                self.draws.extend_from_slice(&self.point.weights);
            }
            sum += self.point.log_posterior;
        }
        self.log_posterior = sum / f64::from(n);
    }

    /// One trajectory; the probability with which its end was to be accepted.
    fn iterate(&mut self) -> f64 {
        let n = self.x.len();
        let noise: Vec<f64> = (0..n).map(|_| self.stream.normal()).collect();
        let mut momentum = self.metric.momentum(&noise);
        let length = LENGTH * (0.5 + self.stream.uniform());
        let threshold = self.stream.uniform();
        let step = if self.iteration < self.warm_up { self.step.current() } else { self.step.settled() };
        let steps = ((length / step).ceil() as u32).clamp(1, MAX_STEPS);
        let mut velocity = self.metric.velocity(&momentum);
        let energy = half_dot(&momentum, &velocity) - self.point.log_density;
        let mut x = self.x.clone();
        let mut point = None;
        axpy(0.5 * step, &self.point.gradient, &mut momentum);
        for i in 1..=steps {
            self.metric.velocity_into(&momentum, &mut velocity);
            axpy(step, &velocity, &mut x);
            let here = self.target.evaluate(&x);
            if !here.is_finite() {
                return 0.0;
            }
            axpy(if i < steps { step } else { 0.5 * step }, &here.gradient, &mut momentum);
            point = Some(here);
        }
        let Some(point) = point else { return 0.0 };
        self.metric.velocity_into(&momentum, &mut velocity);
        let change = energy - (half_dot(&momentum, &velocity) - point.log_density);
        if change.is_nan() {
            return 0.0;
        }
        let acceptance = change.min(0.0).exp();
        if threshold < acceptance {
            self.x = x;
            self.point = point;
        }
        acceptance
    }

    /// The warm-up's schedule: the likelihood comes to its full power in the first quarter, lest a chain be caught where it
    /// happened to begin; metrics of single points at first, then of the mean over points that look like the posterior.
    fn adapt(&mut self, acceptance: f64) {
        self.step.update(acceptance);
        let (i, w) = (self.iteration, self.warm_up);
        if i <= w / 4 {
            self.target.temper(f64::from(i + 1) / f64::from(w / 4 + 1));
            self.refresh_point();
        }
        let collect_from = w / 4;
        let every = (w / 24).max(1);
        if i < collect_from {
            if i == w / 32 || i == w / 16 || i == w / 8 {
                self.start_metric();
            }
        } else {
            if (i - collect_from).is_multiple_of(every) && i <= 5 * w / 8 {
                self.refresh_point();
                self.metric.collect(&self.target, &self.x, &self.point.gradient);
            }
            if i == collect_from || i == w / 2 || i == 5 * w / 8 {
                self.metric.renew();
                self.step.restart();
            }
        }
    }

    fn start_metric(&mut self) {
        if self.is_finite() {
            self.refresh_point();
            self.metric = Metric::unit(self.x.len());
            self.metric.collect(&self.target, &self.x, &self.point.gradient);
            self.metric.renew();
            self.metric.forget();
            self.step.restart();
        }
    }

    /// The target's derivatives are those of the point last evaluated, which a rejected trajectory leaves elsewhere.
    fn refresh_point(&mut self) {
        self.point = self.target.evaluate(&self.x);
    }
}

/// M of the kinetic energy ½ pᵀM⁻¹p.
struct Metric {
    collected: u32,
    /// Sum of x dℓ/dx: the part of the Hessian of −ℓ that the change of scale makes, on the diagonal.
    curvature: Vec<f64>,
    kind: Kind,
}

enum Kind {
    /// Sum of information; M⁻¹; L of M = LLᵀ.
    Dense { sum: DMatrix<f64>, inverse: DMatrix<f64>, factor: DMatrix<f64> },
    /// Sum of information; M.
    Diagonal { sum: Vec<f64>, metric: Vec<f64> },
}

impl Metric {
    fn unit(n: usize) -> Self {
        let kind = if n <= DENSE_METRIC {
            let unit = DMatrix::identity(n, n);
            Kind::Dense { sum: DMatrix::zeros(n, n), inverse: unit.clone(), factor: unit }
        } else {
            Kind::Diagonal { sum: vec![0.0; n], metric: vec![1.0; n] }
        };
        Self { collected: 0, curvature: vec![0.0; n], kind }
    }

    /// `gradient` is that of the log-density at `x`, the point last evaluated.
    fn collect(&mut self, target: &Target<'_>, x: &[f64], gradient: &[f64]) {
        for ((c, x), g) in self.curvature.iter_mut().zip(x).zip(gradient) {
            *c += x * (g + x);
        }
        match &mut self.kind {
            Kind::Dense { sum, .. } => *sum += target.information(x),
            Kind::Diagonal { sum, .. } => axpy(1.0, &target.information_diagonal(x), sum),
        }
        self.collected += 1;
    }

    fn forget(&mut self) {
        self.collected = 0;
        self.curvature.fill(0.0);
        match &mut self.kind {
            Kind::Dense { sum, .. } => sum.fill(0.0),
            Kind::Diagonal { sum, .. } => sum.fill(0.0),
        }
    }

    /// Takes the mean of what was collected; a metric that is none in floating point leaves the former in force.
    fn renew(&mut self) {
        if self.collected == 0 {
            return;
        }
        let share = 1.0 / f64::from(self.collected);
        match &mut self.kind {
            Kind::Dense { sum, inverse, factor } => {
                let mut metric = &*sum * share;
                for i in 0..metric.nrows() {
                    metric[(i, i)] += 1.0 + (share * self.curvature[i]).max(0.0);
                }
                if let Some(cholesky) = Cholesky::new(metric) {
                    *inverse = cholesky.inverse();
                    *factor = cholesky.unpack();
                }
            }
            Kind::Diagonal { sum, metric } => {
                for ((m, s), c) in metric.iter_mut().zip(sum).zip(&self.curvature) {
                    *m = 1.0 + share * (*s + c.max(0.0));
                }
            }
        }
    }

    /// A momentum of covariance M from standard normal noise.
    fn momentum(&self, noise: &[f64]) -> Vec<f64> {
        match &self.kind {
            Kind::Dense { factor, .. } => {
                let mut momentum = vec![0.0; noise.len()];
                for (column, &z) in factor.as_slice().chunks_exact(noise.len()).zip(noise) {
                    axpy(z, column, &mut momentum);
                }
                momentum
            }
            Kind::Diagonal { metric, .. } => metric.iter().zip(noise).map(|(m, z)| m.sqrt() * z).collect(),
        }
    }

    fn velocity(&self, momentum: &[f64]) -> Vec<f64> {
        let mut velocity = vec![0.0; momentum.len()];
        self.velocity_into(momentum, &mut velocity);
        velocity
    }

    /// M⁻¹p.
    fn velocity_into(&self, momentum: &[f64], velocity: &mut [f64]) {
        match &self.kind {
            Kind::Dense { inverse, .. } => {
                multiply(inverse.as_slice(), momentum, velocity);
            }
            Kind::Diagonal { metric, .. } => {
                for ((v, p), m) in velocity.iter_mut().zip(momentum).zip(metric) {
                    *v = p / m;
                }
            }
        }
    }
}

/// Dual averaging of the logarithm of the step size, Hoffman & Gelman (2014) eq. 6.
struct StepSize {
    updates: f64,
    error: f64,
    log_step: f64,
    log_mean: f64,
    centre: f64,
}

const FIRST_STEP: f64 = 0.4;
const SMALLEST_STEP: f64 = 1e-6;

impl StepSize {
    fn new() -> Self {
        Self {
            updates: 0.0,
            error: 0.0,
            log_step: FIRST_STEP.ln(),
            log_mean: FIRST_STEP.ln(),
            centre: (2.0 * FIRST_STEP).ln(),
        }
    }

    /// Forgets all but the present step.
    fn restart(&mut self) {
        let step = self.current().clamp(0.05, FIRST_STEP);
        *self = Self { log_step: step.ln(), log_mean: step.ln(), centre: (2.0 * step).ln(), ..Self::new() };
    }

    fn update(&mut self, acceptance: f64) {
        self.updates += 1.0;
        let t = self.updates;
        let share = 1.0 / (t + 10.0);
        self.error = (1.0 - share) * self.error + share * (TARGET_ACCEPTANCE - acceptance);
        self.log_step = (self.centre - t.sqrt() / 0.05 * self.error).clamp(SMALLEST_STEP.ln(), 0.5);
        let weight = t.powf(-0.75);
        self.log_mean = weight * self.log_step + (1.0 - weight) * self.log_mean;
    }

    fn current(&self) -> f64 {
        self.log_step.exp()
    }

    fn settled(&self) -> f64 {
        self.log_mean.exp()
    }
}
