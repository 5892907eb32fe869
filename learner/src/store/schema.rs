//! The database file: its schema, its migrations, and how a connection is set up.
//!
//! Invariants: a migration, once released, never changes; a schema newer than this release is refused, not guessed at;
//! opening and migrating happen under a lock on a file beside the database, so several processes may start at once.

use super::{StoreError, StoreOptions, fits, repair::beside, room::with_room};
use rusqlite::{Connection, OpenFlags, config::DbConfig};
use rusqlite_migration::{M, Migrations};
use std::{
    fs::{self, File, TryLockError},
    io,
    path::{Path, PathBuf},
    time::Duration,
};

/// Name of the database in the data directory.
pub const FILE_NAME: &str = "mazeway.sqlite3";
/// "MZWY": tells the file from any other SQLite database.
const APPLICATION_ID: i64 = 0x4d5a_5759;
/// Bytes of a page of a new database: twice SQLite's own, since a page costs a call to read however large it is, and not more,
/// since a commit writes whole pages.
const PAGE_BYTES: u32 = 8192;
/// How long a connection waits for another process.
const BUSY_TIMEOUT: Duration = Duration::from_secs(30);

/// What is common to many trajectories lies in `collections`, each stored once. In schema 1 a trajectory's arrays are blobs,
/// little-endian without padding: states and actions as 32-bit integers, rewards as IEEE 754 doubles. Seeds are
/// unsigned and stored by their bits. Times are microseconds since the Unix epoch. Documents are a version byte and a
/// protocol buffer message.
const V1: &str = "
CREATE TABLE collections (
    id INTEGER PRIMARY KEY,
    env_id TEXT NOT NULL,
    model_id TEXT NOT NULL,
    style TEXT NOT NULL,
    source TEXT NOT NULL,
    n_states INTEGER NOT NULL,
    n_actions INTEGER NOT NULL,
    UNIQUE (env_id, style, model_id, source, n_states, n_actions)
) STRICT;

CREATE TABLE trajectories (
    seq INTEGER PRIMARY KEY AUTOINCREMENT,
    trajectory_id TEXT NOT NULL UNIQUE,
    collection INTEGER NOT NULL REFERENCES collections (id),
    recorded_at INTEGER NOT NULL,
    seed INTEGER,
    steps INTEGER NOT NULL,
    final_state INTEGER,
    terminated INTEGER NOT NULL,
    truncated INTEGER NOT NULL,
    content_hash BLOB NOT NULL,
    states BLOB NOT NULL,
    actions BLOB NOT NULL,
    rewards BLOB NOT NULL
) STRICT;

CREATE INDEX trajectories_by_collection ON trajectories (collection, seq);

CREATE TABLE models (
    model_id TEXT PRIMARY KEY,
    env_id TEXT NOT NULL,
    stored_at INTEGER NOT NULL,
    n_transitions INTEGER NOT NULL,
    header BLOB NOT NULL,
    row_lengths BLOB NOT NULL,
    next_states BLOB NOT NULL,
    probabilities BLOB NOT NULL,
    visit_counts BLOB NOT NULL
) STRICT;

CREATE TABLE fits (
    seq INTEGER PRIMARY KEY AUTOINCREMENT,
    fit_id TEXT NOT NULL UNIQUE,
    created_at INTEGER NOT NULL,
    env_id TEXT NOT NULL,
    style TEXT NOT NULL,
    method TEXT NOT NULL,
    model_id TEXT NOT NULL,
    trajectories INTEGER NOT NULL,
    stopped INTEGER NOT NULL,
    iterations INTEGER NOT NULL,
    agreement REAL NOT NULL,
    document BLOB NOT NULL
) STRICT;

CREATE INDEX fits_by_env ON fits (env_id, style, seq);

PRAGMA application_id = 0x4d5a5759;
";

/// From 2 on an id is its 16 bytes; what a count of steps reads comes first in a row, in the fewest bytes (see `packing`);
/// and the ids of a fit's trajectories lie on pages beside it, so that a fit is as large as its model and no larger.
/// What schema 1 stored keeps its width.
const V2: &str = "
CREATE TABLE trajectories_2 (
    seq INTEGER PRIMARY KEY AUTOINCREMENT,
    trajectory_id BLOB NOT NULL UNIQUE,
    collection INTEGER NOT NULL REFERENCES collections (id),
    packing INTEGER NOT NULL,
    final_state INTEGER,
    states BLOB NOT NULL,
    actions BLOB NOT NULL,
    recorded_at INTEGER NOT NULL,
    seed INTEGER,
    steps INTEGER NOT NULL,
    terminated INTEGER NOT NULL,
    truncated INTEGER NOT NULL,
    content_hash BLOB NOT NULL,
    rewards BLOB NOT NULL
) STRICT;

INSERT INTO trajectories_2 (seq, trajectory_id, collection, packing, final_state, states, actions, recorded_at, seed,
    steps, terminated, truncated, content_hash, rewards)
SELECT seq, unhex(trajectory_id, '-'), collection, 0x844, final_state, states, actions, recorded_at, seed,
    steps, terminated, truncated, content_hash, rewards
FROM trajectories ORDER BY seq;

DELETE FROM sqlite_sequence WHERE name = 'trajectories_2';
INSERT INTO sqlite_sequence (name, seq) SELECT 'trajectories_2', seq FROM sqlite_sequence WHERE name = 'trajectories';
DROP TABLE trajectories;
ALTER TABLE trajectories_2 RENAME TO trajectories;
CREATE INDEX trajectories_by_collection ON trajectories (collection, seq);

CREATE TABLE fit_trajectories (
    fit INTEGER NOT NULL REFERENCES fits (seq) ON DELETE CASCADE,
    page INTEGER NOT NULL,
    ids BLOB NOT NULL,
    PRIMARY KEY (fit, page)
) STRICT;
";

/// Version of the newest schema.
const NEWEST: i64 = 2;

fn migrations() -> Migrations<'static> {
    Migrations::new(vec![M::up(V1), M::up_with_hook(V2, |transaction| Ok(fits::unfold_all(transaction)?))])
}

/// Locked while a store is opened, so that one process at a time makes and migrates it.
const OPENING_FILE: &str = "mazeway.lock";
/// Locked, shared, as long as a store is open: whoever can lock it for himself is alone.
const USERS_FILE: &str = "mazeway.users";

/// A database that is open for writing.
#[derive(Debug)]
pub struct Opened {
    /// The database.
    pub path: PathBuf,
    /// For writing.
    pub connection: Connection,
    /// Says that somebody uses the directory, as long as it is not dropped.
    pub user: File,
}

/// Makes the directory and the database where they are missing and brings the schema up to date.
pub fn open(directory: &Path, options: &StoreOptions) -> Result<Opened, StoreError> {
    make_directory(directory).map_err(|e| StoreError::directory(directory, &e))?;
    let opening = lock_file(directory, OPENING_FILE)?;
    opening.lock().map_err(|e| StoreError::directory(directory, &e))?;
    let user = lock_file(directory, USERS_FILE)?;
    match user.try_lock_shared() {
        Ok(()) => {}
        Err(TryLockError::WouldBlock) => return Err(StoreError::Busy { path: directory.join(FILE_NAME) }),
        Err(TryLockError::Error(error)) => return Err(StoreError::directory(directory, &error)),
    }
    let path = directory.join(FILE_NAME);
    let connection = with_room(directory, || open_database(&path, options))?;
    Ok(Opened { path, connection, user })
}

/// Keeps every other process from the store of a directory until it is dropped.
///
/// # Errors
/// [`StoreError::Busy`] where one has it open.
pub fn lock_alone(directory: &Path) -> Result<(File, File), StoreError> {
    let opening = lock_file(directory, OPENING_FILE)?;
    opening.lock().map_err(|e| StoreError::directory(directory, &e))?;
    let user = lock_file(directory, USERS_FILE)?;
    match user.try_lock() {
        Ok(()) => Ok((opening, user)),
        Err(TryLockError::WouldBlock) => Err(StoreError::Busy { path: directory.join(FILE_NAME) }),
        Err(TryLockError::Error(error)) => Err(StoreError::directory(directory, &error)),
    }
}

fn lock_file(directory: &Path, name: &str) -> Result<File, StoreError> {
    let file = File::options().create(true).truncate(false).write(true).open(directory.join(name));
    file.map_err(|e| StoreError::directory(directory, &e))
}

/// Makes a directory and its parents where they are missing, for their owner alone; their names are on stable storage when
/// this returns. SQLite sees to the names of its files in the directory, but not to that of the directory.
pub fn make_directory(directory: &Path) -> io::Result<()> {
    if directory.is_dir() {
        return Ok(());
    }
    let parent = directory.parent().filter(|parent| !parent.as_os_str().is_empty());
    if let Some(parent) = parent {
        make_directory(parent)?;
    }
    let mut builder = fs::DirBuilder::new();
    #[cfg(unix)]
    std::os::unix::fs::DirBuilderExt::mode(&mut builder, 0o700);
    match builder.create(directory) {
        // Somebody else was faster.
        Err(error) if error.kind() == io::ErrorKind::AlreadyExists && directory.is_dir() => {}
        made => made?,
    }
    sync_directory(parent.unwrap_or(Path::new(".")))
}

/// Puts the names of a directory's files on stable storage, where the platform can.
pub fn sync_directory(directory: &Path) -> io::Result<()> {
    if cfg!(unix) { File::open(directory)?.sync_all() } else { Ok(()) }
}

/// An empty file for a database that nobody may read who may not read `like`.
#[cfg_attr(not(unix), expect(unused_variables, reason = "permissions are inherited from the directory there"))]
pub fn make_like(path: &Path, like: &Path) -> io::Result<File> {
    let mut options = File::options();
    options.write(true).create_new(true);
    #[cfg(unix)]
    {
        use std::os::unix::fs::{MetadataExt as _, OpenOptionsExt as _};
        options.mode(fs::metadata(like)?.mode() & 0o777 | 0o600);
    }
    options.open(path)
}

/// Gives a file the owner and the permissions of another, so that it can take its place.
///
/// # Errors
/// Its owner is another user's, and only root may give files away.
#[cfg_attr(not(unix), expect(unused_variables, reason = "permissions are inherited from the directory there"))]
pub fn hand_over(file: &File, like: &Path) -> io::Result<()> {
    #[cfg(unix)]
    {
        use std::os::unix::fs::{MetadataExt as _, PermissionsExt as _, fchown};
        let (ours, theirs) = (file.metadata()?, fs::metadata(like)?);
        if (ours.uid(), ours.gid()) != (theirs.uid(), theirs.gid()) {
            fchown(file, Some(theirs.uid()), Some(theirs.gid())).map_err(|error| {
                let message = format!("a new file cannot be given to the owner of {}: {error}", like.display());
                io::Error::new(error.kind(), message)
            })?;
        }
        file.set_permissions(fs::Permissions::from_mode(theirs.mode() & 0o777 | 0o600))?;
    }
    Ok(())
}

/// A database for writing, made where it is missing and brought up to date.
pub fn open_database(path: &Path, options: &StoreOptions) -> Result<Connection, StoreError> {
    let sqlite = |e: rusqlite::Error| StoreError::from_sqlite(path, &e);
    let flags = OpenFlags::SQLITE_OPEN_READ_WRITE | OpenFlags::SQLITE_OPEN_CREATE | OpenFlags::SQLITE_OPEN_NO_MUTEX;
    forget_beginning(path).map_err(|e| StoreError::directory(path, &e))?;
    let mut connection = connect(path, flags, options).map_err(sqlite)?;
    connection.busy_timeout(BUSY_TIMEOUT).map_err(sqlite)?;
    check_owner(path, &connection)?;
    // FULL makes a commit in WAL mode wait for the disk; `fullfsync` makes macOS mean it.
    connection.pragma_update(None, "synchronous", "FULL").map_err(sqlite)?;
    connection.pragma_update(None, "fullfsync", true).map_err(sqlite)?;
    begin(&connection).map_err(sqlite)?;
    let mode: String =
        connection.pragma_update_and_check(None, "journal_mode", "WAL", |row| row.get(0)).map_err(sqlite)?;
    if mode != "wal" {
        // SQLite keeps to itself why it goes on in another mode; a write tells.
        mark(&connection).map_err(sqlite)?;
        let message = format!("its journal mode stays {mode:?}, expected \"wal\"");
        return Err(StoreError::Database { path: path.to_owned(), message });
    }
    connection.pragma_update(None, "foreign_keys", true).map_err(sqlite)?;
    if let Some(pages) = options.checkpoint_pages {
        connection.pragma_update(None, "wal_autocheckpoint", pages).map_err(sqlite)?;
    }
    migrations().to_latest(&mut connection).map_err(|error| match error {
        rusqlite_migration::Error::RusqliteError { err, .. } => StoreError::from_sqlite(path, &err),
        other => StoreError::Database { path: path.to_owned(), message: other.to_string() },
    })?;
    Ok(connection)
}

/// Gives a new database its first page, in a commit of its own: where this fails, nothing but opening it anew may follow (see
/// [`forget_beginning`]), and SQLite would not say that it fails when it changes the journal mode.
fn begin(connection: &Connection) -> rusqlite::Result<()> {
    let pages: i64 = connection.pragma_query_value(None, "page_count", |row| row.get(0))?;
    if pages == 0 {
        connection.pragma_update(None, "page_size", PAGE_BYTES)?;
        mark(connection)?;
    }
    Ok(())
}

/// Writes down that a database is ours.
fn mark(connection: &Connection) -> rusqlite::Result<()> {
    connection.pragma_update(None, "application_id", APPLICATION_ID)
}

/// Takes away an empty database that has a journal, before SQLite does the opposite: one whose first commit failed. The disk
/// may have written some of that commit and lost that the file was cut again, and SQLite, which takes the journal for a
/// leftover, would take away what tells the next one to cut it. The caller holds the lock of the opening.
fn forget_beginning(path: &Path) -> io::Result<()> {
    let empty = fs::metadata(path).is_ok_and(|file| file.len() == 0);
    if empty && fs::exists(beside(path, "-journal"))? { fs::remove_file(path) } else { Ok(()) }
}

fn connect(path: &Path, flags: OpenFlags, options: &StoreOptions) -> rusqlite::Result<Connection> {
    match &options.vfs {
        Some(vfs) => Connection::open_with_flags_and_vfs(path, flags, vfs.as_str()),
        None => Connection::open_with_flags(path, flags),
    }
}

/// Opens a database that is there, as it is: to look at it, not to bring it up to date.
///
/// # Errors
/// There is none; it is a newer release's or another program's; it is no database.
pub fn open_existing(path: &Path) -> Result<Connection, StoreError> {
    if !path.is_file() {
        let directory = path.parent().unwrap_or(path);
        let error = io::Error::new(io::ErrorKind::NotFound, format!("it holds no {FILE_NAME}"));
        return Err(StoreError::directory(directory, &error));
    }
    with_room(path.parent().unwrap_or(path), || {
        let connection = open_reader(path, &StoreOptions::default())?;
        // What is looked at is left alone: its log is not written back into it.
        connection
            .set_db_config(DbConfig::SQLITE_DBCONFIG_NO_CKPT_ON_CLOSE, true)
            .map_err(|e| StoreError::from_sqlite(path, &e))?;
        check_owner(path, &connection)?;
        Ok(connection)
    })
}

/// A connection that only reads; it sees the last commit at the start of each of its statements or transactions.
pub fn open_reader(path: &Path, options: &StoreOptions) -> Result<Connection, StoreError> {
    let sqlite = |e: rusqlite::Error| StoreError::from_sqlite(path, &e);
    let flags = OpenFlags::SQLITE_OPEN_READ_WRITE | OpenFlags::SQLITE_OPEN_NO_MUTEX;
    let connection = connect(path, flags, options).map_err(sqlite)?;
    connection.busy_timeout(BUSY_TIMEOUT).map_err(sqlite)?;
    connection.pragma_update(None, "query_only", true).map_err(sqlite)?;
    Ok(connection)
}

/// Refuses files of other programs and of newer releases before anything in them is touched.
fn check_owner(path: &Path, connection: &Connection) -> Result<(), StoreError> {
    let sqlite = |e: rusqlite::Error| StoreError::from_sqlite(path, &e);
    let number = |pragma| connection.pragma_query_value(None, pragma, |row| row.get::<_, i64>(0)).map_err(sqlite);
    let (application_id, found) = (number("application_id")?, number("user_version")?);
    let tables: i64 =
        connection.query_row("SELECT count(*) FROM sqlite_schema", [], |row| row.get(0)).map_err(sqlite)?;
    if application_id != APPLICATION_ID && (tables > 0 || application_id != 0) {
        return Err(StoreError::Foreign { path: path.to_owned(), found: application_id });
    }
    let supported = NEWEST;
    if found > supported {
        return Err(StoreError::NewerSchema { path: path.to_owned(), found, supported });
    }
    Ok(())
}

#[cfg(test)]
mod tests {
    use super::*;

    fn open(directory: &Path) -> Result<(PathBuf, Connection), StoreError> {
        super::open(directory, &StoreOptions::default()).map(|opened| (opened.path, opened.connection))
    }

    #[test]
    fn who_has_a_store_open_is_not_alone() {
        let directory = tempfile::tempdir().unwrap();
        let nested = directory.path().join("a").join("b");
        let users = [
            super::open(&nested, &StoreOptions::default()).unwrap(),
            super::open(&nested, &StoreOptions::default()).unwrap(),
        ];
        assert!(matches!(lock_alone(&nested).unwrap_err(), StoreError::Busy { .. }));
        drop(users);
        let alone = lock_alone(&nested).unwrap();
        drop(alone);
        open(&nested).unwrap();
    }

    #[test]
    fn migrations_are_sound() {
        migrations().validate().unwrap();
    }

    #[test]
    fn a_newer_schema_is_refused_and_left_alone() {
        let directory = tempfile::tempdir().unwrap();
        let (path, connection) = open(directory.path()).unwrap();
        connection.pragma_update(None, "user_version", 99).unwrap();
        drop(connection);
        let error = open(directory.path()).unwrap_err();
        assert!(matches!(error, StoreError::NewerSchema { found: 99, supported: NEWEST, .. }), "{error}");
        let connection = Connection::open(path).unwrap();
        let version: i64 = connection.pragma_query_value(None, "user_version", |row| row.get(0)).unwrap();
        assert_eq!(version, 99);
    }

    #[test]
    fn a_database_of_another_program_is_refused() {
        let directory = tempfile::tempdir().unwrap();
        let connection = Connection::open(directory.path().join(FILE_NAME)).unwrap();
        connection.execute_batch("CREATE TABLE theirs (x)").unwrap();
        drop(connection);
        assert!(matches!(open(directory.path()).unwrap_err(), StoreError::Foreign { found: 0, .. }));
    }

    #[test]
    fn a_file_that_is_no_database_is_corrupt() {
        let directory = tempfile::tempdir().unwrap();
        fs::write(directory.path().join(FILE_NAME), "not a database, whatever its name says ".repeat(50)).unwrap();
        assert!(matches!(open(directory.path()).unwrap_err(), StoreError::Corrupt { .. }));
    }

    #[test]
    fn a_beginning_that_failed_is_forgotten() {
        let directory = tempfile::tempdir().unwrap();
        let path = directory.path().join(FILE_NAME);
        // Held open, so that a new file cannot take its number.
        let begun = File::create(&path).unwrap();
        fs::write(beside(&path, "-journal"), vec![7; 1000]).unwrap();
        drop(open(directory.path()).unwrap());
        assert_eq!(begun.metadata().unwrap().len(), 0, "the old file was left alone");
        assert!(fs::metadata(&path).unwrap().len() > 0);
        assert!(!beside(&path, "-journal").exists());
    }

    #[test]
    #[cfg(unix)]
    fn a_disk_that_has_no_write_ahead_log_is_refused() {
        let directory = tempfile::tempdir().unwrap();
        // SQLite's locks by files have no index for a log; it would go on without one.
        let options = StoreOptions { vfs: Some("unix-dotfile".into()), ..StoreOptions::default() };
        let error = super::open(directory.path(), &options).unwrap_err();
        assert!(matches!(&error, StoreError::Database { message, .. } if message.contains("journal mode")), "{error}");
    }

    #[test]
    fn a_commit_waits_for_the_disk() {
        let directory = tempfile::tempdir().unwrap();
        let (_, connection) = open(directory.path()).unwrap();
        let mode: String = connection.pragma_query_value(None, "journal_mode", |row| row.get(0)).unwrap();
        let synchronous: i64 = connection.pragma_query_value(None, "synchronous", |row| row.get(0)).unwrap();
        assert_eq!((mode.as_str(), synchronous), ("wal", 2));
    }
}
