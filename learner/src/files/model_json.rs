//! A model as one JSON document.
//!
//! It is read twice: what states and actions are called first, so that the rest may name them wherever it stands. Every
//! error has the line and column where the reader stood; one that only the whole shows is put to its place by reading up
//! to it once more.

use super::{
    error::{FileError, Place},
    json_lines::Cell,
    model::{Entry, ModelFile, compress, unique},
    names::{Names, Resolve},
    value::Value,
};
use crate::store::clip;
use mazeway_client::{FeatureDomain, FeatureTable};
use serde::de::{DeserializeSeed, Deserializer, Error as _, IgnoredAny, MapAccess, SeqAccess, Visitor};
use std::{fmt, path::Path};

const HINT: &str = "see docs/DATA.md for the format of a model, with an example";
const KEYS: [&str; 8] = ["env", "states", "actions", "transitions", "features", "start", "terminal", "rewards"];

/// An error's message without the place, which the caller names in its own way.
pub(super) fn without_position(error: &serde_json::Error) -> String {
    let text = error.to_string();
    let place = format!(" at line {} column {}", error.line(), error.column());
    text.strip_suffix(&place).unwrap_or(&text).to_owned()
}

/// Reads a model.
pub(super) fn read(file: &Path) -> Result<ModelFile, FileError> {
    let text = std::fs::read(file).map_err(|error| FileError::unreadable(file, &error))?;
    parse(file, &text)
}

/// Reads a model from its text.
pub(super) fn parse(file: &Path, text: &[u8]) -> Result<ModelFile, FileError> {
    let text = text.strip_prefix(b"\xef\xbb\xbf").unwrap_or(text);
    let (states, actions) = run(file, text, Lists)?;
    let whole = |fail| Whole { states: &states, actions: &actions, fail };
    let draft = run(file, text, whole(None))?;
    let rows = match draft.transitions {
        None => None,
        Some(entries) => match compress(entries, &states, &actions, &draft.terminal) {
            Ok(rows) => Some(rows),
            Err(fault) => {
                let at = fault.entry.map(|entry| (entry, fault.message.clone()));
                let place = match run(file, text, whole(at)) {
                    Err(error) if fault.entry.is_some() => error.place,
                    _ => Place::File,
                };
                return Err(FileError::new(file, place, fault.message, fault.hint));
            }
        },
    };
    Ok(ModelFile {
        file: file.to_owned(),
        env: draft.env,
        states,
        actions,
        rows,
        initial_distribution: draft.initial,
        terminal_states: draft.terminal,
        features: draft.features,
        rewards: draft.rewards,
    })
}

fn run<'a, S: DeserializeSeed<'a>>(file: &Path, text: &'a [u8], seed: S) -> Result<S::Value, FileError> {
    let mut deserializer = serde_json::Deserializer::from_slice(text);
    let value = seed.deserialize(&mut deserializer).and_then(|value| deserializer.end().map(|()| value));
    value.map_err(|error| {
        let place = Place::Character { line: error.line() as u64, column: error.column().max(1) };
        FileError::new(file, place, without_position(&error), HINT)
    })
}

/// The two lists of names.
struct Lists;

impl<'de> DeserializeSeed<'de> for Lists {
    type Value = (Names, Names);

    fn deserialize<D: Deserializer<'de>>(self, deserializer: D) -> Result<Self::Value, D::Error> {
        deserializer.deserialize_map(self)
    }
}

impl<'de> Visitor<'de> for Lists {
    type Value = (Names, Names);

    fn expecting(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str("an object with the keys states, actions and transitions")
    }

    fn visit_map<A: MapAccess<'de>>(self, mut map: A) -> Result<Self::Value, A::Error> {
        let (mut states, mut actions) = (None, None);
        while let Some(key) = map.next_key::<String>()? {
            match key.as_str() {
                "states" => states = Some(map.next_value_seed(List("state"))?),
                "actions" => actions = Some(map.next_value_seed(List("action"))?),
                known if KEYS.contains(&known) => {
                    map.next_value::<IgnoredAny>()?;
                }
                other => {
                    let message = format!("expected one of the keys {}, got '{}'", KEYS.join(", "), clip(other));
                    return Err(A::Error::custom(message));
                }
            }
        }
        let missing =
            |what| A::Error::custom(format!("expected the key {what}: a list of labels, or how many there are"));
        Ok((states.ok_or_else(|| missing("states"))?, actions.ok_or_else(|| missing("actions"))?))
    }
}

/// A list of labels, or a number.
struct List(&'static str);

impl<'de> DeserializeSeed<'de> for List {
    type Value = Names;

    fn deserialize<D: Deserializer<'de>>(self, deserializer: D) -> Result<Names, D::Error> {
        deserializer.deserialize_any(self)
    }
}

impl<'de> Visitor<'de> for List {
    type Value = Names;

    fn expecting(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "a list of labels, or how many {}s there are", self.0)
    }

    fn visit_u64<E: serde::de::Error>(self, size: u64) -> Result<Names, E> {
        match i32::try_from(size) {
            Ok(1..) => Ok(Names::numbered(self.0, size as u32)),
            _ => Err(E::custom(format!("expected 1 to {} {}s, got {size}", i32::MAX, self.0))),
        }
    }

    fn visit_seq<A: SeqAccess<'de>>(self, mut list: A) -> Result<Names, A::Error> {
        let (mut labels, mut known) = (Vec::new(), std::collections::HashSet::new());
        while let Some(cell) = list.next_element_seed(Cell)? {
            let label = cell.label().ok_or_else(|| A::Error::custom(format!("expected a label of the {}", self.0)))?;
            if !known.insert(label.clone()) {
                return Err(A::Error::custom(format!("expected each {} once, got '{}' again", self.0, clip(&label))));
            }
            labels.push(label);
        }
        if labels.is_empty() {
            return Err(A::Error::custom(format!("expected at least one {}, got none", self.0)));
        }
        Names::labelled(self.0, labels).map_err(|(_, message)| A::Error::custom(message))
    }
}

/// Everything but the names.
#[derive(Default)]
struct Draft {
    env: Option<String>,
    transitions: Option<Vec<Entry>>,
    features: Option<FeatureTable>,
    initial: Option<Vec<f64>>,
    terminal: Vec<u32>,
    rewards: Vec<(String, Vec<f64>)>,
}

#[derive(Clone)]
struct Whole<'a> {
    states: &'a Names,
    actions: &'a Names,
    /// Fail at this transition with these words.
    fail: Option<(usize, String)>,
}

impl Whole<'_> {
    fn pairs(&self) -> Result<usize, String> {
        let n = u64::from(self.states.len()) * u64::from(self.actions.len());
        usize::try_from(n)
            .ok()
            .filter(|&n| n <= 1 << 28)
            .ok_or_else(|| format!("expected at most {} pairs, got {n}", 1 << 28))
    }
}

impl<'de> DeserializeSeed<'de> for Whole<'_> {
    type Value = Draft;

    fn deserialize<D: Deserializer<'de>>(self, deserializer: D) -> Result<Draft, D::Error> {
        deserializer.deserialize_map(self)
    }
}

impl<'de> Visitor<'de> for Whole<'_> {
    type Value = Draft;

    fn expecting(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str("an object with the keys states, actions and transitions")
    }

    fn visit_map<A: MapAccess<'de>>(self, mut map: A) -> Result<Draft, A::Error> {
        let mut draft = Draft::default();
        let mut features = None;
        let context = &self;
        while let Some(key) = map.next_key::<String>()? {
            match key.as_str() {
                "env" => draft.env = map.next_value()?,
                "transitions" => {
                    let mut entries = Vec::new();
                    map.next_value_seed(Rows::new("[state, action, next state, probability]", |cells: &[Value]| {
                        let [state, action, next, p] = cells else { return Err(length(cells, "4")) };
                        let entry = Entry {
                            state: { context.states }.resolve(state)?,
                            action: { context.actions }.resolve(action)?,
                            next: { context.states }.resolve(next)?,
                            probability: probability(p)?,
                        };
                        match &context.fail {
                            Some((rank, message)) if *rank == entries.len() => return Err(message.clone()),
                            _ => entries.push(entry),
                        }
                        Ok(())
                    }))?;
                    draft.transitions = Some(entries);
                }
                "features" => features = Some(map.next_value_seed(FeaturesSeed(context))?),
                "start" => {
                    let mut initial = vec![0.0; context.states.len() as usize];
                    map.next_value_seed(Rows::new("[state, probability]", |cells: &[Value]| {
                        let [state, p] = cells else { return Err(length(cells, "2")) };
                        initial[{ context.states }.resolve(state)? as usize] = probability(p)?;
                        Ok(())
                    }))?;
                    let sum: f64 = initial.iter().sum();
                    if (sum - 1.0).abs() > 1e-6 {
                        return Err(A::Error::custom(format!("expected start probabilities that sum to 1, got {sum}")));
                    }
                    if (sum - 1.0).abs() > 1e-9 {
                        for p in &mut initial {
                            *p /= sum;
                        }
                    }
                    draft.initial = Some(initial);
                }
                "terminal" => {
                    let terminal = &mut draft.terminal;
                    map.next_value_seed(Scalars(|cell: &Value| {
                        terminal.push({ context.states }.resolve(cell)?);
                        Ok(())
                    }))?;
                    draft.terminal.sort_unstable();
                    draft.terminal.dedup();
                }
                "rewards" => draft.rewards = map.next_value_seed(RewardsSeed(context))?,
                _ => {
                    map.next_value::<IgnoredAny>()?;
                }
            }
        }
        if let Some((table, given)) = features {
            let repeat = if table.domain == FeatureDomain::States { 1 } else { context.actions.len() as usize };
            let missing =
                |row: &usize| !given[*row] && draft.terminal.binary_search(&((*row / repeat) as u32)).is_err();
            if let Some(row) = (0..given.len()).find(missing) {
                let state = clip(&context.states.name((row / repeat) as u32));
                let of = if repeat == 1 && table.domain == FeatureDomain::States {
                    format!("state '{state}'")
                } else {
                    format!("state '{state}' and action '{}'", clip(&context.actions.name((row % repeat) as u32)))
                };
                return Err(A::Error::custom(format!("expected features of {of}, got none")));
            }
            draft.features = Some(table);
        }
        Ok(draft)
    }
}

fn length(cells: &[Value], expected: &str) -> String {
    format!("expected a list of {expected}, got {}", cells.len())
}

fn probability(cell: &Value) -> Result<f64, String> {
    let p = number(cell)?;
    if (0.0..=1.0 + 1e-6).contains(&p) { Ok(p) } else { Err(format!("expected a probability, got {p}")) }
}

fn number(cell: &Value) -> Result<f64, String> {
    match cell {
        Value::Integer(_) | Value::Number(_) => cell.number(),
        _ => None,
    }
    .ok_or_else(|| format!("expected a finite number, got {}", cell.shown()))
}

/// A list of short lists of scalars, each handed over as it comes.
struct Rows<F> {
    shape: &'static str,
    take: F,
}

impl<F> Rows<F> {
    fn new(shape: &'static str, take: F) -> Self {
        Self { shape, take }
    }
}

impl<'de, F: FnMut(&[Value]) -> Result<(), String>> DeserializeSeed<'de> for Rows<F> {
    type Value = ();

    fn deserialize<D: Deserializer<'de>>(self, deserializer: D) -> Result<(), D::Error> {
        deserializer.deserialize_seq(self)
    }
}

impl<'de, F: FnMut(&[Value]) -> Result<(), String>> Visitor<'de> for Rows<F> {
    type Value = ();

    fn expecting(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "a list of {}", self.shape)
    }

    fn visit_seq<A: SeqAccess<'de>>(mut self, mut list: A) -> Result<(), A::Error> {
        let mut cells = Vec::new();
        loop {
            cells.clear();
            let row = Row { shape: self.shape, cells: &mut cells, take: &mut self.take };
            if list.next_element_seed(row)?.is_none() {
                return Ok(());
            }
        }
    }
}

/// One of them.
struct Row<'a, F> {
    shape: &'static str,
    cells: &'a mut Vec<Value>,
    take: &'a mut F,
}

impl<'de, F: FnMut(&[Value]) -> Result<(), String>> DeserializeSeed<'de> for Row<'_, F> {
    type Value = ();

    fn deserialize<D: Deserializer<'de>>(self, deserializer: D) -> Result<(), D::Error> {
        deserializer.deserialize_seq(self)
    }
}

impl<'de, F: FnMut(&[Value]) -> Result<(), String>> Visitor<'de> for Row<'_, F> {
    type Value = ();

    fn expecting(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(self.shape)
    }

    fn visit_seq<A: SeqAccess<'de>>(self, mut list: A) -> Result<(), A::Error> {
        while let Some(cell) = list.next_element_seed(Cell)? {
            self.cells.push(cell);
        }
        (self.take)(self.cells).map_err(A::Error::custom)
    }
}

/// A list of scalars.
struct Scalars<F>(F);

impl<'de, F: FnMut(&Value) -> Result<(), String>> DeserializeSeed<'de> for Scalars<F> {
    type Value = ();

    fn deserialize<D: Deserializer<'de>>(self, deserializer: D) -> Result<(), D::Error> {
        deserializer.deserialize_seq(self)
    }
}

impl<'de, F: FnMut(&Value) -> Result<(), String>> Visitor<'de> for Scalars<F> {
    type Value = ();

    fn expecting(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str("a list of labels or indices")
    }

    fn visit_seq<A: SeqAccess<'de>>(mut self, mut list: A) -> Result<(), A::Error> {
        while let Some(cell) = list.next_element_seed(Cell)? {
            (self.0)(&cell).map_err(A::Error::custom)?;
        }
        Ok(())
    }
}

/// `{"names": […], "states": [[state, value, …], …]}`, or `"state_actions": [[state, action, value, …], …]`.
struct FeaturesSeed<'a, 'b>(&'a Whole<'b>);

impl<'de> DeserializeSeed<'de> for FeaturesSeed<'_, '_> {
    type Value = (FeatureTable, Vec<bool>);

    fn deserialize<D: Deserializer<'de>>(self, deserializer: D) -> Result<Self::Value, D::Error> {
        deserializer.deserialize_map(self)
    }
}

impl<'de> Visitor<'de> for FeaturesSeed<'_, '_> {
    type Value = (FeatureTable, Vec<bool>);

    fn expecting(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str("an object with the keys names, and states or state_actions")
    }

    fn visit_map<A: MapAccess<'de>>(self, mut map: A) -> Result<Self::Value, A::Error> {
        let context = self.0;
        let wrong = A::Error::custom::<String>;
        let (mut names, mut found) = (None::<Vec<String>>, None);
        while let Some(key) = map.next_key::<String>()? {
            let domain = match key.as_str() {
                "names" => {
                    let list: Vec<String> = map.next_value()?;
                    unique(&list).map_err(wrong)?;
                    if list.is_empty() {
                        return Err(wrong("expected at least one feature, got none".into()));
                    }
                    names = Some(list);
                    continue;
                }
                "states" => FeatureDomain::States,
                "state_actions" => FeatureDomain::StateActions,
                other => {
                    let message =
                        format!("expected one of the keys names, states, state_actions, got '{}'", clip(other));
                    return Err(wrong(message));
                }
            };
            let Some(names) = &names else { return Err(wrong("expected the key names before the values".into())) };
            let (of_pairs, width) = (domain == FeatureDomain::StateActions, names.len());
            let rows = if of_pairs { context.pairs().map_err(wrong)? } else { context.states.len() as usize };
            let entries = rows.checked_mul(width).filter(|&n| n <= 1 << 28);
            let entries = entries.ok_or_else(|| wrong(format!("expected at most {} features in all", 1 << 28)))?;
            let (mut values, mut given) = (vec![0.0; entries], vec![false; rows]);
            let keys = 1 + usize::from(of_pairs);
            let shape = if of_pairs { "[state, action, value, ...]" } else { "[state, value, ...]" };
            map.next_value_seed(Rows::new(shape, |cells: &[Value]| {
                if cells.len() != keys + width {
                    return Err(length(cells, &format!("{} for the {width} features", keys + width)));
                }
                let mut row = { context.states }.resolve(&cells[0])? as usize;
                if of_pairs {
                    row = row * context.actions.len() as usize + { context.actions }.resolve(&cells[1])? as usize;
                }
                if std::mem::replace(&mut given[row], true) {
                    return Err("expected each row of features once, got it again".to_owned());
                }
                for (slot, cell) in values[row * width..].iter_mut().zip(&cells[keys..]) {
                    *slot = number(cell)?;
                }
                Ok(())
            }))?;
            found = Some((FeatureTable { names: names.clone(), domain, values }, given));
        }
        found.ok_or_else(|| wrong("expected the values of the features under states or state_actions, got none".into()))
    }
}

/// `{"style": [[state, reward], …]}`, or `[state, action, reward]`; what is not given is 0.
struct RewardsSeed<'a, 'b>(&'a Whole<'b>);

impl<'de> DeserializeSeed<'de> for RewardsSeed<'_, '_> {
    type Value = Vec<(String, Vec<f64>)>;

    fn deserialize<D: Deserializer<'de>>(self, deserializer: D) -> Result<Self::Value, D::Error> {
        deserializer.deserialize_map(self)
    }
}

impl<'de> Visitor<'de> for RewardsSeed<'_, '_> {
    type Value = Vec<(String, Vec<f64>)>;

    fn expecting(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str("an object with a list for each style")
    }

    fn visit_map<A: MapAccess<'de>>(self, mut map: A) -> Result<Self::Value, A::Error> {
        let context = self.0;
        let n_actions = context.actions.len() as usize;
        let mut rewards = Vec::<(String, Vec<f64>)>::new();
        while let Some(style) = map.next_key::<String>()? {
            if style.is_empty() || style.len() > 200 || rewards.iter().any(|(known, _)| *known == style) {
                return Err(A::Error::custom(format!(
                    "expected each style once and in 1 to 200 bytes, got '{}'",
                    clip(&style)
                )));
            }
            let mut values = vec![0.0; context.pairs().map_err(A::Error::custom)?];
            map.next_value_seed(Rows::new("[state, reward] or [state, action, reward]", |cells: &[Value]| {
                let (state, actions, reward) = match cells {
                    [state, reward] => (state, 0..n_actions, reward),
                    [state, action, reward] => {
                        let action = { context.actions }.resolve(action)? as usize;
                        (state, action..action + 1, reward)
                    }
                    _ => return Err(length(cells, "2 or 3")),
                };
                let state = { context.states }.resolve(state)? as usize;
                values[state * n_actions..][actions].fill(number(reward)?);
                Ok(())
            }))?;
            rewards.push((style, values));
        }
        Ok(rewards)
    }
}
