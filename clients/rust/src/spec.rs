//! What a server says of an environment.

use crate::{ClientError, packed::Packed};
use mazeway_proto::env as pb;
use prost_types::value::Kind;
use serde_json::{Map, Number, Value};

/// Options of an environment by name.
pub type Options = Map<String, Value>;

/// Element type of a packed array.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum DType {
    /// One byte.
    Uint8,
    /// Signed, 4 bytes.
    Int32,
    /// Signed, 8 bytes.
    Int64,
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
            Self::Int64 | Self::Float64 => 8,
        }
    }

    fn from_wire(dtype: i32) -> Result<Self, ClientError> {
        match pb::DType::try_from(dtype) {
            Ok(pb::DType::Uint8) => Ok(Self::Uint8),
            Ok(pb::DType::Int32) => Ok(Self::Int32),
            Ok(pb::DType::Int64) => Ok(Self::Int64),
            Ok(pb::DType::Float32) => Ok(Self::Float32),
            Ok(pb::DType::Float64) => Ok(Self::Float64),
            // Two bytes are for roll-outs alone.
            Ok(pb::DType::Unspecified | pb::DType::Uint16) | Err(_) => {
                Err(ClientError::protocol(format!("unknown element type {dtype}")))
            }
        }
    }
}

/// What an observation of one environment may be.
#[derive(Debug, Clone, PartialEq)]
pub enum ObservationSpace {
    /// The integers `0..n`.
    Discrete {
        /// How many values.
        n: u32,
    },
    /// `f32` arrays between element-wise bounds, row-major.
    Box {
        /// Length of each axis.
        shape: Vec<u32>,
        /// Lowest value of each element.
        low: Vec<f32>,
        /// Highest value of each element.
        high: Vec<f32>,
    },
}

/// A named value that accompanies every observation.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct InfoColumn {
    /// Key in Gymnasium's `info`.
    pub name: String,
    /// Element type.
    pub dtype: DType,
    /// Shape of one environment's value; empty for a scalar.
    pub shape: Vec<u32>,
    /// Unit.
    pub unit: String,
    /// What it means.
    pub description: String,
    /// True where roll-outs report its sum over an episode.
    pub summed: bool,
}

impl InfoColumn {
    /// Elements of one environment's value.
    pub fn elements(&self) -> usize {
        self.shape.iter().map(|&n| n as usize).product()
    }
}

/// An option of an environment.
#[derive(Debug, Clone, PartialEq)]
pub struct OptionSpec {
    /// Key.
    pub name: String,
    /// Value where it is not given.
    pub default: Value,
    /// Type, unit, range, effect.
    pub description: String,
}

/// An environment as configured.
#[derive(Debug, Clone, PartialEq)]
pub struct EnvSpec {
    /// Identifier such as `"Highway-v0"`.
    pub env_id: String,
    /// One sentence.
    pub description: String,
    /// Space of one observation.
    pub observation_space: ObservationSpace,
    /// The action space is the integers `0..n_actions`.
    pub n_actions: u32,
    /// Number of tabular states.
    pub n_states: u32,
    /// Columns of the infos, in order.
    pub info_columns: Vec<InfoColumn>,
    /// Default time limit; 0 means none.
    pub max_episode_steps: u32,
    /// Options with their defaults.
    pub options: Vec<OptionSpec>,
    /// Scripted drivers: name and one sentence.
    pub drivers: Vec<(String, String)>,
    /// Names of the model's reward tables; the first is the default style.
    pub styles: Vec<String>,
    /// Frames a second at which renderings look natural.
    pub render_fps: u32,
}

impl EnvSpec {
    pub(crate) fn from_wire(spec: pb::EnvironmentSpec) -> Result<Self, ClientError> {
        use pb::space::Kind as Space;
        let observation_space = match spec.observation_space.and_then(|space| space.kind) {
            Some(Space::Discrete(space)) => ObservationSpace::Discrete { n: space.n },
            Some(Space::Box(space)) => {
                if DType::from_wire(space.dtype)? != DType::Float32 {
                    return Err(ClientError::protocol("expected a box of float32"));
                }
                let elements = space.shape.iter().map(|&n| n as usize).product();
                ObservationSpace::Box {
                    low: Packed::of_len(space.low, elements, "lowest values")?.to_vec(),
                    high: Packed::of_len(space.high, elements, "highest values")?.to_vec(),
                    shape: space.shape,
                }
            }
            None => return Err(ClientError::protocol("expected an observation space, got none")),
        };
        let info_columns = spec.info_columns.into_iter().map(|column| {
            Ok(InfoColumn {
                name: column.name,
                dtype: DType::from_wire(column.dtype)?,
                shape: column.shape,
                unit: column.unit,
                description: column.description,
                summed: column.summed,
            })
        });
        let options = spec.options.into_iter().map(|option| OptionSpec {
            name: option.name,
            default: option.default_value.map_or(Value::Null, value_from_wire),
            description: option.description,
        });
        Ok(Self {
            observation_space,
            info_columns: info_columns.collect::<Result<_, ClientError>>()?,
            options: options.collect(),
            drivers: spec.drivers.into_iter().map(|driver| (driver.name, driver.description)).collect(),
            env_id: spec.env_id,
            description: spec.description,
            n_actions: spec.n_actions,
            n_states: spec.n_states,
            max_episode_steps: spec.max_episode_steps,
            styles: spec.styles,
            render_fps: spec.render_fps,
        })
    }

    /// Elements of one observation.
    pub fn observation_elements(&self) -> usize {
        match &self.observation_space {
            ObservationSpace::Discrete { .. } => 1,
            ObservationSpace::Box { low, .. } => low.len(),
        }
    }
}

impl TryFrom<pb::EnvironmentSpec> for EnvSpec {
    type Error = ClientError;

    fn try_from(spec: pb::EnvironmentSpec) -> Result<Self, ClientError> {
        Self::from_wire(spec)
    }
}

pub(crate) fn options_to_wire(options: &Options) -> Option<prost_types::Struct> {
    let fields = options.iter().map(|(name, value)| (name.clone(), value_to_wire(value)));
    (!options.is_empty()).then(|| prost_types::Struct { fields: fields.collect() })
}

fn value_to_wire(value: &Value) -> prost_types::Value {
    let kind = match value {
        Value::Null => Kind::NullValue(0),
        Value::Bool(flag) => Kind::BoolValue(*flag),
        Value::Number(number) => Kind::NumberValue(number.as_f64().unwrap_or(f64::NAN)),
        Value::String(text) => Kind::StringValue(text.clone()),
        Value::Array(items) => {
            Kind::ListValue(prost_types::ListValue { values: items.iter().map(value_to_wire).collect() })
        }
        Value::Object(map) => Kind::StructValue(prost_types::Struct {
            fields: map.iter().map(|(key, item)| (key.clone(), value_to_wire(item))).collect(),
        }),
    };
    prost_types::Value { kind: Some(kind) }
}

fn value_from_wire(value: prost_types::Value) -> Value {
    match value.kind {
        None | Some(Kind::NullValue(_)) => Value::Null,
        Some(Kind::BoolValue(flag)) => Value::Bool(flag),
        Some(Kind::StringValue(text)) => Value::String(text),
        Some(Kind::NumberValue(number)) if number.fract() == 0.0 && number.abs() < 9e15 => Value::from(number as i64),
        Some(Kind::NumberValue(number)) => Number::from_f64(number).map_or(Value::Null, Value::Number),
        Some(Kind::ListValue(list)) => list.values.into_iter().map(value_from_wire).collect(),
        Some(Kind::StructValue(map)) => {
            map.fields.into_iter().map(|(key, value)| (key, value_from_wire(value))).collect()
        }
    }
}
