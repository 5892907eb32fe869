//! How a store is opened, beyond where it lies.

/// The default: no limit but the disk's, SQLite's own habits.
#[derive(Debug, Clone, PartialEq, Eq, Default)]
pub struct StoreOptions {
    /// Bytes of the database in use from which recordings and models are refused; none means as many as the disk has.
    /// Deleting, reading and storing fits go on.
    pub max_bytes: Option<u64>,
    /// Pages of the write-ahead log after which it is written back into the database; none means SQLite's 1000.
    pub checkpoint_pages: Option<u32>,
    /// SQLite's virtual file system by the name under which it is registered; none means the platform's. For tests that
    /// cut the power.
    pub vfs: Option<String>,
}
