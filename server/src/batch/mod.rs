//! Batches: n environments of one kind that are reset and stepped together, with Gymnasium 1.x semantics.
//!
//! Invariants: environment i of a batch seeded with s behaves exactly like a single one seeded with s + i; a call that is
//! refused changes nothing; a step allocates nothing and takes no lock, but where a batch is so large that several cores
//! share it: then it is a few of each for the whole batch. What comes of a step never depends on the number of cores.
//! Deliberately absent: transports, leases.

mod block;
mod buffers;
mod error;
mod parallel;

use block::{Block, Clock, Rules, Work};
pub use buffers::{ACTION_MASK, Layout, StepBuffers};
pub use error::BatchError;

use crate::sim::{Configured, DType, EnvSpec, InfoColumn, Rng, Simulator};
use std::{any::Any, sync::Arc};

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

/// How far a session has come.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub struct Moment {
    /// Steps of the batch.
    pub steps: u64,
    /// Steps and resets of the batch: as long as it is the same, so is what there is to see.
    pub changes: u64,
    /// Steps of the environment's episode.
    pub episode_steps: u32,
    /// That episode is over, and no other has begun.
    pub ended: bool,
}

/// An environment as it was at some moment, to be drawn whenever and wherever that suits.
pub trait Picture: Send {
    /// As text.
    fn text(&self) -> String;
    /// As an SVG document.
    fn svg(&self) -> String;
}

impl<S: Simulator> Picture for S {
    fn text(&self) -> String {
        self.render_text()
    }

    fn svg(&self) -> String {
        self.render_svg()
    }
}

/// A batch of environments behind one face, whatever their kind.
pub trait Batch: Any + Send {
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
    /// How far it and its environment `index` have come.
    ///
    /// # Errors
    /// No such environment, no reset yet.
    fn moment(&self, index: usize) -> Result<Moment, BatchError>;
    /// A copy of environment `index` as it stands.
    ///
    /// # Errors
    /// No such environment, no reset yet.
    fn picture(&self, index: usize) -> Result<Box<dyn Picture>, BatchError>;
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

/// A batch of simulators of one kind, what they are made of apart in arrays.
pub struct SimBatch<S: Simulator> {
    /// Shared by all batches of equal options.
    configured: Arc<Configured<S>>,
    /// The columns with the action mask, where that was asked for; otherwise they are those of the spec.
    masked_columns: Option<Box<[InfoColumn]>>,
    options: BatchOptions,
    /// Bytes of each info column of the spec.
    info_lens: Box<[usize]>,
    /// What all environments share, and the place where one is put together.
    scratch: S,
    states: Box<[S::Stored]>,
    /// Without meaning until the first reset.
    rngs: Box<[Rng]>,
    clocks: Box<[Clock]>,
    buffers: StepBuffers,
    /// Set by the first reset, which covers every environment.
    born: bool,
    steps: u64,
    resets: u64,
}

impl<S: Simulator> SimBatch<S> {
    /// Allocates everything that the batch will ever need.
    pub fn new(configured: impl Into<Arc<Configured<S>>>, options: BatchOptions) -> Self {
        let configured = configured.into();
        let columns = buffers::info_columns(&configured.spec, options.action_masks);
        assert!(columns.len() <= buffers::MAX_COLUMNS, "an environment of at most {} columns", buffers::MAX_COLUMNS);
        let layout = Layout::new(&configured.spec, &columns, options);
        Self {
            masked_columns: options.action_masks.then(|| columns.into()),
            options,
            info_lens: configured.spec.info_columns.iter().map(InfoColumn::packed_len).collect(),
            scratch: configured.prototype.clone(),
            states: vec![configured.prototype.stored(); options.num_envs].into(),
            rngs: vec![Rng::new(0, 0); options.num_envs].into(),
            clocks: vec![Clock::default(); options.num_envs].into(),
            buffers: StepBuffers::new(layout),
            born: false,
            steps: 0,
            resets: 0,
            configured,
        }
    }

    /// Refuses an environment that there is not, or not yet.
    fn check_index(&self, index: usize) -> Result<(), BatchError> {
        let num_envs = self.options.num_envs;
        if index >= num_envs {
            return Err(BatchError::IndexOutOfRange { index, num_envs });
        }
        if self.born { Ok(()) } else { Err(BatchError::NeverReset) }
    }

    /// Environment `index` as it stands.
    fn environment(&self, index: usize) -> Result<S, BatchError> {
        self.check_index(index)?;
        let mut stored = self.states[index].clone();
        Ok(S::load(&mut self.scratch.clone(), &mut stored).clone())
    }

    fn check_mask(&self, mask: &[u8]) -> Result<(), BatchError> {
        let num_envs = self.options.num_envs;
        if mask.len() != num_envs {
            return Err(BatchError::MaskLength { num_envs, got: mask.len() });
        }
        for (index, &value) in mask.iter().enumerate() {
            if value > 1 {
                return Err(BatchError::MaskValue { index, value });
            }
            if value == 0 && !self.born {
                return Err(BatchError::MaskLeavesUnborn { index });
            }
        }
        Ok(())
    }

    fn check_actions<'a>(&self, actions: &'a [u8]) -> Result<&'a [[u8; 4]], BatchError> {
        if !self.born {
            return Err(BatchError::NeverReset);
        }
        let num_envs = self.options.num_envs;
        let expected = num_envs * DType::Int32.size();
        if actions.len() != expected {
            return Err(BatchError::ActionsLength { expected, got: actions.len(), num_envs });
        }
        let (actions, n_actions) = (actions.as_chunks::<4>().0, self.configured.spec.n_actions);
        let disabled = self.options.autoreset == Autoreset::Disabled;
        // As unsigned numbers negative actions are large: one comparison, many at a time.
        let right = actions.iter().fold(true, |right, action| right & (u32::from_le_bytes(*action) < n_actions));
        if right && !disabled {
            return Ok(actions);
        }
        for (index, (action, clock)) in actions.iter().zip(&self.clocks).enumerate() {
            if clock.ended() {
                if disabled {
                    return Err(BatchError::EpisodeEnded { index });
                }
                // Its action is ignored.
            } else if u32::from_le_bytes(*action) >= n_actions {
                return Err(BatchError::ActionOutOfRange { index, action: i32::from_le_bytes(*action), n_actions });
            }
        }
        Ok(actions)
    }

    fn clear_final(&mut self) {
        if self.buffers.has_final {
            let start = self.buffers.layout.present_len();
            self.buffers.bytes[start..].fill(0);
            self.buffers.has_final = false;
        }
    }

    /// Does checked work, on several cores where it is large enough for that to pay.
    fn run(&mut self, work: Work<'_>) {
        self.clear_final();
        let BatchOptions { autoreset, max_episode_steps, num_envs, .. } = self.options;
        let rules = Rules { autoreset, max_episode_steps, info_lens: &self.info_lens };
        let whole = Block {
            first: 0,
            states: &mut self.states,
            rngs: &mut self.rngs,
            clocks: &mut self.clocks,
            parts: self.buffers.parts(),
        };
        let block_envs = parallel::block_envs::<S>();
        self.buffers.has_final = if num_envs < 2 * block_envs {
            let mut whole = whole;
            whole.run(rules, work, &mut self.scratch)
        } else {
            parallel::run(whole, block_envs, rules, work, &mut self.scratch)
        };
    }
}

impl<S: Simulator> Batch for SimBatch<S> {
    fn spec(&self) -> &Arc<EnvSpec> {
        &self.configured.spec
    }

    fn info_columns(&self) -> &[InfoColumn] {
        self.masked_columns.as_deref().unwrap_or(&self.configured.spec.info_columns)
    }

    fn options(&self) -> BatchOptions {
        self.options
    }

    fn buffers(&self) -> &StepBuffers {
        &self.buffers
    }

    fn reset(&mut self, seeds: Seeds<'_>, mask: Option<&[u8]>) -> Result<&StepBuffers, BatchError> {
        let num_envs = self.options.num_envs;
        if let Some(mask) = mask {
            self.check_mask(mask)?;
        }
        if let Seeds::Each(seeds) = seeds
            && seeds.len() != num_envs * 8
        {
            return Err(BatchError::SeedsLength { expected: num_envs * 8, got: seeds.len(), num_envs });
        }
        // One draw from the system serves the whole batch, and is made before anything changes, as it can fail.
        let fresh = (seeds == Seeds::Continue && !self.born).then(getrandom::u64).transpose();
        let fresh = fresh.map_err(|error| BatchError::Entropy(error.to_string()))?;
        self.run(Work::Reset { seeds, mask, fresh });
        self.born = true;
        self.resets += 1;
        Ok(&self.buffers)
    }

    fn step(&mut self, actions: &[u8]) -> Result<&StepBuffers, BatchError> {
        let actions = self.check_actions(actions)?;
        self.run(Work::Step { actions });
        self.steps += 1;
        Ok(&self.buffers)
    }

    fn tabular_state(&self, index: usize) -> Result<u32, BatchError> {
        Ok(self.environment(index)?.tabular_state())
    }

    fn moment(&self, index: usize) -> Result<Moment, BatchError> {
        self.check_index(index)?;
        let (clock, changes) = (self.clocks[index], self.steps + self.resets);
        Ok(Moment { steps: self.steps, changes, episode_steps: clock.steps(), ended: clock.ended() })
    }

    fn picture(&self, index: usize) -> Result<Box<dyn Picture>, BatchError> {
        Ok(Box::new(self.environment(index)?))
    }

    fn render_text(&self, index: usize) -> Result<String, BatchError> {
        Ok(self.environment(index)?.render_text())
    }

    fn render_svg(&self, index: usize) -> Result<String, BatchError> {
        Ok(self.environment(index)?.render_svg())
    }
}

#[cfg(test)]
mod tests;
