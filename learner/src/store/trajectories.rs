//! Trajectories in the database: insert, list, read a page at a time, delete.

use super::{
    Arrays, Collection, Filter, Recording, StoreError,
    filter::{Condition, stored_uuid},
    fits, now_us,
    packing::{pack, torn, unpack},
};
use rusqlite::{Connection, OptionalExtension, Row, params, params_from_iter, types::Value};
use std::{collections::HashMap, path::Path, sync::Arc};
use uuid::Uuid;

/// What [`Cursor::page`] reads of a row.
const COLUMNS: &str = "seq, trajectory_id, collection, seed, final_state, terminated, truncated, content_hash, packing, states, \
                       actions, rewards";
/// Rows that a page of whole trajectories holds at most.
const PAGE_ROWS: usize = 512;

/// What is known of a trajectory without its arrays.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct TrajectorySummary {
    /// Its place in the order of recording.
    pub seq: i64,
    /// Its id.
    pub id: Uuid,
    /// What it has in common with others.
    pub collection: Collection,
    /// Seed of the episode where the source is scripted.
    pub seed: Option<u64>,
    /// Number of steps.
    pub steps: u32,
    /// When it was stored, in microseconds since the Unix epoch.
    pub recorded_at_us: i64,
}

/// Row ids of the collections that were seen, so that recording asks the database once for each.
pub(super) type CollectionCache = HashMap<Collection, i64>;

/// Stores a trajectory. `Ok(false)`: it is stored already with the same content.
pub(super) fn insert(
    connection: &Connection,
    path: &Path,
    cache: &mut CollectionCache,
    recording: &Recording,
    index: usize,
) -> Result<bool, StoreError> {
    let fail = |e: rusqlite::Error| StoreError::from_sqlite(path, &e);
    let hash = recording.content_hash();
    let id = recording.id().into_bytes();
    let collection = if let Some(&id) = cache.get(recording.collection()) {
        id
    } else {
        let id = collection_id(connection, recording.collection()).map_err(fail)?;
        cache.insert(recording.collection().clone(), id);
        id
    };
    let arrays = recording.arrays();
    let packed = pack(arrays, recording.collection().n_states, recording.collection().n_actions);
    let inserted = connection
        .prepare_cached(
            "INSERT INTO trajectories (trajectory_id, collection, recorded_at, seed, steps, final_state, terminated, \
             truncated, content_hash, packing, states, actions, rewards) VALUES (?, ?, ?, ?, ?, ?, ?, ?, ?, ?, ?, ?, ?) \
             ON CONFLICT (trajectory_id) DO NOTHING",
        )
        .and_then(|mut statement| {
            statement.execute(params![
                id,
                collection,
                now_us(),
                recording.seed().map(|seed| seed as i64),
                recording.steps(),
                arrays.final_state,
                arrays.terminated,
                arrays.truncated,
                hash,
                packed.packing.code(),
                packed.states.as_ref(),
                packed.actions.as_ref(),
                packed.rewards.as_ref(),
            ])
        })
        .map_err(fail)?;
    if inserted == 1 {
        return Ok(true);
    }
    let stored: Vec<u8> = connection
        .prepare_cached("SELECT content_hash FROM trajectories WHERE trajectory_id = ?")
        .and_then(|mut statement| statement.query_row([id], |row| row.get(0)))
        .map_err(fail)?;
    if stored == hash { Ok(false) } else { Err(StoreError::TrajectoryExists { id: recording.id(), index }) }
}

/// The row of a collection, made where it is missing.
fn collection_id(connection: &Connection, collection: &Collection) -> rusqlite::Result<i64> {
    let Collection { env_id, model_id, style, source, n_states, n_actions } = collection;
    let values = params![env_id, style, model_id, source, n_states, n_actions];
    let found = connection
        .prepare_cached(
            "SELECT id FROM collections WHERE env_id = ? AND style = ? AND model_id = ? AND source = ? \
             AND n_states = ? AND n_actions = ?",
        )?
        .query_row(values, |row| row.get(0))
        .optional()?;
    if let Some(id) = found {
        return Ok(id);
    }
    connection
        .prepare_cached(
            "INSERT INTO collections (env_id, style, model_id, source, n_states, n_actions) VALUES (?, ?, ?, ?, ?, ?)",
        )?
        .insert(values)
}

/// Deletes what the filter selects and says how many there were.
pub(super) fn delete(connection: &Connection, filter: &Filter) -> rusqlite::Result<u64> {
    let condition = Condition::new(connection, filter)?;
    let sql = format!("DELETE FROM trajectories WHERE {}", condition.sql());
    Ok(connection.prepare(&sql)?.execute(params_from_iter(condition.values()))? as u64)
}

/// How many the filter selects.
pub(super) fn count(connection: &Connection, filter: &Filter) -> rusqlite::Result<u64> {
    let condition = Condition::new(connection, filter)?;
    let sql = format!("SELECT count(*) FROM trajectories WHERE {}", condition.sql());
    let count: i64 = connection.prepare(&sql)?.query_row(params_from_iter(condition.values()), |row| row.get(0))?;
    Ok(count as u64)
}

/// Reads on after `after`, at most `limit` of what the filter selects.
pub(super) fn summaries(
    connection: &Connection,
    path: &Path,
    filter: &Filter,
    after: i64,
    limit: u32,
) -> Result<Vec<TrajectorySummary>, StoreError> {
    let fail = |e: rusqlite::Error| StoreError::from_sqlite(path, &e);
    let mut condition = Condition::new(connection, filter).map_err(fail)?;
    condition.and("seq > ?", [Value::from(after)]);
    let sql = format!(
        "SELECT seq, trajectory_id, collection, seed, steps, recorded_at FROM trajectories WHERE {} \
         ORDER BY seq LIMIT {limit}",
        condition.sql()
    );
    let mut collections = Collections::default();
    let mut statement = connection.prepare(&sql).map_err(fail)?;
    let mut rows = statement.query(params_from_iter(condition.values())).map_err(fail)?;
    let mut summaries = Vec::new();
    while let Some(row) = rows.next().map_err(fail)? {
        summaries.push(TrajectorySummary {
            seq: row.get(0).map_err(fail)?,
            id: stored_uuid(row.get_ref(1).map_err(fail)?)?,
            collection: Collection::clone(&*collections.get(connection, row.get(2).map_err(fail)?).map_err(fail)?),
            seed: row.get::<_, Option<i64>>(3).map_err(fail)?.map(|bits| bits as u64),
            steps: row.get(4).map_err(fail)?,
            recorded_at_us: row.get(5).map_err(fail)?,
        });
    }
    Ok(summaries)
}

/// Where a reader of whole trajectories stands. A page is a statement of its own: a reader that takes its time neither
/// holds the data nor keeps the database's log from being cleared.
#[derive(Debug)]
pub struct Cursor {
    place: Place,
    collections: Collections,
}

#[derive(Debug)]
enum Place {
    /// Along the table or an index, from `after` on up to what was there when the reading began.
    Scan { filter: Box<Filter>, after: i64, last: i64 },
    /// The rows of a list of ids, which a filter may narrow: those left, the next one last.
    Rows(Vec<i64>),
    /// What the fit of a row used, which a filter may narrow: the ids from rank `next` on, of which those of a page may be
    /// read up to the row `after`.
    Fit { filter: Box<Filter>, fit: i64, next: u64, after: i64 },
}

impl Cursor {
    pub(super) fn new(connection: &Connection, filter: &Filter) -> rusqlite::Result<Self> {
        let place = if filter.ids.is_empty() {
            let last = connection.query_row("SELECT coalesce(max(seq), 0) FROM trajectories", [], |row| row.get(0))?;
            Place::Scan { filter: Box::new(filter.clone()), after: 0, last }
        } else {
            let condition = Condition::new(connection, filter)?;
            let sql = format!("SELECT seq FROM trajectories WHERE {} ORDER BY seq DESC", condition.sql());
            let mut statement = connection.prepare(&sql)?;
            let rows = statement.query_map(params_from_iter(condition.values()), |row| row.get(0))?;
            Place::Rows(rows.collect::<rusqlite::Result<_>>()?)
        };
        Ok(Self { place, collections: Collections::default() })
    }

    /// What the fit of a row used, where the filter selects it too.
    pub(super) fn of_fit(fit: i64, filter: &Filter) -> Self {
        let place = Place::Fit { filter: Box::new(filter.clone()), fit, next: 0, after: i64::MIN };
        Self { place, collections: Collections::default() }
    }

    /// The next trajectories, so many as fit into `max_bytes` and at least one; none where all that was asked for is gone.
    pub(super) fn page(
        &mut self,
        connection: &Connection,
        path: &Path,
        max_bytes: usize,
    ) -> Result<Vec<Recording>, StoreError> {
        let fail = |e: rusqlite::Error| StoreError::from_sqlite(path, &e);
        let (sql, values): (String, Vec<Value>) = match &self.place {
            Place::Scan { filter, after, last } => {
                let mut condition = Condition::new(connection, filter).map_err(fail)?;
                condition.and("seq > ? AND seq <= ?", [Value::from(*after), Value::from(*last)]);
                let sql = format!(
                    "SELECT {COLUMNS} FROM trajectories WHERE {} ORDER BY seq LIMIT {PAGE_ROWS}",
                    condition.sql()
                );
                (sql, condition.into_values())
            }
            Place::Rows(left) => {
                let next = left.iter().rev().take(PAGE_ROWS).map(i64::to_string).collect::<Vec<_>>().join(", ");
                (format!("SELECT {COLUMNS} FROM trajectories WHERE seq IN ({next}) ORDER BY seq"), Vec::new())
            }
            Place::Fit { filter, fit, next, after, .. } => {
                let ids = fits::trajectory_ids(connection, path, *fit, *next, PAGE_ROWS)?;
                if ids.is_empty() {
                    self.place = Place::Rows(Vec::new());
                    return Ok(Vec::new());
                }
                let mut condition = Condition::along_table(connection, filter).map_err(fail)?;
                condition.and("seq > ?", [Value::from(*after)]);
                condition.and_ids(&ids);
                let sql = format!("SELECT {COLUMNS} FROM trajectories WHERE {} ORDER BY seq", condition.sql());
                (sql, condition.into_values())
            }
        };
        let mut statement = connection.prepare(&sql).map_err(fail)?;
        let mut rows = statement.query(params_from_iter(values)).map_err(fail)?;
        let (mut page, mut bytes, mut full) = (Vec::new(), 0, false);
        let mut reached = None;
        while let Some(row) = rows.next().map_err(fail)? {
            let recording = self.read(connection, row).map_err(fail)??;
            bytes += recording.packed_bytes();
            if !page.is_empty() && bytes > max_bytes {
                full = true;
                break;
            }
            reached = Some(row.get::<_, i64>(0).map_err(fail)?);
            page.push(recording);
        }
        self.advance(reached, full);
        Ok(page)
    }

    /// Steps past what was read. Rows that were deleted meanwhile are passed over.
    fn advance(&mut self, reached: Option<i64>, full: bool) {
        match &mut self.place {
            Place::Scan { after, last, .. } => *after = reached.unwrap_or(*last),
            Place::Rows(left) => {
                let asked = left.len().min(PAGE_ROWS);
                let end = if full { reached } else { left.get(left.len() - asked).copied() };
                left.retain(|seq| Some(*seq) > end);
            }
            Place::Fit { next, after, .. } => {
                if full {
                    *after = reached.unwrap_or(*after);
                } else {
                    (*next, *after) = (*next + PAGE_ROWS as u64, i64::MIN);
                }
            }
        }
    }

    /// Whether all was read.
    pub fn is_done(&self) -> bool {
        match &self.place {
            Place::Scan { after, last, .. } => after >= last,
            Place::Rows(left) => left.is_empty(),
            // Whether there are more ids is seen by asking for them.
            Place::Fit { .. } => false,
        }
    }

    fn read(&mut self, connection: &Connection, row: &Row<'_>) -> rusqlite::Result<Result<Recording, StoreError>> {
        let id = match stored_uuid(row.get_ref(1)?) {
            Ok(id) => id,
            Err(error) => return Ok(Err(error)),
        };
        let collection = self.collections.get(connection, row.get(2)?)?;
        let seed = row.get::<_, Option<i64>>(3)?.map(|bits| bits as u64);
        let Some([states, actions, rewards]) = unpack(row.get(8)?, [blob(row, 9)?, blob(row, 10)?, blob(row, 11)?])
        else {
            return Ok(Err(torn(format!("trajectory {id}"))));
        };
        let arrays = Arrays {
            final_state: row.get(4)?,
            terminated: row.get(5)?,
            truncated: row.get(6)?,
            states,
            actions,
            rewards,
        };
        let recording = Recording::from_stored(id, Collection::clone(&collection), seed, arrays);
        if row.get_ref(7)?.as_blob()? != recording.content_hash() {
            let message = "its content is not what was stored: the hashes differ".into();
            return Ok(Err(StoreError::Corrupt { what: format!("trajectory {id}"), message }));
        }
        Ok(Ok(recording))
    }
}

/// An array as it is stored.
pub(super) fn blob<'a>(row: &'a Row<'_>, column: usize) -> rusqlite::Result<&'a [u8]> {
    Ok(row.get_ref(column)?.as_blob()?)
}

/// Collections by row id, read once each.
#[derive(Debug, Default)]
pub(super) struct Collections(HashMap<i64, Arc<Collection>>);

impl Collections {
    pub(super) fn get(&mut self, connection: &Connection, id: i64) -> rusqlite::Result<Arc<Collection>> {
        if let Some(collection) = self.0.get(&id) {
            return Ok(Arc::clone(collection));
        }
        let collection = Arc::new(collection(connection, id)?);
        self.0.insert(id, Arc::clone(&collection));
        Ok(collection)
    }
}

/// Reads a collection by its row.
pub(super) fn collection(connection: &Connection, row: i64) -> rusqlite::Result<Collection> {
    connection.query_row(
        "SELECT env_id, model_id, style, source, n_states, n_actions FROM collections WHERE id = ?",
        [row],
        |row| {
            Ok(Collection {
                env_id: row.get(0)?,
                model_id: row.get(1)?,
                style: row.get(2)?,
                source: row.get(3)?,
                n_states: row.get(4)?,
                n_actions: row.get(5)?,
            })
        },
    )
}
