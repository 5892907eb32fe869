//! A table that is read row by row, whatever the format.

use super::{csv::CsvTable, error::FileError, error::Place, parquet::ParquetTable, value::Value};
use std::path::Path;

/// Rows under named columns.
pub trait Table {
    /// Names of the columns.
    fn columns(&self) -> &[String];

    /// Reads the next row into `row`, one cell a column; false at the end.
    ///
    /// # Errors
    /// Bytes that are no row.
    fn next(&mut self, row: &mut Vec<Value>) -> Result<bool, FileError>;

    /// Where the row lies that was read last, or its cell.
    fn place(&self, column: Option<usize>) -> Place;

    /// The file.
    fn file(&self) -> &Path;

    /// An error at the row that was read last, or at its cell.
    fn error(&self, column: Option<usize>, message: impl Into<String>, hint: impl Into<String>) -> FileError
    where
        Self: Sized,
    {
        FileError::new(self.file(), self.place(column), message, hint)
    }
}

/// A table of a file, by the file's extension.
#[derive(Debug)]
pub enum AnyTable {
    /// Lines of fields.
    Csv(CsvTable<std::fs::File>),
    /// Columns of pages.
    Parquet(ParquetTable),
}

impl Table for AnyTable {
    fn columns(&self) -> &[String] {
        match self {
            Self::Csv(table) => table.columns(),
            Self::Parquet(table) => table.columns(),
        }
    }

    fn next(&mut self, row: &mut Vec<Value>) -> Result<bool, FileError> {
        match self {
            Self::Csv(table) => table.next(row),
            Self::Parquet(table) => table.next(row),
        }
    }

    fn place(&self, column: Option<usize>) -> Place {
        match self {
            Self::Csv(table) => table.place(column),
            Self::Parquet(table) => table.place(column),
        }
    }

    fn file(&self) -> &Path {
        match self {
            Self::Csv(table) => table.file(),
            Self::Parquet(table) => table.file(),
        }
    }
}
