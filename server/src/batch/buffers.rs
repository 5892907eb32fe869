//! One preallocated block that holds everything a batch replies.
//!
//! Invariant: the parts lie one after another in the order of [`Layout`]'s fields, so that an adapter can send a whole
//! reply by copying one prefix of the block.

use super::{Autoreset, BatchOptions};
use crate::sim::{DType, EnvSpec, InfoColumn, Simulator};
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

    /// The whole block, an array apart from the other.
    pub(super) fn parts(&mut self) -> Parts<'_> {
        let Self { bytes, layout, .. } = self;
        let mut rest: &mut [u8] = bytes;
        // The parts follow one another in this order.
        let mut take = |range: &Range<usize>| rest.split_off_mut(..range.len()).expect("the block holds its layout");
        let observations = take(&layout.observations);
        let (rewards, terminated, truncated) =
            (take(&layout.rewards), take(&layout.terminated), take(&layout.truncated));
        let infos = Columns::new(&layout.infos, &mut take);
        // Where there is a mask, it is the last column.
        let mask_len = layout.infos.last().map_or(0, Range::len) / layout.num_envs;
        let observation_len = layout.observations.len() / layout.num_envs;
        let present = Rows { observations, observation_len, infos, mask_len };
        let last = Rows {
            observations: take(&layout.final_observations),
            observation_len: layout.final_observations.len() / layout.num_envs,
            infos: Columns::new(&layout.final_infos, &mut take),
            mask_len,
        };
        Parts { present, rewards: rewards.as_chunks_mut().0, terminated, truncated, last }
    }
}

/// Most info columns of an environment, the action mask included: so many need no list on the heap.
pub const MAX_COLUMNS: usize = 8;

/// Info columns of some environments.
pub(super) struct Columns<'a> {
    bytes: [&'a mut [u8]; MAX_COLUMNS],
    len: usize,
}

impl<'a> Columns<'a> {
    fn new(ranges: &[Range<usize>], take: &mut impl FnMut(&Range<usize>) -> &'a mut [u8]) -> Self {
        let mut columns = Self { bytes: Default::default(), len: ranges.len() };
        columns.bytes.iter_mut().zip(ranges).for_each(|(column, range)| *column = take(range));
        columns
    }

    /// The rows of the first `len` of `num_envs` environments and the others.
    fn split(self, len: usize, num_envs: usize) -> (Self, Self) {
        let (mut first, mut second) =
            (Self { bytes: Default::default(), ..self }, Self { bytes: Default::default(), ..self });
        for (at, column) in self.bytes.into_iter().enumerate().take(self.len) {
            let row_len = column.len() / num_envs;
            (first.bytes[at], second.bytes[at]) = column.split_at_mut(len * row_len);
        }
        (first, second)
    }
}

/// Observations and infos of some environments.
pub(super) struct Rows<'a> {
    observations: &'a mut [u8],
    observation_len: usize,
    infos: Columns<'a>,
    /// Bytes of an action mask, where there is one.
    mask_len: usize,
}

impl Rows<'_> {
    /// Those of the first `len` of `num_envs` environments and of the others.
    fn split(self, len: usize, num_envs: usize) -> (Self, Self) {
        let (infos, infos_after) = self.infos.split(len, num_envs);
        let (observations, observations_after) = self.observations.split_at_mut(len * self.observation_len);
        let (observation_len, mask_len) = (self.observation_len, self.mask_len);
        (
            Self { observations, observation_len, infos, mask_len },
            Self { observations: observations_after, observation_len, infos: infos_after, mask_len },
        )
    }

    /// Packs what neighbouring environments show, from row `first` on. `info_lens` are the spec's columns; one more is the
    /// action mask.
    pub fn write<S: Simulator>(
        &mut self,
        scratch: &mut S,
        states: &mut [S::Stored],
        first: usize,
        info_lens: &[usize],
    ) {
        let (own, mask) = self.infos.bytes[..self.infos.len].split_at_mut(info_lens.len());
        S::write_rows(scratch, states, first, self.observations, self.observation_len, own, info_lens);
        if let [mask] = mask {
            for (i, stored) in states.iter_mut().enumerate() {
                let row = (first + i) * self.mask_len..(first + i + 1) * self.mask_len;
                S::load(scratch, stored).write_action_mask(&mut mask[row]);
            }
        }
    }

    /// Packs what one environment shows as row `index`.
    #[cold]
    pub fn write_one<S: Simulator>(&mut self, simulator: &S, index: usize, info_lens: &[usize]) {
        let row = |len: usize| index * len..(index + 1) * len;
        simulator.write_observation(&mut self.observations[row(self.observation_len)]);
        let (own, mask) = self.infos.bytes[..self.infos.len].split_at_mut(info_lens.len());
        for (column, (out, &len)) in own.iter_mut().zip(info_lens).enumerate() {
            simulator.write_info(column, &mut out[row(len)]);
        }
        if let [mask] = mask {
            simulator.write_action_mask(&mut mask[row(self.mask_len)]);
        }
    }
}

/// A reply of some environments, an array apart from the other.
pub(super) struct Parts<'a> {
    pub present: Rows<'a>,
    pub rewards: &'a mut [[u8; 8]],
    pub terminated: &'a mut [u8],
    pub truncated: &'a mut [u8],
    /// Empty unless `SAME_STEP`.
    pub last: Rows<'a>,
}

impl Parts<'_> {
    /// No reward and no flag.
    pub fn clear_outcomes(&mut self) {
        self.rewards.fill([0; 8]);
        self.terminated.fill(0);
        self.truncated.fill(0);
    }

    /// Those of the first `len` environments and of the others.
    pub fn split(self, len: usize) -> (Self, Self) {
        let num_envs = self.terminated.len();
        let (present, present_after) = self.present.split(len, num_envs);
        let (last, last_after) = self.last.split(len, num_envs);
        let (rewards, rewards_after) = self.rewards.split_at_mut(len);
        let (terminated, terminated_after) = self.terminated.split_at_mut(len);
        let (truncated, truncated_after) = self.truncated.split_at_mut(len);
        (
            Self { present, rewards, terminated, truncated, last },
            Self {
                present: present_after,
                rewards: rewards_after,
                terminated: terminated_after,
                truncated: truncated_after,
                last: last_after,
            },
        )
    }
}
