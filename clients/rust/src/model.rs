//! Tabular models: finite Markov decision processes as sparse rows, as they travel between servers, learners and files.
//!
//! Invariants, checked by [`ModelCollector`]: rows are complete and in order, next states rise within a row, every row sums to 1
//! within [`ROW_SUM_TOLERANCE`], and `model_id` is the hash of sizes and rows that `mazeway/env/v1/model.proto` lays down.

use crate::{
    ClientError,
    packed::{Element, Packed, pack},
};
use bytes::Bytes;
use mazeway_proto::env::{self as pb, model_part::Part};
use sha2::{Digest as _, Sha256};
use std::fmt::Write as _;

/// How far a row may be from summing to 1.
pub const ROW_SUM_TOLERANCE: f64 = 1e-9;

/// Rows of a message.
const ROWS_A_BLOCK: usize = 4096;
/// Entries after which a message ends.
const ENTRIES_A_BLOCK: usize = 1 << 15;

/// Where each state lies when it is drawn on a grid.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Grid {
    /// Number of rows.
    pub rows: u32,
    /// Number of columns.
    pub columns: u32,
    /// Row-major cell of each state, shape `(n_states,)`.
    pub cells: Vec<u32>,
}

/// What the rows of a feature table stand for.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum FeatureDomain {
    /// One row a state, the same for every action.
    States,
    /// One row a state-action pair.
    StateActions,
}

/// Named columns of numbers of which a reward may be a weighted sum.
#[derive(Debug, Clone, PartialEq)]
pub struct FeatureTable {
    /// Name of each feature, shape `(n_features,)`.
    pub names: Vec<String>,
    /// What the rows stand for.
    pub domain: FeatureDomain,
    /// Row-major, shape `(n_states or n_states * n_actions, n_features)`.
    pub values: Vec<f64>,
}

/// A finite Markov decision process as sparse rows (s, a), in order of `s * n_actions + a`.
#[derive(Debug, Clone, PartialEq)]
pub struct Model {
    /// Environment that it describes.
    pub env_id: String,
    /// SHA-256 over sizes and rows, in lower-case hexadecimal.
    pub model_id: String,
    /// Number of states.
    pub n_states: u32,
    /// Number of actions.
    pub n_actions: u32,
    /// Label of each state; empty or `n_states` of them.
    pub state_labels: Vec<String>,
    /// Label of each action; empty or `n_actions` of them.
    pub action_labels: Vec<String>,
    /// p(s₁), shape `(n_states,)`.
    pub initial_distribution: Vec<f64>,
    /// Start of each row's entries, shape `(n_states * n_actions + 1,)`.
    pub row_offsets: Vec<usize>,
    /// Next state of each entry, rising within a row.
    pub next_states: Vec<u32>,
    /// Probability of each entry; each row sums to 1.
    pub probabilities: Vec<f64>,
    /// Visits from which each row was estimated, shape `(n_states * n_actions,)`; `None` where none are known.
    pub visit_counts: Option<Vec<u64>>,
    /// True where the rows were estimated rather than computed.
    pub estimated: bool,
    /// R(s,a) of each style, shape `(n_states, n_actions)`.
    pub rewards: Vec<(String, Vec<f64>)>,
    /// Where the states lie on a grid, if they do.
    pub grid: Option<Grid>,
    /// Features, where any are known.
    pub features: Option<FeatureTable>,
    /// States that no action leaves, rising.
    pub terminal_states: Vec<u32>,
}

/// Parts that are no model: which field and why.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
#[error("{field}: {message}")]
pub struct ModelError {
    /// Path from the part on, such as `"header.n_states"` or `"rows.probabilities"`.
    pub field: String,
    /// What was expected and what came.
    pub message: String,
}

impl ModelError {
    fn new(field: &str, message: impl Into<String>) -> Self {
        Self { field: field.into(), message: message.into() }
    }
}

impl From<ModelError> for ClientError {
    fn from(error: ModelError) -> Self {
        Self::protocol(format!("model {error}"))
    }
}

impl Model {
    /// Number of rows: `n_states * n_actions`.
    pub fn n_rows(&self) -> usize {
        self.row_offsets.len() - 1
    }

    /// Next states and probabilities of row (s, a).
    pub fn row(&self, state: u32, action: u32) -> (&[u32], &[f64]) {
        let row = state as usize * self.n_actions as usize + action as usize;
        let entries = self.row_offsets[row]..self.row_offsets[row + 1];
        (&self.next_states[entries.clone()], &self.probabilities[entries])
    }

    /// The reward table of a style, shape `(n_states, n_actions)`.
    pub fn reward(&self, style: &str) -> Option<&[f64]> {
        self.rewards.iter().find(|(name, _)| name == style).map(|(_, values)| values.as_slice())
    }

    /// The id that sizes and rows have.
    pub fn compute_id(&self) -> String {
        let mut hash = Sha256::new();
        hash.update(b"mazeway-model-v1");
        hash.update(self.n_states.to_le_bytes());
        hash.update(self.n_actions.to_le_bytes());
        for bounds in self.row_offsets.windows(2) {
            hash.update(((bounds[1] - bounds[0]) as u32).to_le_bytes());
            for entry in bounds[0]..bounds[1] {
                hash.update(self.next_states[entry].to_le_bytes());
                hash.update(self.probabilities[entry].to_bits().to_le_bytes());
            }
        }
        hash.finalize().iter().fold(String::with_capacity(64), |mut hex, byte| {
            // Writing to a string cannot fail.
            let _ = write!(hex, "{byte:02x}");
            hex
        })
    }

    /// The model as it travels: a header, then blocks of rows, each made when it is asked for.
    pub fn parts(&self) -> impl Iterator<Item = pb::ModelPart> + Send + '_ {
        let mut row = 0;
        let blocks = std::iter::from_fn(move || {
            let first = row;
            let start = *self.row_offsets.get(first)?;
            while row < self.n_rows()
                && row - first < ROWS_A_BLOCK
                && (row == first || self.row_offsets[row + 1] - start <= ENTRIES_A_BLOCK)
            {
                row += 1;
            }
            (row > first).then(|| Part::Rows(self.block(first, row)))
        });
        std::iter::once(Part::Header(self.header())).chain(blocks).map(|part| pb::ModelPart { part: Some(part) })
    }

    fn header(&self) -> pb::ModelHeader {
        let reward = |(style, values): &(String, Vec<f64>)| pb::RewardTable {
            style: style.clone(),
            values: pack(values.iter().copied()),
        };
        pb::ModelHeader {
            model_id: self.model_id.clone(),
            env_id: self.env_id.clone(),
            n_states: self.n_states,
            n_actions: self.n_actions,
            state_labels: self.state_labels.clone(),
            action_labels: self.action_labels.clone(),
            initial_distribution: pack(self.initial_distribution.iter().copied()),
            rewards: self.rewards.iter().map(reward).collect(),
            estimated: self.estimated,
            grid: self.grid.as_ref().map(|grid| pb::GridLayout {
                rows: grid.rows,
                columns: grid.columns,
                cells: pack(grid.cells.iter().copied()),
            }),
            features: self.features.as_ref().map(|table| pb::FeatureTable {
                names: table.names.clone(),
                domain: match table.domain {
                    FeatureDomain::States => pb::FeatureDomain::State,
                    FeatureDomain::StateActions => pb::FeatureDomain::StateAction,
                } as i32,
                values: pack(table.values.iter().copied()),
            }),
            terminal_states: pack(self.terminal_states.iter().copied()),
        }
    }

    fn block(&self, first: usize, end: usize) -> pb::RowBlock {
        let entries = self.row_offsets[first]..self.row_offsets[end];
        let lengths = self.row_offsets[first..=end].windows(2).map(|bounds| (bounds[1] - bounds[0]) as u32);
        let counts = self.visit_counts.as_ref().map_or(&[][..], |counts| &counts[first..end]);
        pb::RowBlock {
            first_row: first as u32,
            row_lengths: pack(lengths),
            next_states: pack(self.next_states[entries.clone()].iter().copied()),
            probabilities: pack(self.probabilities[entries].iter().copied()),
            visit_counts: pack(counts.iter().copied()),
        }
    }
}

/// Bounds on what a collector takes in, so that a sender cannot exhaust the receiver's memory.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct ModelLimits {
    /// Most rows, `n_states * n_actions`.
    pub max_rows: u64,
    /// Most entries.
    pub max_entries: u64,
}

impl Default for ModelLimits {
    /// About 1 GB.
    fn default() -> Self {
        Self { max_rows: 16 << 20, max_entries: 64 << 20 }
    }
}

/// Puts a model together from its parts and checks every one.
#[derive(Debug, Default)]
pub struct ModelCollector {
    limits: ModelLimits,
    model: Option<Model>,
}

impl ModelCollector {
    /// Takes in no more than `limits`.
    pub fn new(limits: ModelLimits) -> Self {
        Self { limits, model: None }
    }

    /// Takes the next part.
    ///
    /// # Errors
    /// A part out of order or malformed. The collector is of no further use then.
    pub fn push(&mut self, part: pb::ModelPart) -> Result<(), ModelError> {
        match (part.part, &mut self.model) {
            (None, _) => Err(ModelError::new("part", "expected a header or rows, got neither")),
            (Some(Part::Header(_)), Some(_)) => Err(ModelError::new("header", "expected one header, got a second")),
            (Some(Part::Rows(_)), None) => Err(ModelError::new("rows", "expected a header first, got rows")),
            (Some(Part::Header(header)), model @ None) => {
                *model = Some(begin(header, self.limits)?);
                Ok(())
            }
            (Some(Part::Rows(block)), Some(model)) => append(model, block, self.limits),
        }
    }

    /// The whole model.
    ///
    /// # Errors
    /// Rows are missing, or the id is not that of the content.
    pub fn finish(self) -> Result<Model, ModelError> {
        let mut model = self.model.ok_or_else(|| ModelError::new("header", "expected a header, got no part"))?;
        let expected = model.n_states as usize * model.n_actions as usize;
        if model.n_rows() != expected {
            let message = format!("expected {expected} rows, got {}", model.n_rows());
            return Err(ModelError::new("rows", message));
        }
        let computed = model.compute_id();
        if model.model_id.is_empty() {
            model.model_id = computed;
        } else if model.model_id != computed {
            let message = format!("expected {computed}, the hash of the content, got {}", model.model_id);
            return Err(ModelError::new("header.model_id", message));
        }
        Ok(model)
    }
}

fn unpack<T: Element>(field: &str, bytes: Bytes, len: usize) -> Result<Vec<T>, ModelError> {
    let got = bytes.len();
    let packed = Packed::<T>::new(bytes).filter(|packed| packed.len() == len);
    packed
        .map(|packed| packed.to_vec())
        .ok_or_else(|| ModelError::new(field, format!("expected {len} values of {} bytes, got {got} bytes", T::SIZE)))
}

fn check_distribution(field: &str, values: &[f64]) -> Result<(), ModelError> {
    if let Some(value) = values.iter().find(|value| !value.is_finite() || **value < 0.0) {
        return Err(ModelError::new(field, format!("expected probabilities, got {value}")));
    }
    let sum: f64 = values.iter().sum();
    if (sum - 1.0).abs() > ROW_SUM_TOLERANCE {
        return Err(ModelError::new(field, format!("expected probabilities that sum to 1, got {sum}")));
    }
    Ok(())
}

fn begin(header: pb::ModelHeader, limits: ModelLimits) -> Result<Model, ModelError> {
    let (n_states, n_actions) = (header.n_states, header.n_actions);
    for (field, n) in [("header.n_states", n_states), ("header.n_actions", n_actions)] {
        if n == 0 {
            return Err(ModelError::new(field, "expected at least 1, got 0"));
        }
    }
    let n_rows = u64::from(n_states) * u64::from(n_actions);
    if n_rows > limits.max_rows {
        let message = format!("expected at most {} rows of states and actions, got {n_rows}", limits.max_rows);
        return Err(ModelError::new("header.n_states", message));
    }
    for (field, labels, n) in [
        ("header.state_labels", &header.state_labels, n_states),
        ("header.action_labels", &header.action_labels, n_actions),
    ] {
        if !labels.is_empty() && labels.len() != n as usize {
            return Err(ModelError::new(field, format!("expected {n} labels or none, got {}", labels.len())));
        }
    }
    let initial_distribution = if header.initial_distribution.is_empty() {
        vec![1.0 / f64::from(n_states); n_states as usize]
    } else {
        let field = "header.initial_distribution";
        let values = unpack(field, header.initial_distribution, n_states as usize)?;
        check_distribution(field, &values)?;
        values
    };
    let rewards = header.rewards.into_iter().map(|table| {
        let values: Vec<f64> = unpack("header.rewards", table.values, n_rows as usize)?;
        match values.iter().find(|value| !value.is_finite()) {
            None => Ok((table.style, values)),
            Some(value) => Err(ModelError::new("header.rewards", format!("expected finite rewards, got {value}"))),
        }
    });
    let rewards = rewards.collect::<Result<_, _>>()?;
    let grid = header.grid.map(|grid| {
        let cells: Vec<u32> = unpack("header.grid.cells", grid.cells, n_states as usize)?;
        let n_cells = u64::from(grid.rows) * u64::from(grid.columns);
        match cells.iter().find(|&&cell| u64::from(cell) >= n_cells) {
            None => Ok(Grid { rows: grid.rows, columns: grid.columns, cells }),
            Some(cell) => {
                Err(ModelError::new("header.grid.cells", format!("expected cells below {n_cells}, got {cell}")))
            }
        }
    });
    let features = header.features.map(|table| {
        let (domain, rows) = match pb::FeatureDomain::try_from(table.domain) {
            Ok(pb::FeatureDomain::State) => (FeatureDomain::States, n_states as usize),
            Ok(pb::FeatureDomain::StateAction) => (FeatureDomain::StateActions, n_rows as usize),
            Ok(pb::FeatureDomain::Unspecified) | Err(_) => {
                let message = format!("expected states or state-action pairs, got {}", table.domain);
                return Err(ModelError::new("header.features.domain", message));
            }
        };
        let values: Vec<f64> = unpack("header.features.values", table.values, rows * table.names.len())?;
        Ok(FeatureTable { names: table.names, domain, values })
    });
    let n_terminal = header.terminal_states.len() / 4;
    let terminal_states: Vec<u32> = unpack("header.terminal_states", header.terminal_states, n_terminal)?;
    if let Some(state) = terminal_states.iter().find(|&&state| state >= n_states) {
        let message = format!("expected states below {n_states}, got {state}");
        return Err(ModelError::new("header.terminal_states", message));
    }
    Ok(Model {
        env_id: header.env_id,
        model_id: header.model_id,
        n_states,
        n_actions,
        state_labels: header.state_labels,
        action_labels: header.action_labels,
        initial_distribution,
        row_offsets: vec![0],
        next_states: Vec::new(),
        probabilities: Vec::new(),
        visit_counts: None,
        estimated: header.estimated,
        rewards,
        grid: grid.transpose()?,
        features: features.transpose()?,
        terminal_states,
    })
}

fn append(model: &mut Model, block: pb::RowBlock, limits: ModelLimits) -> Result<(), ModelError> {
    let first_row = model.n_rows();
    let n_rows = model.n_states as usize * model.n_actions as usize;
    if block.first_row as usize != first_row {
        let message = format!("expected row {first_row} next, got {}", block.first_row);
        return Err(ModelError::new("rows.first_row", message));
    }
    let in_block = block.row_lengths.len() / 4;
    let lengths: Vec<u32> = unpack("rows.row_lengths", block.row_lengths, in_block)?;
    if lengths.is_empty() || first_row + lengths.len() > n_rows {
        let message = format!("expected 1 to {} rows, got {}", n_rows - first_row, lengths.len());
        return Err(ModelError::new("rows.row_lengths", message));
    }
    let entries = lengths.iter().map(|&length| u64::from(length)).sum::<u64>();
    if model.next_states.len() as u64 + entries > limits.max_entries {
        let message = format!("expected at most {} entries in all", limits.max_entries);
        return Err(ModelError::new("rows.row_lengths", message));
    }
    let next_states: Vec<u32> = unpack("rows.next_states", block.next_states, entries as usize)?;
    let probabilities: Vec<f64> = unpack("rows.probabilities", block.probabilities, entries as usize)?;
    let mut start = 0;
    for (row, &length) in lengths.iter().enumerate() {
        let end = start + length as usize;
        let states = &next_states[start..end];
        if !states.is_sorted_by(|a, b| a < b) || states.last().is_some_and(|&state| state >= model.n_states) {
            let message = format!("expected rising states below {} in row {}", model.n_states, first_row + row);
            return Err(ModelError::new("rows.next_states", message));
        }
        check_distribution("rows.probabilities", &probabilities[start..end]).map_err(|error| ModelError {
            message: format!("{} in row {}", error.message, first_row + row),
            ..error
        })?;
        start = end;
    }
    // Counts come with every block or with none.
    let counted = !block.visit_counts.is_empty();
    if first_row == 0 {
        model.visit_counts = counted.then(Vec::new);
    } else if counted != model.visit_counts.is_some() {
        return Err(ModelError::new("rows.visit_counts", "expected visit counts in every block or in none"));
    }
    if let Some(counts) = &mut model.visit_counts {
        counts.extend(unpack::<u64>("rows.visit_counts", block.visit_counts, lengths.len())?);
    }
    let mut offset = model.next_states.len();
    model.row_offsets.extend(lengths.iter().map(|&length| {
        offset += length as usize;
        offset
    }));
    model.next_states.extend(next_states);
    model.probabilities.extend(probabilities);
    Ok(())
}

#[cfg(test)]
mod tests;
