//! What is wrong with a file, and where.

use std::{
    fmt,
    path::{Path, PathBuf},
};

/// Where in a file.
#[derive(Debug, Clone, PartialEq, Eq)]
pub enum Place {
    /// The whole of it.
    File,
    /// A line, from 1 on.
    Line(u64),
    /// A field of a line: its number from 1 on, and its column's name.
    Field {
        /// Line, from 1 on.
        line: u64,
        /// Number of the field, from 1 on.
        column: usize,
        /// Header of its column.
        name: String,
    },
    /// A character of a line, both from 1 on.
    Character {
        /// Line.
        line: u64,
        /// Column.
        column: usize,
    },
    /// A row of a table without lines, from 1 on.
    Row(u64),
    /// A cell of such a row.
    Cell {
        /// Row, from 1 on.
        row: u64,
        /// Name of its column.
        name: String,
    },
}

impl fmt::Display for Place {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Self::File => Ok(()),
            Self::Line(line) => write!(f, ", line {line}"),
            Self::Field { line, column, name } => write!(f, ", line {line}, column {column} ({name})"),
            Self::Character { line, column } => write!(f, ", line {line}, column {column}"),
            Self::Row(row) => write!(f, ", row {row}"),
            Self::Cell { row, name } => write!(f, ", row {row}, column {name}"),
        }
    }
}

/// A file that does not hold what it should.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
#[error("{}{place}: {message}", file.display())]
pub struct FileError {
    /// Which file.
    pub file: PathBuf,
    /// Where in it.
    pub place: Place,
    /// What was expected and what came.
    pub message: String,
    /// What to do about it.
    pub hint: String,
}

impl FileError {
    /// An error at a place.
    pub fn new(file: &Path, place: Place, message: impl Into<String>, hint: impl Into<String>) -> Self {
        Self { file: file.to_owned(), place, message: message.into(), hint: hint.into() }
    }

    /// A file that cannot be read.
    pub(super) fn unreadable(file: &Path, error: &std::io::Error) -> Self {
        Self::new(
            file,
            Place::File,
            format!("cannot read it: {error}"),
            "check the name of the file and that you may read it",
        )
    }
}
