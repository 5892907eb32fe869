//! A world: the batch of a session, with what this protocol adds to it.
//!
//! Invariant: what is changed while a sequence runs holds from the next one on.

use crate::{
    batch::{Batch, BatchError, BatchOptions, Moment, Picture, Seeds, StepBuffers},
    registry::{Environment, Options},
    sim::{EnvSpec, InfoColumn},
};
use std::{any::Any, sync::Arc};

/// A batch whose next sequence may have another seed, other options or another time limit.
pub struct World {
    batch: Box<dyn Batch>,
    /// True where tensors have a first dimension for the environments.
    batched: bool,
    /// Options as they were given; those of the next sequence, where that changes them.
    given: Options,
    /// The seed that was given last.
    seed: Option<u64>,
    /// True where that seed has not been used yet.
    reseed: bool,
    /// What the batch of the next sequence is made from, where it is another one.
    next: Option<(Arc<dyn Environment>, BatchOptions)>,
    /// Steps, and steps and resets, of all its batches.
    steps: u64,
    changes: u64,
}

impl World {
    /// A world that was never reset.
    pub fn new(batch: Box<dyn Batch>, batched: bool, given: Options, seed: Option<u64>) -> Self {
        Self { batch, batched, given, seed, reseed: seed.is_some(), next: None, steps: 0, changes: 0 }
    }

    /// The world that a session holds, if it holds one.
    pub fn of(batch: &mut dyn Batch) -> Option<&mut Self> {
        let any: &mut dyn Any = batch;
        any.downcast_mut()
    }

    /// True where tensors have a first dimension for the environments.
    pub fn batched(&self) -> bool {
        self.batched
    }

    /// Options as given, those of the next sequence where it has others.
    pub fn given(&self) -> &Options {
        &self.given
    }

    /// The seed that was given last.
    pub fn seed(&self) -> Option<u64> {
        self.seed
    }

    /// Size and limits, those of the next sequence where it has others.
    pub fn next_options(&self) -> BatchOptions {
        self.next.as_ref().map_or_else(|| self.batch.options(), |(_, options)| *options)
    }

    /// The environment, that of the next sequence where it is another.
    pub fn next_spec(&self) -> &Arc<EnvSpec> {
        self.next.as_ref().map_or_else(|| self.batch.spec(), |(environment, _)| environment.spec())
    }

    /// Seeds the next sequence: environment i with seed + i.
    pub fn set_seed(&mut self, seed: u64) {
        self.seed = Some(seed);
        self.reseed = true;
    }

    /// Takes other options from the next sequence on.
    pub fn set_next(&mut self, given: Options, environment: Arc<dyn Environment>, options: BatchOptions) {
        self.given = given;
        self.next = Some((environment, options));
    }

    /// Makes the batch of the next sequence now, where it is another one. Its generators begin at the seed given last.
    pub fn rebuild(&mut self) {
        if let Some((environment, options)) = self.next.take() {
            self.batch = environment.batch(options);
            self.reseed = self.seed.is_some();
        }
    }

    /// Begins a sequence. Without a new seed the generators go on where they are, as those of any session do.
    pub fn begin(&mut self) -> Result<(), BatchError> {
        self.reset(Seeds::Continue, None).map(|_| ())
    }
}

/// So that the other face can use the session too.
impl Batch for World {
    fn spec(&self) -> &Arc<EnvSpec> {
        self.batch.spec()
    }

    fn info_columns(&self) -> &[InfoColumn] {
        self.batch.info_columns()
    }

    fn options(&self) -> BatchOptions {
        self.batch.options()
    }

    fn buffers(&self) -> &StepBuffers {
        self.batch.buffers()
    }

    fn reset(&mut self, seeds: Seeds<'_>, mask: Option<&[u8]>) -> Result<&StepBuffers, BatchError> {
        self.rebuild();
        let seeds = match (seeds, self.seed) {
            (Seeds::Continue, Some(seed)) if self.reseed => Seeds::From(seed),
            (seeds, _) => seeds,
        };
        let buffers = self.batch.reset(seeds, mask)?;
        self.reseed = false;
        self.changes += 1;
        Ok(buffers)
    }

    fn step(&mut self, actions: &[u8]) -> Result<&StepBuffers, BatchError> {
        let buffers = self.batch.step(actions)?;
        self.steps += 1;
        self.changes += 1;
        Ok(buffers)
    }

    fn tabular_state(&self, index: usize) -> Result<u32, BatchError> {
        self.batch.tabular_state(index)
    }

    fn moment(&self, index: usize) -> Result<Moment, BatchError> {
        Ok(Moment { steps: self.steps, changes: self.changes, ..self.batch.moment(index)? })
    }

    fn picture(&self, index: usize) -> Result<Box<dyn Picture>, BatchError> {
        self.batch.picture(index)
    }

    fn render_text(&self, index: usize) -> Result<String, BatchError> {
        self.batch.render_text(index)
    }

    fn render_svg(&self, index: usize) -> Result<String, BatchError> {
        self.batch.render_svg(index)
    }
}
