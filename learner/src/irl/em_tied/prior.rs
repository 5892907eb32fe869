//! The sparse prior of `spike_slab`: what it believes of a reward, and the parameters it learns.

/// Mean and standard deviation of log μ, a reward against the temperature: from about 4 to about 90.
pub(super) const LOG_SCALE: (f64, f64) = (3.0, 0.75);
/// The same of log(shape of the Gamma): 1 is exponential, a large one makes all rewards alike.
pub(super) const LOG_SHAPE: (f64, f64) = (0.7, 0.3);
/// ρ ~ Beta(this, 1): before any data, rewards are alike.
pub(super) const ALIKE: f64 = 9.0;
/// p ~ Beta(1, this × number of weights): before any data, about two rewards are expected.
pub(super) const SPARSITY: f64 = 0.5;

/// What the prior's parameters are, or are held at.
#[derive(Debug, Clone, Copy)]
pub(super) struct Prior {
    /// p: probability that a weight is not 0.
    pub inclusion: f64,
    /// ρ: probability that one that is not 0 is the full reward.
    pub full: f64,
    /// μ: the full reward, and the mean of the others.
    pub scale: f64,
    /// Shape of the Gamma distribution of the others.
    pub shape: f64,
}

impl Prior {
    /// Where a chain begins; with a strength all but p is held: rewards are exponential of that rate.
    pub(super) fn begin(strength: Option<f64>) -> Self {
        match strength {
            None => {
                Self { inclusion: 0.1, full: ALIKE / (ALIKE + 1.0), scale: LOG_SCALE.0.exp(), shape: LOG_SHAPE.0.exp() }
            }
            Some(strength) => Self { inclusion: 0.1, full: 0.0, scale: 1.0 / strength, shape: 1.0 },
        }
    }

    /// log density of u where it is neither 0 nor 1.
    pub(super) fn log_slab(&self, u: f64) -> f64 {
        let k = self.shape;
        (k - 1.0) * u.ln() - k * u + k * k.ln() - libm::lgamma(k)
    }
}

/// log density of a log-normal parameter against its logarithm, but for a constant.
pub(super) fn log_hyper(x: f64, (mean, deviation): (f64, f64)) -> f64 {
    -0.5 * ((x.ln() - mean) / deviation).powi(2)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_slab_is_a_density() {
        let prior = Prior { inclusion: 0.1, full: 0.5, scale: 3.0, shape: 2.5 };
        let step = 0.001;
        let points = (0..60_000).map(|i| (f64::from(i) + 0.5) * step);
        let (mass, mean) = points.fold((0.0, 0.0), |(mass, mean), x| {
            let p = prior.log_slab(x).exp() * step;
            (mass + p, mean + x * p)
        });
        assert!((mass - 1.0).abs() < 1e-6 && (mean - 1.0).abs() < 1e-5, "{mass} {mean}");
    }
}
