//! A copy of a store at one moment, made while services write to it.
//!
//! Invariants: the copy is of one moment; it has its name only once it is whole, on stable storage and checked; writers do
//! not wait for it, and their log is kept until it is done. Nobody may read it who may not read the store.

use super::{StoreError, Verification, check::walk, room::Room, schema};
use rusqlite::{
    Connection,
    backup::{Backup, StepResult},
};
use std::{fs, io, path::Path, thread, time::Duration};

/// Name of a copy that is not whole yet.
const PART_FILE: &str = "mazeway.sqlite3.part";
/// Time between two tries where another process writes the old store's log back.
const PAUSE: Duration = Duration::from_millis(20);

/// Copies the store of a directory into another directory, made where it is missing, and checks the copy. Blocks.
///
/// # Errors
/// There is no store, or there is one where the copy is to be; the disk is full.
pub fn backup(directory: &Path, destination: &Path) -> Result<Verification, StoreError> {
    let _room = Room::as_found(directory);
    let source = schema::open_existing(&directory.join(schema::FILE_NAME))?;
    let fail = |error: io::Error| StoreError::directory(destination, &error);
    schema::make_directory(destination).map_err(fail)?;
    let (path, part) = (destination.join(schema::FILE_NAME), destination.join(PART_FILE));
    if path.exists() {
        let error = io::Error::new(io::ErrorKind::AlreadyExists, format!("it holds a {} already", schema::FILE_NAME));
        return Err(fail(error));
    }
    if part.exists() {
        fs::remove_file(&part).map_err(fail)?;
    }
    schema::make_like(&part, &directory.join(schema::FILE_NAME)).map_err(fail)?;
    {
        let sqlite = |e: rusqlite::Error| StoreError::from_sqlite(&part, &e);
        let mut copy = Connection::open(&part).map_err(sqlite)?;
        {
            let backup = Backup::new(&source, &mut copy).map_err(sqlite)?;
            // All pages in one step: the writers of other processes would make it begin anew between two.
            while backup.step(-1).map_err(sqlite)? != StepResult::Done {
                thread::sleep(PAUSE);
            }
        }
        // One file, without a log beside it.
        copy.pragma_update(None, "journal_mode", "DELETE").map_err(sqlite)?;
    }
    fs::File::open(&part).and_then(|file| file.sync_all()).map_err(fail)?;
    let found = walk(&schema::open_existing(&part)?, &path, |_| Ok::<_, StoreError>(()))?;
    fs::rename(&part, &path).map_err(fail)?;
    schema::sync_directory(destination).map_err(fail)?;
    Ok(found)
}
