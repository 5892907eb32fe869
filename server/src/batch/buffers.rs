//! One preallocated block that holds everything a batch replies.
//!
//! Invariant: the parts lie one after another in the order of [`Layout`]'s fields, so that an adapter can send a whole
//! reply by copying one prefix of the block.

use super::{Autoreset, BatchOptions};
use crate::sim::{DType, EnvSpec, InfoColumn};
use std::ops::Range;

/// Name of the info column that a session may ask for beside the environment's own.
pub const ACTION_MASK: &str = "action_mask";

/// The environment's info columns and, where asked for, the action mask.
pub(super) fn info_columns(spec: &EnvSpec, action_masks: bool) -> Vec<InfoColumn> {
    let mut columns = spec.info_columns.clone();
    if action_masks {
        columns.push(InfoColumn {
            name: ACTION_MASK,
            dtype: DType::Uint8,
            shape: vec![spec.n_actions],
            unit: "1",
            description: "1 for each action that has its full effect in the present state, 0 for the others",
            summed: false,
        });
    }
    columns
}

/// Where each packed array of a reply lies in the block.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Layout {
    /// Number of environments.
    pub num_envs: usize,
    /// Shape (num_envs, ...), as the observation space packs.
    pub observations: Range<usize>,
    /// Float64, shape `(num_envs,)`.
    pub rewards: Range<usize>,
    /// Flags, shape `(num_envs,)`.
    pub terminated: Range<usize>,
    /// Flags, shape `(num_envs,)`.
    pub truncated: Range<usize>,
    /// One array a column, in the order of the columns.
    pub infos: Vec<Range<usize>>,
    /// As `observations`; present in `SAME_STEP` alone, otherwise empty.
    pub final_observations: Range<usize>,
    /// As `infos`; present in `SAME_STEP` alone, otherwise empty.
    pub final_infos: Vec<Range<usize>>,
}

impl Layout {
    /// The layout of a batch's replies, known before anything is allocated.
    pub fn of(spec: &EnvSpec, options: BatchOptions) -> Self {
        Self::new(spec, &info_columns(spec, options.action_masks), options)
    }

    pub(super) fn new(spec: &EnvSpec, columns: &[InfoColumn], options: BatchOptions) -> Self {
        let BatchOptions { num_envs, autoreset, .. } = options;
        let with_final = autoreset == Autoreset::SameStep;
        let mut end = 0;
        let mut take = |bytes_per_env: usize| {
            let start = end;
            end += bytes_per_env * num_envs;
            start..end
        };
        let observation_len = spec.observation_space.packed_len();
        let observations = take(observation_len);
        let rewards = take(DType::Float64.size());
        let terminated = take(1);
        let truncated = take(1);
        let infos = columns.iter().map(|column| take(column.packed_len())).collect();
        let (final_observations, final_infos) = if with_final {
            (take(observation_len), columns.iter().map(|column| take(column.packed_len())).collect())
        } else {
            (end..end, Vec::new())
        };
        Self { num_envs, observations, rewards, terminated, truncated, infos, final_observations, final_infos }
    }

    /// End of everything but the final observations and infos.
    pub fn present_len(&self) -> usize {
        self.final_observations.start
    }

    /// Bytes of the whole block.
    pub fn total_len(&self) -> usize {
        self.final_infos.last().map_or(self.final_observations.end, |last| last.end)
    }
}

/// The reply to the latest reset or step.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct StepBuffers {
    pub(super) bytes: Box<[u8]>,
    pub(super) layout: Layout,
    pub(super) has_final: bool,
}

impl StepBuffers {
    pub(super) fn new(layout: Layout) -> Self {
        Self { bytes: vec![0; layout.total_len()].into_boxed_slice(), layout, has_final: false }
    }

    /// Where each array lies in [`Self::bytes`].
    pub fn layout(&self) -> &Layout {
        &self.layout
    }

    /// The block: the final parts are left out where no episode ended in this step.
    pub fn bytes(&self) -> &[u8] {
        if self.has_final { &self.bytes } else { &self.bytes[..self.layout.present_len()] }
    }

    /// True where the final observations and infos hold an ended episode's.
    pub fn has_final(&self) -> bool {
        self.has_final
    }

    /// Packed observations, shape `(num_envs, ...)`.
    pub fn observations(&self) -> &[u8] {
        &self.bytes[self.layout.observations.clone()]
    }

    /// Packed rewards, float64, shape `(num_envs,)`.
    pub fn rewards(&self) -> &[u8] {
        &self.bytes[self.layout.rewards.clone()]
    }

    /// Reward of environment `index`.
    pub fn reward(&self, index: usize) -> f64 {
        let mut bits = [0; 8];
        bits.copy_from_slice(&self.rewards()[index * 8..][..8]);
        f64::from_le_bytes(bits)
    }

    /// Flags, shape `(num_envs,)`.
    pub fn terminated(&self) -> &[u8] {
        &self.bytes[self.layout.terminated.clone()]
    }

    /// Flags, shape `(num_envs,)`.
    pub fn truncated(&self) -> &[u8] {
        &self.bytes[self.layout.truncated.clone()]
    }

    /// Packed values of one info column, shape `(num_envs, ...)`.
    pub fn info(&self, column: usize) -> &[u8] {
        &self.bytes[self.layout.infos[column].clone()]
    }

    /// Last observations of ended episodes, zero elsewhere, shape `(num_envs, ...)`; empty unless [`Self::has_final`].
    pub fn final_observations(&self) -> &[u8] {
        if self.has_final { &self.bytes[self.layout.final_observations.clone()] } else { &[] }
    }

    /// Last values of one info column of ended episodes; empty unless [`Self::has_final`].
    pub fn final_info(&self, column: usize) -> &[u8] {
        if self.has_final { &self.bytes[self.layout.final_infos[column].clone()] } else { &[] }
    }

    #[inline]
    pub(super) fn row(&mut self, range: Range<usize>, index: usize) -> &mut [u8] {
        let len = range.len() / self.layout.num_envs;
        &mut self.bytes[range.start + index * len..][..len]
    }
}
