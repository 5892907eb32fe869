//! A new store of what is sound in a damaged one.
//!
//! Invariants: the damaged file is never written to; it lies beside the new one when the repair is done, and until then the
//! old name leads to it. What is taken over was checked as it was read, and the new store is checked as a whole before it
//! takes the place of the old one. It is its owner's, and is read by whom the old one was, from the beginning.

use super::{
    StoreError, StoreOptions, Verification, allowance,
    check::{Sound, walk},
    fits, models, schema, trajectories,
};
use rusqlite::{Connection, params};
use std::{
    fs, io,
    path::{Path, PathBuf},
    time::{Duration, SystemTime},
};

/// Where the new store is written.
const NEW_FILE: &str = "mazeway.sqlite3.repairing";

/// What a repair has found and done.
#[derive(Debug, Clone, PartialEq, Eq, serde::Serialize)]
pub struct Repair {
    /// What was found: sound things were taken over, damaged ones were not.
    pub found: Verification,
    /// Where the damaged file lies now; none where there was nothing to repair.
    pub kept: Option<PathBuf>,
}

/// Repairs the store of a directory; a sound one is left alone. Blocks.
///
/// # Errors
/// Another process has it open; the disk has no room for the new one; the old one is another user's; nothing of it can be
/// read.
pub fn repair(directory: &Path) -> Result<Repair, StoreError> {
    let path = directory.join(schema::FILE_NAME);
    if !path.is_file() {
        schema::open_existing(&path)?;
    }
    let _alone = schema::lock_alone(directory)?;
    let fail = |error: io::Error| StoreError::directory(directory, &error);
    let old = schema::open_existing(&path)?;
    let found = walk(&old, &path, |_| Ok::<_, StoreError>(()))?;
    if found.is_sound() {
        return Ok(Repair { found, kept: None });
    }
    let new_path = directory.join(NEW_FILE);
    remove(&new_path).map_err(fail)?;
    schema::make_like(&new_path, &path).and_then(|file| schema::hand_over(&file, &path)).map_err(fail)?;
    let found = {
        let new = schema::open_database(&new_path, &StoreOptions::default())?;
        let found = take_over(&old, &path, &new, &new_path)?;
        // All of it in one file before its name changes.
        new.pragma_update(None, "journal_mode", "DELETE").map_err(|e| StoreError::from_sqlite(&new_path, &e))?;
        found
    };
    let new = walk(&schema::open_existing(&new_path)?, &new_path, |_| Ok::<_, StoreError>(()))?;
    let expected = [found.trajectories.sound, found.models.sound, found.fits.sound];
    if !new.is_sound() || [new.trajectories.sound, new.models.sound, new.fits.sound] != expected {
        let message = format!("expected {expected:?} sound things in the new store, got {new:?}");
        return Err(StoreError::Database { path: new_path, message });
    }
    drop(old);
    let kept = exchange(directory, &path, &new_path).map_err(fail)?;
    Ok(Repair { found, kept: Some(kept) })
}

/// Writes what is sound into the new store, in one transaction.
fn take_over(old: &Connection, path: &Path, new: &Connection, new_path: &Path) -> Result<Verification, StoreError> {
    let fail = |e: rusqlite::Error| StoreError::from_sqlite(new_path, &e);
    let transaction = new.unchecked_transaction().map_err(fail)?;
    let mut collections = trajectories::CollectionCache::new();
    let found = walk(old, path, |sound| match sound {
        Sound::Trajectory { seq, recorded_at_us, recording } => {
            if !trajectories::insert(&transaction, new_path, &mut collections, recording, 0)? {
                return Ok(());
            }
            let place = params![seq, recorded_at_us, recording.id().into_bytes()];
            let sql = "UPDATE trajectories SET seq = ?, recorded_at = ? WHERE trajectory_id = ?";
            transaction.prepare_cached(sql).and_then(|mut s| s.execute(place)).map(drop).map_err(fail)
        }
        Sound::Model { stored_at_us, model } => {
            models::insert(&transaction, new_path, model, false)?;
            let sql = "UPDATE models SET stored_at = ? WHERE model_id = ?";
            transaction.execute(sql, params![stored_at_us, model.model_id()]).map(drop).map_err(fail)
        }
        Sound::Fit(stored) => fits::take_over(old, path, &transaction, new_path, stored),
    })?;
    allowance::copy(old, &transaction).map_err(fail)?;
    transaction.commit().map_err(fail)?;
    Ok(found)
}

/// Puts the new file in the place of the old one, which gets another name first: there is no moment without either.
fn exchange(directory: &Path, path: &Path, new_path: &Path) -> io::Result<PathBuf> {
    fs::File::open(new_path)?.sync_all()?;
    let now = SystemTime::now().duration_since(SystemTime::UNIX_EPOCH).unwrap_or(Duration::ZERO);
    let kept = directory.join(format!("{}.damaged-{}", schema::FILE_NAME, now.as_secs()));
    fs::hard_link(path, &kept)?;
    if beside(path, "-wal").exists() {
        // Its log belongs to the old file alone: the new one must not find it.
        fs::rename(beside(path, "-wal"), beside(&kept, "-wal"))?;
    }
    remove_file(&beside(path, "-shm"))?;
    schema::sync_directory(directory)?;
    fs::rename(new_path, path)?;
    schema::sync_directory(directory)?;
    Ok(kept)
}

/// Removes a database that nobody needs.
fn remove(path: &Path) -> io::Result<()> {
    [path.to_owned(), beside(path, "-wal"), beside(path, "-shm"), beside(path, "-journal")]
        .iter()
        .try_for_each(|path| remove_file(path))
}

fn remove_file(path: &Path) -> io::Result<()> {
    match fs::remove_file(path) {
        Err(error) if error.kind() != io::ErrorKind::NotFound => Err(error),
        _ => Ok(()),
    }
}

/// The path of a file that SQLite keeps beside a database.
pub fn beside(path: &Path, suffix: &str) -> PathBuf {
    let mut name = path.as_os_str().to_owned();
    name.push(suffix);
    name.into()
}
