//! Batches: n environments of one kind that are reset and stepped together, with Gymnasium 1.x semantics.
//!
//! Invariants: environment i of a batch seeded with s behaves exactly like a single one seeded with s + i; a call that is
//! refused changes nothing; a step allocates nothing and takes no lock. Deliberately absent: transports, leases,
//! parallelism.

mod buffers;
mod error;

pub use buffers::{ACTION_MASK, Layout, StepBuffers};
pub use error::BatchError;

use crate::sim::{
    Configured, DType, EnvSpec, InfoColumn, Rng, Simulator,
    rng::{Purpose, stream},
};
use std::sync::Arc;

/// What happens to an environment whose episode has ended (Gymnasium 1.x, `AutoresetMode`).
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub enum Autoreset {
    /// The next step ignores its action, resets, and returns the first observation with reward 0 and no flag set.
    #[default]
    NextStep,
    /// The same step resets and returns the last observation apart.
    SameStep,
    /// Nothing: stepping an ended episode is refused.
    Disabled,
}

/// How a batch is made.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct BatchOptions {
    /// Number of environments; at least 1.
    pub num_envs: usize,
    /// End of an episode.
    pub autoreset: Autoreset,
    /// Steps after which an episode is truncated; 0 means never.
    pub max_episode_steps: u32,
    /// Append the info column [`ACTION_MASK`].
    pub action_masks: bool,
}

/// How the environments of a reset are seeded.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Seeds<'a> {
    /// Every generator goes on where it is; one that was never seeded is seeded from the operating system.
    Continue,
    /// Environment i with seed + i, wrapping around.
    From(u64),
    /// A seed an environment: packed uint64, little-endian, shape `(num_envs,)`.
    Each(&'a [u8]),
}

/// A batch of environments behind one face, whatever their kind.
pub trait Batch: Send {
    /// The environment as configured.
    fn spec(&self) -> &Arc<EnvSpec>;
    /// Info columns in the order of the replies: the environment's and, where asked for, the action mask.
    fn info_columns(&self) -> &[InfoColumn];
    /// How it was made.
    fn options(&self) -> BatchOptions;
    /// The reply to the latest reset or step.
    fn buffers(&self) -> &StepBuffers;
    /// Begins new episodes where `mask` (uint8 flags, shape `(num_envs,)`) says, or everywhere.
    ///
    /// # Errors
    /// Wrong lengths and flags; a mask that leaves out an environment that was never reset.
    fn reset(&mut self, seeds: Seeds<'_>, mask: Option<&[u8]>) -> Result<&StepBuffers, BatchError>;
    /// Steps every environment once; `actions` are packed int32, little-endian, shape `(num_envs,)`.
    ///
    /// # Errors
    /// Wrong length, action out of range, no reset yet, an ended episode where autoreset is disabled.
    fn step(&mut self, actions: &[u8]) -> Result<&StepBuffers, BatchError>;
    /// Index of the present tabular state of environment `index`.
    ///
    /// # Errors
    /// No such environment, no reset yet.
    fn tabular_state(&self, index: usize) -> Result<u32, BatchError>;
    /// Draws environment `index` as text.
    ///
    /// # Errors
    /// No such environment, no reset yet.
    fn render_text(&self, index: usize) -> Result<String, BatchError>;
    /// Draws environment `index` as an SVG document.
    ///
    /// # Errors
    /// No such environment, no reset yet.
    fn render_svg(&self, index: usize) -> Result<String, BatchError>;
}

#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum Phase {
    /// Never reset: there is no observation.
    Unborn,
    Running,
    /// The episode is over and a reset is due.
    Ended,
}

/// One environment of a batch.
#[derive(Clone)]
struct Slot<S> {
    simulator: S,
    /// `None` until it is first seeded.
    rng: Option<Rng>,
    elapsed_steps: u32,
    phase: Phase,
}

/// A batch of simulators of one kind.
pub struct SimBatch<S> {
    spec: Arc<EnvSpec>,
    columns: Vec<InfoColumn>,
    options: BatchOptions,
    slots: Vec<Slot<S>>,
    buffers: StepBuffers,
    /// Set by the first reset, which covers every environment.
    born: bool,
}

impl<S: Simulator> SimBatch<S> {
    /// Allocates everything that the batch will ever need.
    pub fn new(configured: &Configured<S>, options: BatchOptions) -> Self {
        let spec = Arc::clone(&configured.spec);
        let columns = buffers::info_columns(&spec, options.action_masks);
        let slot = Slot { simulator: configured.prototype.clone(), rng: None, elapsed_steps: 0, phase: Phase::Unborn };
        let layout = Layout::new(&spec, &columns, options);
        Self {
            spec,
            columns,
            options,
            slots: vec![slot; options.num_envs],
            buffers: StepBuffers::new(layout),
            born: false,
        }
    }

    fn slot(&self, index: usize) -> Result<&Slot<S>, BatchError> {
        let slot = self.slots.get(index).ok_or(BatchError::IndexOutOfRange { index, num_envs: self.slots.len() })?;
        if slot.phase == Phase::Unborn { Err(BatchError::NeverReset) } else { Ok(slot) }
    }

    fn check_mask(&self, mask: &[u8]) -> Result<(), BatchError> {
        if mask.len() != self.slots.len() {
            return Err(BatchError::MaskLength { num_envs: self.slots.len(), got: mask.len() });
        }
        for (index, (&value, slot)) in mask.iter().zip(&self.slots).enumerate() {
            if value > 1 {
                return Err(BatchError::MaskValue { index, value });
            }
            if value == 0 && slot.phase == Phase::Unborn {
                return Err(BatchError::MaskLeavesUnborn { index });
            }
        }
        Ok(())
    }

    fn check_actions(&self, actions: &[u8]) -> Result<(), BatchError> {
        if !self.born {
            return Err(BatchError::NeverReset);
        }
        let expected = self.slots.len() * DType::Int32.size();
        if actions.len() != expected {
            return Err(BatchError::ActionsLength { expected, got: actions.len(), num_envs: self.slots.len() });
        }
        let disabled = self.options.autoreset == Autoreset::Disabled;
        for (index, (action, slot)) in unpack(actions).zip(&self.slots).enumerate() {
            if slot.phase == Phase::Ended {
                if disabled {
                    return Err(BatchError::EpisodeEnded { index });
                }
            } else if u32::try_from(action).is_ok_and(|action| action < self.spec.n_actions) {
                // within the action space
            } else {
                return Err(BatchError::ActionOutOfRange { index, action, n_actions: self.spec.n_actions });
            }
        }
        Ok(())
    }

    /// Packs the present observation and infos of one environment, into the final parts where `last`.
    #[inline]
    fn observe(&mut self, index: usize, last: bool) {
        let Self { slots, buffers, spec, .. } = self;
        let simulator = &slots[index].simulator;
        let range = if last { &buffers.layout.final_observations } else { &buffers.layout.observations }.clone();
        simulator.write_observation(buffers.row(range, index));
        for column in 0..buffers.layout.infos.len() {
            let range = if last { &buffers.layout.final_infos } else { &buffers.layout.infos }[column].clone();
            let out = buffers.row(range, index);
            if column < spec.info_columns.len() {
                simulator.write_info(column, out);
            } else {
                simulator.write_action_mask(out);
            }
        }
    }

    #[inline]
    fn begin_episode(&mut self, index: usize) {
        let slot = &mut self.slots[index];
        let rng = slot.rng.as_mut().expect("seeded by the first reset");
        slot.simulator.reset(rng);
        slot.elapsed_steps = 0;
        slot.phase = Phase::Running;
    }

    #[inline]
    fn set_outcome(&mut self, index: usize, reward: f64, terminated: bool, truncated: bool) {
        let Layout { rewards, terminated: terminated_at, truncated: truncated_at, .. } = &self.buffers.layout;
        let (reward_at, terminated_at, truncated_at) =
            (rewards.start + index * 8, terminated_at.start + index, truncated_at.start + index);
        self.buffers.bytes[reward_at..][..8].copy_from_slice(&reward.to_le_bytes());
        self.buffers.bytes[terminated_at] = u8::from(terminated);
        self.buffers.bytes[truncated_at] = u8::from(truncated);
    }

    fn clear_final(&mut self) {
        if self.buffers.has_final {
            let start = self.buffers.layout.present_len();
            self.buffers.bytes[start..].fill(0);
            self.buffers.has_final = false;
        }
    }

    #[inline]
    fn step_one(&mut self, index: usize, action: u32) {
        if self.slots[index].phase == Phase::Ended {
            self.begin_episode(index);
            self.set_outcome(index, 0.0, false, false);
            self.observe(index, false);
            return;
        }
        let slot = &mut self.slots[index];
        let rng = slot.rng.as_mut().expect("seeded by the first reset");
        let outcome = slot.simulator.step(action, rng);
        slot.elapsed_steps += 1;
        let truncated = self.options.max_episode_steps != 0 && slot.elapsed_steps >= self.options.max_episode_steps;
        if outcome.terminated || truncated {
            if self.options.autoreset == Autoreset::SameStep {
                self.observe(index, true);
                self.buffers.has_final = true;
                self.begin_episode(index);
            } else {
                slot.phase = Phase::Ended;
            }
        }
        self.set_outcome(index, outcome.reward, outcome.terminated, truncated);
        self.observe(index, false);
    }
}

impl<S: Simulator> Batch for SimBatch<S> {
    fn spec(&self) -> &Arc<EnvSpec> {
        &self.spec
    }

    fn info_columns(&self) -> &[InfoColumn] {
        &self.columns
    }

    fn options(&self) -> BatchOptions {
        self.options
    }

    fn buffers(&self) -> &StepBuffers {
        &self.buffers
    }

    fn reset(&mut self, seeds: Seeds<'_>, mask: Option<&[u8]>) -> Result<&StepBuffers, BatchError> {
        let num_envs = self.slots.len();
        if let Some(mask) = mask {
            self.check_mask(mask)?;
        }
        if let Seeds::Each(seeds) = seeds
            && seeds.len() != num_envs * 8
        {
            return Err(BatchError::SeedsLength { expected: num_envs * 8, got: seeds.len(), num_envs });
        }
        // One draw from the system serves the whole batch, and is made before anything changes, as it can fail.
        let entropy = if seeds == Seeds::Continue && !self.born {
            getrandom::u64().map_err(|error| BatchError::Entropy(error.to_string()))?
        } else {
            0
        };
        self.clear_final();
        for index in 0..num_envs {
            if mask.is_none_or(|mask| mask[index] == 1) {
                let rng = &mut self.slots[index].rng;
                match seeds {
                    Seeds::Continue => {
                        rng.get_or_insert_with(|| dynamics(entropy.wrapping_add(index as u64)));
                    }
                    Seeds::From(seed) => *rng = Some(dynamics(seed.wrapping_add(index as u64))),
                    Seeds::Each(seeds) => {
                        let mut bits = [0; 8];
                        bits.copy_from_slice(&seeds[index * 8..][..8]);
                        *rng = Some(dynamics(u64::from_le_bytes(bits)));
                    }
                }
                self.begin_episode(index);
            }
            self.set_outcome(index, 0.0, false, false);
            self.observe(index, false);
        }
        self.born = true;
        Ok(&self.buffers)
    }

    fn step(&mut self, actions: &[u8]) -> Result<&StepBuffers, BatchError> {
        self.check_actions(actions)?;
        self.clear_final();
        for (index, action) in unpack(actions).enumerate() {
            self.step_one(index, action as u32);
        }
        Ok(&self.buffers)
    }

    fn tabular_state(&self, index: usize) -> Result<u32, BatchError> {
        Ok(self.slot(index)?.simulator.tabular_state())
    }

    fn render_text(&self, index: usize) -> Result<String, BatchError> {
        Ok(self.slot(index)?.simulator.render_text())
    }

    fn render_svg(&self, index: usize) -> Result<String, BatchError> {
        Ok(self.slot(index)?.simulator.render_svg())
    }
}

/// Generator of an environment seeded with `seed`.
fn dynamics(seed: u64) -> Rng {
    stream(seed, Purpose::Dynamics)
}

fn unpack(actions: &[u8]) -> impl Iterator<Item = i32> + '_ {
    actions.chunks_exact(4).map(|bytes| i32::from_le_bytes([bytes[0], bytes[1], bytes[2], bytes[3]]))
}

#[cfg(test)]
mod tests;
