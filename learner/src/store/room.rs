//! Room that is kept for reading: a store that is closed opens again on a disk that has filled up meanwhile.
//!
//! SQLite needs a file of 32 KiB beside the database before anybody can read it, and that file goes with the last connection. So
//! some bytes are kept in a file of their own, which is given up where a database does not open for want of room.

use super::StoreError;
use std::{
    fs, io,
    path::{Path, PathBuf},
};

/// What takes the room.
const FILE: &str = "mazeway.reserve";
/// Twice what is needed.
const BYTES: usize = 64 << 10;

/// Opens a database; where there is no room for that, what was kept is given up for it.
pub fn with_room<T>(directory: &Path, open: impl Fn() -> Result<T, StoreError>) -> Result<T, StoreError> {
    match open() {
        Err(StoreError::DiskFull { .. }) if fs::remove_file(directory.join(FILE)).is_ok() => {
            tracing::warn!("the disk is full: room that was kept for reading was given up");
            open()
        }
        opened => opened,
    }
}

/// Keeps room in a directory again when it is dropped, after the last connection has gone.
#[derive(Debug)]
pub struct Room {
    directory: PathBuf,
    wanted: bool,
}

impl Room {
    /// Keeps room from now on, as far as there is any.
    pub fn kept(directory: &Path) -> Self {
        keep(directory);
        Self { directory: directory.to_owned(), wanted: true }
    }

    /// For a directory that is only looked at: what it has kept is kept afterwards.
    pub fn as_found(directory: &Path) -> Self {
        Self { directory: directory.to_owned(), wanted: directory.join(FILE).exists() }
    }
}

impl Drop for Room {
    fn drop(&mut self) {
        if self.wanted {
            keep(&self.directory);
        }
    }
}

/// Several processes may do so at once: they write the same.
fn keep(directory: &Path) {
    let path = directory.join(FILE);
    let kept = fs::metadata(&path).is_ok_and(|file| file.len() == BYTES as u64);
    // Not zeros, which some file systems do not store.
    if !kept && let Err(error) = fs::write(&path, vec![b'.'; BYTES]) {
        if error.kind() != io::ErrorKind::NotFound {
            tracing::debug!(%error, "no room could be kept for reading");
        }
        let _ = fs::remove_file(&path);
    }
}
