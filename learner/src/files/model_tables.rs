//! A model from tables, Parquet or CSV: one of transitions, or a directory of several.

use super::{
    csv::CsvTable,
    error::{FileError, Place},
    model::{Entry, ModelFile, ROW_SUM_TOLERANCE, compress, unique},
    names::{Collector, Names, Resolve},
    parquet::ParquetTable,
    table::{AnyTable, Table},
    value::Value,
};
use crate::store::clip;
use mazeway_client::{FeatureDomain, FeatureTable};
use std::path::{Path, PathBuf};

/// Tables of a directory, without their extensions.
const TABLES: &str = "transitions, states, actions, state_actions, rewards";

pub(super) fn extension(path: &Path) -> String {
    path.extension().and_then(|e| e.to_str()).unwrap_or_default().to_ascii_lowercase()
}

/// Reads a table of transitions alone.
pub(super) fn one(path: &Path) -> Result<ModelFile, FileError> {
    tables(path, Tables { transitions: Some(path.to_owned()), ..Tables::default() })
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

/// Reads a directory of tables.
pub(super) fn directory(path: &Path) -> Result<ModelFile, FileError> {
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
