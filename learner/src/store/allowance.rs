//! How many bytes each caller has recorded, kept in the database, so that a quota outlives the service.
//!
//! What a caller records is charged in the transaction that stores it: a repeated trajectory costs nothing, a refused one
//! neither, and no crash lets one in that is not charged. Deleting gives nothing back, for who deletes need not be who
//! recorded. The table is made at its first use and is no part of the schema: a store without it has charged nobody. A repaired
//! one has charged what the damaged one still told.

use super::StoreError;
use rusqlite::Connection;
use std::path::Path;

const TABLE: &str =
    "CREATE TABLE IF NOT EXISTS recorded_bytes (caller TEXT PRIMARY KEY, bytes INTEGER NOT NULL) STRICT";

/// Takes over what was charged, as far as it reads.
///
/// # Errors
/// It cannot be written.
pub(super) fn copy(old: &Connection, new: &Connection) -> rusqlite::Result<()> {
    let Ok(mut statement) = old.prepare("SELECT caller, bytes FROM recorded_bytes") else { return Ok(()) };
    let Ok(mut rows) = statement.query([]) else { return Ok(()) };
    new.execute_batch(TABLE)?;
    while let Ok(Some(row)) = rows.next() {
        if let (Ok(caller), Ok(bytes)) = (row.get::<_, String>(0), row.get::<_, i64>(1)) {
            new.execute("INSERT OR REPLACE INTO recorded_bytes VALUES (?, ?)", (caller, bytes))?;
        }
    }
    Ok(())
}

/// Who records, and how much it may.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Allowance {
    /// The caller's name.
    pub caller: String,
    /// Bytes of arrays in all; `None`: as many as there is room for, but they are counted.
    pub max_bytes: Option<u64>,
}

impl Allowance {
    /// Counts bytes that are being stored. The caller's savepoint takes everything back where it fails.
    pub(super) fn charge(&self, connection: &Connection, path: &Path, bytes: u64) -> Result<(), StoreError> {
        let fail = |error: rusqlite::Error| StoreError::from_sqlite(path, &error);
        connection.execute_batch(TABLE).map_err(fail)?;
        let used: i64 = connection
            .prepare_cached(
                "INSERT INTO recorded_bytes (caller, bytes) VALUES (?, ?) \
                 ON CONFLICT (caller) DO UPDATE SET bytes = bytes + excluded.bytes RETURNING bytes",
            )
            .and_then(|mut statement| {
                statement.query_row((&self.caller, i64::try_from(bytes).unwrap_or(i64::MAX)), |row| row.get(0))
            })
            .map_err(fail)?;
        let used = u64::try_from(used).unwrap_or(u64::MAX);
        match self.max_bytes {
            Some(limit) if used > limit => Err(StoreError::AllowanceSpent { limit, used }),
            _ => Ok(()),
        }
    }
}
