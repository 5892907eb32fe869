//! What can go wrong with the store, with the values that a caller needs to say what to do about it.

use rusqlite::{ErrorCode, ffi};
use std::{io, path::PathBuf};
use uuid::Uuid;

/// Why the store did not do what it was asked.
#[derive(Debug, Clone, thiserror::Error)]
pub enum StoreError {
    /// The directory cannot be made or locked.
    #[error("cannot use the data directory {path}: {message}")]
    Directory {
        /// The directory.
        path: PathBuf,
        /// What the operating system said.
        message: String,
        /// Its kind.
        kind: io::ErrorKind,
    },
    /// The file was written by a newer release.
    #[error("{path} has schema {found}, this release reads up to {supported}")]
    NewerSchema {
        /// The database.
        path: PathBuf,
        /// Version of its schema.
        found: i64,
        /// The newest schema that this release knows.
        supported: i64,
    },
    /// The file belongs to another program.
    #[error("{path} is no Mazeway store: its application id is {found:#x}")]
    Foreign {
        /// The file.
        path: PathBuf,
        /// Its application id.
        found: i64,
    },
    /// A trajectory of this id is stored with another content.
    #[error("trajectory {id} is stored already with another content")]
    TrajectoryExists {
        /// The id.
        id: Uuid,
        /// Which of the request's trajectories it is.
        index: usize,
    },
    /// A model of these rows is stored with another header.
    #[error("model {id} is stored already, for environment {env_id:?}, with other {differs}")]
    ModelExists {
        /// The id.
        id: String,
        /// Environment of the stored one.
        env_id: String,
        /// In what the two differ.
        differs: String,
    },
    /// More than one fit begins with this prefix.
    #[error("{matches} fits begin with {prefix:?}")]
    AmbiguousFit {
        /// The prefix.
        prefix: String,
        /// How many fits it fits.
        matches: u64,
    },
    /// The disk is full, or the database has reached its largest size.
    #[error("the disk that holds {path} is full")]
    DiskFull {
        /// The database.
        path: PathBuf,
    },
    /// The store holds as much as it may, and what was to be stored is more.
    #[error("the store may hold {limit} bytes and would hold {used}; delete recordings, or raise the limit")]
    QuotaReached {
        /// Bytes that it may hold.
        limit: u64,
        /// Bytes that it would hold.
        used: u64,
    },
    /// A caller has recorded as much as it may, and this would be more.
    #[error("expected at most {limit} recorded bytes of this caller, this would make {used}")]
    AllowanceSpent {
        /// Bytes that it may record.
        limit: u64,
        /// Bytes that it would have recorded.
        used: u64,
    },
    /// Another process held the database for longer than the busy timeout.
    #[error("{path} is locked by another process")]
    Busy {
        /// The database.
        path: PathBuf,
    },
    /// Stored bytes do not read as what they should be.
    #[error("the stored {what} does not read: {message}")]
    Corrupt {
        /// What does not read.
        what: String,
        /// Why.
        message: String,
    },
    /// The store is closing.
    #[error("the store is closed")]
    Closed,
    /// Anything else that SQLite reports.
    #[error("the database {path} failed: {message}")]
    Database {
        /// The database.
        path: PathBuf,
        /// What SQLite said.
        message: String,
    },
}

impl StoreError {
    /// Sorts an error of SQLite's.
    pub(super) fn from_sqlite(path: &std::path::Path, error: &rusqlite::Error) -> Self {
        let path = path.to_owned();
        // Of the file that readers share: it does not grow where there is no room.
        let shared = error.sqlite_error().is_some_and(|error| error.extended_code == ffi::SQLITE_IOERR_SHMSIZE);
        match error.sqlite_error_code() {
            _ if shared => Self::DiskFull { path },
            Some(ErrorCode::DiskFull) => Self::DiskFull { path },
            Some(ErrorCode::DatabaseBusy | ErrorCode::DatabaseLocked) => Self::Busy { path },
            Some(ErrorCode::DatabaseCorrupt | ErrorCode::NotADatabase) => {
                Self::Corrupt { what: "database".into(), message: error.to_string() }
            }
            _ => Self::Database { path, message: error.to_string() },
        }
    }

    /// An error of a file beside the database.
    pub(super) fn of_file(path: &std::path::Path, error: &io::Error) -> Self {
        match error.kind() {
            io::ErrorKind::StorageFull | io::ErrorKind::QuotaExceeded => Self::DiskFull { path: path.to_owned() },
            _ => Self::Database { path: path.to_owned(), message: error.to_string() },
        }
    }

    /// An error of the data directory.
    pub(super) fn directory(path: &std::path::Path, error: &io::Error) -> Self {
        Self::Directory { path: path.to_owned(), message: error.to_string(), kind: error.kind() }
    }
}
