//! Is what is stored what was stored? And what can still be read of a file that is damaged?
//!
//! Structure is SQLite's: its `integrity_check` looks at pages, order of keys and indices. Contents are ours: a trajectory
//! is checked against the SHA-256 that it was stored with, a model against its id, which is its SHA-256, a fit against the SHA-256
//! in its document, and what lists tell of it against that document, of which it is made.
//! Rows are read one by one, by every key that any index or the table itself still tells, so that a page that does not
//! read costs the rows that lie on it and no others.

use super::{
    Arrays, Collection, Model, Recording, StoreError,
    filter::stored_uuid,
    fits::{self, StoredFit},
    models,
    packing::{torn, unpack},
    room::Room,
    schema,
    trajectories::{self, blob},
};
use rusqlite::Connection;
use std::{
    collections::{BTreeMap, HashMap, HashSet},
    path::{Path, PathBuf},
};
use uuid::Uuid;

/// Findings of SQLite's that are told at most.
const MAX_FINDINGS: u32 = 100;
/// Damaged things that are named at most, of each kind; all are counted.
const MAX_NAMED: usize = 10_000;
/// Keys that are tried in vain at most where a table does not read, for each that something tells of: more than damaged pages
/// hide, and in a small store a moment's worth, wherever damage has put its keys.
const TRIED_A_KEY: usize = 64;
/// Fewest that may be.
const LEAST_TRIED: usize = 1 << 14;
/// Most that may be.
const MOST_TRIED: usize = 1 << 20;
/// Keys beyond the last known one that are tried.
const BEYOND: i64 = 10_000;
/// After so many in vain, one more is left out at a time.
const STRIDE: u32 = 16;
/// After so many in vain, by when half a page of pages is behind, a sixteenth more is left out at a time.
const FAR: u32 = 1 << 10;
/// So many keys that were left out are tried one by one; of more, those at their end.
const FEW: u64 = 1 << 12;

/// How many of a kind were looked at.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default, serde::Serialize)]
pub struct Tally {
    /// They are what was stored.
    pub sound: u64,
    /// They are not, or do not read.
    pub damaged: u64,
}

/// What a thing is.
#[derive(Debug, Clone, Copy, PartialEq, Eq, serde::Serialize)]
#[serde(rename_all = "lowercase")]
pub enum Kind {
    /// A trajectory.
    Trajectory,
    /// A model.
    Model,
    /// A fit.
    Fit,
}

/// One thing that is not what was stored, or does not read.
#[derive(Debug, Clone, PartialEq, Eq, serde::Serialize)]
pub struct Damage {
    /// What it is.
    pub kind: Kind,
    /// Its id, or its row where the id does not read.
    pub name: String,
    /// What is wrong.
    pub message: String,
}

/// What was found in a store.
#[derive(Debug, Clone, PartialEq, Eq, Default, serde::Serialize)]
pub struct Verification {
    /// The database.
    pub path: PathBuf,
    /// Version of its schema.
    pub schema: i64,
    /// What is wrong with its structure.
    pub structure: Vec<String>,
    /// Trajectories.
    pub trajectories: Tally,
    /// Models.
    pub models: Tally,
    /// Fits.
    pub fits: Tally,
    /// The damaged ones by name.
    pub damage: Vec<Damage>,
}

impl Verification {
    /// Whether nothing is wrong.
    pub fn is_sound(&self) -> bool {
        self.structure.is_empty() && [self.trajectories, self.models, self.fits].iter().all(|tally| tally.damaged == 0)
    }

    fn count(&mut self, kind: Kind, outcome: Result<(), (String, StoreError)>) {
        let tally = match kind {
            Kind::Trajectory => &mut self.trajectories,
            Kind::Model => &mut self.models,
            Kind::Fit => &mut self.fits,
        };
        match outcome {
            Ok(()) => tally.sound += 1,
            Err((name, error)) => {
                tally.damaged += 1;
                if tally.damaged <= MAX_NAMED as u64 {
                    self.damage.push(Damage { kind, name, message: error.to_string() });
                }
            }
        }
    }
}

/// A thing that is what was stored.
#[derive(Debug)]
pub enum Sound<'a> {
    /// A trajectory, its place in the order of recording and when it was recorded.
    Trajectory { seq: i64, recorded_at_us: i64, recording: &'a Recording },
    /// A model and when it was stored.
    Model { stored_at_us: i64, model: &'a Model },
    /// A fit.
    Fit(&'a StoredFit),
}

/// Reads everything that a store holds and checks it. A service may be at work on it meanwhile. Blocks.
///
/// # Errors
/// There is no store; it is a newer release's or another program's.
pub fn verify(directory: &Path) -> Result<Verification, StoreError> {
    sound_trajectories(directory, |_| Ok::<_, StoreError>(()))
}

/// As [`verify`], and calls `visit` with every trajectory that is what was stored, in the order of recording: what can be read
/// of a damaged store without repairing it.
///
/// # Errors
/// As [`verify`], and those of `visit`.
pub fn sound_trajectories<E: From<StoreError>>(
    directory: &Path,
    mut visit: impl FnMut(&Recording) -> Result<(), E>,
) -> Result<Verification, E> {
    let path = directory.join(schema::FILE_NAME);
    let _room = Room::as_found(directory);
    let connection = match schema::open_existing(&path) {
        Err(StoreError::Corrupt { message, .. }) => {
            return Ok(Verification { path, structure: vec![message], ..Verification::default() });
        }
        opened => opened?,
    };
    walk(&connection, &path, |sound| match sound {
        Sound::Trajectory { recording, .. } => visit(recording),
        Sound::Model { .. } | Sound::Fit(_) => Ok(()),
    })
}

/// What SQLite finds wrong with the structure of the database.
pub(super) fn structure(connection: &Connection) -> rusqlite::Result<Vec<String>> {
    let mut statement = connection.prepare(&format!("PRAGMA integrity_check({MAX_FINDINGS})"))?;
    let findings = statement.query_map([], |row| row.get::<_, String>(0))?.collect::<rusqlite::Result<Vec<_>>>()?;
    Ok(findings.into_iter().filter(|finding| finding != "ok").collect())
}

/// Checks everything, as it stands at the first, and calls `visit` with what is sound, trajectories in their order.
///
/// # Errors
/// Those of `visit`.
pub(super) fn walk<E: From<StoreError>>(
    connection: &Connection,
    path: &Path,
    mut visit: impl FnMut(Sound<'_>) -> Result<(), E>,
) -> Result<Verification, E> {
    let corrupt = |error: &rusqlite::Error| StoreError::from_sqlite(path, error);
    let snapshot = connection.unchecked_transaction().map_err(|e| corrupt(&e))?;
    let mut found = Verification { path: path.to_owned(), ..Verification::default() };
    match snapshot.pragma_query_value(None, "user_version", |row| row.get(0)) {
        Ok(version) => found.schema = version,
        Err(error) => found.structure.push(error.to_string()),
    }
    match structure(&snapshot) {
        Ok(findings) => found.structure.extend(findings),
        Err(error) => found.structure.push(error.to_string()),
    }
    let whole = found.structure.is_empty();
    if snapshot.is_autocommit() {
        // Damage ends a transaction, and without one every look would lock the file anew.
        snapshot.execute_batch("BEGIN").map_err(|e| corrupt(&e))?;
    }

    let names = if whole { BTreeMap::new() } else { names(&snapshot) };
    // An id is no part of what is hashed: where the row and the index do not agree on whose it is, nobody knows.
    let mut owners = HashMap::new();
    for (&key, &id) in &names {
        owners.entry(id).or_insert(key);
    }
    let mut seen = HashSet::new();
    let mut another = |key: i64, id: Uuid| {
        let elsewhere = owners.get(&id).is_some_and(|owner| *owner != key);
        !whole && (elsewhere || names.get(&key).is_some_and(|indexed| *indexed != id) || !seen.insert(id))
    };
    let mut collections = HashMap::new();
    let keys = Keys::new(&snapshot, "trajectories", "seq", &["trajectories_by_collection"], whole);
    keys.try_for_each(|key| {
        let name = || names.get(&key).map_or_else(|| format!("row {key}"), Uuid::to_string);
        match trajectory(&snapshot, path, found.schema, &mut collections, key) {
            Ok(Some((_, recording))) if another(key, recording.id()) => {
                found.count(
                    Kind::Trajectory,
                    Err((
                        name(),
                        damaged("trajectory", "its id is that of another one, or another than the index has"),
                    )),
                );
            }
            Ok(Some((recorded_at_us, recording))) => {
                visit(Sound::Trajectory { seq: key, recorded_at_us, recording: &recording })?;
                found.count(Kind::Trajectory, Ok(()));
            }
            Ok(None) => {
                found.count(Kind::Trajectory, Err((name(), damaged("trajectory", "its row is missing"))));
            }
            Err((id, error)) => found.count(Kind::Trajectory, Err((id.unwrap_or_else(name), error))),
        }
        Ok::<_, E>(())
    })?;
    Keys::new(&snapshot, "models", "rowid", &[], whole).try_for_each(|key| {
        match models::by_row(&snapshot, path, key) {
            Ok(Some((stored_at_us, model))) => {
                visit(Sound::Model { stored_at_us, model: &model })?;
                found.count(Kind::Model, Ok(()));
            }
            Ok(None) => {
                found.count(Kind::Model, Err((format!("row {key}"), damaged("model", "its row is missing"))));
            }
            Err(error) => found.count(Kind::Model, Err((format!("row {key}"), error))),
        }
        Ok::<_, E>(())
    })?;
    Keys::new(&snapshot, "fits", "seq", &["fits_by_env"], whole).try_for_each(|key| {
        match fits::by_row(&snapshot, path, key) {
            Ok(Some(stored)) => {
                visit(Sound::Fit(&stored))?;
                found.count(Kind::Fit, Ok(()));
                if !stored.is_listed_rightly && found.structure.len() < MAX_FINDINGS as usize {
                    let message = "what lists tell of it is not what its document says";
                    found.structure.push(format!("fit {}: {message}", stored.fit.fit_id));
                }
            }
            Ok(None) => {
                found.count(Kind::Fit, Err((format!("row {key}"), damaged("fit", "its row is missing"))));
            }
            Err(error) => found.count(Kind::Fit, Err((format!("row {key}"), error))),
        }
        Ok::<_, E>(())
    })?;
    Ok(found)
}

fn damaged(what: &str, message: impl Into<String>) -> StoreError {
    StoreError::Corrupt { what: what.into(), message: message.into() }
}

/// The keys of a table.
struct Keys<'a> {
    connection: &'a Connection,
    table: &'a str,
    key: &'a str,
    /// What the table or an index tells, rising.
    known: Vec<i64>,
    /// Where there may be more: within this range.
    guessed: Option<(i64, i64)>,
}

impl<'a> Keys<'a> {
    /// Where the structure is whole, the table tells; else whatever reads of the table and its indices, from either end.
    fn new(connection: &'a Connection, table: &'a str, key: &'a str, indices: &[&str], whole: bool) -> Self {
        let mut known = Vec::new();
        let mut read = |sql: &str| {
            let Ok(mut statement) = connection.prepare(sql) else { return };
            let Ok(mut rows) = statement.query([]) else { return };
            while let Ok(Some(row)) = rows.next() {
                known.extend(row.get::<_, i64>(0).ok());
            }
        };
        read(&format!("SELECT {key} FROM {table} NOT INDEXED ORDER BY {key}"));
        if whole {
            return Self { connection, table, key, known, guessed: None };
        }
        read(&format!("SELECT {key} FROM {table} NOT INDEXED ORDER BY {key} DESC"));
        let own = format!("sqlite_autoindex_{table}_1");
        for index in indices.iter().copied().chain([own.as_str()]) {
            read(&format!("SELECT {key} FROM {table} INDEXED BY {index}"));
        }
        known.sort_unstable();
        known.dedup();
        // Pages before and after what is known may be such as no index tells of.
        let guessed =
            known.first().zip(known.last()).map(|(&first, &last)| (first.min(1), last.saturating_add(BEYOND)));
        Self { connection, table, key, known, guessed }
    }

    /// Every key, rising.
    fn try_for_each<E>(self, visit: impl FnMut(i64) -> Result<(), E>) -> Result<(), E> {
        let Self { connection, table, key, known, guessed } = self;
        let sql = format!("SELECT {key} FROM {table} NOT INDEXED WHERE {key} >= ? ORDER BY {key} LIMIT 1");
        let (Some(range), Ok(mut statement)) = (guessed, connection.prepare(&sql)) else {
            return known.into_iter().try_for_each(visit);
        };
        let next_from = |at: i64| match statement.query_row([at], |row| row.get::<_, i64>(0)) {
            Ok(next) if next >= at => Next::Is(next),
            Err(rusqlite::Error::QueryReturnedNoRows) => Next::None,
            _ => Next::Unreadable,
        };
        rising(known, range, next_from, visit)
    }
}

/// Visits the keys that are `known` and those that a table tells within a range. It is asked for the next key that it has, so
/// that gaps cost nothing; where it does not read on, the next key is tried, for what follows may lie on a page that reads.
fn rising<E>(
    known: Vec<i64>,
    (first, last): (i64, i64),
    mut next_from: impl FnMut(i64) -> Next,
    mut visit: impl FnMut(i64) -> Result<(), E>,
) -> Result<(), E> {
    let mut vain = Vain::new(known.len());
    let mut known = known.into_iter().peekable();
    // The next to be tried, and the last that was tried in vain.
    let (mut at, mut failed) = (first, first);
    while at <= last && vain.left > 0 {
        let next = match next_from(at) {
            Next::Is(next) => next,
            Next::None => break,
            Next::Unreadable => {
                if known.next_if_eq(&at).is_some() {
                    visit(at)?;
                }
                failed = at;
                let further = at.saturating_add(vain.next());
                at = known.peek().map_or(further, |known| further.min(*known));
                continue;
            }
        };
        if vain.ends(at.abs_diff(failed) > 1) {
            // Back to what was left out: to all of it, or to where it ends.
            while at.abs_diff(failed) > FEW && vain.left > 0 {
                let middle = failed.midpoint(at);
                vain.left -= 1;
                match next_from(middle) {
                    Next::Is(_) => at = middle,
                    Next::None | Next::Unreadable => failed = middle,
                }
            }
            at = failed + 1;
            continue;
        }
        while let Some(missing) = known.next_if(|known| *known < next) {
            visit(missing)?;
        }
        known.next_if_eq(&next);
        visit(next)?;
        let Some(after) = next.checked_add(1) else { break };
        (at, failed) = (after, next);
    }
    known.try_for_each(visit)
}

/// What a table says of the next key from some key on.
enum Next {
    Is(i64),
    None,
    Unreadable,
}

/// Keys that are tried in vain, one after the other.
struct Vain {
    /// How many more may be.
    left: usize,
    in_a_row: u32,
    /// From the last one to the next.
    step: i64,
    /// Every key is tried, whatever is known.
    careful: bool,
}

impl Vain {
    /// Where so many keys are known.
    fn new(known: usize) -> Self {
        let left = known.saturating_mul(TRIED_A_KEY).clamp(LEAST_TRIED, MOST_TRIED);
        Self { left, in_a_row: 0, step: 1, careful: false }
    }

    /// One more was; how far it is to the next: further and further, so that the way is short even to a key that damage has
    /// put far away. Pages that read between two that do not are met unless they hold less than a sixteenth of what lies before.
    fn next(&mut self) -> i64 {
        self.left -= 1;
        self.in_a_row += 1;
        self.step = match self.in_a_row {
            _ if self.careful => 1,
            ..FAR => 1 + i64::from(self.in_a_row / STRIDE),
            _ => self.step.saturating_add(self.step / i64::from(STRIDE)),
        };
        self.step
    }

    /// One was not in vain: whether what was left out before it, if anything `was`, is to be tried key by key.
    fn ends(&mut self, was: bool) -> bool {
        self.in_a_row = 0;
        self.step = 1;
        self.careful = was;
        was
    }
}

/// Ids of trajectories by row, as far as the index of the ids reads.
fn names(connection: &Connection) -> BTreeMap<i64, Uuid> {
    let mut names = BTreeMap::new();
    let sql = "SELECT seq, trajectory_id FROM trajectories INDEXED BY sqlite_autoindex_trajectories_1";
    let Ok(mut statement) = connection.prepare(sql) else { return names };
    let Ok(mut rows) = statement.query([]) else { return names };
    while let Ok(Some(row)) = rows.next() {
        let id = row.get_ref(1).ok().and_then(|id| stored_uuid(id).ok());
        if let (Ok(seq), Some(id)) = (row.get(0), id) {
            names.insert(seq, id);
        }
    }
    names
}

/// An error, and the id of the trajectory that it is about where that reads.
type Unreadable = (Option<String>, StoreError);

/// Reads a trajectory and when it was recorded, and checks it against what it was stored with.
fn trajectory(
    connection: &Connection,
    path: &Path,
    schema: i64,
    collections: &mut HashMap<i64, Collection>,
    seq: i64,
) -> Result<Option<(i64, Recording)>, Unreadable> {
    let mut id = None;
    let read = (|| {
        // Schema 1 stored all arrays as wide as this.
        let packing = if schema < 2 { "0x844" } else { "packing" };
        let sql = format!(
            "SELECT trajectory_id, collection, recorded_at, seed, steps, final_state, terminated, truncated, \
             content_hash, states, actions, rewards, {packing} FROM trajectories WHERE seq = ?"
        );
        let mut statement = connection.prepare_cached(&sql)?;
        let mut rows = statement.query([seq])?;
        let Some(row) = rows.next()? else { return Ok(None) };
        let uuid = stored_uuid(row.get_ref(0)?);
        id = uuid.as_ref().ok().map(Uuid::to_string);
        let collection_row: i64 = row.get(1)?;
        let collection = if let Some(collection) = collections.get(&collection_row) {
            collection.clone()
        } else {
            let collection = trajectories::collection(connection, collection_row)?;
            collections.insert(collection_row, collection.clone());
            collection
        };
        let arrays = unpack(row.get(12)?, [blob(row, 9)?, blob(row, 10)?, blob(row, 11)?]);
        let (final_state, terminated, truncated) = (row.get(5)?, row.get(6)?, row.get(7)?);
        let arrays = arrays.map(|[states, actions, rewards]| Arrays {
            states,
            actions,
            rewards,
            final_state,
            terminated,
            truncated,
        });
        let seed = row.get::<_, Option<i64>>(3)?.map(|bits| bits as u64);
        let (recorded_at_us, steps, hash): (i64, i64, Vec<u8>) = (row.get(2)?, row.get(4)?, row.get(8)?);
        Ok(Some((uuid, collection, seed, arrays, recorded_at_us, steps, hash)))
    })();
    let read = read.map_err(|error: rusqlite::Error| (id.clone(), StoreError::from_sqlite(path, &error)))?;
    let Some((uuid, collection, seed, arrays, recorded_at_us, steps, hash)) = read else { return Ok(None) };
    let checked = uuid.and_then(|id| {
        let arrays = arrays.ok_or_else(|| torn(format!("trajectory {id}")))?;
        let recording = Recording::new(id, collection, seed, arrays);
        let recording = recording.map_err(|error| damaged("trajectory", error.to_string()))?;
        if recording.content_hash()[..] != hash[..] || i64::from(recording.steps()) != steps {
            return Err(damaged("trajectory", "its content is not what was stored: the hashes differ"));
        }
        Ok(recording)
    });
    match checked {
        Ok(recording) => Ok(Some((recorded_at_us, recording))),
        Err(error) => Err((id, error)),
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::{collection::vec, prelude::*};
    use std::{collections::BTreeSet, convert::Infallible, ops::RangeInclusive};

    /// What is visited of a table with these keys, of which some ranges do not read and some are known, and how often the table
    /// was asked.
    fn visited(keys: &BTreeSet<i64>, broken: &[RangeInclusive<i64>], known: &BTreeSet<i64>) -> (Vec<i64>, usize) {
        let (mut visited, mut asked) = (Vec::new(), 0);
        let next_from = |at: i64| {
            asked += 1;
            match keys.range(at..).next() {
                _ if broken.iter().any(|range| range.contains(&at)) => Next::Unreadable,
                Some(next) if broken.iter().any(|range| range.contains(next)) => Next::Unreadable,
                Some(&next) => Next::Is(next),
                None => Next::None,
            }
        };
        let range =
            (known.first().copied().unwrap_or(1).min(1), known.last().map_or(0, |last| last.saturating_add(BEYOND)));
        let visit = |key| {
            visited.push(key);
            Ok::<_, Infallible>(())
        };
        match rising(known.iter().copied().collect(), range, next_from, visit) {
            Ok(()) => (visited, asked),
        }
    }

    #[test]
    fn the_way_to_a_key_that_damage_has_put_far_away_is_short() {
        let far = i64::MAX - 1_000_000;
        let keys = (1..=500).chain(2_001..=2_100).chain([far]).collect();
        let (found, asked) = visited(&keys, &[101..=200, 501..=2_000, 2_101..=far - 1], &[1, 48, far].into());
        assert_eq!(found, (1..=100).chain(201..=500).chain(2_001..=2_100).chain([far]).collect::<Vec<_>>());
        assert!(asked < 10_000, "{asked}");
    }

    proptest! {
        /// Keys rise, none comes twice, all that are known come, and of the others those that read.
        #[test]
        fn what_reads_is_visited(
            pages in vec((50_i64..200, any::<bool>()), 1..40),
            known in proptest::collection::btree_set(1_i64..3_000, 0..20),
        ) {
            let (mut keys, mut broken, mut at) = (BTreeSet::new(), Vec::new(), 1);
            for (length, reads) in pages {
                let page = at..=at + length - 1;
                if reads {
                    keys.extend(page);
                } else {
                    broken.push(page);
                }
                at += length;
            }
            let mut expected: Vec<_> = keys.union(&known).copied().collect();
            let limit = known.last().map_or(0, |last| last + BEYOND);
            expected.retain(|key| known.contains(key) || *key <= limit);
            let (found, _) = visited(&keys, &broken, &known);
            prop_assert_eq!(found, expected);
        }
    }
}
