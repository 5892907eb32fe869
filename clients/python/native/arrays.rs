//! Packed arrays of the wire as the numpy arrays and Python numbers that Gymnasium expects.
//!
//! Scalar columns become int64 and float64, as Gymnasium's vector environments batch Python numbers; an action mask becomes
//! int8, which is what `Discrete.sample(mask)` takes; other arrays keep their element type.

use crate::errors::Failure;
use mazeway_client::{
    Infos,
    spec::{DType, InfoColumn},
};
use numpy::{Element, IntoPyArray as _, PyArray1, ndarray::ArrayD};
use pyo3::{
    IntoPyObjectExt as _,
    prelude::*,
    types::{PyDict, PyString},
};

/// Name of the column that masks actions.
const ACTION_MASK: &str = "action_mask";

fn elements<const N: usize, T>(bytes: &[u8], read: impl Fn([u8; N]) -> T) -> Vec<T> {
    bytes.as_chunks::<N>().0.iter().map(|chunk| read(*chunk)).collect()
}

/// An array of `shape` over `values`, without a copy.
pub fn shaped<T: Element>(py: Python<'_>, values: Vec<T>, shape: &[usize]) -> Result<Py<PyAny>, Failure> {
    if let [_] = shape {
        return Ok(PyArray1::from_vec(py, values).into_any().unbind());
    }
    let array = ArrayD::from_shape_vec(shape, values).map_err(|error| Failure::protocol(error.to_string()))?;
    Ok(array.into_pyarray(py).into_any().unbind())
}

/// Flags as bool.
pub fn flags(py: Python<'_>, bytes: &[u8]) -> Py<PyAny> {
    PyArray1::from_vec(py, bytes.iter().map(|&flag| flag != 0).collect::<Vec<_>>()).into_any().unbind()
}

/// One column of the infos.
#[derive(Debug)]
pub struct Column {
    name: String,
    key: Py<PyString>,
    dtype: DType,
    shape: Vec<usize>,
    is_mask: bool,
}

impl Column {
    pub fn new(py: Python<'_>, column: &InfoColumn) -> Self {
        Self {
            key: PyString::intern(py, &column.name).unbind(),
            dtype: column.dtype,
            shape: column.shape.iter().map(|&n| n as usize).collect(),
            is_mask: column.name == ACTION_MASK,
            name: column.name.clone(),
        }
    }

    fn bytes<'a>(&self, infos: &'a Infos) -> Result<&'a [u8], Failure> {
        let bytes = infos.as_bytes(&self.name).map(AsRef::as_ref);
        bytes.ok_or_else(|| Failure::protocol(format!("expected the info column {:?}", self.name)))
    }

    /// The values of `num_envs` environments, shape `(num_envs, ...)`.
    pub fn batch(&self, py: Python<'_>, infos: &Infos, num_envs: usize) -> Result<Py<PyAny>, Failure> {
        let mut shape = Vec::with_capacity(1 + self.shape.len());
        shape.push(num_envs);
        shape.extend_from_slice(&self.shape);
        self.array(py, self.bytes(infos)?, &shape)
    }

    fn array(&self, py: Python<'_>, bytes: &[u8], shape: &[usize]) -> Result<Py<PyAny>, Failure> {
        if self.is_mask {
            return shaped(py, elements(bytes, i8::from_le_bytes), shape);
        }
        if self.shape.is_empty() {
            return match self.dtype {
                DType::Uint8 => shaped(py, elements(bytes, |b| i64::from(u8::from_le_bytes(b))), shape),
                DType::Int32 => shaped(py, elements(bytes, |b| i64::from(i32::from_le_bytes(b))), shape),
                DType::Int64 => shaped(py, elements(bytes, i64::from_le_bytes), shape),
                DType::Float32 => shaped(py, elements(bytes, |b| f64::from(f32::from_le_bytes(b))), shape),
                DType::Float64 => shaped(py, elements(bytes, f64::from_le_bytes), shape),
            };
        }
        match self.dtype {
            DType::Uint8 => shaped(py, bytes.to_vec(), shape),
            DType::Int32 => shaped(py, elements(bytes, i32::from_le_bytes), shape),
            DType::Int64 => shaped(py, elements(bytes, i64::from_le_bytes), shape),
            DType::Float32 => shaped(py, elements(bytes, f32::from_le_bytes), shape),
            DType::Float64 => shaped(py, elements(bytes, f64::from_le_bytes), shape),
        }
    }

    /// Puts the value of a single environment into `info`: a Python number, or an array.
    pub fn insert(&self, info: &Bound<'_, PyDict>, infos: &Infos) -> PyResult<()> {
        let (py, bytes) = (info.py(), self.bytes(infos)?);
        let key = self.key.bind(py);
        if !self.shape.is_empty() {
            return info.set_item(key, self.array(py, bytes, &self.shape)?);
        }
        // The client has checked the lengths.
        match (self.dtype, bytes) {
            (DType::Uint8, &[byte]) => info.set_item(key, byte),
            (DType::Int32, &[a, b, c, d]) => info.set_item(key, i32::from_le_bytes([a, b, c, d])),
            (DType::Float32, &[a, b, c, d]) => info.set_item(key, f32::from_le_bytes([a, b, c, d])),
            (DType::Int64, &[a, b, c, d, e, f, g, h]) => {
                info.set_item(key, i64::from_le_bytes([a, b, c, d, e, f, g, h]))
            }
            (DType::Float64, &[a, b, c, d, e, f, g, h]) => {
                info.set_item(key, f64::from_le_bytes([a, b, c, d, e, f, g, h]))
            }
            _ => Err(Failure::protocol(format!("expected one value of {:?}", self.name)).into()),
        }
    }
}

/// Numbers of a discrete space as numpy's int64 scalars, which Gymnasium expects; the same object each time.
#[derive(Debug)]
pub struct Scalars {
    known: Vec<Py<PyAny>>,
    int64: Py<PyAny>,
}

impl Scalars {
    /// Numbers that are made beforehand.
    const KNOWN: u32 = 4096;

    pub fn new(py: Python<'_>, n: u32) -> PyResult<Self> {
        let int64 = py.import("numpy")?.getattr("int64")?;
        let known = (0..n.min(Self::KNOWN)).map(|value| Ok(int64.call1((value,))?.unbind()));
        Ok(Self { known: known.collect::<PyResult<_>>()?, int64: int64.unbind() })
    }

    pub fn get(&self, py: Python<'_>, value: u32) -> PyResult<Py<PyAny>> {
        match self.known.get(value as usize) {
            Some(scalar) => Ok(scalar.clone_ref(py)),
            None => self.int64.bind(py).call1((value,))?.into_py_any(py),
        }
    }
}
