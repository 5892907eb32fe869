//! A model from files: one JSON document, one table of transitions, or a directory of tables.
//!
//! Rows may come in any order. Invariants of a [`ModelFile`]: rows that are there are complete, each sums to 1, and a terminal
//! state leads to itself alone; features are given for every state or pair that is not terminal.

use super::{
    csv::CsvTable,
    error::{FileError, Place},
    model_json,
    names::{Collector, Names, Resolve},
    parquet::ParquetTable,
    table::{AnyTable, Table},
    value::Value,
};
use crate::store::clip;
use mazeway_client::{FeatureDomain, FeatureTable, Model};
use std::path::{Path, PathBuf};

/// How far a row may be from summing to 1: numbers in a file are rounded. What is nearer is scaled to 1.
const ROW_SUM_TOLERANCE: f64 = 1e-6;
/// Tables of a directory, without their extensions.
const TABLES: &str = "transitions, states, actions, state_actions, rewards";

/// What a file says of a process.
#[derive(Debug, Clone)]
pub struct ModelFile {
    /// The file or directory.
    pub file: PathBuf,
    /// Environment, where it says so.
    pub env: Option<String>,
    /// The states.
    pub states: Names,
    /// The actions.
    pub actions: Names,
    /// The rows, where it has any.
    pub rows: Option<Rows>,
    /// p(s₁), shape (`n_states`,), where it says so.
    pub initial_distribution: Option<Vec<f64>>,
    /// States that no action leaves, rising.
    pub terminal_states: Vec<u32>,
    /// Features, where it has any.
    pub features: Option<FeatureTable>,
    /// R(s,a) of each style, shape (`n_states`, `n_actions`).
    pub rewards: Vec<(String, Vec<f64>)>,
}

/// Rows of a transition function in order of s * `n_actions` + a.
#[derive(Debug, Clone, PartialEq)]
pub struct Rows {
    /// Start of each row, shape (`n_states * n_actions + 1`,).
    pub offsets: Vec<usize>,
    /// Next states, rising within a row.
    pub next_states: Vec<u32>,
    /// Their probabilities.
    pub probabilities: Vec<f64>,
}

/// One entry of the transition function as a file gives it.
#[derive(Debug, Clone, Copy)]
pub(super) struct Entry {
    pub(super) state: u32,
    pub(super) action: u32,
    pub(super) next: u32,
    pub(super) probability: f64,
}

/// What is wrong with entries: which of them, if one is to blame.
#[derive(Debug)]
pub(super) struct Fault {
    pub(super) entry: Option<usize>,
    pub(super) message: String,
    pub(super) hint: &'static str,
}

impl ModelFile {
    /// The model, whose rows must be there.
    ///
    /// # Errors
    /// It has no rows.
    pub fn into_model(self, env_id: String) -> Result<Model, FileError> {
        let Some(rows) = self.rows else {
            let hint = "give its transitions, or estimate them: --model estimate --describe FILE";
            return Err(FileError::new(&self.file, Place::File, "expected a model with transitions, got none", hint));
        };
        let n_states = self.states.len();
        let uniform = || vec![1.0 / f64::from(n_states); n_states as usize];
        let mut model = Model {
            env_id,
            model_id: String::new(),
            n_states,
            n_actions: self.actions.len(),
            state_labels: self.states.labels().to_vec(),
            action_labels: self.actions.labels().to_vec(),
            initial_distribution: self.initial_distribution.unwrap_or_else(uniform),
            row_offsets: rows.offsets,
            next_states: rows.next_states,
            probabilities: rows.probabilities,
            visit_counts: None,
            estimated: false,
            rewards: self.rewards,
            grid: None,
            features: self.features,
            terminal_states: self.terminal_states,
        };
        model.model_id = model.compute_id();
        Ok(model)
    }
}

/// Reads a model.
///
/// # Errors
/// The first thing that is wrong in it.
pub fn read_model(path: &Path) -> Result<ModelFile, FileError> {
    if path.is_dir() {
        return directory(path);
    }
    match extension(path).as_str() {
        "json" => model_json::read(path),
        "parquet" | "pq" | "csv" | "tsv" => {
            tables(path, Tables { transitions: Some(path.to_owned()), ..Tables::default() })
        }
        _ => {
            let hint =
                "a model is a .json file, a .parquet or .csv table of transitions, or a directory of such tables";
            Err(FileError::new(path, Place::File, "expected a model of a known format, got another extension", hint))
        }
    }
}

fn extension(path: &Path) -> String {
    path.extension().and_then(|e| e.to_str()).unwrap_or_default().to_ascii_lowercase()
}

/// The tables of a model.
#[derive(Debug, Default)]
struct Tables {
    transitions: Option<PathBuf>,
    states: Option<PathBuf>,
    actions: Option<PathBuf>,
    state_actions: Option<PathBuf>,
    rewards: Option<PathBuf>,
}

fn directory(path: &Path) -> Result<ModelFile, FileError> {
    let find = |name: &str| {
        ["parquet", "csv", "tsv"].iter().map(|e| path.join(format!("{name}.{e}"))).find(|table| table.is_file())
    };
    let tables_found = Tables {
        transitions: find("transitions"),
        states: find("states"),
        actions: find("actions"),
        state_actions: find("state_actions"),
        rewards: find("rewards"),
    };
    if tables_found.transitions.is_none() && tables_found.states.is_none() {
        let hint = format!("its tables are {TABLES}, each .parquet or .csv");
        return Err(FileError::new(
            path,
            Place::File,
            "expected a table transitions or states in it, got neither",
            hint,
        ));
    }
    tables(path, tables_found)
}

fn open(path: &Path) -> Result<AnyTable, FileError> {
    match extension(path).as_str() {
        "csv" => Ok(AnyTable::Csv(CsvTable::open(path, b',')?)),
        "tsv" => Ok(AnyTable::Csv(CsvTable::open(path, b'\t')?)),
        _ => Ok(AnyTable::Parquet(ParquetTable::open(path)?)),
    }
}

/// The rank of a column that must be there.
fn needed(table: &AnyTable, names: &[&str]) -> Result<usize, FileError> {
    let found = names.iter().find_map(|name| table.columns().iter().position(|column| column == name));
    found.ok_or_else(|| {
        let place = if matches!(table, AnyTable::Csv(_)) { Place::Line(1) } else { Place::File };
        let got = clip(&table.columns().join(", "));
        let message = format!("expected a column '{}', got {got}", names[0]);
        FileError::new(table.file(), place, message, "see docs/DATA.md for the columns of each table")
    })
}

const NAMED: &str = "states and actions are those of the tables states and actions: labels, or indices from 0 on";
const NUMBERS: &str = "give a finite number in every cell, or take the column out";

fn tables(path: &Path, given: Tables) -> Result<ModelFile, FileError> {
    let listed = |table: &Option<PathBuf>, noun: &'static str| table.as_deref().map(|t| list(t, noun)).transpose();
    let described = given.states.as_deref().map(described_states).transpose()?;
    let states = described.as_ref().map(|(names, _)| names.clone());
    let actions = listed(&given.actions, "action")?;
    let (states, actions, entries, places) = match &given.transitions {
        Some(table) => transitions(table, states, actions)?,
        None => match (states, actions) {
            (Some(states), Some(actions)) => (states, actions, Vec::new(), Vec::new()),
            // What a demonstration does, it may: the actions are those that turn up there.
            (Some(states), None) => (states, Names::numbered("action", 0), Vec::new(), Vec::new()),
            (None, _) => {
                let hint = format!("its tables are {TABLES}");
                return Err(FileError::new(
                    path,
                    Place::File,
                    "expected a table of states or transitions, got none",
                    hint,
                ));
            }
        },
    };
    let (initial_distribution, terminal_states, state_features) = match described {
        Some((_, description)) => (description.initial, description.terminal, description.features),
        None => (None, Vec::new(), None),
    };
    let rows = match &given.transitions {
        None => None,
        Some(table) => Some(compress(entries, &states, &actions, &terminal_states).map_err(|fault| {
            let place = match fault.entry {
                None => Place::File,
                Some(entry) if extension(table) == "parquet" || extension(table) == "pq" => {
                    Place::Row(entry as u64 + 1)
                }
                Some(entry) => Place::Line(u64::from(places[entry])),
            };
            FileError::new(table, place, fault.message, fault.hint)
        })?),
    };
    let pair_features = match &given.state_actions {
        Some(table) => Some(features_of_pairs(table, &states, &actions, &terminal_states)?),
        None => None,
    };
    let features = joined(state_features, pair_features, actions.len() as usize)
        .map_err(|message| FileError::new(path, Place::File, message, "give every feature a name of its own"))?;
    let rewards = match &given.rewards {
        Some(table) => rewards(table, &states, &actions)?,
        None => Vec::new(),
    };
    Ok(ModelFile {
        file: path.to_owned(),
        env: None,
        states,
        actions,
        rows,
        initial_distribution,
        terminal_states,
        features,
        rewards,
    })
}

/// The names of a list, one a row.
fn list(path: &Path, noun: &'static str) -> Result<Names, FileError> {
    let mut table = open(path)?;
    let column = needed(&table, &[noun])?;
    let (mut labels, mut row) = (Vec::new(), Vec::new());
    while table.next(&mut row)? {
        labels.push(label(&table, &row, column, noun)?);
        if let Err((_, message)) = check_last(&labels, noun) {
            return Err(table.error(Some(column), message, "give each a row of its own"));
        }
    }
    names(&table, labels, noun)
}

/// A cheap check of a label as it comes; the whole list is checked when it is there.
fn check_last(labels: &[String], noun: &'static str) -> Result<(), (usize, String)> {
    Names::labelled(noun, labels.last().cloned().into_iter().collect()).map(|_| ())
}

fn label(table: &AnyTable, row: &[Value], column: usize, noun: &str) -> Result<String, FileError> {
    row[column].label().ok_or_else(|| {
        table.error(
            Some(column),
            format!("expected a label or an index of the {noun}, got nothing"),
            "give each row one",
        )
    })
}

/// Labels that are the indices from 0 on are none.
fn names(table: &AnyTable, labels: Vec<String>, noun: &'static str) -> Result<Names, FileError> {
    if labels.is_empty() {
        let message = format!("expected at least one {noun}, got none");
        return Err(FileError::new(table.file(), Place::File, message, "give each a row"));
    }
    if labels.iter().enumerate().all(|(i, label)| *label == i.to_string()) {
        return Ok(Names::numbered(noun, labels.len() as u32));
    }
    Names::labelled(noun, labels).map_err(|(rank, message)| {
        // A list has a row a label, and a CSV file a header before them.
        let place = match table {
            AnyTable::Csv(_) => Place::Line(rank as u64 + 2),
            AnyTable::Parquet(_) => Place::Row(rank as u64 + 1),
        };
        FileError::new(table.file(), place, message, "give each a row of its own")
    })
}

/// What a table of states says beside their names.
struct Description {
    initial: Option<Vec<f64>>,
    terminal: Vec<u32>,
    features: Option<FeatureTable>,
}

/// Columns that are features: all but those with a meaning of their own and a data frame's index.
fn feature_columns(table: &AnyTable, known: &[&str]) -> Vec<usize> {
    let is = |name: &str| !known.contains(&name) && !name.is_empty() && !name.starts_with("__index_level_");
    table.columns().iter().enumerate().filter(|(_, name)| is(name)).map(|(rank, _)| rank).collect()
}

fn number(table: &AnyTable, row: &[Value], column: usize) -> Result<f64, FileError> {
    row[column].number().ok_or_else(|| {
        table.error(Some(column), format!("expected a finite number, got {}", row[column].shown()), NUMBERS)
    })
}

fn described_states(path: &Path) -> Result<(Names, Description), FileError> {
    let mut table = open(path)?;
    let state = needed(&table, &["state"])?;
    let find = |name: &str| table.columns().iter().position(|column| column == name);
    let (start, terminal) = (find("start"), find("terminal"));
    let columns = feature_columns(&table, &["state", "start", "terminal"]);
    let (mut labels, mut initial, mut ends, mut values) = (Vec::new(), Vec::new(), Vec::new(), Vec::new());
    let mut row = Vec::new();
    while table.next(&mut row)? {
        labels.push(label(&table, &row, state, "state")?);
        if let Some(column) = start {
            let p = if row[column].is_null() { 0.0 } else { number(&table, &row, column)? };
            if !(0.0..=1.0).contains(&p) {
                let message = format!("expected a probability, got {p}");
                return Err(table.error(Some(column), message, "start is the probability that a process begins there"));
            }
            initial.push(p);
        }
        let ends_here = match terminal.map(|column| (column, &row[column])) {
            None | Some((_, Value::Null)) => false,
            Some((column, value)) => value.truth().ok_or_else(|| {
                let message = format!("expected true or false, got {}", value.shown());
                table.error(Some(column), message, "terminal says whether nothing leaves the state")
            })?,
        };
        if ends_here {
            ends.push(labels.len() as u32 - 1);
        }
        for &column in &columns {
            let nothing = ends_here && row[column].is_null();
            values.push(if nothing { 0.0 } else { number(&table, &row, column)? });
        }
    }
    let features = (!columns.is_empty()).then(|| FeatureTable {
        names: columns.iter().map(|&column| table.columns()[column].clone()).collect(),
        domain: FeatureDomain::States,
        values,
    });
    let names = names(&table, labels, "state")?;
    let initial = (start.is_some()).then_some(initial).map(|initial| scaled(initial, path)).transpose()?;
    Ok((names, Description { initial, terminal: ends, features }))
}

/// A distribution that sums to 1 but for rounding, scaled to do so.
fn scaled(mut values: Vec<f64>, path: &Path) -> Result<Vec<f64>, FileError> {
    let sum: f64 = values.iter().sum();
    if (sum - 1.0).abs() > ROW_SUM_TOLERANCE {
        let message = format!("expected start probabilities that sum to 1, got {sum}");
        return Err(FileError::new(path, Place::File, message, "leave the column out for a uniform start"));
    }
    for value in &mut values {
        *value /= sum;
    }
    Ok(values)
}

type Transitions = (Names, Names, Vec<Entry>, Vec<u32>);

/// Entries of a long table, under the names that are known or under those that turn up.
fn transitions(path: &Path, states: Option<Names>, actions: Option<Names>) -> Result<Transitions, FileError> {
    let mut table = open(path)?;
    let columns = [
        needed(&table, &["state", "s"])?,
        needed(&table, &["action", "a"])?,
        needed(&table, &["next_state", "s_next"])?,
        needed(&table, &["probability", "p"])?,
    ];
    let (mut new_states, mut new_actions) = (Collector::new("state"), Collector::new("action"));
    let (mut entries, mut places, mut row) = (Vec::new(), Vec::new(), Vec::new());
    while table.next(&mut row)? {
        let index = |column: usize, known: Option<&Names>, new: &mut Collector| {
            let index = match known {
                Some(mut names) => names.resolve(&row[column]),
                None => new.resolve(&row[column]),
            };
            index.map_err(|message| table.error(Some(column), message, NAMED))
        };
        let state = index(columns[0], states.as_ref(), &mut new_states)?;
        let action = index(columns[1], actions.as_ref(), &mut new_actions)?;
        let next = index(columns[2], states.as_ref(), &mut new_states)?;
        let probability = number(&table, &row, columns[3])?;
        if !(0.0..=1.0 + ROW_SUM_TOLERANCE).contains(&probability) {
            let message = format!("expected a probability, got {}", row[columns[3]].shown());
            return Err(table.error(Some(columns[3]), message, "the probabilities of a state and action sum to 1"));
        }
        entries.push(Entry { state, action, next, probability });
        places.push(match table.place(None) {
            Place::Line(line) => line as u32,
            _ => entries.len() as u32,
        });
    }
    let none = |message: String| FileError::new(path, Place::File, message, "give a row for every transition");
    let known = |names: Option<Names>, new: Collector| match names {
        Some(names) => Ok((names, None)),
        None => new.finish().map(|(names, index)| (names, Some(index))),
    };
    let (states, state_index) = known(states, new_states).map_err(none)?;
    let (actions, action_index) = known(actions, new_actions).map_err(none)?;
    for entry in &mut entries {
        if let Some(index) = &state_index {
            (entry.state, entry.next) = (index[entry.state as usize], index[entry.next as usize]);
        }
        if let Some(index) = &action_index {
            entry.action = index[entry.action as usize];
        }
    }
    Ok((states, actions, entries, places))
}

/// Rows from entries in any order.
pub(super) fn compress(entries: Vec<Entry>, states: &Names, actions: &Names, terminal: &[u32]) -> Result<Rows, Fault> {
    let n_actions = u64::from(actions.len());
    let n_rows = u64::from(states.len()) * n_actions;
    if n_rows > u64::from(u32::MAX) {
        let message = format!("expected at most {} state-action pairs, got {n_rows}", u32::MAX);
        return Err(Fault { entry: None, message, hint: "make the states coarser" });
    }
    let pair = |entry: &Entry| u64::from(entry.state) * n_actions + u64::from(entry.action);
    let mut order: Vec<u32> = (0..entries.len() as u32).collect();
    order.sort_by_key(|&rank| (pair(&entries[rank as usize]), entries[rank as usize].next));
    let what = |row: u64| {
        let (state, action) = ((row / n_actions) as u32, (row % n_actions) as u32);
        format!("state '{}' and action '{}'", clip(&states.name(state)), clip(&actions.name(action)))
    };
    let mut rows = Rows { offsets: vec![0], next_states: Vec::new(), probabilities: Vec::new() };
    let mut at = 0;
    for row in 0..n_rows {
        let begin = at;
        while at < order.len() && pair(&entries[order[at] as usize]) == row {
            at += 1;
        }
        let own = &order[begin..at];
        let state = (row / n_actions) as u32;
        let ends = terminal.binary_search(&state).is_ok();
        if let Some(twice) =
            own.windows(2).find(|pair| entries[pair[0] as usize].next == entries[pair[1] as usize].next)
        {
            let next = states.name(entries[twice[1] as usize].next);
            let message = format!("expected each transition once, got {} to '{}' again", what(row), clip(&next));
            return Err(Fault { entry: Some(twice[1] as usize), message, hint: "add the two probabilities up" });
        }
        if ends {
            let leaves = own.iter().find(|&&rank| entries[rank as usize].next != state);
            if let Some(&rank) = leaves.filter(|&&rank| entries[rank as usize].probability > 0.0) {
                let message = format!(
                    "expected nothing to leave the terminal state '{}', got a transition",
                    clip(&states.name(state))
                );
                return Err(Fault {
                    entry: Some(rank as usize),
                    message,
                    hint: "leave its transitions out, or do not call it terminal",
                });
            }
            rows.next_states.push(state);
            rows.probabilities.push(1.0);
        } else {
            let sum: f64 = own.iter().map(|&rank| entries[rank as usize].probability).sum();
            if own.is_empty() {
                let message = format!("expected transitions of {}, got none", what(row));
                let hint = "give a row for every state and action; a state that nothing leaves is terminal";
                return Err(Fault { entry: None, message, hint });
            }
            if (sum - 1.0).abs() > ROW_SUM_TOLERANCE {
                let message = format!("expected the probabilities of {} to sum to 1, got {sum}", what(row));
                let hint =
                    "sums may be off by 1e-6; give probabilities with more digits, or the transitions that are missing";
                return Err(Fault { entry: Some(own[0] as usize), message, hint });
            }
            for entry in own.iter().map(|&rank| &entries[rank as usize]).filter(|entry| entry.probability > 0.0) {
                rows.next_states.push(entry.next);
                // An exact row keeps its bits: a model that was written and read is the same one.
                let exact = (sum - 1.0).abs() <= 1e-9;
                rows.probabilities.push(if exact { entry.probability } else { entry.probability / sum });
            }
        }
        rows.offsets.push(rows.next_states.len());
    }
    Ok(rows)
}

fn features_of_pairs(
    path: &Path,
    mut states: &Names,
    mut actions: &Names,
    terminal: &[u32],
) -> Result<FeatureTable, FileError> {
    let mut table = open(path)?;
    let (state, action) = (needed(&table, &["state"])?, needed(&table, &["action"])?);
    let columns = feature_columns(&table, &["state", "action"]);
    if columns.is_empty() {
        let message = "expected a column for every feature, got none";
        return Err(FileError::new(path, Place::File, message, "its columns are state, action and the features"));
    }
    let n_actions = actions.len() as usize;
    let n_pairs = states.len() as usize * n_actions;
    let (mut values, mut given) = (vec![0.0; n_pairs * columns.len()], vec![false; n_pairs]);
    let mut row = Vec::new();
    while table.next(&mut row)? {
        let s = states.resolve(&row[state]).map_err(|message| table.error(Some(state), message, NAMED))?;
        let a = actions.resolve(&row[action]).map_err(|message| table.error(Some(action), message, NAMED))?;
        let pair = s as usize * n_actions + a as usize;
        if std::mem::replace(&mut given[pair], true) {
            return Err(table.error(None, "expected each pair once, got it again", "give every pair one row"));
        }
        for (slot, &column) in values[pair * columns.len()..].iter_mut().zip(&columns) {
            *slot = number(&table, &row, column)?;
        }
    }
    let missing = |pair: &usize| !given[*pair] && terminal.binary_search(&((*pair / n_actions) as u32)).is_err();
    if let Some(pair) = (0..n_pairs).find(missing) {
        let (s, a) = (states.name((pair / n_actions) as u32), actions.name((pair % n_actions) as u32));
        let message = format!("expected features of state '{}' and action '{}', got none", clip(&s), clip(&a));
        return Err(FileError::new(
            path,
            Place::File,
            message,
            "give every pair one row; those of terminal states may be left out",
        ));
    }
    let names = columns.iter().map(|&column| table.columns()[column].clone()).collect();
    Ok(FeatureTable { names, domain: FeatureDomain::StateActions, values })
}

/// Features of states and of pairs in one table over the pairs.
fn joined(
    of_states: Option<FeatureTable>,
    of_pairs: Option<FeatureTable>,
    n_actions: usize,
) -> Result<Option<FeatureTable>, String> {
    let joined = match (of_states, of_pairs) {
        (Some(s), Some(p)) => {
            let (a, b) = (s.names.len(), p.names.len());
            let mut values = Vec::with_capacity(p.values.len() / b * (a + b));
            for (pair, row) in p.values.chunks_exact(b).enumerate() {
                let state = pair / n_actions;
                values.extend_from_slice(&s.values[state * a..(state + 1) * a]);
                values.extend_from_slice(row);
            }
            let names = s.names.into_iter().chain(p.names).collect();
            Some(FeatureTable { names, domain: FeatureDomain::StateActions, values })
        }
        (one, other) => one.or(other),
    };
    if let Some(table) = &joined {
        unique(&table.names)?;
    }
    Ok(joined)
}

/// Every name once, and short enough.
pub(super) fn unique(names: &[String]) -> Result<(), String> {
    for (i, name) in names.iter().enumerate() {
        if name.is_empty() || name.len() > 200 {
            return Err(format!("expected names of 1 to 200 bytes, got '{}'", clip(name)));
        }
        if names[..i].contains(name) {
            return Err(format!("expected each feature once, got '{}' again", clip(name)));
        }
    }
    Ok(())
}

fn rewards(path: &Path, mut states: &Names, mut actions: &Names) -> Result<Vec<(String, Vec<f64>)>, FileError> {
    let mut table = open(path)?;
    let state = needed(&table, &["state"])?;
    let action = table.columns().iter().position(|column| column == "action");
    let columns = feature_columns(&table, &["state", "action"]);
    let n_actions = actions.len() as usize;
    let names = columns.iter().map(|&column| table.columns()[column].clone());
    let mut rewards: Vec<_> = names.map(|name| (name, vec![0.0; states.len() as usize * n_actions])).collect();
    let mut row = Vec::new();
    while table.next(&mut row)? {
        let s = states.resolve(&row[state]).map_err(|message| table.error(Some(state), message, NAMED))? as usize;
        let of = match action {
            None => 0..n_actions,
            Some(column) => {
                let a = actions.resolve(&row[column]).map_err(|message| table.error(Some(column), message, NAMED))?;
                a as usize..a as usize + 1
            }
        };
        for ((_, values), &column) in rewards.iter_mut().zip(&columns) {
            values[s * n_actions..][of.clone()].fill(number(&table, &row, column)?);
        }
    }
    Ok(rewards)
}
