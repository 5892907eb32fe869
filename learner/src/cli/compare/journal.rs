//! What a comparison has finished, on stable storage: one line a fit.
//!
//! Invariants: a line is whole and synced before the fit counts as finished; its key is a hash of everything that decides the fit,
//! so that a line is never taken for another fit's; what a kill left of a last line is cut off before anything is appended; one
//! process at a time writes.

use crate::cli::error::CliError;
use mazeway_learner::eval::comparison::Cell;
use serde::{Deserialize, Serialize};
use std::{
    collections::HashMap,
    fs::{File, OpenOptions, TryLockError},
    io::{self, Read as _, Seek as _, SeekFrom, Write as _},
    path::Path,
};

/// Name of the file.
pub const NAME: &str = "journal.jsonl";

/// One finished fit.
#[derive(Debug, Serialize, Deserialize)]
struct Line {
    key: String,
    cell: Cell,
}

/// The file, locked.
#[derive(Debug)]
pub struct Journal {
    file: File,
}

impl Journal {
    /// Opens or makes the journal of a directory, and reads what it has.
    ///
    /// # Errors
    /// It cannot be read or written, or another process writes to it.
    pub fn open(directory: &Path) -> Result<(Self, HashMap<String, Cell>), CliError> {
        let path = directory.join(NAME);
        let failed = |error: io::Error| {
            CliError::failure(
                format!("cannot use {}: {error}", path.display()),
                "choose a directory that you may write to with --out DIR",
            )
        };
        let mut file =
            OpenOptions::new().read(true).write(true).create(true).truncate(false).open(&path).map_err(failed)?;
        match file.try_lock() {
            Ok(()) => {}
            Err(TryLockError::WouldBlock) => {
                return Err(CliError::failure(
                    format!("another comparison is writing to {}", directory.display()),
                    "wait for it, or choose another directory with --out DIR",
                ));
            }
            Err(TryLockError::Error(error)) => return Err(failed(error)),
        }
        let mut bytes = Vec::new();
        file.read_to_end(&mut bytes).map_err(failed)?;
        // What follows the last line break is the beginning of a line that was never finished.
        let whole = bytes.iter().rposition(|&byte| byte == b'\n').map_or(0, |at| at + 1);
        file.set_len(whole as u64).map_err(failed)?;
        file.seek(SeekFrom::Start(whole as u64)).map_err(failed)?;
        file.sync_all().map_err(failed)?;
        if let Ok(directory) = File::open(directory) {
            // The name of a new file is part of its directory; not every system can sync one.
            let _ = directory.sync_all();
        }
        // A line that says nothing readable is a fit to be done again.
        let lines = bytes[..whole].split(|&byte| byte == b'\n').filter_map(|line| serde_json::from_slice(line).ok());
        Ok((Self { file }, lines.map(|Line { key, cell }| (key, cell)).collect()))
    }

    /// Appends finished fits; they are on stable storage when this returns.
    ///
    /// # Errors
    /// The disk refuses.
    pub fn append(&mut self, finished: impl IntoIterator<Item = (String, Cell)>) -> io::Result<()> {
        let mut text = Vec::new();
        for (key, cell) in finished {
            serde_json::to_writer(&mut text, &Line { key, cell })?;
            text.push(b'\n');
        }
        self.file.write_all(&text)?;
        self.file.sync_data()
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use mazeway_learner::eval::comparison::{Outcome, Score};

    fn cell(seed: u32) -> Cell {
        let score = Score { agreement: 0.1 + 0.2, evd: None, log_likelihood: -1.0 / 3.0, fit_secs: 1e-5 };
        Cell { method: "bc".into(), trajectories: 5, seed, outcome: Outcome::Fitted(score) }
    }

    #[test]
    fn what_was_appended_comes_back_whatever_happened_to_the_last_line() {
        let directory = tempfile::tempdir().expect("a directory");
        let (mut journal, found) = Journal::open(directory.path()).expect("a journal");
        assert!(found.is_empty());
        journal.append([("a".to_owned(), cell(1)), ("b".to_owned(), cell(2))]).expect("appended");
        let busy = Journal::open(directory.path()).expect_err("one at a time");
        assert!(busy.message.contains("another comparison"), "{}", busy.message);
        drop(journal);
        let path = directory.path().join(NAME);
        let whole = std::fs::read(&path).expect("a file");
        for cut in [1, 10, whole.len() / 2 - 1] {
            std::fs::write(&path, &whole[..whole.len() - cut]).expect("written");
            let (mut journal, found) = Journal::open(directory.path()).expect("a journal");
            assert_eq!((found.len(), &found["a"]), (1, &cell(1)), "cut by {cut}");
            journal.append([("b".to_owned(), cell(2))]).expect("appended");
            drop(journal);
            let (_, found) = Journal::open(directory.path()).expect("a journal");
            assert_eq!((&found["a"], &found["b"]), (&cell(1), &cell(2)), "cut by {cut}");
        }
    }

    #[test]
    fn noise_within_is_passed_over() {
        let directory = tempfile::tempdir().expect("a directory");
        let path = directory.path().join(NAME);
        let (mut journal, _) = Journal::open(directory.path()).expect("a journal");
        journal.append([("a".to_owned(), cell(1))]).expect("appended");
        drop(journal);
        let mut bytes = b"\xff\x00 not a line\n{}\n".to_vec();
        bytes.extend(std::fs::read(&path).expect("a file"));
        std::fs::write(&path, bytes).expect("written");
        let (_, found) = Journal::open(directory.path()).expect("a journal");
        assert_eq!(found, HashMap::from([("a".to_owned(), cell(1))]));
    }
}
