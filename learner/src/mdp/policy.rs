//! Stationary stochastic policies.

use super::numeric::{max, max_abs};

/// Action values that differ by less than this share of the largest magnitude count as tied.
///
/// Planners solve to about 1e-13, so true ties (symmetric mazes) stay ties and real differences stay differences.
pub const TIE_TOLERANCE: f64 = 1e-9;

/// π(a|s). Invariant: every row is a distribution over the actions.
#[derive(Debug, Clone, PartialEq)]
pub struct Policy {
    n_actions: usize,
    probabilities: Vec<f64>,
}

/// Why an array is not a policy.
#[derive(Debug, Clone, PartialEq, thiserror::Error)]
pub enum PolicyError {
    /// Not a whole number of rows.
    #[error("expected a positive multiple of {n_actions} probabilities, got {got}")]
    Length {
        /// Number of actions.
        n_actions: usize,
        /// What came.
        got: usize,
    },
    /// A row that is no distribution.
    #[error("expected probabilities of state {state} in [0, 1] that sum to 1, got a sum of {sum}")]
    Row {
        /// Row.
        state: usize,
        /// What came.
        sum: f64,
    },
}

impl Policy {
    /// Checks and keeps π(a|s), shape (`n_states * n_actions`,).
    ///
    /// # Errors
    /// A length that is no multiple of `n_actions`, rows that do not sum to 1 within 1e-9.
    pub fn new(n_actions: usize, probabilities: Vec<f64>) -> Result<Self, PolicyError> {
        if n_actions == 0 || probabilities.is_empty() || !probabilities.len().is_multiple_of(n_actions) {
            return Err(PolicyError::Length { n_actions, got: probabilities.len() });
        }
        for (state, row) in probabilities.chunks_exact(n_actions).enumerate() {
            let sum: f64 = row.iter().sum();
            if row.iter().any(|p| !(0.0..=1.0 + 1e-9).contains(p)) || (sum - 1.0).abs() > 1e-9 {
                return Err(PolicyError::Row { state, sum });
            }
        }
        Ok(Self { n_actions, probabilities })
    }

    /// Every action equally likely everywhere.
    #[must_use]
    pub fn uniform(n_states: usize, n_actions: usize) -> Self {
        Self { n_actions, probabilities: vec![1.0 / n_actions as f64; n_states * n_actions] }
    }

    /// Best actions, ties split evenly. Two values tie where they differ by at most [`TIE_TOLERANCE`] times the largest
    /// magnitude among all `action_values`, shape (`n_states * n_actions`,).
    #[must_use]
    pub fn greedy(n_actions: usize, action_values: &[f64]) -> Self {
        let margin = TIE_TOLERANCE * max_abs(action_values);
        let mut probabilities = vec![0.0; action_values.len()];
        for (row, values) in probabilities.chunks_exact_mut(n_actions).zip(action_values.chunks_exact(n_actions)) {
            let threshold = max(values) - margin;
            let share = 1.0 / values.iter().filter(|&&q| q >= threshold).count() as f64;
            for (p, &q) in row.iter_mut().zip(values) {
                *p = if q >= threshold { share } else { 0.0 };
            }
        }
        Self { n_actions, probabilities }
    }

    /// π(a|s) ∝ exp(inverse temperature · Q(s,a)).
    #[must_use]
    pub fn boltzmann(n_actions: usize, action_values: &[f64], inverse_temperature: f64) -> Self {
        let mut probabilities = vec![0.0; action_values.len()];
        for (row, values) in probabilities.chunks_exact_mut(n_actions).zip(action_values.chunks_exact(n_actions)) {
            let largest = max(values);
            let mut sum = 0.0;
            for (p, &q) in row.iter_mut().zip(values) {
                *p = (inverse_temperature * (q - largest)).exp();
                sum += *p;
            }
            for p in row {
                *p /= sum;
            }
        }
        Self { n_actions, probabilities }
    }

    /// Number of actions.
    pub fn n_actions(&self) -> usize {
        self.n_actions
    }

    /// Number of states.
    pub fn n_states(&self) -> usize {
        self.probabilities.len() / self.n_actions
    }

    /// π(·|s), shape (`n_actions`,).
    pub fn row(&self, state: usize) -> &[f64] {
        &self.probabilities[state * self.n_actions..(state + 1) * self.n_actions]
    }

    /// π(a|s), shape (`n_states * n_actions`,).
    pub fn probabilities(&self) -> &[f64] {
        &self.probabilities
    }

    /// π(a|s), shape (`n_states * n_actions`,).
    pub fn into_probabilities(self) -> Vec<f64> {
        self.probabilities
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn ties_are_split_by_relative_size() {
        let values = [1.0, 1.0, 0.5, 0.0, 0.0, 1e-12];
        let greedy = Policy::greedy(3, &values);
        assert_eq!(greedy.row(0), [0.5, 0.5, 0.0]);
        assert_eq!(greedy.row(1), [1.0 / 3.0; 3]);
        // the unit of the values does not matter
        for unit in [1e-6, 1e6] {
            let scaled: Vec<f64> = values.iter().map(|v| unit * v).collect();
            assert_eq!(Policy::greedy(3, &scaled), greedy);
        }
        assert_eq!(Policy::greedy(2, &[0.0; 4]), Policy::uniform(2, 2));
    }

    #[test]
    fn boltzmann_has_no_overflow() {
        let sharp = Policy::boltzmann(2, &[1e300, 0.0, -1e300, -1e300], 1.0);
        assert_eq!(sharp.probabilities(), [1.0, 0.0, 0.5, 0.5]);
    }

    #[test]
    fn rows_are_checked() {
        assert!(Policy::new(2, vec![0.5, 0.5]).is_ok());
        assert!(matches!(Policy::new(2, vec![0.5; 3]), Err(PolicyError::Length { .. })));
        assert!(matches!(Policy::new(0, vec![]), Err(PolicyError::Length { .. })));
        assert!(matches!(Policy::new(2, vec![1.0, 0.0, 0.5, 0.4]), Err(PolicyError::Row { state: 1, .. })));
        assert!(matches!(Policy::new(2, vec![2.0, -1.0]), Err(PolicyError::Row { state: 0, .. })));
        assert!(matches!(Policy::new(2, vec![f64::NAN, 1.0]), Err(PolicyError::Row { state: 0, .. })));
    }
}
