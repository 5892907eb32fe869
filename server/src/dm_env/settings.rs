//! Settings: tensors by name, each read once and by its type; what nobody has asked for is refused.

use super::{error::WorldError, tensor};
use crate::{
    registry::Options,
    sim::options::{self, shortened},
};
use mazeway_proto::dm_env::Tensor;
use serde_json::Value;
use std::{collections::BTreeMap, time::Duration};

/// Prefix of the settings that are options of the environment.
const OPTION: &str = "options.";
/// All options as one JSON object, for values that no tensor can express.
const ALL_OPTIONS: &str = "options";

/// Settings that are still to be read.
pub struct Settings(BTreeMap<String, Tensor>);

impl Settings {
    /// Settings as they came.
    pub fn new(settings: BTreeMap<String, Tensor>) -> Self {
        Self(settings)
    }

    fn take(&mut self, name: &str) -> Result<Option<Value>, WorldError> {
        self.0.remove(name).map(|tensor| tensor::to_json(&tensor, &path(name))).transpose()
    }

    /// A string.
    pub fn text(&mut self, name: &str) -> Result<Option<String>, WorldError> {
        match self.take(name)? {
            None => Ok(None),
            Some(Value::String(text)) => Ok(Some(text)),
            Some(other) => Err(wrong(name, "a string", &other)),
        }
    }

    /// An integer of any type, or a number without a fraction.
    pub fn integer(&mut self, name: &str, least: u64, most: u64) -> Result<Option<u64>, WorldError> {
        match self.take(name)? {
            None => Ok(None),
            Some(value) => integer(&value, least, most)
                .map(Some)
                .ok_or_else(|| wrong(name, &format!("an integer from {least} to {most}"), &value)),
        }
    }

    /// A positive number of seconds.
    pub fn seconds(&mut self, name: &str) -> Result<Option<Duration>, WorldError> {
        match self.take(name)? {
            None => Ok(None),
            Some(value) => {
                let secs = value.as_f64().and_then(|secs| Duration::try_from_secs_f64(secs).ok());
                let secs = secs.filter(|duration| !duration.is_zero());
                secs.map(Some).ok_or_else(|| wrong(name, "a positive number of seconds", &value))
            }
        }
    }

    /// Options of the environment: `options.NAME`, or `options` with a JSON object of them.
    pub fn options(&mut self) -> Result<Options, WorldError> {
        let mut options = match self.text(ALL_OPTIONS)? {
            None => Options::new(),
            Some(text) => serde_json::from_str::<Options>(&text).map_err(|error| {
                WorldError::malformed(
                    path(ALL_OPTIONS),
                    format!("expected a JSON object: {}", shortened(&error.to_string())),
                )
            })?,
        };
        while let Some((key, _)) = self.0.range(OPTION.to_owned()..).next().filter(|(key, _)| key.starts_with(OPTION)) {
            let key = key.clone();
            let (name, value) = (&key[OPTION.len()..], self.take(&key)?.unwrap_or_default());
            if options.insert(name.to_owned(), value).is_some() {
                let message = "expected each option once, got it in \"options\" as well";
                return Err(WorldError::malformed(path(&key), message));
            }
        }
        Ok(options)
    }

    /// Refuses what is left; `known` are the names that there are.
    pub fn finish(self, known: &str) -> Result<(), WorldError> {
        match self.0.into_keys().next() {
            None => Ok(()),
            Some(name) => {
                let message = format!("no such setting; there are {known}");
                Err(WorldError::malformed(path(&shortened(&name)), message))
            }
        }
    }
}

/// An integer within bounds.
pub fn integer(value: &Value, least: u64, most: u64) -> Option<u64> {
    value.as_u64().filter(|integer| (least..=most).contains(integer))
}

fn path(name: &str) -> String {
    format!("settings.{}", shortened(name))
}

fn wrong(name: &str, expected: &str, got: &Value) -> WorldError {
    WorldError::malformed(path(name), format!("expected {expected}, got {}", options::kind(got)))
}
