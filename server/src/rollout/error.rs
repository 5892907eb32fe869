//! What can be wrong with a roll-out.

/// A refused roll-out.
#[derive(Debug, Clone, PartialEq, thiserror::Error)]
pub enum RolloutError {
    /// A count that must be positive.
    #[error("expected at least 1, got 0")]
    Zero {
        /// Which.
        field: &'static str,
    },
    /// No such driver.
    #[error("expected a driver among {}, got {name:?}", known.join(", "))]
    UnknownDriver {
        /// What came.
        name: String,
        /// What there is.
        known: Vec<&'static str>,
    },
    /// Neither driver nor policy.
    #[error("expected a driver or a policy, got neither")]
    NoController,
    /// A policy whose bytes are no whole float64 values.
    #[error("expected packed float64 values, got {got} bytes")]
    PolicyBytes {
        /// Bytes that came.
        got: usize,
    },
    /// A policy of another shape.
    #[error("expected {expected} probabilities, shape ({n_states}, {n_actions}), got {got}")]
    PolicyShape {
        /// Values expected.
        expected: usize,
        /// Values that came.
        got: usize,
        /// Number of states.
        n_states: u32,
        /// Number of actions.
        n_actions: u32,
    },
    /// An entry that is no probability.
    #[error("expected a probability for state {state} and action {action}, got {value}")]
    PolicyEntry {
        /// Row.
        state: usize,
        /// Column.
        action: usize,
        /// What came.
        value: f64,
    },
    /// A row that does not sum to 1.
    #[error("expected the probabilities of state {state} to sum to 1 within 1e-6, got {sum}")]
    PolicyRow {
        /// Row.
        state: usize,
        /// Its sum.
        sum: f64,
    },
}

impl RolloutError {
    /// The field of the request that is wrong.
    pub fn field(&self) -> String {
        match self {
            Self::Zero { field } => (*field).into(),
            Self::UnknownDriver { .. } => "driver".into(),
            Self::NoController => "controller".into(),
            Self::PolicyBytes { .. } | Self::PolicyShape { .. } => "policy.probabilities".into(),
            Self::PolicyEntry { state, action, .. } => format!("policy.probabilities[{state}][{action}]"),
            Self::PolicyRow { state, .. } => format!("policy.probabilities[{state}]"),
        }
    }
}
