//! Tabular models in the store: checked, named by their content, kept packed as they came.
//!
//! Invariants of a [`Model`]: every row (s, a) is there once, its next states rise and lie within the sizes, its
//! probabilities are not negative and sum to 1; labels and rewards have the sizes that the header says; the id is the
//! SHA-256 that `mazeway/env/v1/model.proto` lays down.

use super::{
    StoreError, document, now_us,
    recording::{FieldError, check_label, clip, unpack_f64, unpack_u32},
};
use bytes::Bytes;
use mazeway_proto::env::{FeatureDomain, FeatureTable, ModelHeader};
use prost::Message as _;
use rusqlite::{Connection, OptionalExtension, params};
use sha2::{Digest, Sha256};
use std::{fmt::Write as _, path::Path};

/// Version of the header's encoding: behind it and a hash, the hash of the visit counts and a protocol buffer message.
const DOCUMENT_VERSION: u8 = 2;
/// The version that had no hashes.
const WITHOUT_HASH: u8 = 1;
/// How far a sum of probabilities may lie from 1, as for [`crate::mdp::TabularMdp`].
const ROW_SUM_TOLERANCE: f64 = 1e-9;

/// Rows of the transition function, packed as in `mazeway.env.v1.RowBlock`, all in one block.
#[derive(Debug, Clone, PartialEq, Eq, Default)]
pub struct Rows {
    /// Entries of each row, 32-bit integers, shape (`n_states * n_actions`,).
    pub row_lengths: Bytes,
    /// Next state of each entry, 32-bit integers.
    pub next_states: Bytes,
    /// Probability of each entry, doubles.
    pub probabilities: Bytes,
    /// Visits of each row, 64-bit integers; empty where the model is exact.
    pub visit_counts: Bytes,
}

/// A tabular model, checked.
#[derive(Debug, Clone, PartialEq)]
pub struct Model {
    header: ModelHeader,
    rows: Rows,
}

/// What is known of a model without its rows.
#[derive(Debug, Clone, PartialEq)]
pub struct ModelInfo {
    /// Everything but the rows.
    pub header: ModelHeader,
    /// Entries of the transition function.
    pub n_transitions: u64,
    /// When it was stored, in microseconds since the Unix epoch.
    pub stored_at_us: i64,
}

impl Model {
    /// Bytes of its rows.
    pub fn packed_bytes(&self) -> u64 {
        let Rows { row_lengths, next_states, probabilities, visit_counts } = &self.rows;
        [row_lengths, next_states, probabilities, visit_counts].iter().map(|array| array.len() as u64).sum()
    }

    /// Checks header and rows and names the model by its content.
    ///
    /// # Errors
    /// The first field that breaks an invariant; a `model_id` that is given and is not that of the content.
    pub fn new(mut header: ModelHeader, rows: Rows) -> Result<Self, FieldError> {
        check_header(&header)?;
        check_rows(&header, &rows)?;
        let model_id = model_id(&header, &rows);
        if !header.model_id.is_empty() && header.model_id != model_id {
            let message = format!("expected {model_id} by the model's content, got {:?}", clip(&header.model_id));
            return Err(FieldError::new("header.model_id", message));
        }
        header.model_id = model_id;
        Ok(Self { header, rows })
    }

    /// Its id.
    pub fn model_id(&self) -> &str {
        &self.header.model_id
    }

    /// Everything but the rows.
    pub fn header(&self) -> &ModelHeader {
        &self.header
    }

    /// The rows.
    pub fn rows(&self) -> &Rows {
        &self.rows
    }
}

/// Checks sizes, labels, start, rewards, grid, features and the range of terminal states.
pub fn check_header(header: &ModelHeader) -> Result<(), FieldError> {
    let field = |name: &str, message: String| Err(FieldError::new(format!("header.{name}"), message));
    check_label("header.env_id", &header.env_id, false)?;
    for (name, size) in [("n_states", header.n_states), ("n_actions", header.n_actions)] {
        if size == 0 || size > i32::MAX as u32 {
            return field(name, format!("expected 1 to {}, got {size}", i32::MAX));
        }
    }
    let (n_states, n_actions) = (header.n_states as usize, header.n_actions as usize);
    if n_states.checked_mul(n_actions).is_none_or(|rows| rows > u32::MAX as usize) {
        return field("n_actions", format!("expected at most {} rows, got {n_states} times {n_actions}", u32::MAX));
    }
    for (name, labels, size) in
        [("state_labels", &header.state_labels, n_states), ("action_labels", &header.action_labels, n_actions)]
    {
        if !labels.is_empty() && labels.len() != size {
            return field(name, format!("expected {size} labels or none, got {}", labels.len()));
        }
    }
    let start = &header.initial_distribution;
    if !start.is_empty() {
        if start.len() != n_states * 8 {
            let (expected, got) = (n_states * 8, start.len());
            return field("initial_distribution", format!("expected {expected} bytes or none, got {got}"));
        }
        if let Some((state, p)) =
            unpack_f64(start).enumerate().find(|(_, p)| !(0.0..=1.0 + ROW_SUM_TOLERANCE).contains(p))
        {
            return field("initial_distribution", format!("expected probabilities, got {p} at state {state}"));
        }
        let sum = unpack_f64(start).sum::<f64>();
        if (sum - 1.0).abs() > ROW_SUM_TOLERANCE {
            return field("initial_distribution", format!("expected a sum of 1, got {sum}"));
        }
    }
    for (i, table) in header.rewards.iter().enumerate() {
        check_label(&format!("header.rewards[{i}].style"), &table.style, false)?;
        if header.rewards[..i].iter().any(|other| other.style == table.style) {
            return field(&format!("rewards[{i}].style"), format!("expected each style once, got {:?}", table.style));
        }
        let name = format!("rewards[{i}].values");
        if table.values.len() != n_states * n_actions * 8 {
            let (expected, got) = (n_states * n_actions * 8, table.values.len());
            return field(&name, format!("expected {expected} bytes, got {got}"));
        }
        if let Some(value) = unpack_f64(&table.values).find(|value| !value.is_finite()) {
            return field(&name, format!("expected finite rewards, got {value}"));
        }
    }
    if let Some(grid) = &header.grid {
        if grid.cells.len() != n_states * 4 {
            let (expected, got) = (n_states * 4, grid.cells.len());
            return field("grid.cells", format!("expected {expected} bytes, got {got}"));
        }
        let cells = u64::from(grid.rows) * u64::from(grid.columns);
        if let Some(cell) = unpack_u32(&grid.cells).find(|&cell| u64::from(cell) >= cells) {
            return field("grid.cells", format!("expected cells below {cells}, got {}", cell as i32));
        }
    }
    if let Some(table) = &header.features {
        check_features(table, n_states, n_actions)?;
    }
    let terminal = &header.terminal_states;
    if !terminal.len().is_multiple_of(4) {
        return field("terminal_states", format!("expected 4 bytes a state, got {} bytes", terminal.len()));
    }
    let mut before = None;
    for state in unpack_u32(terminal) {
        if state >= header.n_states || before.is_some_and(|before| before >= state) {
            let message = format!("expected rising states below {n_states}, got {}", state as i32);
            return field("terminal_states", message);
        }
        before = Some(state);
    }
    Ok(())
}

fn check_features(table: &FeatureTable, n_states: usize, n_actions: usize) -> Result<(), FieldError> {
    let field = |name: &str, message: String| Err(FieldError::new(format!("header.features.{name}"), message));
    if table.names.is_empty() {
        return field("names", "expected at least one feature, got none".into());
    }
    for (i, name) in table.names.iter().enumerate() {
        check_label(&format!("header.features.names[{i}]"), name, false)?;
        if table.names[..i].contains(name) {
            return field(&format!("names[{i}]"), format!("expected each feature once, got {:?} again", clip(name)));
        }
    }
    let rows = match FeatureDomain::try_from(table.domain) {
        Ok(FeatureDomain::State) => n_states,
        Ok(FeatureDomain::StateAction) => n_states * n_actions,
        Ok(FeatureDomain::Unspecified) | Err(_) => {
            return field("domain", format!("expected states or state-action pairs, got {}", table.domain));
        }
    };
    let expected = rows.saturating_mul(table.names.len()).saturating_mul(8);
    if table.values.len() != expected {
        return field("values", format!("expected {expected} bytes, got {}", table.values.len()));
    }
    if let Some((entry, value)) = unpack_f64(&table.values).enumerate().find(|(_, value)| !value.is_finite()) {
        let (row, name) = (entry / table.names.len(), &table.names[entry % table.names.len()]);
        return field("values", format!("expected finite features, got {value} for {:?} in row {row}", clip(name)));
    }
    Ok(())
}

fn check_rows(header: &ModelHeader, rows: &Rows) -> Result<(), FieldError> {
    let field = |name: &str, message: String| Err(FieldError::new(format!("rows.{name}"), message));
    let n_rows = header.n_states as usize * header.n_actions as usize;
    if rows.row_lengths.len() != n_rows * 4 {
        return field("row_lengths", format!("expected {n_rows} rows, got {}", rows.row_lengths.len() as f64 / 4.0));
    }
    let entries = unpack_u32(&rows.row_lengths).map(u64::from).sum::<u64>();
    if rows.next_states.len() as u64 != entries * 4 {
        return field("next_states", format!("expected {} bytes, got {}", entries * 4, rows.next_states.len()));
    }
    if rows.probabilities.len() as u64 != entries * 8 {
        return field("probabilities", format!("expected {} bytes, got {}", entries * 8, rows.probabilities.len()));
    }
    if !rows.visit_counts.is_empty() && rows.visit_counts.len() != n_rows * 8 {
        let got = rows.visit_counts.len();
        return field("visit_counts", format!("expected {} bytes or none, got {got}", n_rows * 8));
    }
    let mut next_states = unpack_u32(&rows.next_states);
    let mut probabilities = unpack_f64(&rows.probabilities);
    let mut terminal = unpack_u32(&header.terminal_states).peekable();
    for (row, length) in unpack_u32(&rows.row_lengths).enumerate() {
        let at = || format!("at state {}, action {}", row / header.n_actions as usize, row % header.n_actions as usize);
        let (mut before, mut sum) = (None, 0.0);
        for (next, p) in next_states.by_ref().zip(probabilities.by_ref()).take(length as usize) {
            if next >= header.n_states {
                let message = format!("expected states below {}, got {} {}", header.n_states, next as i32, at());
                return field("next_states", message);
            }
            if before.is_some_and(|before| before >= next) {
                return field("next_states", format!("expected rising next states, got {next} out of order {}", at()));
            }
            if !(0.0..=1.0 + ROW_SUM_TOLERANCE).contains(&p) {
                return field("probabilities", format!("expected values from 0 to 1, got {p} {}", at()));
            }
            before = Some(next);
            sum += p;
        }
        if (sum - 1.0).abs() > ROW_SUM_TOLERANCE {
            return field("probabilities", format!("expected a sum of 1, got {sum} {}", at()));
        }
        let state = (row / header.n_actions as usize) as u32;
        if terminal.peek() == Some(&state) {
            if length != 1 || before != Some(state) {
                return field("next_states", format!("expected a terminal state to lead to itself alone {}", at()));
            }
            if row % header.n_actions as usize + 1 == header.n_actions as usize {
                terminal.next();
            }
        }
    }
    Ok(())
}

/// SHA-256 over sizes and rows, see `ModelHeader.model_id`.
fn model_id(header: &ModelHeader, rows: &Rows) -> String {
    let mut hash = Sha256::new();
    hash.update(b"mazeway-model-v1");
    hash.update(header.n_states.to_le_bytes());
    hash.update(header.n_actions.to_le_bytes());
    let mut entry = 0;
    let mut bytes = Vec::new();
    for length in unpack_u32(&rows.row_lengths) {
        bytes.clear();
        bytes.extend(length.to_le_bytes());
        for _ in 0..length {
            bytes.extend(&rows.next_states[entry * 4..entry * 4 + 4]);
            bytes.extend(&rows.probabilities[entry * 8..entry * 8 + 8]);
            entry += 1;
        }
        hash.update(&bytes);
    }
    let mut hexadecimal = String::with_capacity(64);
    for byte in hash.finalize() {
        // Writing to a string cannot fail.
        let _ = write!(hexadecimal, "{byte:02x}");
    }
    hexadecimal
}

/// What became of a model that was to be stored.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Put {
    /// It is new.
    Stored,
    /// It was there, header and all.
    Known,
    /// Its rows were there; its header took the place of theirs.
    Replaced,
}

/// Stores a model. Its rows are its identity: where they are there with another header, that is an error unless it is to
/// be replaced.
pub(super) fn insert(connection: &Connection, path: &Path, model: &Model, replace: bool) -> Result<Put, StoreError> {
    let fail = |e: rusqlite::Error| StoreError::from_sqlite(path, &e);
    let Model { header, rows } = model;
    // The id, a hash, stands for the other rows.
    let message = [&document::hash(&rows.visit_counts)[..], &header.encode_to_vec()].concat();
    let document = document::seal(DOCUMENT_VERSION, &message);
    let known = connection
        .query_row("SELECT header FROM models WHERE model_id = ?", [&header.model_id], |row| row.get::<_, Vec<u8>>(0))
        .optional()
        .map_err(fail)?;
    if let Some(known) = known {
        let (known, _) = decode_header(known.into(), &header.model_id)?;
        if known == *header {
            return Ok(Put::Known);
        }
        if !replace {
            let differs = differing(&known, header);
            if differs.is_empty() {
                return Ok(Put::Known);
            }
            return Err(StoreError::ModelExists { id: header.model_id.clone(), env_id: known.env_id.clone(), differs });
        }
        let values = params![header.env_id, document, rows.visit_counts.as_ref(), header.model_id];
        connection
            .execute("UPDATE models SET env_id = ?, header = ?, visit_counts = ? WHERE model_id = ?", values)
            .map_err(fail)?;
        return Ok(Put::Replaced);
    }
    let insert = connection.execute(
        "INSERT INTO models (model_id, env_id, stored_at, n_transitions, header, row_lengths, next_states, \
         probabilities, visit_counts) VALUES (?, ?, ?, ?, ?, ?, ?, ?, ?)",
        params![
            header.model_id,
            header.env_id,
            now_us(),
            (rows.next_states.len() / 4) as i64,
            document,
            rows.row_lengths.as_ref(),
            rows.next_states.as_ref(),
            rows.probabilities.as_ref(),
            rows.visit_counts.as_ref(),
        ],
    );
    insert.map_err(fail)?;
    Ok(Put::Stored)
}

/// In what a new header contradicts the known one of the same rows; what it leaves out contradicts nothing.
fn differing(known: &ModelHeader, new: &ModelHeader) -> String {
    let labels = |known: &[String], new: &[String]| !new.is_empty() && known != new;
    let parts = [
        ("environment", known.env_id != new.env_id),
        ("labels", labels(&known.state_labels, &new.state_labels) || labels(&known.action_labels, &new.action_labels)),
        (
            "start distribution",
            !new.initial_distribution.is_empty() && known.initial_distribution != new.initial_distribution,
        ),
        ("rewards", !new.rewards.is_empty() && known.rewards != new.rewards),
        ("features", new.features.is_some() && known.features != new.features),
        ("terminal states", !new.terminal_states.is_empty() && known.terminal_states != new.terminal_states),
        ("origin", known.estimated != new.estimated),
        ("grid", new.grid.is_some() && known.grid != new.grid),
    ];
    parts.into_iter().filter(|part| part.1).map(|part| part.0).collect::<Vec<_>>().join(", ")
}

/// Reads a model.
pub(super) fn get(connection: &Connection, path: &Path, model_id: &str) -> Result<Option<Model>, StoreError> {
    let fail = |e: rusqlite::Error| StoreError::from_sqlite(path, &e);
    let found = connection
        .query_row(
            "SELECT header, row_lengths, next_states, probabilities, visit_counts FROM models WHERE model_id = ?",
            [model_id],
            |row| {
                let blob = |column| row.get::<_, Vec<u8>>(column).map(Bytes::from);
                let rows = Rows {
                    row_lengths: blob(1)?,
                    next_states: blob(2)?,
                    probabilities: blob(3)?,
                    visit_counts: blob(4)?,
                };
                Ok((blob(0)?, rows))
            },
        )
        .optional()
        .map_err(fail)?;
    let Some((document, rows)) = found else { return Ok(None) };
    let (header, counts) = decode_header(document, model_id)?;
    if counts.is_some_and(|counts| counts != document::hash(&rows.visit_counts)) {
        let message = "its visit counts are not what was stored: the hashes differ".into();
        return Err(StoreError::Corrupt { what: format!("model {model_id}"), message });
    }
    Ok(Some(Model { header, rows }))
}

/// Reads the model of a row, checks it as if it came from outside, and tells when it was stored.
pub(super) fn by_row(connection: &Connection, path: &Path, row: i64) -> Result<Option<(i64, Model)>, StoreError> {
    let fail = |e: rusqlite::Error| StoreError::from_sqlite(path, &e);
    let sql = "SELECT model_id, stored_at FROM models WHERE rowid = ?";
    let found = connection.query_row(sql, [row], |row| Ok((row.get::<_, String>(0)?, row.get(1)?))).optional();
    let Some((model_id, stored_at)) = found.map_err(fail)? else { return Ok(None) };
    let corrupt = |message: String| StoreError::Corrupt { what: format!("model {model_id}"), message };
    let Some(model) = get(connection, path, &model_id)? else {
        return Err(corrupt("it is not found by its id".into()));
    };
    if model.header.model_id != model_id {
        return Err(corrupt(format!("its header is that of {:?}", clip(&model.header.model_id))));
    }
    let model = Model::new(model.header, model.rows).map_err(|error| corrupt(error.to_string()))?;
    Ok(Some((stored_at, model)))
}

/// Lists models in the order of their ids; an empty `env_id` means any.
pub(super) fn list(connection: &Connection, path: &Path, env_id: &str) -> Result<Vec<ModelInfo>, StoreError> {
    let fail = |e: rusqlite::Error| StoreError::from_sqlite(path, &e);
    let mut statement = connection
        .prepare(
            "SELECT model_id, header, n_transitions, stored_at FROM models WHERE ?1 = '' OR env_id = ?1 \
             ORDER BY model_id",
        )
        .map_err(fail)?;
    let mut rows = statement.query([env_id]).map_err(fail)?;
    let mut models = Vec::new();
    while let Some(row) = rows.next().map_err(fail)? {
        let model_id: String = row.get(0).map_err(fail)?;
        let document: Vec<u8> = row.get(1).map_err(fail)?;
        models.push(ModelInfo {
            header: decode_header(document.into(), &model_id)?.0,
            n_transitions: row.get::<_, i64>(2).map_err(fail)? as u64,
            stored_at_us: row.get(3).map_err(fail)?,
        });
    }
    Ok(models)
}

/// The header of a document, and the hash that the visit counts had, where it tells.
fn decode_header(document: Bytes, model_id: &str) -> Result<(ModelHeader, Option<[u8; 32]>), StoreError> {
    let corrupt = |message: String| StoreError::Corrupt { what: format!("header of model {model_id}"), message };
    let (counts, message) = match document.first() {
        Some(&DOCUMENT_VERSION) => {
            let split = document::unseal(&document).and_then(|message| document::split_hash(&message));
            split.map(|(counts, message)| (Some(counts), message)).map_err(|message| corrupt(message.into()))?
        }
        Some(&WITHOUT_HASH) => (None, document.slice(1..)),
        version => return Err(corrupt(format!("expected version {DOCUMENT_VERSION}, got {version:?}"))),
    };
    Ok((ModelHeader::decode(message).map_err(|e| corrupt(e.to_string()))?, counts))
}
