//! Tabular models: their identity and their making from rows.
//!
//! Invariant: rows come in order of `s * n_actions + a`, next states rise within a row, each row sums to 1 within 1e-12.
//! Deliberately absent: planning and learning, which live with whoever receives the model.

use std::fmt::Write as _;

use sha2::{Digest, Sha256};

/// SHA-256 in lower-case hexadecimal over the sizes and rows of a transition function, as `ModelHeader.model_id` of
/// `mazeway/env/v1/model.proto` lays down.
///
/// `row_offsets` has shape `(n_states * n_actions + 1,)`; `next_states` and `probabilities` hold the entries.
pub fn model_id(
    n_states: u32,
    n_actions: u32,
    row_offsets: &[usize],
    next_states: &[u32],
    probabilities: &[f64],
) -> String {
    let mut hasher = Sha256::new();
    hasher.update(b"mazeway-model-v1");
    hasher.update(n_states.to_le_bytes());
    hasher.update(n_actions.to_le_bytes());
    for row in row_offsets.windows(2) {
        hasher.update(((row[1] - row[0]) as u32).to_le_bytes());
        for entry in row[0]..row[1] {
            hasher.update(next_states[entry].to_le_bytes());
            hasher.update(probabilities[entry].to_bits().to_le_bytes());
        }
    }
    hasher.finalize().iter().fold(String::with_capacity(64), |mut text, byte| {
        let _ = write!(text, "{byte:02x}");
        text
    })
}

/// Sparse rows under construction.
#[derive(Debug, Clone)]
pub(crate) struct Rows {
    pub(crate) offsets: Vec<usize>,
    pub(crate) next_states: Vec<u32>,
    pub(crate) probabilities: Vec<f64>,
}

impl Rows {
    pub(crate) fn new() -> Self {
        Self { offsets: vec![0], next_states: Vec::new(), probabilities: Vec::new() }
    }

    /// Appends one row; `entries` may repeat a state and hold zeros, and are sorted and merged here.
    pub(crate) fn push(&mut self, entries: &mut [(u32, f64)]) {
        entries.sort_by_key(|&(state, _)| state);
        let start = self.next_states.len();
        for &(state, probability) in entries.iter().filter(|&&(_, probability)| probability > 0.0) {
            if self.next_states.len() > start && self.next_states.last() == Some(&state) {
                *self.probabilities.last_mut().expect("pushed with the state") += probability;
            } else {
                self.next_states.push(state);
                self.probabilities.push(probability);
            }
        }
        self.offsets.push(self.next_states.len());
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn identity_is_the_hash_of_the_documented_bytes() {
        // One state, one action, one entry of probability 1, written out by hand.
        let mut bytes = b"mazeway-model-v1".to_vec();
        bytes.extend([1, 0, 0, 0, 1, 0, 0, 0, 1, 0, 0, 0, 0, 0, 0, 0]);
        bytes.extend([0, 0, 0, 0, 0, 0, 0xf0, 0x3f]);
        let id = model_id(1, 1, &[0, 1], &[0], &[1.0]);
        assert_eq!(id.len(), 64);
        for (byte, text) in Sha256::digest(&bytes).iter().zip(id.as_bytes().as_chunks::<2>().0) {
            assert_eq!(text, format!("{byte:02x}").as_bytes());
        }
    }

    #[test]
    fn identity_tells_rows_apart() {
        let id = |offsets: &[usize]| model_id(2, 1, offsets, &[0, 1, 1], &[0.5, 0.5, 1.0]);
        assert_ne!(id(&[0, 2, 3]), id(&[0, 1, 3]));
    }

    #[test]
    fn rows_merge_and_rise() {
        let mut rows = Rows::new();
        rows.push(&mut [(3, 0.25), (1, 0.5), (3, 0.25), (2, 0.0)]);
        assert_eq!(rows.next_states, [1, 3]);
        assert_eq!(rows.probabilities, [0.5, 0.5]);
        assert_eq!(rows.offsets, [0, 2]);
    }
}
