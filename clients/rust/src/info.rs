//! Observations and infos as clients see them.

use crate::{
    ClientError,
    packed::{Element, Packed},
    spec::{DType, EnvSpec, InfoColumn, ObservationSpace},
};
use bytes::Bytes;
use std::sync::Arc;

/// One environment's observation.
#[derive(Debug, Clone, PartialEq)]
pub enum Observation {
    /// One of the integers `0..n`.
    Discrete(u32),
    /// An array, row-major, in the shape of the space.
    Box(Vec<f32>),
}

impl Observation {
    /// The integer, where the space is discrete.
    pub fn discrete(&self) -> Option<u32> {
        match self {
            Self::Discrete(value) => Some(*value),
            Self::Box(_) => None,
        }
    }
}

/// The observations of a batch.
#[derive(Debug, Clone, PartialEq)]
pub enum Observations {
    /// One of the integers `0..n` an environment, shape `(num_envs,)`.
    Discrete(Packed<u32>),
    /// An array an environment, row-major, shape `(num_envs, ...)`.
    Box {
        /// All elements.
        values: Packed<f32>,
        /// Elements of one environment's array.
        elements: usize,
    },
}

impl Observations {
    pub(crate) fn from_wire(bytes: Bytes, spec: &EnvSpec, num_envs: usize) -> Result<Self, ClientError> {
        Ok(match spec.observation_space {
            ObservationSpace::Discrete { .. } => Self::Discrete(Packed::of_len(bytes, num_envs, "observations")?),
            ObservationSpace::Box { .. } => {
                let elements = spec.observation_elements();
                Self::Box { values: Packed::of_len(bytes, num_envs * elements, "observations")?, elements }
            }
        })
    }

    /// Environment `index`'s; `None` beyond the batch.
    pub fn get(&self, index: usize) -> Option<Observation> {
        match self {
            Self::Discrete(values) => values.get(index).map(Observation::Discrete),
            Self::Box { values, elements } => {
                let end = (index + 1) * elements;
                let within = end <= values.len();
                within.then(|| Observation::Box(values.iter().take(end).skip(index * elements).collect()))
            }
        }
    }

    /// All of them as they travelled.
    pub fn as_bytes(&self) -> &Bytes {
        match self {
            Self::Discrete(values) => values.as_bytes(),
            Self::Box { values, .. } => values.as_bytes(),
        }
    }

    /// The integers, where the space is discrete, shape `(num_envs,)`.
    pub fn discrete(&self) -> Option<&Packed<u32>> {
        match self {
            Self::Discrete(values) => Some(values),
            Self::Box { .. } => None,
        }
    }
}

/// The infos of a batch: named packed columns.
#[derive(Debug, Clone, PartialEq)]
pub struct Infos {
    columns: Arc<[InfoColumn]>,
    values: Vec<Bytes>,
}

impl Infos {
    pub(crate) fn from_wire(
        values: Vec<Bytes>,
        columns: &Arc<[InfoColumn]>,
        num_envs: usize,
    ) -> Result<Self, ClientError> {
        if values.len() != columns.len() {
            let message = format!("expected {} info columns, got {}", columns.len(), values.len());
            return Err(ClientError::protocol(message));
        }
        for (bytes, column) in values.iter().zip(columns.iter()) {
            let expected = num_envs * column.elements() * column.dtype.size();
            if bytes.len() != expected {
                let message = format!("expected {expected} bytes of {:?}, got {}", column.name, bytes.len());
                return Err(ClientError::protocol(message));
            }
        }
        Ok(Self { columns: Arc::clone(columns), values })
    }

    /// The columns in order.
    pub fn columns(&self) -> &[InfoColumn] {
        &self.columns
    }

    fn column(&self, name: &str) -> Option<(&InfoColumn, &Bytes)> {
        let rank = self.columns.iter().position(|column| column.name == name)?;
        Some((&self.columns[rank], &self.values[rank]))
    }

    fn typed<T: Element>(&self, name: &str, dtype: DType) -> Option<Packed<T>> {
        let (column, bytes) = self.column(name)?;
        if column.dtype == dtype { Packed::new(bytes.clone()) } else { None }
    }

    /// A column of any type as it travelled.
    pub fn as_bytes(&self, name: &str) -> Option<&Bytes> {
        self.column(name).map(|(_, bytes)| bytes)
    }

    /// An `Int32` column, shape `(num_envs, ...)`; `None` for another name or type.
    pub fn i32(&self, name: &str) -> Option<Packed<i32>> {
        self.typed(name, DType::Int32)
    }

    /// A `Uint8` column, shape `(num_envs, ...)`; `None` for another name or type.
    pub fn u8(&self, name: &str) -> Option<Packed<u8>> {
        self.typed(name, DType::Uint8)
    }

    /// A `Float32` column, shape `(num_envs, ...)`; `None` for another name or type.
    pub fn f32(&self, name: &str) -> Option<Packed<f32>> {
        self.typed(name, DType::Float32)
    }

    /// A `Float64` column, shape `(num_envs, ...)`; `None` for another name or type.
    pub fn f64(&self, name: &str) -> Option<Packed<f64>> {
        self.typed(name, DType::Float64)
    }

    /// Environment `index`'s value of a scalar column of any type, as a number.
    pub fn number(&self, name: &str, index: usize) -> Option<f64> {
        let (column, bytes) = self.column(name)?;
        let size = column.dtype.size();
        let bytes = bytes.get(index * size..(index + 1) * size).filter(|_| column.shape.is_empty())?;
        Some(match column.dtype {
            DType::Uint8 => f64::from(bytes[0]),
            DType::Int32 => f64::from(i32::read(bytes)),
            DType::Int64 => i64::read(bytes) as f64,
            DType::Float32 => f64::from(f32::read(bytes)),
            DType::Float64 => f64::read(bytes),
        })
    }
}
