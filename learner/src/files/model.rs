//! A model from files: one JSON document, one table of transitions, or a directory of tables.
//!
//! Rows may come in any order. Invariants of a [`ModelFile`]: rows that are there are complete, each sums to 1, and a terminal
//! state leads to itself alone; features are given for every state or pair that is not terminal.

use super::{
    error::{FileError, Place},
    model_json, model_tables,
    names::Names,
};
use crate::store::clip;
use mazeway_client::{FeatureTable, Model};
use std::path::{Path, PathBuf};

/// How far a row may be from summing to 1: numbers in a file are rounded. What is nearer is scaled to 1.
pub(super) const ROW_SUM_TOLERANCE: f64 = 1e-6;

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
        return model_tables::directory(path);
    }
    match model_tables::extension(path).as_str() {
        "json" => model_json::read(path),
        "parquet" | "pq" | "csv" | "tsv" => model_tables::one(path),
        _ => {
            let hint =
                "a model is a .json file, a .parquet or .csv table of transitions, or a directory of such tables";
            Err(FileError::new(path, Place::File, "expected a model of a known format, got another extension", hint))
        }
    }
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
