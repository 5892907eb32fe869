//! The ids of the trajectories that a fit uses, gathered while it reads them.
//!
//! Invariant: memory does not grow with their number. What does not fit into [`IN_MEMORY`] waits in a file without a name,
//! in the directory of the store, which goes with the list.

use super::StoreError;
use mazeway_proto::learner as pb;
use rusqlite::{Connection, params};
use sha2::{Digest as _, Sha256};
use std::{
    io::{self, Read as _, Seek as _, Write as _},
    path::{Path, PathBuf},
};
use tempfile::SpooledTempFile;
use uuid::Uuid;

/// Ids on a page: as many as a reader of trajectories takes at a time.
pub(super) const IDS_A_PAGE: usize = 512;
/// Bytes of an id.
const ID_BYTES: usize = 16;
/// Bytes of ids that are kept in memory.
const IN_MEMORY: usize = 1 << 20;

/// Ids in the order in which they came.
#[derive(Debug)]
pub struct IdList {
    directory: PathBuf,
    /// Whole pages.
    pages: SpooledTempFile,
    /// The ids that do not fill a page yet.
    last: Vec<u8>,
    tally: Tally,
}

impl IdList {
    /// An empty list; what does not fit into memory goes into the directory.
    pub(super) fn new(directory: &Path) -> Self {
        Self {
            directory: directory.to_owned(),
            pages: tempfile::spooled_tempfile_in(IN_MEMORY, directory),
            last: Vec::with_capacity(IDS_A_PAGE * ID_BYTES),
            tally: Tally::default(),
        }
    }

    /// One id more.
    ///
    /// # Errors
    /// The disk is full, or fails.
    pub fn push(&mut self, id: Uuid) -> Result<(), StoreError> {
        self.last.extend(id.as_bytes());
        if self.last.len() >= IDS_A_PAGE * ID_BYTES {
            self.tally.add(&self.last);
            self.pages.write_all(&self.last).map_err(|e| StoreError::of_file(&self.directory, &e))?;
            self.last.clear();
        }
        Ok(())
    }

    /// How many there are.
    pub fn len(&self) -> u64 {
        self.tally.bytes / ID_BYTES as u64 + (self.last.len() / ID_BYTES) as u64
    }

    /// Whether there are none.
    pub fn is_empty(&self) -> bool {
        self.len() == 0
    }

    /// Has a fit tell how many there are and their digest.
    pub fn describe(&self, fit: &mut pb::Fit) {
        let mut tally = self.tally.clone();
        tally.add(&self.last);
        tally.describe(fit);
    }

    /// Writes them beside the fit of a row.
    pub(super) fn write(&mut self, connection: &Connection, path: &Path, row: i64) -> Result<(), StoreError> {
        let sqlite = |e: rusqlite::Error| StoreError::from_sqlite(path, &e);
        let fail = |e: io::Error| StoreError::of_file(path, &e);
        self.pages.rewind().map_err(fail)?;
        let mut buffer = [0; IDS_A_PAGE * ID_BYTES];
        let whole = self.tally.bytes / buffer.len() as u64;
        for page in 0..whole {
            self.pages.read_exact(&mut buffer).map_err(fail)?;
            write_page(connection, row, page as i64, &buffer).map_err(sqlite)?;
        }
        if self.last.is_empty() {
            return Ok(());
        }
        write_page(connection, row, whole as i64, &self.last).map_err(sqlite)
    }
}

/// Writes one page of ids.
pub(super) fn write_page(connection: &Connection, row: i64, page: i64, ids: &[u8]) -> rusqlite::Result<()> {
    let sql = "INSERT INTO fit_trajectories (fit, page, ids) VALUES (?, ?, ?)";
    connection.prepare_cached(sql)?.execute(params![row, page, ids]).map(drop)
}

/// Number and digest of ids.
#[derive(Debug, Clone, Default)]
pub(super) struct Tally {
    bytes: u64,
    hash: Sha256,
}

impl Tally {
    /// Ids, 16 bytes each.
    pub(super) fn add(&mut self, ids: &[u8]) {
        self.bytes += ids.len() as u64;
        self.hash.update(ids);
    }

    /// Has a fit tell of ids that were added.
    pub(super) fn describe(&self, fit: &mut pb::Fit) {
        (fit.trajectories, fit.trajectories_digest) = (self.n_ids(), self.digest().to_vec().into());
    }

    pub(super) fn n_ids(&self) -> u64 {
        self.bytes / ID_BYTES as u64
    }

    pub(super) fn digest(&self) -> [u8; 32] {
        self.hash.clone().finalize().into()
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_long_list_waits_on_the_disk_and_tells_the_same() {
        let directory = tempfile::tempdir().unwrap();
        let ids = (0..70_000_u128).map(|i| Uuid::from_u128(i.wrapping_mul(0x9e37_79b9_7f4a_7c15)));
        let mut list = IdList::new(directory.path());
        ids.clone().for_each(|id| list.push(id).unwrap());
        assert!(list.pages.is_rolled() && list.last.capacity() <= IDS_A_PAGE * ID_BYTES);
        let mut fit = pb::Fit::default();
        list.describe(&mut fit);
        assert_eq!((fit.trajectories, list.len()), (70_000, 70_000));
        let whole = Sha256::digest(ids.flat_map(|id| *id.as_bytes()).collect::<Vec<u8>>());
        assert_eq!(fit.trajectories_digest[..], whole[..]);
        assert!(IdList::new(directory.path()).is_empty());
    }
}
