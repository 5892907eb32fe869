//! Reading of options: every unknown or malformed one is refused by name.

use serde_json::{Map, Value};

use super::{OptionError, OptionSpec};

/// An error on `field`.
pub(crate) fn error(field: &str, message: impl Into<String>) -> OptionError {
    OptionError { field: field.to_owned(), message: message.into() }
}

/// Refuses keys that no option has.
pub(crate) fn refuse_unknown(given: &Map<String, Value>, known: &[OptionSpec]) -> Result<(), OptionError> {
    match given.keys().find(|key| !known.iter().any(|option| option.name == key.as_str())) {
        None => Ok(()),
        Some(key) => {
            let names: Vec<&str> = known.iter().map(|option| option.name).collect();
            let key = shortened(key);
            Err(error(&key, format!("expected one of the options {}, got {key:?}", names.join(", "))))
        }
    }
}

/// At most 80 characters of what came, for messages that never repeat a large input.
pub(crate) fn shortened(text: &str) -> String {
    match text.char_indices().nth(80) {
        None => text.to_owned(),
        Some((end, _)) => format!("{}… ({} bytes)", &text[..end], text.len()),
    }
}

/// What a value is, for messages that never repeat a large input.
pub(crate) fn kind(value: &Value) -> String {
    match value {
        Value::Null => "null".to_owned(),
        Value::Bool(flag) => flag.to_string(),
        Value::Number(number) => number.to_string(),
        Value::String(text) if text.len() <= 40 => format!("{text:?}"),
        Value::String(text) => format!("a string of {} bytes", text.len()),
        Value::Array(items) => format!("a list of {} items", items.len()),
        Value::Object(_) => "an object".to_owned(),
    }
}

/// A number in `low..=high`.
pub(crate) fn number(
    given: &Map<String, Value>,
    field: &str,
    default: f64,
    low: f64,
    high: f64,
) -> Result<f64, OptionError> {
    let Some(value) = given.get(field) else { return Ok(default) };
    match value.as_f64() {
        Some(number) if (low..=high).contains(&number) => Ok(number),
        _ => Err(error(field, format!("expected a number from {low} to {high}, got {}", kind(value)))),
    }
}

/// A boolean.
pub(crate) fn flag(given: &Map<String, Value>, field: &str, default: bool) -> Result<bool, OptionError> {
    let Some(value) = given.get(field) else { return Ok(default) };
    value.as_bool().ok_or_else(|| error(field, format!("expected true or false, got {}", kind(value))))
}

/// One of some names; returns its rank.
pub(crate) fn choice(
    given: &Map<String, Value>,
    field: &str,
    names: &[&str],
    default: usize,
) -> Result<usize, OptionError> {
    let Some(value) = given.get(field) else { return Ok(default) };
    value
        .as_str()
        .and_then(|text| names.iter().position(|&name| name == text))
        .ok_or_else(|| error(field, format!("expected one of {}, got {}", names.join(", "), kind(value))))
}

#[cfg(test)]
mod tests {
    use serde_json::json;

    use super::*;

    fn given(value: Value) -> Map<String, Value> {
        value.as_object().expect("an object").clone()
    }

    #[test]
    fn malformed_values_name_their_field() {
        let options = given(json!({"slip": 1.5, "flag": 1, "style": "fast"}));
        assert_eq!(
            number(&options, "slip", 0.3, 0.0, 1.0).unwrap_err().to_string(),
            "slip: expected a number from 0 to 1, got 1.5"
        );
        assert_eq!(flag(&options, "flag", false).unwrap_err().to_string(), "flag: expected true or false, got 1");
        assert_eq!(
            choice(&options, "style", &["bad", "legal"], 0).unwrap_err().to_string(),
            "style: expected one of bad, legal, got \"fast\""
        );
    }

    #[test]
    fn no_message_repeats_a_large_input() {
        let name = "ü".repeat(100_000);
        let error = refuse_unknown(&given(json!({ name: 1 })), &[]).unwrap_err();
        assert!(error.field.len() < 200 && error.message.len() < 300, "{error}");
    }

    #[test]
    fn absent_values_are_the_defaults() {
        let options = Map::new();
        assert_eq!(number(&options, "slip", 0.3, 0.0, 1.0), Ok(0.3));
        assert_eq!(flag(&options, "flag", true), Ok(true));
        assert_eq!(choice(&options, "style", &["bad", "legal"], 1), Ok(1));
    }
}
