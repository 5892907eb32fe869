//! CSV (RFC 4180), a row at a time.

use super::{
    error::{FileError, Place},
    table::Table,
    value::Value,
};
use csv::{ErrorKind, ReaderBuilder, StringRecord};
use std::{
    cell::Cell,
    fs::File,
    io::{self, Read},
    path::{Path, PathBuf},
    rc::Rc,
};

/// Bytes of one row at most: a quote that is never closed must not read the whole file into memory.
const MOST_ROW_BYTES: usize = 16 << 20;

/// Lines of fields under a header.
pub struct CsvTable<R> {
    file: PathBuf,
    reader: csv::Reader<Limited<R>>,
    read: Rc<Cell<usize>>,
    columns: Vec<String>,
    record: StringRecord,
    line: u64,
}

impl<R> std::fmt::Debug for CsvTable<R> {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.debug_struct("CsvTable").field("file", &self.file).field("line", &self.line).finish_non_exhaustive()
    }
}

/// Fails once more was read since the last row than a row may have.
struct Limited<R> {
    inner: R,
    read: Rc<Cell<usize>>,
}

impl<R: Read> Read for Limited<R> {
    fn read(&mut self, buffer: &mut [u8]) -> io::Result<usize> {
        if self.read.get() > MOST_ROW_BYTES {
            let message = format!("a row of more than {MOST_ROW_BYTES} bytes; is a quote not closed?");
            return Err(io::Error::new(io::ErrorKind::InvalidData, message));
        }
        let n = self.inner.read(buffer)?;
        self.read.set(self.read.get() + n);
        Ok(n)
    }
}

impl CsvTable<File> {
    /// Opens a file.
    ///
    /// # Errors
    /// It cannot be read, or has no header.
    pub fn open(file: &Path, delimiter: u8) -> Result<Self, FileError> {
        let opened = File::open(file).map_err(|error| FileError::unreadable(file, &error))?;
        Self::new(file, opened, delimiter)
    }
}

impl<R: Read> CsvTable<R> {
    /// Reads the header.
    ///
    /// # Errors
    /// There is none.
    pub fn new(file: &Path, inner: R, delimiter: u8) -> Result<Self, FileError> {
        let read = Rc::new(Cell::new(0));
        let limited = Limited { inner, read: Rc::clone(&read) };
        let mut reader = ReaderBuilder::new().delimiter(delimiter).from_reader(limited);
        let columns: Vec<String> = match reader.headers() {
            Ok(header) => header.iter().map(|name| name.trim_start_matches('\u{feff}').trim().to_owned()).collect(),
            Err(error) => return Err(wrong(file, &error, &[])),
        };
        if columns.is_empty() || columns.iter().all(String::is_empty) {
            let hint = "the first line names the columns, such as trajectory,step,state,action";
            return Err(FileError::new(file, Place::Line(1), "expected a header, got an empty file", hint));
        }
        Ok(Self { file: file.to_owned(), reader, read, columns, record: StringRecord::new(), line: 1 })
    }
}

impl<R: Read> Table for CsvTable<R> {
    fn columns(&self) -> &[String] {
        &self.columns
    }

    fn next(&mut self, row: &mut Vec<Value>) -> Result<bool, FileError> {
        self.read.set(0);
        let more = self.reader.read_record(&mut self.record);
        if !more.map_err(|error| wrong(&self.file, &error, &self.columns))? {
            return Ok(false);
        }
        self.line = self.record.position().map_or(self.line, csv::Position::line);
        row.clear();
        row.extend(self.record.iter().map(|field| Value::text(field.trim())));
        Ok(true)
    }

    fn place(&self, column: Option<usize>) -> Place {
        match column {
            None => Place::Line(self.line),
            Some(column) => Place::Field {
                line: self.line,
                column: column + 1,
                name: self.columns.get(column).cloned().unwrap_or_default(),
            },
        }
    }

    fn file(&self) -> &Path {
        &self.file
    }
}

/// The library's errors in our words.
fn wrong(file: &Path, error: &csv::Error, columns: &[String]) -> FileError {
    let line = error.position().map_or(1, csv::Position::line);
    match error.kind() {
        ErrorKind::Io(error) if error.kind() == io::ErrorKind::InvalidData => {
            FileError::new(file, Place::Line(line), error.to_string(), "close every quote that is opened")
        }
        ErrorKind::Io(error) => FileError::unreadable(file, error),
        ErrorKind::Utf8 { err, .. } => {
            let name = columns.get(err.field()).cloned().unwrap_or_default();
            let place = Place::Field { line, column: err.field() + 1, name };
            FileError::new(file, place, "expected text in UTF-8, got other bytes", "convert the file to UTF-8")
        }
        ErrorKind::UnequalLengths { expected_len, len, .. } => FileError::new(
            file,
            Place::Line(line),
            format!("expected {expected_len} fields as in the header, got {len}"),
            "quote fields that hold the delimiter; --delimiter names another one than the comma",
        ),
        _ => FileError::new(file, Place::Line(line), error.to_string(), "see docs/DATA.md for the format"),
    }
}
