//! One cell of a table, whatever the format.

use crate::store::clip;

/// A cell.
#[derive(Debug, Clone, PartialEq)]
pub enum Value {
    /// Nothing.
    Null,
    /// A whole number.
    Integer(i64),
    /// A number.
    Number(f64),
    /// True or false.
    Truth(bool),
    /// A text, not empty.
    Text(String),
}

impl Value {
    /// A text; an empty one is no value.
    pub fn text(text: &str) -> Self {
        if text.is_empty() { Self::Null } else { Self::Text(text.to_owned()) }
    }

    /// True where there is no value.
    pub fn is_null(&self) -> bool {
        matches!(self, Self::Null)
    }

    /// As a label: a whole number is written without a point.
    pub fn label(&self) -> Option<String> {
        match self {
            Self::Null => None,
            Self::Integer(i) => Some(i.to_string()),
            Self::Number(x) if x.fract() == 0.0 && x.abs() < 1e15 => Some((*x as i64).to_string()),
            Self::Number(x) => Some(x.to_string()),
            Self::Truth(b) => Some(b.to_string()),
            Self::Text(text) => Some(text.clone()),
        }
    }

    /// As a whole number that is not negative; `3.0` is one, as tools write it where a column has gaps.
    pub fn whole(&self) -> Option<u64> {
        match self {
            Self::Integer(i) => u64::try_from(*i).ok(),
            Self::Number(x) if x.fract() == 0.0 && (0.0..9e15).contains(x) => Some(*x as u64),
            Self::Text(text) => text.parse().ok().or_else(|| Self::Number(text.parse().ok()?).whole()),
            Self::Null | Self::Number(_) | Self::Truth(_) => None,
        }
    }

    /// As a finite number.
    pub fn number(&self) -> Option<f64> {
        let number = match self {
            Self::Integer(i) => *i as f64,
            Self::Number(x) => *x,
            Self::Text(text) => text.trim().parse().ok()?,
            Self::Truth(b) => f64::from(u8::from(*b)),
            Self::Null => return None,
        };
        number.is_finite().then_some(number)
    }

    /// As true or false.
    pub fn truth(&self) -> Option<bool> {
        match self {
            Self::Truth(b) => Some(*b),
            Self::Integer(0) => Some(false),
            Self::Integer(1) => Some(true),
            Self::Text(text) => match text.to_ascii_lowercase().as_str() {
                "true" | "1" | "yes" => Some(true),
                "false" | "0" | "no" => Some(false),
                _ => None,
            },
            Self::Null | Self::Integer(_) | Self::Number(_) => None,
        }
    }

    /// As it is shown in a message.
    pub fn shown(&self) -> String {
        match self {
            Self::Null => "nothing".to_owned(),
            Self::Text(text) => format!("'{}'", clip(text).escape_debug()),
            other => format!("'{}'", other.label().unwrap_or_default()),
        }
    }
}
