//! Policies over the tabular states, to draw actions from.

use super::RolloutError;
use crate::sim::{Rng, rng::uniform};

/// How far a row of a policy may be from summing to 1.
pub const ROW_SUM_TOLERANCE: f64 = 1e-6;

/// A checked policy over the tabular states, ready to be drawn from.
#[derive(Debug, Clone, PartialEq)]
pub struct TabularPolicy {
    n_actions: usize,
    /// Running sums of each row, shape `(n_states, n_actions)`.
    cumulative: Vec<f64>,
}

impl TabularPolicy {
    /// Checks π(a|s), shape `(n_states, n_actions)`.
    ///
    /// # Errors
    /// Another length, an entry that is negative or not finite, a row that does not sum to 1 within
    /// [`ROW_SUM_TOLERANCE`].
    pub fn new(probabilities: &[f64], n_states: u32, n_actions: u32) -> Result<Self, RolloutError> {
        let expected = n_states as usize * n_actions as usize;
        if probabilities.len() != expected {
            return Err(RolloutError::PolicyShape { expected, got: probabilities.len(), n_states, n_actions });
        }
        let mut cumulative = Vec::with_capacity(expected);
        for (state, row) in probabilities.chunks_exact(n_actions as usize).enumerate() {
            let mut sum = 0.0;
            for (action, &value) in row.iter().enumerate() {
                if !value.is_finite() || value < 0.0 {
                    return Err(RolloutError::PolicyEntry { state, action, value });
                }
                sum += value;
                cumulative.push(sum);
            }
            if (sum - 1.0).abs() > ROW_SUM_TOLERANCE {
                return Err(RolloutError::PolicyRow { state, sum });
            }
        }
        Ok(Self { n_actions: n_actions as usize, cumulative })
    }

    /// Draws an action in `state` by the inverse of the cumulative distribution.
    #[inline]
    pub fn draw(&self, state: u32, rng: &mut Rng) -> u32 {
        let row = &self.cumulative[state as usize * self.n_actions..][..self.n_actions];
        let total = row[self.n_actions - 1];
        let u = uniform(rng) * total;
        // The sums never fall: the first above u has as many below it. Counting needs no branch that nobody can foretell.
        let below: u32 = row.iter().map(|&sum| u32::from(sum <= u)).sum();
        if below as usize == self.n_actions {
            // The product has rounded up to the total: then it is the last action of positive probability.
            return row.partition_point(|&sum| sum < total) as u32;
        }
        below
    }

    /// Number of entries.
    pub(super) fn len(&self) -> usize {
        self.cumulative.len()
    }

    /// Number of actions.
    pub(super) fn n_actions(&self) -> u32 {
        self.n_actions as u32
    }
}
