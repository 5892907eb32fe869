//! From the core to the wire.

use crate::{
    batch::{Autoreset, Batch, StepBuffers},
    rollout::{EpisodeChunk, Width},
    sim::{DType, EnvSpec, InfoColumn, Space, TabularModel},
};
use bytes::Bytes;
use mazeway_proto::env as pb;
use prost_types::value::Kind;
use serde_json::Value;
use std::{ops::Range, sync::Arc};

/// Rows of a message of a model.
const ROWS_A_BLOCK: usize = 4096;
/// Entries after which a message of a model ends.
const ENTRIES_A_BLOCK: usize = 1 << 15;

fn dtype(dtype: DType) -> i32 {
    match dtype {
        DType::Uint8 => pb::DType::Uint8,
        DType::Int32 => pb::DType::Int32,
        DType::Float32 => pb::DType::Float32,
        DType::Float64 => pb::DType::Float64,
    }
    .into()
}

fn discrete(n: u32) -> pb::Space {
    let space = pb::DiscreteSpace { n, dtype: dtype(DType::Int32) };
    pb::Space { kind: Some(pb::space::Kind::Discrete(space)) }
}

fn space(space: &Space) -> pb::Space {
    match space {
        Space::Discrete { n } => discrete(*n),
        Space::Box { shape, low, high } => {
            let pack = |values: &[f32]| values.iter().flat_map(|value| value.to_le_bytes()).collect();
            let space =
                pb::BoxSpace { shape: shape.clone(), dtype: dtype(DType::Float32), low: pack(low), high: pack(high) };
            pb::Space { kind: Some(pb::space::Kind::Box(space)) }
        }
    }
}

fn value(value: &Value) -> prost_types::Value {
    let kind = match value {
        Value::Null => Kind::NullValue(0),
        Value::Bool(flag) => Kind::BoolValue(*flag),
        Value::Number(number) => Kind::NumberValue(number.as_f64().unwrap_or(f64::NAN)),
        Value::String(text) => Kind::StringValue(text.clone()),
        Value::Array(items) => {
            Kind::ListValue(prost_types::ListValue { values: items.iter().map(self::value).collect() })
        }
        Value::Object(map) => Kind::StructValue(prost_types::Struct {
            fields: map.iter().map(|(key, item)| (key.clone(), self::value(item))).collect(),
        }),
    };
    prost_types::Value { kind: Some(kind) }
}

fn column(column: &InfoColumn) -> pb::InfoColumn {
    pb::InfoColumn {
        name: column.name.into(),
        dtype: dtype(column.dtype),
        shape: column.shape.clone(),
        unit: column.unit.into(),
        description: column.description.into(),
        summed: column.summed,
    }
}

/// An environment with the info columns of a session, or its own.
pub fn spec(spec: &EnvSpec, columns: &[InfoColumn]) -> pb::EnvironmentSpec {
    pb::EnvironmentSpec {
        env_id: spec.env_id.into(),
        description: spec.description.into(),
        observation_space: Some(space(&spec.observation_space)),
        action_space: Some(discrete(spec.n_actions)),
        info_columns: columns.iter().map(column).collect(),
        reward_dtype: dtype(DType::Float64),
        max_episode_steps: spec.max_episode_steps,
        options: spec
            .options
            .iter()
            .map(|option| pb::OptionSpec {
                name: option.name.into(),
                default_value: Some(value(&option.default)),
                description: option.description.into(),
            })
            .collect(),
        drivers: spec
            .drivers
            .iter()
            .map(|&(name, description)| pb::DriverSpec { name: name.into(), description: description.into() })
            .collect(),
        styles: spec.styles.iter().map(|&style| style.into()).collect(),
        n_states: spec.n_states,
        n_actions: spec.n_actions,
        render_fps: spec.render_fps,
    }
}

fn autoreset(mode: Autoreset) -> pb::AutoresetMode {
    match mode {
        Autoreset::NextStep => pb::AutoresetMode::NextStep,
        Autoreset::SameStep => pb::AutoresetMode::SameStep,
        Autoreset::Disabled => pb::AutoresetMode::Disabled,
    }
}

/// What a session has become.
pub fn session(session_id: String, lease: prost_types::Duration, batch: &dyn Batch) -> pb::CreateSessionResponse {
    let options = batch.options();
    pb::CreateSessionResponse {
        session_id,
        spec: Some(spec(batch.spec(), batch.info_columns())),
        num_envs: options.num_envs as u32,
        autoreset_mode: autoreset(options.autoreset).into(),
        max_episode_steps: options.max_episode_steps,
        lease: Some(lease),
    }
}

/// One copy of the whole reply; its fields share it.
struct Block(Bytes);

impl Block {
    fn new(buffers: &StepBuffers) -> Self {
        Self(Bytes::copy_from_slice(buffers.bytes()))
    }

    fn part(&self, range: &Range<usize>) -> Bytes {
        self.0.slice(range.clone())
    }

    fn parts(&self, ranges: &[Range<usize>]) -> Vec<Bytes> {
        ranges.iter().map(|range| self.part(range)).collect()
    }
}

/// The reply to a reset.
pub fn reset(buffers: &StepBuffers) -> pb::ResetResponse {
    let (block, layout) = (Block::new(buffers), buffers.layout());
    pb::ResetResponse { observations: block.part(&layout.observations), infos: block.parts(&layout.infos) }
}

/// The reply to a step.
pub fn step(buffers: &StepBuffers) -> pb::StepResponse {
    let (block, layout) = (Block::new(buffers), buffers.layout());
    let (final_observations, final_infos) = if buffers.has_final() {
        (block.part(&layout.final_observations), block.parts(&layout.final_infos))
    } else {
        (Bytes::new(), Vec::new())
    };
    pb::StepResponse {
        observations: block.part(&layout.observations),
        rewards: block.part(&layout.rewards),
        terminated: block.part(&layout.terminated),
        truncated: block.part(&layout.truncated),
        infos: block.parts(&layout.infos),
        final_observations,
        final_infos,
    }
}

fn pack_u32(values: &[u32]) -> Bytes {
    values.iter().flat_map(|value| value.to_le_bytes()).collect()
}

fn pack_f64(values: &[f64]) -> Bytes {
    values.iter().flat_map(|value| value.to_le_bytes()).collect()
}

fn width(width: Width) -> i32 {
    match width {
        // What needs not be told, so that clients that do not know of it understand the rest.
        Width::Four => pb::DType::Unspecified,
        Width::One => pb::DType::Uint8,
        Width::Two => pb::DType::Uint16,
    }
    .into()
}

/// Some episodes of a roll-out; the arrays of every step are moved, not copied.
pub fn episodes(chunk: EpisodeChunk) -> pb::RolloutResponse {
    pb::RolloutResponse {
        first_episode: chunk.first_episode,
        lengths: pack_u32(&chunk.lengths),
        states_dtype: width(chunk.steps.format.states),
        actions_dtype: width(chunk.steps.format.actions),
        reward_values: pack_f64(&chunk.steps.reward_values),
        states: chunk.steps.states.into(),
        actions: chunk.steps.actions.into(),
        rewards: chunk.steps.rewards.into(),
        final_states: pack_u32(&chunk.final_states),
        terminated: chunk.terminated.iter().map(|&flag| u8::from(flag)).collect(),
        returns: pack_f64(&chunk.returns),
        totals: chunk
            .total_names
            .iter()
            .zip(&chunk.totals)
            .map(|(&name, values)| pb::EpisodeTotals { name: name.into(), values: pack_f64(values) })
            .collect(),
    }
}

/// The parts of a model, each made when it is asked for.
pub fn model_parts(model: Arc<TabularModel>) -> impl Iterator<Item = pb::ModelPart> + Send {
    let header = pb::ModelPart { part: Some(pb::model_part::Part::Header(model_header(&model))) };
    let mut row = 0;
    let blocks = std::iter::from_fn(move || {
        let n_rows = model.row_offsets.len() - 1;
        if row == n_rows {
            return None;
        }
        let first_row = row;
        let first_entry = model.row_offsets[first_row];
        while row < n_rows && row - first_row < ROWS_A_BLOCK && model.row_offsets[row] - first_entry < ENTRIES_A_BLOCK {
            row += 1;
        }
        let entries = first_entry..model.row_offsets[row];
        let lengths = model.row_offsets[first_row..=row].windows(2).map(|pair| (pair[1] - pair[0]) as u32);
        let counts = model.visit_counts.as_ref().map(|counts| &counts[first_row..row]);
        let block = pb::RowBlock {
            first_row: first_row as u32,
            row_lengths: lengths.flat_map(u32::to_le_bytes).collect(),
            next_states: pack_u32(&model.next_states[entries.clone()]),
            probabilities: pack_f64(&model.probabilities[entries]),
            visit_counts: counts.unwrap_or_default().iter().flat_map(|count| count.to_le_bytes()).collect(),
        };
        Some(pb::ModelPart { part: Some(pb::model_part::Part::Rows(block)) })
    });
    std::iter::once(header).chain(blocks)
}

fn model_header(model: &TabularModel) -> pb::ModelHeader {
    pb::ModelHeader {
        model_id: model.model_id.clone(),
        env_id: model.env_id.clone(),
        n_states: model.n_states,
        n_actions: model.n_actions,
        state_labels: model.state_labels.clone(),
        action_labels: model.action_labels.clone(),
        initial_distribution: pack_f64(&model.initial_distribution),
        rewards: model
            .rewards
            .iter()
            .map(|(style, values)| pb::RewardTable { style: style.clone(), values: pack_f64(values) })
            .collect(),
        estimated: model.visit_counts.is_some(),
        grid: model.grid.as_ref().map(|(rows, columns, cells)| pb::GridLayout {
            rows: *rows,
            columns: *columns,
            cells: pack_u32(cells),
        }),
        features: None,
        terminal_states: Bytes::new(),
    }
}
