//! The transition model: sparse rows that are known to be distributions.

/// A finite Markov decision process without a reward.
///
/// Invariants: at least one state and one action; each row P(·|s,a) is a distribution over `0..n_states` stored as strictly
/// rising columns; so is the initial distribution. A terminal state is one that all actions leave unchanged.
#[derive(Debug, Clone, PartialEq)]
pub struct TabularMdp {
    n_states: usize,
    n_actions: usize,
    row_offsets: Vec<usize>,
    next_states: Vec<u32>,
    probabilities: Vec<f64>,
    initial_distribution: Vec<f64>,
}

/// How far a sum of probabilities may lie from 1.
const SUM_TOLERANCE: f64 = 1e-9;

/// Why arrays are not a Markov decision process.
#[derive(Debug, Clone, PartialEq, thiserror::Error)]
pub enum MdpError {
    /// No state or no action.
    #[error("expected at least one state and one action, got {n_states} states and {n_actions} actions")]
    Empty {
        /// Number of states.
        n_states: usize,
        /// Number of actions.
        n_actions: usize,
    },
    /// More pairs than can be counted.
    #[error("expected at most 4294967295 state-action pairs, got {n_states} states times {n_actions} actions")]
    TooLarge {
        /// Number of states.
        n_states: usize,
        /// Number of actions.
        n_actions: usize,
    },
    /// Offsets are not those of `n_states * n_actions` rows.
    #[error("expected {expected} row offsets rising from 0 to the number of transitions, got {reason}")]
    RowOffsets {
        /// Number of offsets wanted.
        expected: usize,
        /// What is wrong.
        reason: String,
    },
    /// Columns and probabilities differ in length.
    #[error(
        "expected as many probabilities as next states, got {next_states} next states and {probabilities} probabilities"
    )]
    Ragged {
        /// Length of the columns.
        next_states: usize,
        /// Length of the values.
        probabilities: usize,
    },
    /// A next state outside the state set, or not in rising order.
    #[error(
        "expected next states rising and below {n_states} in row (state {state}, action {action}), got {next_state}"
    )]
    NextState {
        /// Row.
        state: usize,
        /// Row.
        action: usize,
        /// What came.
        next_state: u32,
        /// Size of the state set.
        n_states: usize,
    },
    /// Not a probability.
    #[error("expected probabilities in [0, 1] in row (state {state}, action {action}), got {probability}")]
    Probability {
        /// Row.
        state: usize,
        /// Row.
        action: usize,
        /// What came.
        probability: f64,
    },
    /// A row that is no distribution.
    #[error("expected row (state {state}, action {action}) to sum to 1, got {sum}")]
    RowSum {
        /// Row.
        state: usize,
        /// Row.
        action: usize,
        /// What came.
        sum: f64,
    },
    /// The initial distribution has another length.
    #[error("expected an initial distribution over {expected} states, got {got} entries")]
    InitialLength {
        /// Number of states.
        expected: usize,
        /// What came.
        got: usize,
    },
    /// The initial distribution is none.
    #[error("expected an initial distribution with entries in [0, 1] that sum to 1, got {reason}")]
    InitialDistribution {
        /// What is wrong.
        reason: String,
    },
}

impl TabularMdp {
    /// Checks and keeps a model.
    ///
    /// Row r = s * `n_actions` + a holds the entries `row_offsets[r]..row_offsets[r + 1]` of `next_states` and
    /// `probabilities`. Without an initial distribution, all states are equally likely.
    ///
    /// # Errors
    /// Sizes that do not fit together, indices out of range or out of order, rows that do not sum to 1 within 1e-9.
    pub fn new(
        n_states: usize,
        n_actions: usize,
        row_offsets: Vec<usize>,
        next_states: Vec<u32>,
        probabilities: Vec<f64>,
        initial_distribution: Option<Vec<f64>>,
    ) -> Result<Self, MdpError> {
        if n_states == 0 || n_actions == 0 {
            return Err(MdpError::Empty { n_states, n_actions });
        }
        let n_rows = n_states
            .checked_mul(n_actions)
            .filter(|&n| u32::try_from(n).is_ok())
            .ok_or(MdpError::TooLarge { n_states, n_actions })?;
        let wrong_offsets = |reason: String| MdpError::RowOffsets { expected: n_rows + 1, reason };
        if row_offsets.len() != n_rows + 1 {
            return Err(wrong_offsets(format!("{} offsets", row_offsets.len())));
        }
        if next_states.len() != probabilities.len() {
            return Err(MdpError::Ragged { next_states: next_states.len(), probabilities: probabilities.len() });
        }
        if row_offsets[0] != 0 || row_offsets[n_rows] != next_states.len() {
            let (first, last) = (row_offsets[0], row_offsets[n_rows]);
            return Err(wrong_offsets(format!("{first} to {last} for {} transitions", next_states.len())));
        }
        if let Some(row) = row_offsets.windows(2).position(|pair| pair[0] > pair[1]) {
            return Err(wrong_offsets(format!("a fall after row {row}")));
        }
        for row in 0..n_rows {
            let (state, action) = (row / n_actions, row % n_actions);
            let entries = row_offsets[row]..row_offsets[row + 1];
            let mut sum = 0.0;
            for (i, entry) in entries.clone().enumerate() {
                let (next_state, probability) = (next_states[entry], probabilities[entry]);
                if next_state as usize >= n_states || (i > 0 && next_states[entry - 1] >= next_state) {
                    return Err(MdpError::NextState { state, action, next_state, n_states });
                }
                if !(0.0..=1.0 + SUM_TOLERANCE).contains(&probability) {
                    return Err(MdpError::Probability { state, action, probability });
                }
                sum += probability;
            }
            if (sum - 1.0).abs() > SUM_TOLERANCE {
                return Err(MdpError::RowSum { state, action, sum });
            }
        }
        let initial_distribution = match initial_distribution {
            None => vec![1.0 / n_states as f64; n_states],
            Some(initial) => {
                if initial.len() != n_states {
                    return Err(MdpError::InitialLength { expected: n_states, got: initial.len() });
                }
                if let Some(p) = initial.iter().find(|p| !(0.0..=1.0 + SUM_TOLERANCE).contains(*p)) {
                    return Err(MdpError::InitialDistribution { reason: format!("the entry {p}") });
                }
                let sum: f64 = initial.iter().sum();
                if (sum - 1.0).abs() > SUM_TOLERANCE {
                    return Err(MdpError::InitialDistribution { reason: format!("a sum of {sum}") });
                }
                initial
            }
        };
        Ok(Self { n_states, n_actions, row_offsets, next_states, probabilities, initial_distribution })
    }

    /// Number of states.
    pub fn n_states(&self) -> usize {
        self.n_states
    }

    /// Number of actions.
    pub fn n_actions(&self) -> usize {
        self.n_actions
    }

    /// Number of state-action pairs.
    pub fn n_pairs(&self) -> usize {
        self.n_states * self.n_actions
    }

    /// Index of a state-action pair in flat arrays.
    pub fn pair(&self, state: usize, action: usize) -> usize {
        state * self.n_actions + action
    }

    /// P(·|s,a) of a pair: next states in rising order and their probabilities.
    pub fn row(&self, pair: usize) -> (&[u32], &[f64]) {
        let entries = self.row_offsets[pair]..self.row_offsets[pair + 1];
        (&self.next_states[entries.clone()], &self.probabilities[entries])
    }

    /// Where each row begins, shape (`n_states * n_actions + 1`,).
    pub fn row_offsets(&self) -> &[usize] {
        &self.row_offsets
    }

    /// Columns of all rows, shape (`n_transitions`,).
    pub fn next_states(&self) -> &[u32] {
        &self.next_states
    }

    /// Probabilities of all rows, shape (`n_transitions`,).
    pub fn probabilities(&self) -> &[f64] {
        &self.probabilities
    }

    /// p(s₁), shape (`n_states`,).
    pub fn initial_distribution(&self) -> &[f64] {
        &self.initial_distribution
    }

    /// Σ P(s'|s,a) values(s') of one pair.
    pub fn expected(&self, pair: usize, values: &[f64]) -> f64 {
        let (states, probabilities) = self.row(pair);
        states.iter().zip(probabilities).map(|(&s, &p)| p * values[s as usize]).sum()
    }

    /// Q(s,a) = R(s,a) + γ Σ P(s'|s,a) V(s'), shape (`n_states * n_actions`,).
    pub fn action_values(&self, reward: &[f64], discount: f64, state_values: &[f64]) -> Vec<f64> {
        let mut action_values = vec![0.0; self.n_pairs()];
        self.action_values_into(reward, discount, state_values, &mut action_values);
        action_values
    }

    pub(crate) fn action_values_into(&self, reward: &[f64], discount: f64, state_values: &[f64], out: &mut [f64]) {
        for (pair, (q, &r)) in out.iter_mut().zip(reward).enumerate() {
            *q = r + discount * self.expected(pair, state_values);
        }
    }

    /// Σ_{s,a} flow(s,a) P(·|s,a): where a flow through pairs leads, shape (`n_states`,).
    pub fn propagate(&self, flow: &[f64]) -> Vec<f64> {
        let mut arrivals = vec![0.0; self.n_states];
        for (pair, &mass) in flow.iter().enumerate() {
            if mass != 0.0 {
                let (states, probabilities) = self.row(pair);
                for (&s, &p) in states.iter().zip(probabilities) {
                    arrivals[s as usize] += mass * p;
                }
            }
        }
        arrivals
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    type Parts = (usize, usize, Vec<usize>, Vec<u32>, Vec<f64>, Option<Vec<f64>>);

    fn parts() -> Parts {
        (2, 1, vec![0, 2, 3], vec![0, 1, 1], vec![0.25, 0.75, 1.0], None)
    }

    fn error(change: impl FnOnce(&mut Parts)) -> MdpError {
        let mut parts = parts();
        change(&mut parts);
        TabularMdp::new(parts.0, parts.1, parts.2, parts.3, parts.4, parts.5).expect_err("a refusal")
    }

    #[test]
    fn keeps_what_is_right() {
        let (n, a, offsets, next, probabilities, _) = parts();
        let mdp = TabularMdp::new(n, a, offsets, next, probabilities, None).expect("a model");
        assert_eq!((mdp.n_states(), mdp.n_actions(), mdp.n_pairs()), (2, 1, 2));
        assert_eq!(mdp.initial_distribution(), [0.5, 0.5]);
        assert_eq!(mdp.row(0), ([0, 1].as_slice(), [0.25, 0.75].as_slice()));
        assert_eq!(mdp.action_values(&[1.0, 2.0], 0.5, &[4.0, 8.0]), [1.0 + 0.5 * 7.0, 2.0 + 0.5 * 8.0]);
        assert_eq!(mdp.propagate(&[4.0, 1.0]), [1.0, 4.0]);
    }

    #[test]
    fn names_what_is_wrong() {
        assert!(matches!(error(|p| p.0 = 0), MdpError::Empty { .. }));
        assert!(matches!(error(|p| p.0 = usize::MAX), MdpError::TooLarge { .. }));
        assert!(matches!(error(|p| p.0 = 3), MdpError::RowOffsets { expected: 4, .. }));
        assert!(matches!(error(|p| p.2[0] = 1), MdpError::RowOffsets { .. }));
        assert!(matches!(error(|p| p.2[1] = 4), MdpError::RowOffsets { .. }));
        assert!(matches!(error(|p| p.2[2] = 2), MdpError::RowOffsets { .. }));
        assert!(matches!(error(|p| p.4.truncate(2)), MdpError::Ragged { next_states: 3, probabilities: 2 }));
        assert!(matches!(error(|p| p.3[1] = 2), MdpError::NextState { state: 0, next_state: 2, .. }));
        assert!(matches!(error(|p| p.3[1] = 0), MdpError::NextState { state: 0, next_state: 0, .. }));
        for wrong in [-0.25, 1.5, f64::NAN, f64::INFINITY] {
            assert!(matches!(error(|p| p.4[0] = wrong), MdpError::Probability { state: 0, action: 0, .. }));
        }
        assert!(matches!(error(|p| p.4[2] = 0.999), MdpError::RowSum { state: 1, action: 0, .. }));
        assert!(matches!(error(|p| p.2[1] = 0), MdpError::RowSum { state: 0, .. }));
        assert!(matches!(error(|p| p.5 = Some(vec![1.0])), MdpError::InitialLength { expected: 2, got: 1 }));
        assert!(matches!(error(|p| p.5 = Some(vec![0.5, 0.4])), MdpError::InitialDistribution { .. }));
        assert!(matches!(error(|p| p.5 = Some(vec![1.5, -0.5])), MdpError::InitialDistribution { .. }));
        let message = error(|p| p.4[2] = 0.5).to_string();
        assert_eq!(message, "expected row (state 1, action 0) to sum to 1, got 0.5");
    }
}
