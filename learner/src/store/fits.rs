//! Fits in the database: whole, as a versioned document, beside the columns that lists and searches need.

use super::StoreError;
use mazeway_proto::learner as pb;
use prost::Message as _;
use rusqlite::{Connection, OptionalExtension, Row, params};
use std::path::Path;

/// Version of the document: a `mazeway.learner.v1.Fit` behind this byte.
const DOCUMENT_VERSION: u8 = 1;

/// What is known of a fit without its arrays.
#[derive(Debug, Clone, PartialEq)]
pub struct FitInfo {
    /// Its place in the order of storing.
    pub seq: i64,
    /// Its id.
    pub fit_id: String,
    /// When it was stored, in microseconds since the Unix epoch.
    pub created_at_us: i64,
    /// Environment of its trajectories.
    pub env_id: String,
    /// Their style, where they have one and the same.
    pub style: String,
    /// Method.
    pub method: String,
    /// Model in which it was fitted.
    pub model_id: String,
    /// Number of trajectories.
    pub trajectories: u32,
    /// How it stopped, as in `mazeway.learner.v1.Stopped`.
    pub stopped: i32,
    /// Iterations done.
    pub iterations: u32,
    /// Share of demonstrated steps whose action the greedy policy takes.
    pub agreement: f64,
}

/// Stores a fit whose id and time are set.
pub(super) fn insert(connection: &Connection, fit: &pb::Fit, created_at_us: i64) -> rusqlite::Result<()> {
    let mut document = vec![DOCUMENT_VERSION];
    document.extend(fit.encode_to_vec());
    connection.execute(
        "INSERT INTO fits (fit_id, created_at, env_id, style, method, model_id, trajectories, stopped, iterations, \
         agreement, document) VALUES (?, ?, ?, ?, ?, ?, ?, ?, ?, ?, ?)",
        params![
            fit.fit_id,
            created_at_us,
            fit.env_id,
            fit.style,
            fit.request.as_ref().map_or("", |request| request.method.as_str()),
            fit.model_id,
            fit.trajectory_ids.len() as i64,
            fit.stopped,
            fit.iterations,
            fit.agreement,
            document,
        ],
    )?;
    Ok(())
}

/// Reads the one fit whose id begins so.
pub(super) fn get(connection: &Connection, path: &Path, prefix: &str) -> Result<Option<pb::Fit>, StoreError> {
    let fail = |e: rusqlite::Error| StoreError::from_sqlite(path, &e);
    let matches: i64 = connection
        .query_row("SELECT count(*) FROM fits WHERE substr(fit_id, 1, length(?1)) = ?1", [prefix], |row| row.get(0))
        .map_err(fail)?;
    if matches > 1 {
        return Err(StoreError::AmbiguousFit { prefix: prefix.to_owned(), matches: matches as u64 });
    }
    let document: Option<Vec<u8>> = connection
        .query_row("SELECT document FROM fits WHERE substr(fit_id, 1, length(?1)) = ?1", [prefix], |row| row.get(0))
        .optional()
        .map_err(fail)?;
    let Some(document) = document else { return Ok(None) };
    let corrupt = |message: String| StoreError::Corrupt { what: format!("fit {prefix}"), message };
    match document.split_first() {
        Some((&DOCUMENT_VERSION, message)) => pb::Fit::decode(message).map(Some).map_err(|e| corrupt(e.to_string())),
        version => {
            Err(corrupt(format!("expected version {DOCUMENT_VERSION}, got {:?}", version.map(|(first, _)| first))))
        }
    }
}

/// Reads the fit of a row, and checks that it is what the row says.
pub(super) fn by_row(connection: &Connection, path: &Path, seq: i64) -> Result<Option<pb::Fit>, StoreError> {
    let found = connection.query_row("SELECT fit_id FROM fits WHERE seq = ?", [seq], |row| row.get::<_, String>(0));
    let Some(fit_id) = found.optional().map_err(|e| StoreError::from_sqlite(path, &e))? else { return Ok(None) };
    let corrupt = |message: &str| StoreError::Corrupt { what: format!("fit {fit_id}"), message: message.into() };
    let fit = get(connection, path, &fit_id)?.ok_or_else(|| corrupt("it is not found by its id"))?;
    if fit.fit_id == fit_id { Ok(Some(fit)) } else { Err(corrupt("its document is that of another fit")) }
}

/// Lists fits, newest first, from before `before` on; empty labels mean any.
pub(super) fn list(
    connection: &Connection,
    env_id: &str,
    style: &str,
    before: i64,
    limit: u32,
) -> rusqlite::Result<Vec<FitInfo>> {
    let mut statement = connection.prepare(
        "SELECT seq, fit_id, created_at, env_id, style, method, model_id, trajectories, stopped, iterations, agreement \
         FROM fits WHERE (?1 = '' OR env_id = ?1) AND (?2 = '' OR style = ?2) AND seq < ?3 ORDER BY seq DESC LIMIT ?4",
    )?;
    let info = |row: &Row<'_>| {
        Ok(FitInfo {
            seq: row.get(0)?,
            fit_id: row.get(1)?,
            created_at_us: row.get(2)?,
            env_id: row.get(3)?,
            style: row.get(4)?,
            method: row.get(5)?,
            model_id: row.get(6)?,
            trajectories: row.get(7)?,
            stopped: row.get(8)?,
            iterations: row.get(9)?,
            agreement: row.get(10)?,
        })
    };
    statement.query_map(params![env_id, style, before, limit], info)?.collect()
}

/// Deletes a fit by its whole id and says whether there was one.
pub(super) fn delete(connection: &Connection, fit_id: &str) -> rusqlite::Result<bool> {
    Ok(connection.execute("DELETE FROM fits WHERE fit_id = ?", [fit_id])? == 1)
}
