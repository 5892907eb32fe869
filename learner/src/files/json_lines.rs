//! JSON lines: an object a trajectory with arrays, as `learner export` writes them, or an object a step.

use super::{
    columns::{ReadOptions, Role},
    demonstrations::{Demonstration, Resolvers, Seen, finish},
    error::{FileError, Place},
    names::Resolve,
    table::Table,
    value::Value,
};
use crate::store::clip;
use serde::de::{DeserializeSeed, Deserializer, Error as _, IgnoredAny, MapAccess, SeqAccess, Visitor};
use std::{
    fmt,
    fs::File,
    io::{BufRead as _, BufReader, Read as _},
    ops::ControlFlow,
    path::{Path, PathBuf},
};

/// Bytes of one line at most.
const MOST_LINE_BYTES: u64 = 256 << 20;
const HINT: &str = "each line is one JSON object, such as {\"trajectory\":\"a\",\"states\":[0,1],\"actions\":[2,2]}";

/// Lines that are not blank, with their numbers.
struct Lines {
    file: PathBuf,
    reader: BufReader<File>,
    text: Vec<u8>,
    number: u64,
}

impl Lines {
    fn open(file: &Path) -> Result<Self, FileError> {
        let opened = File::open(file).map_err(|error| FileError::unreadable(file, &error))?;
        Ok(Self { file: file.to_owned(), reader: BufReader::new(opened), text: Vec::new(), number: 0 })
    }

    /// Reads on; false at the end.
    fn next(&mut self) -> Result<bool, FileError> {
        loop {
            self.text.clear();
            let limited = (&mut self.reader).take(MOST_LINE_BYTES + 1).read_until(b'\n', &mut self.text);
            let read = limited.map_err(|error| FileError::unreadable(&self.file, &error))?;
            self.number += 1;
            if read as u64 > MOST_LINE_BYTES {
                let message = format!("expected lines of at most {MOST_LINE_BYTES} bytes, got a longer one");
                return Err(FileError::new(&self.file, Place::Line(self.number), message, HINT));
            }
            if read == 0 {
                return Ok(false);
            }
            if self.number == 1 && self.text.starts_with(b"\xef\xbb\xbf") {
                self.text.drain(..3);
            }
            while self.text.last().is_some_and(u8::is_ascii_whitespace) {
                self.text.pop();
            }
            if !self.text.is_empty() {
                return Ok(true);
            }
        }
    }

    fn parse<'a, S: DeserializeSeed<'a>>(&'a self, seed: S) -> Result<S::Value, FileError> {
        parse(seed, &self.text).map_err(|(column, message)| {
            FileError::new(&self.file, Place::Character { line: self.number, column }, message, HINT)
        })
    }
}

/// Parses a text of one line; the column of an error counts characters.
fn parse<'a, S: DeserializeSeed<'a>>(seed: S, text: &'a [u8]) -> Result<S::Value, (usize, String)> {
    let mut deserializer = serde_json::Deserializer::from_slice(text);
    let value = seed.deserialize(&mut deserializer).and_then(|value| deserializer.end().map(|()| value));
    value.map_err(|error| {
        let bytes = error.column().clamp(1, text.len().max(1));
        let column = String::from_utf8_lossy(&text[..bytes.min(text.len())]).chars().count().max(1);
        (column, super::model_json::without_position(&error))
    })
}

/// Any scalar.
pub(super) struct Cell;

impl<'de> DeserializeSeed<'de> for Cell {
    type Value = Value;

    fn deserialize<D: Deserializer<'de>>(self, deserializer: D) -> Result<Value, D::Error> {
        deserializer.deserialize_any(self)
    }
}

impl Visitor<'_> for Cell {
    type Value = Value;

    fn expecting(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str("a text, a number, true, false or null")
    }

    fn visit_bool<E>(self, value: bool) -> Result<Value, E> {
        Ok(Value::Truth(value))
    }

    fn visit_i64<E>(self, value: i64) -> Result<Value, E> {
        Ok(Value::Integer(value))
    }

    fn visit_u64<E>(self, value: u64) -> Result<Value, E> {
        Ok(i64::try_from(value).map_or(Value::Number(value as f64), Value::Integer))
    }

    fn visit_f64<E>(self, value: f64) -> Result<Value, E> {
        Ok(Value::Number(value))
    }

    fn visit_str<E>(self, value: &str) -> Result<Value, E> {
        Ok(Value::text(value))
    }

    fn visit_unit<E>(self) -> Result<Value, E> {
        Ok(Value::Null)
    }
}

/// Indices of states or actions.
struct Indices<'a>(&'a mut dyn Resolve);

impl<'de> DeserializeSeed<'de> for Indices<'_> {
    type Value = Vec<u32>;

    fn deserialize<D: Deserializer<'de>>(self, deserializer: D) -> Result<Vec<u32>, D::Error> {
        deserializer.deserialize_seq(self)
    }
}

impl<'de> Visitor<'de> for Indices<'_> {
    type Value = Vec<u32>;

    fn expecting(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str("a list of labels or indices")
    }

    fn visit_seq<A: SeqAccess<'de>>(self, mut list: A) -> Result<Vec<u32>, A::Error> {
        let mut indices = Vec::new();
        while let Some(cell) = list.next_element_seed(Cell)? {
            indices.push(self.0.resolve(&cell).map_err(A::Error::custom)?);
        }
        Ok(indices)
    }
}

/// A whole trajectory.
struct Trajectory<'a, 'b> {
    options: &'a ReadOptions,
    names: &'a mut Resolvers<'b>,
}

impl<'de> DeserializeSeed<'de> for Trajectory<'_, '_> {
    type Value = Demonstration;

    fn deserialize<D: Deserializer<'de>>(self, deserializer: D) -> Result<Demonstration, D::Error> {
        deserializer.deserialize_map(self)
    }
}

impl<'de> Visitor<'de> for Trajectory<'_, '_> {
    type Value = Demonstration;

    fn expecting(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str("an object")
    }

    fn visit_map<A: MapAccess<'de>>(self, mut map: A) -> Result<Demonstration, A::Error> {
        let (mut d, mut name) = (Demonstration::default(), None);
        let wrong = A::Error::custom::<String>;
        while let Some(key) = map.next_key::<String>()? {
            match self.options.role(&key) {
                Some(Role::Trajectory) if name.is_none() => name = map.next_value_seed(Cell)?.label(),
                Some(Role::States) => d.states = map.next_value_seed(Indices(&mut *self.names.states))?,
                Some(Role::Actions) => d.actions = map.next_value_seed(Indices(&mut *self.names.actions))?,
                Some(Role::Rewards) => d.rewards = map.next_value()?,
                Some(Role::FinalState | Role::NextState) => match map.next_value_seed(Cell)? {
                    Value::Null => {}
                    cell => d.final_state = Some(self.names.states.resolve(&cell).map_err(wrong)?),
                },
                Some(Role::Env) => d.env = map.next_value_seed(Cell)?.label(),
                Some(Role::Style) => d.style = map.next_value_seed(Cell)?.label(),
                Some(Role::Source) => d.source = map.next_value_seed(Cell)?.label(),
                Some(Role::Seed) => d.seed = map.next_value()?,
                Some(Role::Terminated) => d.terminated = map.next_value()?,
                Some(Role::Truncated) => d.truncated = map.next_value()?,
                _ => {
                    map.next_value::<IgnoredAny>()?;
                }
            }
        }
        d.name = name.ok_or_else(|| wrong("expected the id of a trajectory, got none".into()))?;
        finish(d).map_err(|(message, _)| wrong(message))
    }
}

/// Reads a file of an object a trajectory.
pub(super) fn trajectories(
    file: &Path,
    options: &ReadOptions,
    names: &mut Resolvers<'_>,
    visit: &mut dyn FnMut(Demonstration) -> ControlFlow<Option<FileError>>,
) -> Result<(), FileError> {
    let (mut lines, mut seen) = (Lines::open(file)?, Seen::default());
    while lines.next()? {
        let mut demonstration = lines.parse(Trajectory { options, names })?;
        if !seen.insert(&demonstration.name) {
            let message = format!("expected each trajectory once, got '{}' again", clip(&demonstration.name));
            return Err(FileError::new(
                file,
                Place::Line(lines.number),
                message,
                "give every trajectory an id of its own",
            ));
        }
        demonstration.places = vec![lines.number; demonstration.states.len()];
        match visit(demonstration) {
            ControlFlow::Continue(()) => {}
            ControlFlow::Break(None) => return Ok(()),
            ControlFlow::Break(Some(error)) => return Err(error),
        }
    }
    Ok(())
}

/// Scalars of an object by key; whatever else it holds is `None`.
struct Object;

impl<'de> DeserializeSeed<'de> for Object {
    type Value = Vec<(String, Option<Value>)>;

    fn deserialize<D: Deserializer<'de>>(self, deserializer: D) -> Result<Self::Value, D::Error> {
        deserializer.deserialize_map(self)
    }
}

impl<'de> Visitor<'de> for Object {
    type Value = Vec<(String, Option<Value>)>;

    fn expecting(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str("an object")
    }

    fn visit_map<A: MapAccess<'de>>(self, mut map: A) -> Result<Self::Value, A::Error> {
        let mut cells = Vec::new();
        while let Some(key) = map.next_key::<String>()? {
            let value = match map.next_value::<serde_json::Value>()? {
                serde_json::Value::Null => Some(Value::Null),
                serde_json::Value::Bool(truth) => Some(Value::Truth(truth)),
                serde_json::Value::Number(number) => Some(match number.as_i64() {
                    Some(integer) => Value::Integer(integer),
                    None => Value::Number(number.as_f64().unwrap_or(f64::NAN)),
                }),
                serde_json::Value::String(text) => Some(Value::text(&text)),
                serde_json::Value::Array(_) | serde_json::Value::Object(_) => None,
            };
            cells.push((key, value));
        }
        Ok(cells)
    }
}

/// A file of an object a step; its columns are the keys of the first.
pub(super) struct JsonTable {
    lines: Lines,
    columns: Vec<String>,
    first: Option<Vec<(String, Option<Value>)>>,
}

impl JsonTable {
    /// Opens a file; `None` where its objects are whole trajectories.
    pub(super) fn open(file: &Path, options: &ReadOptions) -> Result<Option<Self>, FileError> {
        let mut lines = Lines::open(file)?;
        if !lines.next()? {
            return Err(FileError::new(file, Place::File, "expected a JSON object a line, got an empty file", HINT));
        }
        let first = lines.parse(Object)?;
        if first.iter().any(|(key, _)| options.role(key) == Some(Role::States)) {
            return Ok(None);
        }
        let columns = first.iter().map(|(key, _)| key.clone()).collect();
        Ok(Some(Self { lines, columns, first: Some(first) }))
    }
}

impl Table for JsonTable {
    fn columns(&self) -> &[String] {
        &self.columns
    }

    fn next(&mut self, row: &mut Vec<Value>) -> Result<bool, FileError> {
        let cells = match self.first.take() {
            Some(first) => first,
            None if self.lines.next()? => self.lines.parse(Object)?,
            None => return Ok(false),
        };
        row.clear();
        row.resize(self.columns.len(), Value::Null);
        for (key, value) in cells {
            // A key that the first object has not is no column; a list is no cell.
            if let (Some(rank), Some(value)) = (self.columns.iter().position(|column| *column == key), value) {
                row[rank] = value;
            }
        }
        Ok(true)
    }

    fn place(&self, column: Option<usize>) -> Place {
        let line = self.lines.number;
        let Some(name) = column.and_then(|column| self.columns.get(column)) else { return Place::Line(line) };
        // The column of the key: it stands in front of its value.
        let text = String::from_utf8_lossy(&self.lines.text);
        match text.find(&format!("\"{name}\"")) {
            Some(byte) => Place::Character { line, column: text[..byte].chars().count() + 1 },
            None => Place::Line(line),
        }
    }

    fn file(&self) -> &Path {
        &self.lines.file
    }
}
