//! What an agent can do and see in a world, and the bytes of what it sees.
//!
//! Invariant: the answer to a step is written from the batch's own buffers straight into its frame, in one pass and
//! without a message in between.

use super::{error::WorldError, tensor, world::World};
use crate::{
    batch::{ACTION_MASK, Batch, BatchOptions, Layout, StepBuffers},
    sim::{DType, EnvSpec, Space},
};
use bytes::{BufMut as _, BytesMut};
use mazeway_proto::dm_env::{
    ActionObservationSpecs, DataType, EnvironmentStateType, TensorSpec,
    tensor::{FloatArray, Int32Array, Uint8Array},
    tensor_spec::{Value, value::Payload},
};
use prost::encoding::{encode_varint, encoded_len_varint};

/// Number of the only action.
pub const ACTION: u64 = 1;

/// Where an observation lies in the buffers of a batch.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum Source {
    Observation,
    Reward,
    Terminated,
    Truncated,
    Info(usize),
}

impl Source {
    fn bytes(self, buffers: &StepBuffers) -> &[u8] {
        match self {
            Self::Observation => buffers.observations(),
            Self::Reward => buffers.rewards(),
            Self::Terminated => buffers.terminated(),
            Self::Truncated => buffers.truncated(),
            Self::Info(column) => buffers.info(column),
        }
    }
}

/// One observation; its number is its rank, counted from 1.
#[derive(Debug, Clone, PartialEq)]
struct Observation {
    source: Source,
    spec: TensorSpec,
    /// Field `shape` of its tensors, encoded.
    shape: Vec<u8>,
}

/// What an agent can do and see.
#[derive(Debug, Clone, PartialEq)]
pub struct Specs {
    /// `None` for a single environment.
    batch: Option<usize>,
    action: TensorSpec,
    observations: Vec<Observation>,
}

/// Most observations of a world: each is a bit of [`Requested`].
const MAX_OBSERVATIONS: usize = 64;

/// A set of observations.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Requested(u64);

impl Specs {
    /// Those of a world's present batch.
    pub fn of(world: &World) -> Self {
        let (spec, options) = (world.spec(), world.options());
        let batch = world.batched().then_some(options.num_envs);
        let whole = |shape: &[u32]| -> Vec<i32> {
            let first = batch.map(|n| n as i32);
            first.into_iter().chain(shape.iter().map(|&length| length as i32)).collect()
        };
        let mut observations = Vec::new();
        let mut add = |source, name: String, dtype: DataType, shape: &[u32], (min, max)| {
            let shape = whole(shape);
            let mut encoded = BytesMut::new();
            prost::encoding::int32::encode_packed(15, &shape, &mut encoded);
            let spec = TensorSpec { name, shape, dtype: dtype.into(), min, max };
            observations.push(Observation { source, spec, shape: encoded.to_vec() });
        };
        let none = (None, None);
        match &spec.observation_space {
            Space::Discrete { n } => {
                let bounds = (Some(int32s(0)), Some(int32s(n.saturating_sub(1) as i32)));
                add(Source::Observation, "observation".into(), DataType::Int32, &[], bounds);
            }
            Space::Box { shape, low, high } => {
                let (low, high) = if batch.is_some() {
                    (loosest(low, f32::min), loosest(high, f32::max))
                } else {
                    (brief(low), brief(high))
                };
                let bounds = (floats(low), floats(high));
                add(Source::Observation, "observation".into(), DataType::Float, shape, bounds);
            }
        }
        add(Source::Reward, "reward".into(), DataType::Double, &[], none.clone());
        add(Source::Terminated, "terminated".into(), DataType::Bool, &[], none.clone());
        add(Source::Truncated, "truncated".into(), DataType::Bool, &[], none.clone());
        for (rank, column) in world.info_columns().iter().enumerate() {
            let bounds = if column.name == ACTION_MASK { (Some(uint8s(0)), Some(uint8s(1))) } else { none.clone() };
            add(Source::Info(rank), format!("info.{}", column.name), data_type(column.dtype), &column.shape, bounds);
        }
        debug_assert!(observations.len() <= MAX_OBSERVATIONS, "an observation without a bit");
        let action = TensorSpec {
            name: "action".into(),
            shape: whole(&[]),
            dtype: DataType::Int32.into(),
            min: Some(int32s(0)),
            max: Some(int32s(spec.n_actions.saturating_sub(1) as i32)),
        };
        Self { batch, action, observations }
    }

    /// Size of the batch; `None` for a single environment.
    pub fn batch(&self) -> Option<usize> {
        self.batch
    }

    /// As the protocol sends them.
    pub fn to_proto(&self) -> ActionObservationSpecs {
        let numbered = (1..).zip(self.observations.iter().map(|observation| observation.spec.clone()));
        ActionObservationSpecs { actions: [(ACTION, self.action.clone())].into(), observations: numbered.collect() }
    }

    /// The observations of these numbers.
    ///
    /// # Errors
    /// A number that none has.
    pub fn requested(&self, numbers: &[u64]) -> Result<Requested, WorldError> {
        let mut set = 0;
        for (rank, &number) in numbers.iter().enumerate() {
            if number == 0 || number > self.observations.len() as u64 {
                let message = format!("expected an observation from 1 to {}, got {number}", self.observations.len());
                return Err(WorldError::malformed(format!("requested_observations[{rank}]"), message));
            }
            set |= 1 << (number - 1);
        }
        Ok(Requested(set))
    }

    /// Writes the frame of an answer to a step: an `EnvironmentResponse` with the state and what was requested, in the
    /// order of the numbers. `lengths` is scratch.
    pub fn write_step(
        &self,
        buffers: &StepBuffers,
        state: EnvironmentStateType,
        requested: Requested,
        lengths: &mut Vec<Lengths>,
        frame: &mut BytesMut,
    ) {
        lengths.clear();
        let chosen = || (1_u8..).zip(&self.observations).filter(|(number, _)| requested.0 >> (number - 1) & 1 == 1);
        // The state and its key.
        let mut step = 2;
        for (_, observation) in chosen() {
            let of = Lengths::of(observation, observation.source.bytes(buffers));
            step += 1 + delimited(of.entry);
            lengths.push(of);
        }
        frame.reserve(1 + delimited(step));
        frame.put_u8(key(3));
        encode_varint(step as u64, frame);
        frame.put_slice(&[1 << 3, state as u8]);
        for ((number, observation), of) in chosen().zip(lengths) {
            frame.put_u8(key(2));
            encode_varint(of.entry as u64, frame);
            frame.put_slice(&[1 << 3, number, key(2)]);
            encode_varint(of.tensor as u64, frame);
            frame.put_u8(key(observation.payload()));
            encode_varint(of.array as u64, frame);
            frame.put_u8(key(1));
            encode_varint(of.packed as u64, frame);
            let bytes = observation.source.bytes(buffers);
            if observation.is_varint() {
                int32(bytes).for_each(|value| encode_varint(value, frame));
            } else {
                frame.put_slice(bytes);
            }
            frame.put_slice(&observation.shape);
        }
    }
}

/// Lengths of the nested parts of one observation in a frame.
#[derive(Debug, Clone, Copy)]
pub struct Lengths {
    packed: usize,
    array: usize,
    tensor: usize,
    entry: usize,
}

impl Lengths {
    fn of(observation: &Observation, bytes: &[u8]) -> Self {
        let packed = if observation.is_varint() { int32(bytes).map(encoded_len_varint).sum() } else { bytes.len() };
        let array = 1 + delimited(packed);
        let tensor = 1 + delimited(array) + observation.shape.len();
        Self { packed, array, tensor, entry: 2 + 1 + delimited(tensor) }
    }
}

impl Observation {
    fn dtype(&self) -> DataType {
        DataType::try_from(self.spec.dtype).unwrap_or_default()
    }

    /// Number of the field of `Tensor.payload`.
    fn payload(&self) -> u8 {
        match self.dtype() {
            DataType::Float => 1,
            DataType::Double => 2,
            DataType::Uint8 => 6,
            DataType::Bool => 9,
            // The others are no types of the buffers.
            _ => 4,
        }
    }

    /// True where elements are not sent as they lie in the buffers.
    fn is_varint(&self) -> bool {
        self.payload() == 4
    }
}

/// Key of a field with a length, of a number up to 15.
const fn key(number: u8) -> u8 {
    number << 3 | 2
}

/// Bytes of a part with its length before it.
fn delimited(length: usize) -> usize {
    encoded_len_varint(length as u64) + length
}

/// Packed int32 as the varints of the wire, which sign-extend.
fn int32(bytes: &[u8]) -> impl Iterator<Item = u64> + '_ {
    bytes.as_chunks::<4>().0.iter().map(|bits| i64::from(i32::from_le_bytes(*bits)).cast_unsigned())
}

/// Bytes of the largest answer to a step that a batch can give.
pub fn largest_reply(spec: &EnvSpec, options: BatchOptions) -> usize {
    /// Of 4 bytes at rest: a negative number takes 10.
    const WORST_GROWTH: usize = 3;
    Layout::of(spec, options).total_len().saturating_mul(WORST_GROWTH)
}

fn data_type(dtype: DType) -> DataType {
    match dtype {
        DType::Uint8 => DataType::Uint8,
        DType::Int32 => DataType::Int32,
        DType::Float32 => DataType::Float,
        DType::Float64 => DataType::Double,
    }
}

fn int32s(value: i32) -> Value {
    Value { payload: Some(Payload::Int32s(Int32Array { array: vec![value] })) }
}

fn uint8s(value: u8) -> Value {
    Value { payload: Some(Payload::Uint8s(Uint8Array { array: vec![value].into() })) }
}

fn floats(array: Vec<f32>) -> Option<Value> {
    (!array.is_empty()).then(|| Value { payload: Some(Payload::Floats(FloatArray { array })) })
}

/// One value where all are the same.
fn brief(values: &[f32]) -> Vec<f32> {
    match values {
        [first, rest @ ..] if rest.iter().all(|value| value == first) => vec![*first],
        all => all.to_vec(),
    }
}

/// The one value that holds for all.
fn loosest(values: &[f32], looser: fn(f32, f32) -> f32) -> Vec<f32> {
    values.iter().copied().reduce(looser).into_iter().collect()
}

impl Specs {
    /// Packs the action of a step, which `out` then holds.
    ///
    /// # Errors
    /// None, another number, another type or shape.
    pub fn actions(
        &self,
        actions: &std::collections::BTreeMap<u64, mazeway_proto::dm_env::Tensor>,
        out: &mut Vec<u8>,
    ) -> Result<(), WorldError> {
        if let Some(number) = actions.keys().find(|&&number| number != ACTION) {
            let message = format!("expected the action {ACTION}, got {number}");
            return Err(WorldError::malformed(format!("actions[{number}]"), message));
        }
        let action = actions.get(&ACTION).ok_or_else(|| {
            WorldError::malformed(
                format!("actions[{ACTION}]"),
                "expected an action, as the sequence is running, got none",
            )
        })?;
        tensor::actions(action, "actions[1]", self.batch, out)
    }
}
