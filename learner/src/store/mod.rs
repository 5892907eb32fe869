//! Durable trajectories, models and fits in one directory, in SQLite.
//!
//! Invariants: what was acknowledged is on stable storage and survives the death of the process and of the machine; an
//! id means one content for ever; rows are read in the order in which they were recorded, in memory that does not grow
//! with the data; several processes may use a directory at once. Trajectories are kept raw: what a method needs of them
//! depends on the discount and the horizon, and is derived when it is needed.
//!
//! Deliberately absent: the wire (see `grpc`), and any change of what is stored; there is recording and
//! deleting.

mod activity;
mod allowance;
mod backup;
mod check;
mod document;
mod error;
mod filter;
mod fits;
mod id_list;
mod models;
mod options;
mod packing;
mod recording;
mod repair;
mod room;
mod scan;
mod schema;
mod trajectories;
mod writer;

#[cfg(test)]
mod tests;

pub use activity::Activity;
pub use allowance::Allowance;
pub use backup::backup;
pub use check::{Damage, Kind, Tally, Verification, sound_trajectories, verify};
pub use error::StoreError;
pub use filter::Filter;
pub use fits::FitInfo;
pub use id_list::IdList;
pub use models::{Model, ModelInfo, Put, Rows, check_header};
pub use options::StoreOptions;
pub use recording::{
    Arrays, Collection, FieldError, MAX_LABEL_BYTES, Recording, check_label, check_model_id, clip, pack_f64, pack_u32,
    unpack_f64, unpack_u32,
};
pub use repair::{Repair, repair};
pub use scan::Stored;
pub use schema::FILE_NAME;
pub use trajectories::{Cursor, TrajectorySummary};
pub use writer::Pending;

use activity::Recorded;
use mazeway_proto::learner as pb;
use room::Room;
use rusqlite::Connection;
use std::{
    fs::File,
    ops::{ControlFlow, Deref},
    path::{Path, PathBuf},
    sync::{Arc, Mutex, PoisonError},
    time::SystemTime,
};
use tokio::sync::Semaphore;
use uuid::Uuid;
use writer::Writer;

/// Bytes of arrays that wait for the disk at most; more wait in their callers.
const PENDING_BYTES: usize = 256 << 20;
/// Unit in which pending bytes are counted.
const PENDING_UNIT: usize = 1 << 10;
/// Bytes of arrays that a reader holds at a time, one trajectory more at most.
const PAGE_BYTES: usize = 1 << 20;
/// Bytes that are written on trial where the last write failed: so much must fit before recordings are taken again.
const TRIAL_BYTES: usize = 64 << 10;
/// Idle reading connections that are kept.
const IDLE_READERS: usize = 8;

/// A store, cheap to clone. Writing is asynchronous; reading blocks and belongs on a thread that may block. The last
/// clone that goes waits until everything submitted is written.
#[derive(Debug, Clone)]
pub struct Store(Arc<Inner>);

#[derive(Debug)]
struct Inner {
    path: PathBuf,
    options: StoreOptions,
    // Dropped in this order: the last connection goes before the sign that somebody uses the directory.
    readers: Mutex<Vec<Connection>>,
    writer: Writer,
    activity: Arc<Activity>,
    pending: Arc<Semaphore>,
    _room: Room,
    _user: File,
}

impl Store {
    /// Opens the store of a directory, made where it is missing. Blocks.
    pub fn open(directory: &Path) -> Result<Self, StoreError> {
        Self::open_with(directory, StoreOptions::default())
    }

    /// As [`Store::open`], with options. Blocks.
    pub fn open_with(directory: &Path, options: StoreOptions) -> Result<Self, StoreError> {
        let schema::Opened { path, connection, user } = schema::open(directory, &options)?;
        let activity = Arc::new(Activity::default());
        let writer = Writer::start(connection, path.clone(), Arc::clone(&activity))?;
        let pending = Arc::new(Semaphore::new(PENDING_BYTES / PENDING_UNIT));
        let (readers, room) = (Mutex::default(), Room::kept(directory));
        Ok(Self(Arc::new(Inner { path, options, readers, writer, activity, pending, _room: room, _user: user })))
    }

    /// As [`Store::open`], where there is a store already. Blocks.
    pub fn open_existing(directory: &Path) -> Result<Self, StoreError> {
        drop(schema::open_existing(&directory.join(schema::FILE_NAME))?);
        Self::open(directory)
    }

    /// The database file.
    pub fn path(&self) -> &Path {
        &self.0.path
    }

    /// Stores all of the trajectories or none. Returns how many were not stored before, once they are on stable storage.
    ///
    /// # Errors
    /// [`StoreError::TrajectoryExists`] where an id is stored with another content.
    pub async fn record(&self, recordings: Vec<Recording>) -> Result<u32, StoreError> {
        self.queue_recordings(recordings).await?.committed().await
    }

    /// As [`Store::record`], but comes back as soon as the trajectories have their place in the order of recording.
    pub async fn queue_recordings(&self, recordings: Vec<Recording>) -> Result<Pending<u32>, StoreError> {
        self.queue_recordings_of(None, recordings).await
    }

    /// As [`Store::queue_recordings`], at the expense of a caller.
    ///
    /// # Errors
    /// As before; once written, [`StoreError::AllowanceSpent`] where the caller may not keep as much.
    pub async fn queue_recordings_of(
        &self,
        allowance: Option<Allowance>,
        recordings: Vec<Recording>,
    ) -> Result<Pending<u32>, StoreError> {
        let bytes = recordings.iter().map(Recording::packed_bytes).sum::<usize>();
        let units = bytes.div_ceil(PENDING_UNIT).clamp(1, PENDING_BYTES / PENDING_UNIT);
        let pending = Arc::clone(&self.0.pending);
        let pending = pending.acquire_many_owned(units as u32).await.map_err(|_| StoreError::Closed)?;
        let quota = self.0.options.max_bytes;
        let job = move |work: &mut writer::Work<'_>| {
            let _pending = pending;
            let (mut stored, mut recorded) = (0, Recorded::default());
            for (index, recording) in recordings.iter().enumerate() {
                let new = trajectories::insert(work.connection, work.path, work.collections, recording, index)?;
                stored += u32::from(new);
                if new {
                    recorded.add(recording);
                }
            }
            if stored > 0 {
                check_quota(work, quota)?;
                if let Some(allowance) = &allowance {
                    allowance.charge(work.connection, work.path, recorded.bytes())?;
                }
                work.recorded.join(recorded);
            }
            Ok(stored)
        };
        self.0.writer.queue(job).await
    }

    /// What it has done since it was opened.
    pub fn activity(&self) -> &Arc<Activity> {
        &self.0.activity
    }

    /// Writes some bytes and takes them back in the same commit, to find out whether there is room for recordings again.
    ///
    /// # Errors
    /// There is none, or the disk fails.
    pub async fn try_writing(&self) -> Result<(), StoreError> {
        let quota = self.0.options.max_bytes;
        let job = move |work: &mut writer::Work<'_>| {
            let fail = |e: rusqlite::Error| StoreError::from_sqlite(work.path, &e);
            let write = format!("CREATE TABLE trial(bytes); INSERT INTO trial VALUES (zeroblob({TRIAL_BYTES}))");
            work.connection.execute_batch(&write).map_err(fail)?;
            check_quota(work, quota)?;
            work.connection.execute_batch("DROP TABLE trial").map_err(fail)
        };
        self.0.writer.queue(job).await?.committed().await
    }

    /// Deletes what the filter selects and returns how many there were.
    pub async fn delete_trajectories(&self, filter: Filter) -> Result<u64, StoreError> {
        self.write(move |connection| trajectories::delete(connection, &filter)).await
    }

    /// Stores a model; with `replace`, its header takes the place of the one that its rows are stored with.
    ///
    /// # Errors
    /// [`StoreError::ModelExists`] where the rows are stored with another header, which is not to be replaced.
    pub async fn put_model(&self, model: Model, replace: bool) -> Result<Put, StoreError> {
        self.put_model_of(None, model, replace).await
    }

    /// As [`Store::put_model`], at the expense of a caller.
    ///
    /// # Errors
    /// As before, and [`StoreError::AllowanceSpent`] where the caller may not keep as much.
    pub async fn put_model_of(
        &self,
        allowance: Option<Allowance>,
        model: Model,
        replace: bool,
    ) -> Result<Put, StoreError> {
        let quota = self.0.options.max_bytes;
        let job = move |work: &mut writer::Work<'_>| {
            let put = models::insert(work.connection, work.path, &model, replace)?;
            if put != Put::Known {
                check_quota(work, quota)?;
                if let Some(allowance) = &allowance {
                    allowance.charge(work.connection, work.path, model.packed_bytes())?;
                }
            }
            Ok(put)
        };
        self.0.writer.queue(job).await?.committed().await
    }

    /// A list for the ids of the trajectories that a fit uses.
    pub fn id_list(&self) -> IdList {
        IdList::new(self.path().parent().unwrap_or(Path::new(".")))
    }

    /// Stores a fit, whose id is set, with the ids of its trajectories, and returns it with their number and digest and the
    /// time at which it was stored.
    pub async fn put_fit(&self, mut fit: pb::Fit, mut ids: IdList) -> Result<pb::Fit, StoreError> {
        let job = move |work: &mut writer::Work<'_>| {
            let now = now_us();
            fit.created_at = Some(timestamp(now));
            fits::insert(work.connection, work.path, &mut fit, &mut ids)?;
            Ok(fit)
        };
        self.0.writer.queue(job).await?.committed().await
    }

    /// Deletes a fit by its whole id and says whether there was one.
    pub async fn delete_fit(&self, fit_id: String) -> Result<bool, StoreError> {
        self.write(move |connection| fits::delete(connection, &fit_id)).await
    }

    /// Writes the database anew without the room that deleting has left, and gives that back to the disk. Needs as much
    /// room again while it works. Recordings wait meanwhile.
    pub async fn vacuum(&self) -> Result<(), StoreError> {
        self.0.writer.queue_alone(|connection| connection.execute_batch("VACUUM")).await?;
        self.checkpoint().await
    }

    /// Writes the write-ahead log back into the database and empties it, as far as no reader needs it.
    pub async fn checkpoint(&self) -> Result<(), StoreError> {
        let checkpoint =
            |connection: &Connection| connection.query_row("PRAGMA wal_checkpoint(TRUNCATE)", [], |_| Ok(()));
        self.0.writer.queue_alone(checkpoint).await
    }

    async fn write<T: Send + 'static>(
        &self,
        job: impl FnOnce(&Connection) -> rusqlite::Result<T> + Send + 'static,
    ) -> Result<T, StoreError> {
        let job =
            move |work: &mut writer::Work<'_>| job(work.connection).map_err(|e| StoreError::from_sqlite(work.path, &e));
        self.0.writer.queue(job).await?.committed().await
    }

    /// Reads on after the trajectory of rank `after`, 0 for the first, at most `limit`. Blocks.
    pub fn summaries(&self, filter: &Filter, after: i64, limit: u32) -> Result<Vec<TrajectorySummary>, StoreError> {
        trajectories::summaries(&*self.reader()?, self.path(), filter, after, limit)
    }

    /// How many trajectories the filter selects. Blocks.
    pub fn count(&self, filter: &Filter) -> Result<u64, StoreError> {
        self.read(|connection| trajectories::count(connection, filter))
    }

    /// Begins to read whole trajectories. Blocks.
    pub fn cursor(&self, filter: &Filter) -> Result<Cursor, StoreError> {
        self.read(|connection| Cursor::new(connection, filter))
    }

    /// The next trajectories; none at the end. Blocks.
    pub fn next_page(&self, cursor: &mut Cursor) -> Result<Vec<Recording>, StoreError> {
        next_page(&*self.reader()?, self.path(), cursor)
    }

    /// As [`Store::cursor`], over what a fit used and the filter selects too; `None` where no fit's id begins so. Blocks.
    ///
    /// # Errors
    /// [`StoreError::AmbiguousFit`] where there are several.
    pub fn fit_cursor(&self, prefix: &str, filter: &Filter) -> Result<Option<Cursor>, StoreError> {
        let found = fits::find(&*self.reader()?, self.path(), prefix)?;
        Ok(found.map(|(row, _)| Cursor::of_fit(row, filter)))
    }

    /// Ids of the trajectories that a fit used, from the one of rank `after` on, at most `limit`, and how many there are in
    /// all; `None` where no fit's id begins so. Blocks.
    ///
    /// # Errors
    /// [`StoreError::AmbiguousFit`] where there are several.
    pub fn fit_trajectories(
        &self,
        prefix: &str,
        after: u64,
        limit: usize,
    ) -> Result<Option<(Vec<Uuid>, u64)>, StoreError> {
        let reader = self.reader()?;
        let Some((row, _)) = fits::find(&reader, self.path(), prefix)? else { return Ok(None) };
        let ids = fits::trajectory_ids(&reader, self.path(), row, after, limit)?;
        let total: i64 = reader
            .query_row("SELECT trajectories FROM fits WHERE seq = ?", [row], |row| row.get(0))
            .map_err(|e| StoreError::from_sqlite(self.path(), &e))?;
        Ok(Some((ids, total as u64)))
    }

    /// Calls `visit` with every trajectory that the filter selects, without its rewards (no method learns from them), all as
    /// they stand at the first. Blocks.
    pub fn for_each<B>(
        &self,
        filter: &Filter,
        visit: impl FnMut(&Stored<'_>) -> ControlFlow<B>,
    ) -> Result<ControlFlow<B>, StoreError> {
        let reader = self.reader()?;
        let snapshot = reader.unchecked_transaction().map_err(|e| StoreError::from_sqlite(self.path(), &e))?;
        scan::scan(&snapshot, self.path(), filter, visit)
    }

    /// Reads a model. Blocks.
    pub fn model(&self, model_id: &str) -> Result<Option<Model>, StoreError> {
        models::get(&*self.reader()?, self.path(), model_id)
    }

    /// Lists models in the order of their ids; an empty `env_id` means any. Blocks.
    pub fn models(&self, env_id: &str) -> Result<Vec<ModelInfo>, StoreError> {
        models::list(&*self.reader()?, self.path(), env_id)
    }

    /// Reads the fit whose id begins so. Blocks.
    ///
    /// # Errors
    /// [`StoreError::AmbiguousFit`] where there are several.
    pub fn fit(&self, prefix: &str) -> Result<Option<pb::Fit>, StoreError> {
        fits::get(&*self.reader()?, self.path(), prefix)
    }

    /// Lists fits, newest first, from before the fit of rank `before` on; empty labels mean any. Blocks.
    pub fn fits(&self, env_id: &str, style: &str, before: i64, limit: u32) -> Result<Vec<FitInfo>, StoreError> {
        self.read(|connection| fits::list(connection, env_id, style, before, limit))
    }

    /// What SQLite finds wrong with the structure of the database: pages, order of keys, indices. Blocks.
    pub fn check_structure(&self) -> Result<Vec<String>, StoreError> {
        self.read(check::structure)
    }

    fn read<T>(&self, query: impl FnOnce(&Connection) -> rusqlite::Result<T>) -> Result<T, StoreError> {
        query(&*self.reader()?).map_err(|e| StoreError::from_sqlite(self.path(), &e))
    }

    fn reader(&self) -> Result<Reader<'_>, StoreError> {
        let idle = self.0.readers.lock().unwrap_or_else(PoisonError::into_inner).pop();
        let connection = match idle {
            Some(connection) => connection,
            None => schema::open_reader(self.path(), &self.0.options)?,
        };
        Ok(Reader { connection: Some(connection), idle: &self.0.readers })
    }
}

/// Refuses what a job has written where it is more than the quota: its savepoint takes it back.
fn check_quota(work: &writer::Work<'_>, max_bytes: Option<u64>) -> Result<(), StoreError> {
    let Some(limit) = max_bytes else { return Ok(()) };
    let number = |pragma| work.connection.pragma_query_value(None, pragma, |row| row.get::<_, i64>(0));
    let used = (|| Ok((number("page_count")? - number("freelist_count")?) * number("page_size")?))();
    let used = used.map_err(|e| StoreError::from_sqlite(work.path, &e))? as u64;
    if used > limit { Err(StoreError::QuotaReached { limit, used }) } else { Ok(()) }
}

fn next_page(connection: &Connection, path: &Path, cursor: &mut Cursor) -> Result<Vec<Recording>, StoreError> {
    // A page may be empty because its rows were deleted meanwhile: that is not the end.
    while !cursor.is_done() {
        let page = cursor.page(connection, path, PAGE_BYTES)?;
        if !page.is_empty() {
            return Ok(page);
        }
    }
    Ok(Vec::new())
}

/// A reading connection, given back when dropped.
struct Reader<'a> {
    connection: Option<Connection>,
    idle: &'a Mutex<Vec<Connection>>,
}

impl Deref for Reader<'_> {
    type Target = Connection;

    fn deref(&self) -> &Connection {
        self.connection.as_ref().expect("a reader holds its connection until it is dropped")
    }
}

impl Drop for Reader<'_> {
    fn drop(&mut self) {
        let mut idle = self.idle.lock().unwrap_or_else(PoisonError::into_inner);
        if idle.len() < IDLE_READERS {
            idle.extend(self.connection.take());
        }
    }
}

/// Bytes of a database and its log on the disk. Blocks, shortly.
pub fn store_bytes(path: &Path) -> u64 {
    let log = path.with_extension("sqlite3-wal");
    [path, log.as_path()].iter().filter_map(|path| path.metadata().ok()).map(|file| file.len()).sum()
}

/// Microseconds since the Unix epoch.
fn now_us() -> i64 {
    SystemTime::now().duration_since(SystemTime::UNIX_EPOCH).map_or(0, |d| d.as_micros() as i64)
}

/// A stored time on the wire.
pub fn timestamp(us: i64) -> prost_types::Timestamp {
    prost_types::Timestamp { seconds: us.div_euclid(1_000_000), nanos: (us.rem_euclid(1_000_000) * 1000) as i32 }
}
