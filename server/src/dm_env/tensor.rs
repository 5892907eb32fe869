//! Tensors: the rules of their shapes, and what they hold.
//!
//! Invariant: memory is taken for the elements that came, never for those that a shape claims; a single element that stands
//! for many is repeated only up to a length that the server has set.

use super::error::WorldError;
use mazeway_proto::dm_env::{
    DataType, Tensor,
    tensor::{self, Payload},
};
use serde_json::{Number, Value};

/// Most elements of a setting's value.
pub const MAX_SETTING_ELEMENTS: usize = 1 << 18;
/// Most dimensions of a setting's value.
const MAX_SETTING_DIMENSIONS: usize = 4;
/// Largest integer up to which every integer is a float64.
const MAX_EXACT: f64 = 9_007_199_254_740_992.0;

/// The type that a payload has.
fn dtype(payload: &Payload) -> DataType {
    match payload {
        Payload::Floats(_) => DataType::Float,
        Payload::Doubles(_) => DataType::Double,
        Payload::Int8s(_) => DataType::Int8,
        Payload::Int32s(_) => DataType::Int32,
        Payload::Int64s(_) => DataType::Int64,
        Payload::Uint8s(_) => DataType::Uint8,
        Payload::Uint32s(_) => DataType::Uint32,
        Payload::Uint64s(_) => DataType::Uint64,
        Payload::Bools(_) => DataType::Bool,
        Payload::Strings(_) => DataType::String,
        Payload::Protos(_) => DataType::Proto,
    }
}

/// Elements that came.
fn len(payload: &Payload) -> usize {
    match payload {
        Payload::Floats(a) => a.array.len(),
        Payload::Doubles(a) => a.array.len(),
        Payload::Int8s(a) => a.array.len(),
        Payload::Int32s(a) => a.array.len(),
        Payload::Int64s(a) => a.array.len(),
        Payload::Uint8s(a) => a.array.len(),
        Payload::Uint32s(a) => a.array.len(),
        Payload::Uint64s(a) => a.array.len(),
        Payload::Bools(a) => a.array.len(),
        Payload::Strings(a) => a.array.len(),
        Payload::Protos(a) => a.array.len(),
    }
}

/// What a tensor is, for messages.
fn described(tensor: &Tensor) -> String {
    let Some(payload) = &tensor.payload else { return "no elements".into() };
    format!("{} of shape {}", dtype(payload).as_str_name(), show(&tensor.shape))
}

/// A shape for messages: as `[2, 3]`, and not more than its first dimensions.
pub fn show(shape: &[i32]) -> String {
    const SHOWN: usize = 8;
    if shape.len() <= SHOWN {
        format!("{shape:?}")
    } else {
        format!("{:?}… ({} dimensions)", &shape[..SHOWN], shape.len())
    }
}

/// What a shape comes to with the elements that are there.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Resolved {
    /// Length of the negative dimension, if there is one.
    inferred: usize,
    /// Elements of the whole tensor.
    total: usize,
}

/// Applies the rules of the protocol: at most one negative dimension, which follows from the number of elements; a single
/// element stands for all.
pub fn resolve(shape: &[i32], elements: usize) -> Result<Resolved, String> {
    let negative = shape.iter().filter(|&&length| length < 0).count();
    if negative > 1 {
        return Err(format!("expected at most one negative dimension, got {negative}"));
    }
    let mut known = 1_usize;
    for &length in shape.iter().filter(|&&length| length >= 0) {
        known = known
            .checked_mul(length as usize)
            .ok_or_else(|| format!("expected a shape that memory has room for, got {}", show(shape)))?;
    }
    if elements == 1 && known > 0 {
        return Ok(Resolved { inferred: 1, total: known });
    }
    if negative == 1 && known > 0 && elements.is_multiple_of(known) {
        return Ok(Resolved { inferred: elements / known, total: elements });
    }
    if negative == 0 && known == elements {
        return Ok(Resolved { inferred: 0, total: elements });
    }
    let wanted = if negative == 1 { format!("a multiple of {known} elements") } else { format!("{known} elements") };
    Err(format!("expected {wanted} for the shape {}, or a single one for all, got {elements}", show(shape)))
}

impl Resolved {
    /// Lengths of all dimensions of `shape`, which this came from.
    fn lengths(self, shape: &[i32]) -> impl Iterator<Item = usize> {
        shape.iter().map(move |&length| usize::try_from(length).unwrap_or(self.inferred))
    }
}

/// Packs the actions that a tensor holds, little-endian, in the place of what `out` held: one INT32, or one for each
/// environment of a batch.
///
/// # Errors
/// Another type or shape; the elements are not looked at.
pub fn actions(tensor: &Tensor, field: &str, batch: Option<usize>, out: &mut Vec<u8>) -> Result<(), WorldError> {
    let expected = || batch.map_or_else(|| "INT32 of shape []".into(), |n| format!("INT32 of shape [{n}]"));
    let wrong = || WorldError::malformed(field, format!("expected {}, got {}", expected(), described(tensor)));
    let Some(Payload::Int32s(tensor::Int32Array { array })) = &tensor.payload else { return Err(wrong()) };
    if tensor.shape.len() != usize::from(batch.is_some()) {
        return Err(wrong());
    }
    let resolved = resolve(&tensor.shape, array.len()).map_err(|message| WorldError::malformed(field, message))?;
    let wanted = batch.unwrap_or(1);
    if !resolved.lengths(&tensor.shape).eq(batch) || resolved.total != wanted {
        return Err(wrong());
    }
    out.clear();
    if let [action] = array[..] {
        for _ in 0..wanted {
            out.extend_from_slice(&action.to_le_bytes());
        }
    } else {
        out.extend(array.iter().flat_map(|action| action.to_le_bytes()));
    }
    Ok(())
}

/// The value of a setting: a scalar, or lists as deep as the tensor has dimensions. Numbers without a fraction become integers.
///
/// # Errors
/// No elements, messages, numbers that are not finite, a shape that the elements do not fill, too many of them.
pub fn to_json(tensor: &Tensor, field: &str) -> Result<Value, WorldError> {
    let malformed = |message: String| WorldError::malformed(field, message);
    let payload = tensor.payload.as_ref().ok_or_else(|| malformed("expected a value, got no elements".into()))?;
    if tensor.shape.len() > MAX_SETTING_DIMENSIONS {
        return Err(malformed(format!(
            "expected at most {MAX_SETTING_DIMENSIONS} dimensions, got {}",
            show(&tensor.shape)
        )));
    }
    let resolved = resolve(&tensor.shape, len(payload)).map_err(malformed)?;
    // Empty lists count too: a shape with a 0 may ask for a great many of them.
    let lists = resolved.lengths(&tensor.shape).try_fold(1_usize, |product, length| product.checked_mul(length.max(1)));
    if lists.is_none_or(|lists| lists > MAX_SETTING_ELEMENTS) {
        let message =
            format!("expected at most {MAX_SETTING_ELEMENTS} elements, got the shape {}", show(&tensor.shape));
        return Err(malformed(message));
    }
    let mut elements = elements(payload, field)?;
    if tensor.shape.is_empty() {
        return Ok(elements.swap_remove(0));
    }
    if elements.len() == 1 {
        elements = vec![elements.swap_remove(0); resolved.total];
    }
    let lengths: Vec<usize> = resolved.lengths(&tensor.shape).collect();
    Ok(nested(&lengths, &mut elements.into_iter()))
}

fn nested(lengths: &[usize], elements: &mut std::vec::IntoIter<Value>) -> Value {
    match lengths {
        [] => elements.next().unwrap_or_default(),
        [length, rest @ ..] => (0..*length).map(|_| nested(rest, elements)).collect(),
    }
}

fn elements(payload: &Payload, field: &str) -> Result<Vec<Value>, WorldError> {
    let number = |value: f64| {
        if value.fract() == 0.0 && value.abs() <= MAX_EXACT {
            return Ok(Value::from(value as i64));
        }
        let number = Number::from_f64(value).map(Value::Number);
        number.ok_or_else(|| WorldError::malformed(field, format!("expected finite numbers, got {value}")))
    };
    Ok(match payload {
        Payload::Floats(a) => a.array.iter().map(|&v| number(f64::from(v))).collect::<Result<_, _>>()?,
        Payload::Doubles(a) => a.array.iter().map(|&v| number(v)).collect::<Result<_, _>>()?,
        Payload::Int8s(a) => a.array.iter().map(|&v| Value::from(v.cast_signed())).collect(),
        Payload::Int32s(a) => a.array.iter().map(|&v| Value::from(v)).collect(),
        Payload::Int64s(a) => a.array.iter().map(|&v| Value::from(v)).collect(),
        Payload::Uint8s(a) => a.array.iter().map(|&v| Value::from(v)).collect(),
        Payload::Uint32s(a) => a.array.iter().map(|&v| Value::from(v)).collect(),
        Payload::Uint64s(a) => a.array.iter().map(|&v| Value::from(v)).collect(),
        Payload::Bools(a) => a.array.iter().map(|&v| Value::from(v)).collect(),
        Payload::Strings(a) => a.array.iter().map(|v| Value::from(v.as_str())).collect(),
        Payload::Protos(_) => {
            return Err(WorldError::malformed(field, "expected numbers, truth values or strings, got PROTO"));
        }
    })
}

/// A scalar of strings.
pub fn string(text: impl Into<String>) -> Tensor {
    with_shape(Payload::Strings(tensor::StringArray { array: vec![text.into()] }), Vec::new())
}

/// A scalar of UINT64.
pub fn uint64(value: u64) -> Tensor {
    with_shape(Payload::Uint64s(tensor::Uint64Array { array: vec![value] }), Vec::new())
}

/// A scalar of DOUBLE.
pub fn double(value: f64) -> Tensor {
    with_shape(Payload::Doubles(tensor::DoubleArray { array: vec![value] }), Vec::new())
}

fn with_shape(payload: Payload, shape: Vec<i32>) -> Tensor {
    Tensor { payload: Some(payload), shape }
}

/// The value of an option: BOOL, INT64, DOUBLE or STRING, alone, in a list, or (numbers) in lists of equal length; anything
/// else as STRING with its JSON. A number is DOUBLE where the option's default is one with a fraction.
pub fn from_json(value: &Value, default: &Value) -> Tensor {
    let json = || string(value.to_string());
    match value {
        Value::Bool(flag) => with_shape(Payload::Bools(tensor::BoolArray { array: vec![*flag] }), Vec::new()),
        Value::String(text) => string(text.as_str()),
        Value::Number(number) => match number.as_i64() {
            Some(integer) if !default.is_f64() => {
                with_shape(Payload::Int64s(tensor::Int64Array { array: vec![integer] }), Vec::new())
            }
            _ => double(number.as_f64().unwrap_or(f64::NAN)),
        },
        Value::Array(items) if !items.is_empty() => {
            let length = items.len() as i32;
            let texts: Option<Vec<String>> = items.iter().map(|item| item.as_str().map(str::to_owned)).collect();
            if let Some(array) = texts {
                return with_shape(Payload::Strings(tensor::StringArray { array }), vec![length]);
            }
            let numbers: Option<Vec<f64>> = items.iter().map(Value::as_f64).collect();
            if let Some(array) = numbers {
                return with_shape(Payload::Doubles(tensor::DoubleArray { array }), vec![length]);
            }
            let rows: Option<Vec<&Vec<Value>>> = items.iter().map(Value::as_array).collect();
            let width = rows.as_ref().map_or(0, |rows| rows[0].len());
            match rows.filter(|rows| rows.iter().all(|row| row.len() == width)) {
                Some(rows) => match rows.into_iter().flatten().map(Value::as_f64).collect::<Option<Vec<f64>>>() {
                    Some(array) => {
                        with_shape(Payload::Doubles(tensor::DoubleArray { array }), vec![length, width as i32])
                    }
                    None => json(),
                },
                None => json(),
            }
        }
        Value::Null | Value::Array(_) | Value::Object(_) => json(),
    }
}

/// Type and shape of a tensor that this server made, for its spec.
pub fn kind(tensor: &Tensor) -> (DataType, Vec<i32>) {
    (tensor.payload.as_ref().map_or(DataType::InvalidDataType, dtype), tensor.shape.clone())
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;
    use serde_json::json;

    fn doubles(array: Vec<f64>, shape: &[i32]) -> Tensor {
        with_shape(Payload::Doubles(tensor::DoubleArray { array }), shape.to_vec())
    }

    fn int32s(array: Vec<i32>, shape: &[i32]) -> Tensor {
        with_shape(Payload::Int32s(tensor::Int32Array { array }), shape.to_vec())
    }

    #[test]
    fn shapes_follow_the_rules_of_the_protocol() {
        let lengths = |shape: &[i32], elements| resolve(shape, elements).map(|r| r.lengths(shape).collect::<Vec<_>>());
        assert_eq!(lengths(&[], 1), Ok(vec![]));
        assert_eq!(lengths(&[2, 3], 6), Ok(vec![2, 3]));
        assert_eq!(lengths(&[2, -1], 6), Ok(vec![2, 3]));
        assert_eq!(lengths(&[-7], 0), Ok(vec![0]));
        assert_eq!(lengths(&[0, 5], 0), Ok(vec![0, 5]));
        // One element for all; a dimension that is left open is then 1.
        assert_eq!(lengths(&[2, 3], 1), Ok(vec![2, 3]));
        assert_eq!(lengths(&[2, -1], 1), Ok(vec![2, 1]));
        for (shape, elements) in
            [(&[-1, -1][..], 4), (&[2, 3], 5), (&[2, -1], 5), (&[0, -1], 3), (&[0], 1), (&[], 0), (&[], 2)]
        {
            assert!(lengths(shape, elements).is_err(), "{shape:?} with {elements}");
        }
        assert!(lengths(&[i32::MAX; 3], 1).is_err());
    }

    #[test]
    fn values_are_nested_as_the_shape_says() {
        let value = |tensor: &Tensor| to_json(tensor, "x").map_err(|error| error.to_string());
        assert_eq!(value(&doubles(vec![0.25], &[])), Ok(json!(0.25)));
        assert_eq!(value(&doubles(vec![4.0], &[])), Ok(json!(4)));
        assert_eq!(value(&doubles(vec![1.0, 2.5, 3.0, 4.0], &[2, -1])), Ok(json!([[1, 2.5], [3, 4]])));
        assert_eq!(value(&doubles(vec![1.0], &[2, 2])), Ok(json!([[1, 1], [1, 1]])));
        assert_eq!(value(&doubles(vec![], &[2, 0])), Ok(json!([[], []])));
        assert_eq!(
            value(&with_shape(Payload::Int8s(tensor::Int8Array { array: vec![0xff].into() }), vec![])),
            Ok(json!(-1))
        );
        assert_eq!(value(&uint64(u64::MAX)), Ok(json!(u64::MAX)));
        for wrong in [
            Tensor::default(),
            doubles(vec![f64::NAN], &[]),
            doubles(vec![1.0], &[1 << 20]),
            doubles(vec![], &[1 << 20, 0]),
            doubles(vec![1.0], &[1; 5]),
            doubles(vec![1.0, 2.0], &[]),
        ] {
            assert!(value(&wrong).is_err(), "{wrong:?}");
        }
    }

    #[test]
    fn options_come_back_from_their_tensors() {
        let round = |value: Value, default: Value| {
            let tensor = from_json(&value, &default);
            (kind(&tensor).0, to_json(&tensor, "x").expect("a value"))
        };
        assert_eq!(round(json!(4), json!(0.3)), (DataType::Double, json!(4)));
        assert_eq!(round(json!(4), json!(3)), (DataType::Int64, json!(4)));
        assert_eq!(round(json!(true), json!(false)), (DataType::Bool, json!(true)));
        assert_eq!(round(json!("a"), json!("b")), (DataType::String, json!("a")));
        assert_eq!(round(json!(["..", ".#"]), json!("")), (DataType::String, json!(["..", ".#"])));
        assert_eq!(round(json!([[0, 1], [2, 0.5]]), Value::Null), (DataType::Double, json!([[0, 1], [2, 0.5]])));
        // What no tensor can express is told as JSON.
        for value in [json!(null), json!([]), json!([[0, 1], [2]]), json!([1, "a"]), json!({"a": 1})] {
            assert_eq!(round(value.clone(), Value::Null), (DataType::String, json!(value.to_string())));
        }
    }

    proptest! {
        #[test]
        fn any_tensor_is_packed_or_refused(
            array in proptest::collection::vec(any::<i32>(), 0..12),
            shape in proptest::collection::vec(prop_oneof![-2..6, any::<i32>()], 0..4),
            batch in proptest::option::of(1_usize..6),
        ) {
            let mut out = vec![7; 3];
            let tensor = int32s(array.clone(), &shape);
            match actions(&tensor, "actions[1]", batch, &mut out) {
                Ok(()) => {
                    let n = batch.unwrap_or(1);
                    prop_assert_eq!(out.len(), 4 * n);
                    prop_assert!(array.len() == 1 || array.len() == n);
                    prop_assert_eq!(shape.len(), usize::from(batch.is_some()));
                }
                Err(error) => {
                    prop_assert_eq!(out, vec![7; 3]);
                    prop_assert_eq!(error.field(), Some("actions[1]".to_owned()));
                }
            }
            // Whatever it claims to be, no more memory is taken than a setting may have.
            let _ = to_json(&tensor, "x");
        }
    }
}
