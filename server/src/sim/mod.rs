//! Pure, deterministic simulators: state machines that know no session, no transport and no clock.
//!
//! Invariants: the same seed gives the same numbers on every platform and release; a step neither allocates nor locks.
//! Deliberately absent: time limits, autoreset and batching, which the batch above adds alike for every simulator.

mod drivers;
pub mod highway;
pub mod maze;
pub mod model;
pub(crate) mod options;
pub mod rng;

use std::sync::Arc;

/// The random generator of one environment: PCG XSL RR 128/64, a named and portable algorithm.
pub type Rng = rand_pcg::Pcg64;

/// Element type of a packed array: little-endian, row-major, no padding.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum DType {
    /// One byte.
    Uint8,
    /// Signed, 4 bytes.
    Int32,
    /// IEEE 754, 4 bytes.
    Float32,
    /// IEEE 754, 8 bytes.
    Float64,
}

impl DType {
    /// Bytes of one element.
    pub const fn size(self) -> usize {
        match self {
            Self::Uint8 => 1,
            Self::Int32 | Self::Float32 => 4,
            Self::Float64 => 8,
        }
    }
}

/// What an observation or an action of one environment may be.
#[derive(Debug, Clone, PartialEq)]
pub enum Space {
    /// The integers `0..n`, one `Int32` each.
    Discrete {
        /// How many values.
        n: u32,
    },
    /// `Float32` arrays between element-wise bounds, row-major.
    Box {
        /// Length of each axis.
        shape: Vec<u32>,
        /// Lowest value of each element.
        low: Vec<f32>,
        /// Highest value of each element.
        high: Vec<f32>,
    },
}

impl Space {
    /// Bytes of one packed value.
    pub fn packed_len(&self) -> usize {
        match self {
            Self::Discrete { .. } => DType::Int32.size(),
            Self::Box { low, .. } => low.len() * DType::Float32.size(),
        }
    }
}

/// A named value that accompanies every observation.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct InfoColumn {
    /// Key in Gymnasium's `info`.
    pub name: &'static str,
    /// Element type.
    pub dtype: DType,
    /// Shape of one environment's value; empty for a scalar.
    pub shape: Vec<u32>,
    /// Unit, for people.
    pub unit: &'static str,
    /// What it means.
    pub description: &'static str,
    /// True where the sum over an episode is meaningful.
    pub summed: bool,
}

impl InfoColumn {
    /// Bytes of one packed value.
    pub fn packed_len(&self) -> usize {
        self.shape.iter().map(|&n| n as usize).product::<usize>() * self.dtype.size()
    }
}

/// One option of an environment.
#[derive(Debug, Clone, PartialEq)]
pub struct OptionSpec {
    /// Key.
    pub name: &'static str,
    /// Value where it is not given.
    pub default: serde_json::Value,
    /// Type, unit, range, effect.
    pub description: &'static str,
}

/// A configured environment, described.
#[derive(Debug, Clone, PartialEq)]
pub struct EnvSpec {
    /// Identifier such as `"Maze-v0"`.
    pub env_id: &'static str,
    /// One sentence.
    pub description: &'static str,
    /// Space of one observation.
    pub observation_space: Space,
    /// Number of actions: the action space is `Discrete(n_actions)`.
    pub n_actions: u32,
    /// Number of tabular states.
    pub n_states: u32,
    /// Columns of the info, in order.
    pub info_columns: Vec<InfoColumn>,
    /// Default time limit; 0 means none.
    pub max_episode_steps: u32,
    /// Options with their defaults.
    pub options: Vec<OptionSpec>,
    /// Scripted drivers: name and one sentence; `"random"` is always among them.
    pub drivers: Vec<(&'static str, &'static str)>,
    /// Names of the model's reward tables; the first is the default style.
    pub styles: Vec<&'static str>,
    /// Frames a second at which renderings look natural.
    pub render_fps: u32,
}

/// What a step gives beside the new state.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Outcome {
    /// Reward of the step.
    pub reward: f64,
    /// The episode came to an end of its own.
    pub terminated: bool,
}

/// One environment. `Clone` copies the whole state, so that a batch is one allocation.
///
/// The caller upholds: `reset` before the first `step`; `action < n_actions`; buffers of the sizes that the spec says.
pub trait Simulator: Clone + Send + Sync + 'static {
    /// What a batch keeps of one environment: all but what the environments of one configuration share.
    type Stored: Clone + Send + Sync + 'static;
    /// Rough time of a step and its packing on one core, which decides from what size on several cores pay.
    const STEP_NANOS: usize;
    /// What [`Self::load`] needs to go on from here.
    fn stored(&self) -> Self::Stored;
    /// The environment that `stored` keeps: `stored` itself, or `scratch` made into it.
    fn load<'a>(scratch: &'a mut Self, stored: &'a mut Self::Stored) -> &'a mut Self;
    /// Keeps what [`Self::load`] gave out, where that was `scratch`.
    fn save(scratch: &Self, stored: &mut Self::Stored);
    /// Begins an episode, drawing from `rng`.
    fn reset(&mut self, rng: &mut Rng);
    /// Advances one decision. Neither allocates nor locks.
    fn step(&mut self, action: u32, rng: &mut Rng) -> Outcome;
    /// Index of the present tabular state, whatever the observation space.
    fn tabular_state(&self) -> u32;
    /// Packs the observation; `out` has `observation_space.packed_len()` bytes.
    fn write_observation(&self, out: &mut [u8]);
    /// Packs info column `column` of the spec; `out` has that column's `packed_len()` bytes.
    fn write_info(&self, column: usize, out: &mut [u8]);
    /// Value of a summed info column, for totals.
    fn info_value(&self, column: usize) -> f64;
    /// One byte an action, 1 where the action has its full effect; `out` has `n_actions` bytes.
    fn write_action_mask(&self, out: &mut [u8]);
    /// Packs the observations and infos of neighbouring environments of a batch, the first of which has row `first` of each
    /// array; `info_lens` are the bytes of a row of each info column. Small simulators do it an array at a time.
    fn write_rows(
        scratch: &mut Self,
        stored: &mut [Self::Stored],
        first: usize,
        observations: &mut [u8],
        observation_len: usize,
        infos: &mut [&mut [u8]],
        info_lens: &[usize],
    ) {
        for (i, stored) in stored.iter_mut().enumerate() {
            let (simulator, row) = (Self::load(scratch, stored), first + i);
            simulator.write_observation(&mut observations[row * observation_len..][..observation_len]);
            for (column, (out, &len)) in infos.iter_mut().zip(info_lens).enumerate() {
                simulator.write_info(column, &mut out[row * len..][..len]);
            }
        }
    }
    /// Draws as text.
    fn render_text(&self) -> String;
    /// Draws as an SVG document, to be rasterised by the caller.
    fn render_svg(&self) -> String;
    /// A scripted driver by name (the spec's `drivers`, `"random"` among them), sharing nothing between episodes.
    fn driver(&self, name: &str) -> Option<Box<dyn Driver<Self>>>;
}

/// A scripted driver: sees the whole simulator, as a person sees the whole road.
pub trait Driver<S>: Send {
    /// Chooses an action; draws only from `rng`, which is not the simulator's.
    fn act(&mut self, simulator: &S, rng: &mut Rng) -> u32;
}

/// A wrong option: which and why.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
#[error("{field}: {message}")]
pub struct OptionError {
    /// Name of the option, such as `"slip"`.
    pub field: String,
    /// What was expected and what came.
    pub message: String,
}

/// A finite Markov decision process as sparse rows (s, a), in order of `s * n_actions + a`.
#[derive(Debug, Clone, PartialEq)]
pub struct TabularModel {
    /// Environment that it describes.
    pub env_id: String,
    /// SHA-256 over sizes and rows, as `mazeway/env/v1/model.proto` lays down (see `ModelHeader.model_id`).
    pub model_id: String,
    /// Number of states.
    pub n_states: u32,
    /// Number of actions.
    pub n_actions: u32,
    /// Label of each state.
    pub state_labels: Vec<String>,
    /// Label of each action.
    pub action_labels: Vec<String>,
    /// p(s₁), shape `(n_states,)`.
    pub initial_distribution: Vec<f64>,
    /// Start of each row's entries, shape `(n_states * n_actions + 1,)`.
    pub row_offsets: Vec<usize>,
    /// Next state of each entry, rising within a row.
    pub next_states: Vec<u32>,
    /// Probability of each entry; each row sums to 1.
    pub probabilities: Vec<f64>,
    /// Visits from which each row was estimated, shape `(n_states * n_actions,)`; `None` where exact.
    pub visit_counts: Option<Vec<u64>>,
    /// R(s,a) of each style, shape `(n_states, n_actions)`.
    pub rewards: Vec<(String, Vec<f64>)>,
    /// Grid rows, grid columns and each state's row-major cell, where the environment lies on a grid.
    pub grid: Option<(u32, u32, Vec<u32>)>,
}

/// A configured simulator: what a session, a roll-out and a model are made from.
#[derive(Debug, Clone)]
pub struct Configured<S> {
    /// Its description under the options.
    pub spec: Arc<EnvSpec>,
    /// A simulator that was never reset, to clone.
    pub prototype: S,
}

/// Every environment with its default options, in alphabetical order of `env_id`.
pub fn catalogue() -> Vec<EnvSpec> {
    let none = serde_json::Map::new();
    let specs = [highway::configure(&none).map(|c| c.spec), maze::configure(&none).map(|c| c.spec)];
    specs.into_iter().map(|spec| Arc::unwrap_or_clone(spec.expect("defaults are valid options"))).collect()
}
