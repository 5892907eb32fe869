//! Fits in the database: whole, as a versioned document, beside the columns that lists and searches need. The ids of the
//! trajectories that a fit used lie on pages of their own: they are as many as the data, and few ask for them.

use super::{
    StoreError, document,
    id_list::{IDS_A_PAGE, IdList, Tally, write_page},
};
use bytes::Bytes;
use mazeway_proto::learner as pb;
use prost::Message as _;
use rusqlite::{Connection, OptionalExtension, Row, params};
use std::path::Path;
use uuid::Uuid;

/// Version of the document: a `mazeway.learner.v1.Fit` behind this byte and the SHA-256 of the message.
const DOCUMENT_VERSION: u8 = 3;
/// The version whose documents had no hash.
const WITHOUT_HASH: u8 = 2;
/// The version whose documents had no hash and held the ids of the trajectories too.
const WITH_IDS: u8 = 1;

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

/// The columns of a [`FitInfo`], in its order.
const LISTED: &str =
    "seq, fit_id, created_at, env_id, style, method, model_id, trajectories, stopped, iterations, agreement";

impl FitInfo {
    /// Of a fit in its place, as its document tells.
    fn of(seq: i64, fit: &pb::Fit) -> Self {
        let created = fit.created_at.unwrap_or_default();
        Self {
            seq,
            fit_id: fit.fit_id.clone(),
            created_at_us: created.seconds.saturating_mul(1_000_000).saturating_add(i64::from(created.nanos / 1000)),
            env_id: fit.env_id.clone(),
            style: fit.style.clone(),
            method: fit.request.as_ref().map_or_else(String::new, |request| request.method.clone()),
            model_id: fit.model_id.clone(),
            trajectories: u32::try_from(fit.trajectories).unwrap_or(u32::MAX),
            stopped: fit.stopped,
            iterations: fit.iterations,
            agreement: fit.agreement,
        }
    }

    fn read(row: &Row<'_>) -> rusqlite::Result<Self> {
        Ok(Self {
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
    }
}

/// A document of the version that held the ids.
#[derive(Clone, PartialEq, prost::Message)]
struct OldDocument {
    #[prost(string, repeated, tag = "10")]
    trajectory_ids: Vec<String>,
}

/// Stores a fit whose id and time are set, and the ids of its trajectories, of which it tells number and digest then.
pub(super) fn insert(
    connection: &Connection,
    path: &Path,
    fit: &mut pb::Fit,
    ids: &mut IdList,
) -> Result<(), StoreError> {
    ids.describe(fit);
    let row = write_row(connection, None, fit, &encode(fit)).map_err(|e| StoreError::from_sqlite(path, &e))?;
    ids.write(connection, path, row)
}

/// Writes the row of a fit, in the next place or the one given, and tells which.
fn write_row(connection: &Connection, seq: Option<i64>, fit: &pb::Fit, document: &[u8]) -> rusqlite::Result<i64> {
    let info = FitInfo::of(0, fit);
    let sql = format!("INSERT INTO fits ({LISTED}, document) VALUES (?, ?, ?, ?, ?, ?, ?, ?, ?, ?, ?, ?)");
    connection.prepare_cached(&sql)?.insert(params![
        seq,
        info.fit_id,
        info.created_at_us,
        info.env_id,
        info.style,
        info.method,
        info.model_id,
        info.trajectories,
        info.stopped,
        info.iterations,
        info.agreement,
        document,
    ])
}

/// Takes a fit over from another store, with the ids of its trajectories where they lie on pages.
pub(super) fn take_over(
    old: &Connection,
    old_path: &Path,
    new: &Connection,
    new_path: &Path,
    stored: &StoredFit,
) -> Result<(), StoreError> {
    let read = |e: rusqlite::Error| StoreError::from_sqlite(old_path, &e);
    let write = |e: rusqlite::Error| StoreError::from_sqlite(new_path, &e);
    let StoredFit { row, fit, document, .. } = stored;
    write_row(new, Some(*row), fit, document).map_err(write)?;
    if document.first() == Some(&WITH_IDS) {
        return unfold(new, *row).map_err(write);
    }
    let sql = "SELECT page, ids FROM fit_trajectories WHERE fit = ? ORDER BY page";
    let mut statement = old.prepare_cached(sql).map_err(read)?;
    let mut pages = statement.query([row]).map_err(read)?;
    while let Some(page) = pages.next().map_err(read)? {
        let (page, ids) = page.get(0).and_then(|number| Ok((number, page.get::<_, Vec<u8>>(1)?))).map_err(read)?;
        write_page(new, *row, page, &ids).map_err(write)?;
    }
    Ok(())
}

fn encode(fit: &pb::Fit) -> Vec<u8> {
    document::seal(DOCUMENT_VERSION, &fit.encode_to_vec())
}

/// The row and the whole id of the one fit whose id begins so.
pub(super) fn find(connection: &Connection, path: &Path, prefix: &str) -> Result<Option<(i64, String)>, StoreError> {
    let fail = |e: rusqlite::Error| StoreError::from_sqlite(path, &e);
    let matching = "FROM fits WHERE substr(fit_id, 1, length(?1)) = ?1";
    let matches: i64 =
        connection.query_row(&format!("SELECT count(*) {matching}"), [prefix], |row| row.get(0)).map_err(fail)?;
    if matches > 1 {
        return Err(StoreError::AmbiguousFit { prefix: prefix.to_owned(), matches: matches as u64 });
    }
    let sql = format!("SELECT seq, fit_id {matching}");
    connection.query_row(&sql, [prefix], |row| Ok((row.get(0)?, row.get(1)?))).optional().map_err(fail)
}

/// Reads the one fit whose id begins so.
pub(super) fn get(connection: &Connection, path: &Path, prefix: &str) -> Result<Option<pb::Fit>, StoreError> {
    match find(connection, path, prefix)? {
        Some((row, id)) => {
            let document = stored(connection, row).map_err(|e| StoreError::from_sqlite(path, &e))?;
            decode(&document).map(Some).map_err(|message| corrupt(&id, message))
        }
        None => Ok(None),
    }
}

/// The document of a row.
fn stored(connection: &Connection, row: i64) -> rusqlite::Result<Bytes> {
    connection
        .query_row("SELECT document FROM fits WHERE seq = ?", [row], |row| row.get::<_, Vec<u8>>(0))
        .map(Bytes::from)
}

/// A document of any version.
fn decode(document: &Bytes) -> Result<pb::Fit, String> {
    match document.split_first() {
        Some((&DOCUMENT_VERSION, _)) => pb::Fit::decode(document::unseal(document)?).map_err(|e| e.to_string()),
        Some((&WITHOUT_HASH, message)) => pb::Fit::decode(message).map_err(|e| e.to_string()),
        Some((&WITH_IDS, message)) => {
            let mut fit = pb::Fit::decode(message).map_err(|e| e.to_string())?;
            let mut tally = Tally::default();
            old_ids(document)?.into_iter().flatten().for_each(|id| tally.add(id.as_bytes()));
            tally.describe(&mut fit);
            Ok(fit)
        }
        version => Err(format!("expected version {DOCUMENT_VERSION}, got {:?}", version.map(|(first, _)| first))),
    }
}

/// The ids that a document holds itself; `None` where they lie beside it.
fn old_ids(document: &[u8]) -> Result<Option<Vec<Uuid>>, String> {
    let Some((&WITH_IDS, message)) = document.split_first() else { return Ok(None) };
    let old = OldDocument::decode(message).map_err(|e| e.to_string())?;
    let ids = old.trajectory_ids.iter().map(|id| Uuid::parse_str(id).map_err(|e| format!("id {id:?}: {e}")));
    ids.collect::<Result<_, _>>().map(Some)
}

fn corrupt(fit_id: &str, message: impl Into<String>) -> StoreError {
    StoreError::Corrupt { what: format!("fit {fit_id}"), message: message.into() }
}

/// Takes the ids out of every document that holds them. One that does not read stays as it is: a check will name it.
pub(super) fn unfold_all(connection: &Connection) -> rusqlite::Result<()> {
    let mut statement = connection.prepare("SELECT seq FROM fits ORDER BY seq")?;
    let rows = statement.query_map([], |row| row.get(0))?.collect::<rusqlite::Result<Vec<_>>>()?;
    rows.into_iter().try_for_each(|row| unfold(connection, row))
}

/// As [`unfold_all`], of one row.
fn unfold(connection: &Connection, row: i64) -> rusqlite::Result<()> {
    let old = stored(connection, row)?;
    let (Ok(fit), Ok(Some(ids))) = (decode(&old), old_ids(&old)) else { return Ok(()) };
    for (page, ids) in ids.chunks(IDS_A_PAGE).enumerate() {
        let ids = ids.iter().flat_map(|id| *id.as_bytes()).collect::<Vec<u8>>();
        write_page(connection, row, page as i64, &ids)?;
    }
    connection.execute("UPDATE fits SET document = ? WHERE seq = ?", params![encode(&fit), row])?;
    Ok(())
}

/// A fit that is what was stored.
#[derive(Debug)]
pub struct StoredFit {
    /// Its row.
    row: i64,
    /// What its document says.
    pub(super) fit: pb::Fit,
    document: Bytes,
    /// Whether lists tell of it what its document says.
    pub(super) is_listed_rightly: bool,
}

/// Reads the fit of a row, and checks that it is what the row says and that its trajectories are those that it was made of.
pub(super) fn by_row(connection: &Connection, path: &Path, seq: i64) -> Result<Option<StoredFit>, StoreError> {
    let fail = |e: rusqlite::Error| StoreError::from_sqlite(path, &e);
    let found = connection.query_row("SELECT fit_id FROM fits WHERE seq = ?", [seq], |row| row.get::<_, String>(0));
    let Some(fit_id) = found.optional().map_err(fail)? else { return Ok(None) };
    let document = stored(connection, seq).map_err(fail)?;
    let fit = decode(&document).map_err(|message| corrupt(&fit_id, message))?;
    if fit.fit_id != fit_id {
        return Err(corrupt(&fit_id, "its document is that of another fit"));
    }
    if fit.agreement.is_nan() {
        return Err(corrupt(&fit_id, "its agreement is no number"));
    }
    if document.first() != Some(&WITH_IDS) {
        let mut tally = Tally::default();
        let sql = "SELECT page, ids FROM fit_trajectories WHERE fit = ? ORDER BY page";
        let mut statement = connection.prepare_cached(sql).map_err(fail)?;
        let mut pages = statement.query([seq]).map_err(fail)?;
        while let Some(page) = pages.next().map_err(fail)? {
            let ids = page.get_ref(1).and_then(|ids| Ok(ids.as_blob()?)).map_err(fail)?;
            tally.add(ids);
        }
        if tally.n_ids() != fit.trajectories || tally.digest()[..] != fit.trajectories_digest[..] {
            return Err(corrupt(&fit_id, "the ids of its trajectories are not what was stored: the digests differ"));
        }
    }
    // What is listed is made of the document, and can be made anew.
    let sql = format!("SELECT {LISTED} FROM fits WHERE seq = ?");
    let listed = connection.prepare_cached(&sql).and_then(|mut s| s.query_row([seq], FitInfo::read));
    let is_listed_rightly = listed.is_ok_and(|listed| listed == FitInfo::of(seq, &fit));
    Ok(Some(StoredFit { row: seq, fit, document, is_listed_rightly }))
}

/// The ids of a fit's trajectories from the one of rank `after` on, at most `limit`.
pub(super) fn trajectory_ids(
    connection: &Connection,
    path: &Path,
    row: i64,
    after: u64,
    limit: usize,
) -> Result<Vec<Uuid>, StoreError> {
    let fail = |e: rusqlite::Error| StoreError::from_sqlite(path, &e);
    let (page, mut skip) = (after / IDS_A_PAGE as u64, (after % IDS_A_PAGE as u64) as usize);
    let sql = "SELECT ids FROM fit_trajectories WHERE fit = ? AND page >= ? ORDER BY page";
    let mut statement = connection.prepare_cached(sql).map_err(fail)?;
    let mut pages = statement.query(params![row, page.min(i64::MAX as u64) as i64]).map_err(fail)?;
    let mut ids = Vec::new();
    while ids.len() < limit
        && let Some(page) = pages.next().map_err(fail)?
    {
        let blob = page.get_ref(0).and_then(|ids| Ok(ids.as_blob()?)).map_err(fail)?;
        ids.extend(blob.as_chunks().0.iter().skip(skip).take(limit - ids.len()).map(|id| Uuid::from_bytes(*id)));
        skip = 0;
    }
    Ok(ids)
}

/// Lists fits, newest first, from before `before` on; empty labels mean any.
pub(super) fn list(
    connection: &Connection,
    env_id: &str,
    style: &str,
    before: i64,
    limit: u32,
) -> rusqlite::Result<Vec<FitInfo>> {
    let mut statement = connection.prepare(&format!(
        "SELECT {LISTED} FROM fits WHERE (?1 = '' OR env_id = ?1) AND (?2 = '' OR style = ?2) AND seq < ?3 \
         ORDER BY seq DESC LIMIT ?4"
    ))?;
    statement.query_map(params![env_id, style, before, limit], FitInfo::read)?.collect()
}

/// Deletes a fit by its whole id and says whether there was one.
pub(super) fn delete(connection: &Connection, fit_id: &str) -> rusqlite::Result<bool> {
    Ok(connection.execute("DELETE FROM fits WHERE fit_id = ?", [fit_id])? == 1)
}
