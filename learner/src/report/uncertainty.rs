//! What the data leave open: standard errors or a posterior of each weight, and how it is put in words.
//!
//! Invariant: a weight that the data do not determine has an infinite interval here, whatever stood for it before, and is named
//! so wherever it is shown.

use super::format::{brief, clip, count};
use super::{Report, ReportError};
use crate::irl::{Diagnostics, Posterior};

/// Standard normal quantile of 0.975.
const Z: f64 = 1.959_963_984_540_054;

/// A standard error of so many times the largest weight says nothing.
pub const HOPELESS: f64 = 1e3;

/// Intervals of the weights.
#[derive(Debug, Clone, PartialEq)]
pub struct Uncertainty {
    /// Where they come from.
    pub source: UncertaintySource,
    /// Standard errors or posterior standard deviations, shape (B,); infinite where not determined.
    pub standard_deviations: Vec<f64>,
    /// Lower ends of the 95 % intervals, shape (B,).
    pub low: Vec<f64>,
    /// Upper ends, shape (B,).
    pub high: Vec<f64>,
    /// How well a posterior was sampled.
    pub diagnostics: Option<Diagnostics>,
}

/// Where intervals come from.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum UncertaintySource {
    /// The exact Hessian of an unpenalised likelihood.
    StandardErrors,
    /// A posterior.
    Posterior,
}

impl Uncertainty {
    /// Normal intervals from standard errors. Those that are no number are not determined, and so are those of more than
    /// [`HOPELESS`] times the largest weight: a Hessian that is singular but for rounding.
    pub fn from_standard_errors(weights: &[f64], standard_errors: &[f64]) -> Self {
        let most = weights.iter().filter(|w| w.is_finite()).fold(0.0, |most: f64, w| most.max(w.abs()));
        let limit = if most > 0.0 { HOPELESS * most } else { f64::INFINITY };
        let known = |se: f64| if se.is_finite() && se <= limit { se } else { f64::INFINITY };
        let sd: Vec<f64> = standard_errors.iter().map(|&se| known(se)).collect();
        let end = |sign: f64| weights.iter().zip(&sd).map(|(w, sd)| w + sign * Z * sd).collect();
        Self {
            source: UncertaintySource::StandardErrors,
            low: end(-1.0),
            high: end(1.0),
            standard_deviations: sd,
            diagnostics: None,
        }
    }

    /// The central intervals of a posterior.
    pub fn from_posterior(posterior: Posterior) -> Self {
        let or = |values: Vec<f64>, missing: f64| -> Vec<f64> {
            values.into_iter().map(|x| if x.is_nan() { missing } else { x }).collect()
        };
        Self {
            source: UncertaintySource::Posterior,
            standard_deviations: or(posterior.standard_deviations, f64::INFINITY),
            low: or(posterior.low, f64::NEG_INFINITY),
            high: or(posterior.high, f64::INFINITY),
            diagnostics: posterior.diagnostics,
        }
    }

    /// Whether the data say anything about a weight.
    pub fn determined(&self, weight: usize) -> bool {
        (self.high[weight] - self.low[weight]).is_finite()
    }

    /// Width of a weight's interval; infinite where it is not determined.
    pub fn width(&self, weight: usize) -> f64 {
        if self.determined(weight) { self.high[weight] - self.low[weight] } else { f64::INFINITY }
    }

    /// Weights that the data do not determine.
    pub fn undetermined(&self) -> usize {
        (0..self.low.len()).filter(|&weight| !self.determined(weight)).count()
    }

    /// `[0.12, 0.31]`.
    pub(crate) fn interval(&self, weight: usize) -> String {
        if self.determined(weight) {
            format!("[{}, {}]", brief(self.low[weight]), brief(self.high[weight]))
        } else {
            "not determined".to_owned()
        }
    }

    /// Shapes against the number of weights.
    pub(crate) fn check(&self, weights: usize) -> Result<(), ReportError> {
        for (field, got) in [
            ("uncertainty.standard_deviations", self.standard_deviations.len()),
            ("uncertainty.low", self.low.len()),
            ("uncertainty.high", self.high.len()),
        ] {
            if got != weights {
                return Err(ReportError::Shape { field, expected: weights, got });
            }
        }
        Ok(())
    }

    /// One line about it.
    pub(crate) fn summary(&self) -> String {
        let n = self.low.len();
        let what = match self.source {
            UncertaintySource::StandardErrors => "95 % intervals from the exact Hessian",
            UncertaintySource::Posterior => "95 % intervals of the posterior",
        };
        let open = match self.undetermined() {
            0 => String::new(),
            some => format!("; {} of {} weights not determined by the data", count(some as f64), count(n as f64)),
        };
        let chains = self.diagnostics.as_ref().map_or_else(String::new, |diagnostics| {
            let finite = |values: &[f64]| -> Vec<f64> { values.iter().copied().filter(|x| x.is_finite()).collect() };
            let rhat = finite(&diagnostics.split_rhat).into_iter().fold(f64::NAN, f64::max);
            let size = finite(&diagnostics.effective_sample_size).into_iter().fold(f64::NAN, f64::min);
            format!(
                "; {} chains of {} draws, split R̂ at most {}, at least {} effective draws",
                diagnostics.chains,
                diagnostics.draws,
                super::format::fixed(rhat, 3),
                count(size.floor())
            )
        });
        format!("{what} of {} weights{open}{chains}", count(n as f64))
    }
}

impl Report {
    /// Name of a weight, at most `most` characters: of its state, its state and action, or its rank.
    pub(crate) fn weight_name(&self, weight: usize, most: usize) -> String {
        let (s, a) = (self.states(), self.actions());
        match self.weight_names.get(weight) {
            Some(name) => clip(name, most),
            None if self.weights.len() == s => self.state_name(weight, most),
            None if self.weights.len() == s * a => {
                clip(&format!("{}, {}", self.state_name(weight / a, most), self.action_name(weight % a, most)), most)
            }
            None => format!("weight {weight}"),
        }
    }

    /// The weights to show, at most `most`: the largest in size, in their order.
    pub(crate) fn leading_weights(&self, most: usize) -> Vec<usize> {
        let mut weights: Vec<usize> = (0..self.weights.len()).collect();
        if weights.len() > most {
            let size = |weight: usize| self.weights[weight].abs();
            weights.sort_by(|&i, &j| size(j).total_cmp(&size(i)).then(i.cmp(&j)));
            weights.truncate(most);
            weights.sort_unstable();
        }
        weights
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn what_is_not_determined_is_called_so() {
        let uncertainty = Uncertainty::from_standard_errors(&[1.0, 2.0, 3.0], &[0.5, f64::NAN, 4e3]);
        assert_eq!(uncertainty.undetermined(), 2);
        assert!((uncertainty.low[0] - 0.02).abs() < 1e-3 && (uncertainty.high[0] - 1.98).abs() < 1e-3);
        assert_eq!(uncertainty.interval(1), "not determined");
        assert!(uncertainty.width(2).is_infinite() && uncertainty.standard_deviations[1].is_infinite());
        assert!(uncertainty.summary().contains("2 of 3 weights not determined"), "{}", uncertainty.summary());
        assert!(uncertainty.check(3).is_ok() && uncertainty.check(4).is_err());
    }

    #[test]
    fn a_posterior_tells_how_well_it_was_sampled() {
        let posterior = Posterior {
            standard_deviations: vec![0.1, 0.2],
            low: vec![0.0, 0.1],
            high: vec![0.4, 0.9],
            diagnostics: Some(Diagnostics {
                chains: 4,
                draws: 500,
                acceptance: 0.8,
                split_rhat: vec![1.001, 1.012],
                effective_sample_size: vec![812.7, 1500.0],
            }),
        };
        let text = Uncertainty::from_posterior(posterior).summary();
        assert!(text.contains("split R̂ at most 1.012, at least 812 effective draws"), "{text}");
    }
}
