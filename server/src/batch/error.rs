//! What can be wrong with a call on a batch.

/// A refused call. Nothing of the batch has changed.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
pub enum BatchError {
    /// Packed actions of another length.
    #[error("expected {expected} bytes of int32 actions for {num_envs} environments, got {got}")]
    ActionsLength {
        /// Bytes expected.
        expected: usize,
        /// Bytes that came.
        got: usize,
        /// Size of the batch.
        num_envs: usize,
    },
    /// An action outside the action space.
    #[error("expected an action from 0 to {} for environment {index}, got {action}", n_actions - 1)]
    ActionOutOfRange {
        /// Which environment.
        index: usize,
        /// What came.
        action: i32,
        /// Size of the action space.
        n_actions: u32,
    },
    /// Packed seeds of another length.
    #[error("expected {expected} bytes of uint64 seeds for {num_envs} environments, got {got}")]
    SeedsLength {
        /// Bytes expected.
        expected: usize,
        /// Bytes that came.
        got: usize,
        /// Size of the batch.
        num_envs: usize,
    },
    /// A mask of another length.
    #[error("expected a mask of {num_envs} bytes, one an environment, got {got}")]
    MaskLength {
        /// Size of the batch.
        num_envs: usize,
        /// Bytes that came.
        got: usize,
    },
    /// A flag that is neither 0 nor 1.
    #[error("expected flags 0 or 1, got {value} for environment {index}")]
    MaskValue {
        /// Which environment.
        index: usize,
        /// What came.
        value: u8,
    },
    /// A masked reset that leaves out an environment which has no observation yet.
    #[error("environment {index} was never reset: its first reset cannot leave it out")]
    MaskLeavesUnborn {
        /// Which environment.
        index: usize,
    },
    /// Step or render before the first reset.
    #[error("expected a reset before the first step or rendering")]
    NeverReset,
    /// A step of an ended episode in mode `DISABLED`.
    #[error("the episode of environment {index} has ended: reset it first, as autoreset is disabled")]
    EpisodeEnded {
        /// Which environment.
        index: usize,
    },
    /// No such environment in the batch.
    #[error("expected an index below {num_envs}, got {index}")]
    IndexOutOfRange {
        /// What came.
        index: usize,
        /// Size of the batch.
        num_envs: usize,
    },
    /// The operating system gave no random numbers for an unseeded reset.
    #[error("no random seed from the operating system: {0}")]
    Entropy(String),
}

impl BatchError {
    /// The field of the call that is wrong, where one is: `"actions[3]"`.
    pub fn field(&self) -> Option<String> {
        match self {
            Self::ActionsLength { .. } => Some("actions".into()),
            Self::ActionOutOfRange { index, .. } => Some(format!("actions[{index}]")),
            Self::SeedsLength { .. } => Some("seeds".into()),
            Self::MaskLength { .. } => Some("reset_mask".into()),
            Self::MaskValue { index, .. } | Self::MaskLeavesUnborn { index } => Some(format!("reset_mask[{index}]")),
            Self::IndexOutOfRange { .. } => Some("index".into()),
            Self::NeverReset | Self::EpisodeEnded { .. } | Self::Entropy(_) => None,
        }
    }
}
