//! Whether predicted probabilities of actions come true: reliability, and the expected calibration error.
//!
//! Every step makes one prediction for each action, which came true or did not. Predictions are sorted into bins of equal width;
//! in a calibrated policy, actions predicted with 0.3 are taken three times in ten. Naeini, Cooper & Hauskrecht (2015) define
//! the expected calibration error, Σ_b (n_b / n) |observed_b − predicted_b|; here over all actions rather than the likeliest alone
//! (class-wise, Kull et al. 2019), since an expert may well take any of several.

use serde::{Deserialize, Serialize};

/// Bins between 0 and 1.
pub const BINS: usize = 10;

/// Predictions of about one probability.
#[derive(Debug, Clone, Copy, PartialEq, Default, Serialize, Deserialize)]
pub struct Bin {
    /// How many predictions.
    pub predictions: u64,
    /// Mean predicted probability; 0 for no prediction.
    pub predicted: f64,
    /// Share of them that came true; 0 for no prediction.
    pub observed: f64,
}

/// How well predicted probabilities fit what happened.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct Calibration {
    /// Bins of equal width from 0 to 1, [`BINS`] of them.
    pub bins: Vec<Bin>,
    /// Expected calibration error, in [0, 1].
    pub expected_error: f64,
}

/// Gathers predictions.
#[derive(Debug, Clone, Default)]
pub struct CalibrationBuilder {
    bins: [Bin; BINS],
}

impl CalibrationBuilder {
    /// One step: π(·|s), shape (`n_actions`,), and the action taken.
    pub fn add(&mut self, probabilities: &[f64], action: usize) {
        for (candidate, &p) in probabilities.iter().enumerate() {
            let bin = &mut self.bins[((p * BINS as f64) as usize).min(BINS - 1)];
            bin.predictions += 1;
            bin.predicted += p;
            bin.observed += f64::from(u8::from(candidate == action));
        }
    }

    /// All steps of the other.
    pub fn merge(&mut self, other: &Self) {
        for (bin, other) in self.bins.iter_mut().zip(&other.bins) {
            bin.predictions += other.predictions;
            bin.predicted += other.predicted;
            bin.observed += other.observed;
        }
    }

    /// The result; `None` for no step.
    pub fn finish(self) -> Option<Calibration> {
        let all: u64 = self.bins.iter().map(|bin| bin.predictions).sum();
        if all == 0 {
            return None;
        }
        let bins: Vec<Bin> = self
            .bins
            .iter()
            .map(|bin| {
                let n = bin.predictions.max(1) as f64;
                Bin { predictions: bin.predictions, predicted: bin.predicted / n, observed: bin.observed / n }
            })
            .collect();
        let gap = |bin: &Bin| bin.predictions as f64 * (bin.observed - bin.predicted).abs();
        let expected_error = bins.iter().map(gap).sum::<f64>() / all as f64;
        Some(Calibration { bins, expected_error })
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn predictions_that_come_true_have_no_error() {
        let mut builder = CalibrationBuilder::default();
        for step in 0..10 {
            builder.add(&[0.3, 0.7], usize::from(step >= 3));
            builder.add(&[1.0, 0.0], 0);
        }
        let calibration = builder.finish().expect("steps");
        assert!(calibration.expected_error < 1e-12, "{calibration:?}");
        assert_eq!(calibration.bins.iter().map(|bin| bin.predictions).sum::<u64>(), 40);
        assert!((calibration.bins[9].observed - 1.0).abs() < 1e-12);
        assert_eq!(CalibrationBuilder::default().finish(), None);
    }

    #[test]
    fn overconfidence_is_an_error_of_its_size() {
        let mut builder = CalibrationBuilder::default();
        for step in 0..10 {
            builder.add(&[0.9, 0.1], usize::from(step >= 6));
        }
        let calibration = builder.finish().expect("steps");
        assert!((calibration.expected_error - 0.3).abs() < 1e-12, "{}", calibration.expected_error);
    }

    #[test]
    fn parts_add_up() {
        let (mut whole, mut left, mut right) = Default::default();
        for step in 0..7_usize {
            let row = [0.1 * step as f64, 1.0 - 0.1 * step as f64];
            CalibrationBuilder::add(&mut whole, &row, step % 2);
            let part: &mut CalibrationBuilder = if step < 3 { &mut left } else { &mut right };
            part.add(&row, step % 2);
        }
        left.merge(&right);
        let (whole, parts) = (whole.finish().expect("steps"), left.finish().expect("steps"));
        assert!((whole.expected_error - parts.expected_error).abs() < 1e-12);
    }
}
