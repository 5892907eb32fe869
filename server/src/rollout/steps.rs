//! What a roll-out records of every step, packed as it travels.

use super::RolloutPlan;
use crate::sim::EnvSpec;

/// Bytes of one state or action.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Width {
    /// Unsigned, below 2⁸.
    One,
    /// Unsigned, below 2¹⁶.
    Two,
    /// Signed, below 2³¹.
    Four,
}

impl Width {
    /// The smallest that holds the integers `0..n`.
    fn of(n: u32) -> Self {
        match n {
            0..=0x100 => Self::One,
            0x101..=0x1_0000 => Self::Two,
            _ => Self::Four,
        }
    }

    /// Bytes of one element.
    pub const fn size(self) -> usize {
        match self {
            Self::One => 1,
            Self::Two => 2,
            Self::Four => 4,
        }
    }

    #[inline]
    pub(super) fn put(self, out: &mut [u8], at: usize, value: u32) {
        match self {
            Self::One => out[at] = value as u8,
            Self::Two => out.as_chunks_mut::<2>().0[at] = (value as u16).to_le_bytes(),
            Self::Four => out.as_chunks_mut::<4>().0[at] = value.to_le_bytes(),
        }
    }

    fn get(self, bytes: &[u8], at: usize) -> u32 {
        match self {
            Self::One => bytes[at].into(),
            Self::Two => u16::from_le_bytes(bytes.as_chunks::<2>().0[at]).into(),
            Self::Four => u32::from_le_bytes(bytes.as_chunks::<4>().0[at]),
        }
    }
}

/// How rewards are packed.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum RewardFormat {
    /// Float64.
    Values,
    /// One byte: the rank among [`Steps::reward_values`].
    Ranks,
}

impl RewardFormat {
    /// Bytes of one element.
    pub const fn size(self) -> usize {
        match self {
            Self::Values => 8,
            Self::Ranks => 1,
        }
    }
}

/// How the arrays of every step are packed.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct StepFormat {
    /// Of the states.
    pub states: Width,
    /// Of the actions.
    pub actions: Width,
    /// Of the rewards.
    pub rewards: RewardFormat,
}

impl StepFormat {
    pub(super) fn of(plan: &RolloutPlan, spec: &EnvSpec) -> Self {
        if plan.compact {
            Self { states: Width::of(spec.n_states), actions: Width::of(spec.n_actions), rewards: RewardFormat::Ranks }
        } else {
            Self { states: Width::Four, actions: Width::Four, rewards: RewardFormat::Values }
        }
    }
}

/// Packed arrays of some steps, little-endian, shape `(steps,)` each.
#[derive(Debug, Clone, PartialEq)]
pub struct Steps {
    /// How they are packed.
    pub format: StepFormat,
    /// Tabular state before each step.
    pub states: Vec<u8>,
    /// Action of each step.
    pub actions: Vec<u8>,
    /// Reward of each step.
    pub rewards: Vec<u8>,
    /// The distinct rewards in the order of their first appearance, where `rewards` holds their ranks; otherwise empty.
    pub reward_values: Vec<f64>,
}

impl Steps {
    pub(super) fn new(format: StepFormat, steps: usize) -> Self {
        Self {
            format,
            states: vec![0; steps * format.states.size()],
            actions: vec![0; steps * format.actions.size()],
            rewards: vec![0; steps * format.rewards.size()],
            reward_values: Vec::new(),
        }
    }

    /// Number of steps.
    pub fn len(&self) -> usize {
        self.actions.len() / self.format.actions.size()
    }

    /// True where there is none.
    pub fn is_empty(&self) -> bool {
        self.actions.is_empty()
    }

    /// Tabular state before step `at`.
    pub fn state(&self, at: usize) -> u32 {
        self.format.states.get(&self.states, at)
    }

    /// Action of step `at`.
    pub fn action(&self, at: usize) -> u32 {
        self.format.actions.get(&self.actions, at)
    }

    /// Reward of step `at`.
    pub fn reward(&self, at: usize) -> f64 {
        match self.format.rewards {
            RewardFormat::Values => f64::from_le_bytes(self.rewards.as_chunks::<8>().0[at]),
            RewardFormat::Ranks => self.reward_values[usize::from(self.rewards[at])],
        }
    }

    /// Moves the first `lengths[i]` of each `capacity` steps together.
    pub(super) fn close_gaps(&mut self, capacity: usize, lengths: &[u32]) {
        let StepFormat { states, actions, rewards } = self.format;
        let arrays = [
            (&mut self.states, states.size()),
            (&mut self.actions, actions.size()),
            (&mut self.rewards, rewards.size()),
        ];
        for (array, size) in arrays {
            let mut end = 0;
            for (rank, &length) in lengths.iter().enumerate() {
                let (start, len) = (rank * capacity * size, length as usize * size);
                array.copy_within(start..start + len, end);
                end += len;
            }
            array.truncate(end);
        }
    }
}
