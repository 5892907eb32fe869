//! Parquet, a row at a time, from the columns of simple types that it has.
//!
//! Columns are read in batches by the low-level readers: the record interface of the library panics on types that it does
//! not know. Columns of other types (lists, structs, times of 96 bits) are left out, as if they were not there.

use super::{
    error::{FileError, Place},
    footer::{is_plausible, varint},
    table::Table,
    value::Value,
};
use bytes::Bytes;
use parquet::{
    basic::{ConvertedType, Encoding, Type as PhysicalType},
    column::{
        page::{Page, PageMetadata, PageReader},
        reader::{ColumnReader, ColumnReaderImpl, get_column_reader},
    },
    data_type::DataType,
    errors::ParquetError,
    file::reader::{ChunkReader, FileReader, Length, SerializedFileReader},
};
use std::{
    collections::VecDeque,
    fs::File,
    io::{self, BufReader, Read},
    panic::{AssertUnwindSafe, catch_unwind},
    path::{Path, PathBuf},
};

/// Rows that are read at a time.
const BATCH: usize = 4096;
/// Bytes of a page at most, once it is unpacked. Writers make them of about a mebibyte.
const MAX_PAGE_BYTES: u64 = 64 << 20;
/// Bytes behind the footer: its length and what follows.
const TAIL: u64 = 8;
/// What a file ends with.
const MAGIC: &[u8; 4] = b"PAR1";
/// Bytes of the beginning of a page's header: two marks and two numbers.
const HEADER_START: usize = 12;
const HINT: &str = "write it again with pandas, polars or DuckDB, compressed with snappy, zstd or not at all";

/// A file that says where it ends: reading on there is an error. The library leaves out what it does not know by reading it,
/// takes an end for bytes that were read, and would go on for billions of them where a damaged header says so.
struct Bounded(File);

impl Bounded {
    /// The footer: before the last bytes, which tell its length; `None` where there is none.
    fn footer(&self) -> Result<Option<Bytes>, ParquetError> {
        let Some(end) = Length::len(self).checked_sub(TAIL) else { return Ok(None) };
        let tail = self.get_bytes(end, TAIL as usize)?;
        let length = u32::from_le_bytes([tail[0], tail[1], tail[2], tail[3]]);
        match end.checked_sub(length.into()) {
            Some(start) if tail[4..] == *MAGIC => self.get_bytes(start, length as usize).map(Some),
            _ => Ok(None),
        }
    }
}

impl Length for Bounded {
    fn len(&self) -> u64 {
        Length::len(&self.0)
    }
}

impl ChunkReader for Bounded {
    type T = Ending<BufReader<File>>;

    /// From the header of a page on, or the file's last bytes.
    fn get_read(&self, start: u64) -> Result<Self::T, ParquetError> {
        if start.saturating_add(TAIL) >= Length::len(self) {
            return self.0.get_read(start).map(Ending);
        }
        let mut header = [0; HEADER_START];
        let read = self.0.get_read(start)?.take(HEADER_START as u64).read(&mut header)?;
        match page_bytes(&header[..read]) {
            None => Err(ParquetError::General("the header of a page is damaged".into())),
            Some(bytes) if bytes > MAX_PAGE_BYTES => {
                Err(ParquetError::General(format!("expected pages of {MAX_PAGE_BYTES} bytes at most, got {bytes}")))
            }
            Some(_) => self.0.get_read(start).map(Ending),
        }
    }

    fn get_bytes(&self, start: u64, length: usize) -> Result<Bytes, ParquetError> {
        self.0.get_bytes(start, length)
    }
}

/// Bytes of a page once it is unpacked, as the beginning of its header says: two numbers in Thrift's compact protocol, each
/// behind its mark, as every writer begins; `None` where it does not begin so.
fn page_bytes(header: &[u8]) -> Option<u64> {
    let mut bytes = header.iter().copied();
    let mut number = || {
        const I32: u8 = 0x15;
        (bytes.next()? == I32).then(|| varint(|| bytes.next()))?
    };
    let (_kind, zigzag) = (number()?, number()?);
    zigzag.is_multiple_of(2).then_some(zigzag / 2)
}

/// The pages of a column, where none claims more values than it can have: the library makes room for them all at once, and a
/// process that cannot have so much room ends.
struct Pages {
    inner: Box<dyn PageReader>,
    /// Of a value in a dictionary, at least.
    value_bits: usize,
    /// Whether values may be missing, so that a page begins with which.
    optional: bool,
}

impl Pages {
    fn check(&self, page: Page) -> Result<Page, ParquetError> {
        let refuse = |message: String| Err(ParquetError::General(message));
        match &page {
            Page::DictionaryPage { buf, num_values, .. }
                if *num_values as usize > buf.len().saturating_mul(8) / self.value_bits =>
            {
                refuse(format!("a dictionary of {} bytes cannot have {num_values} values", buf.len()))
            }
            Page::DataPage { encoding: Encoding::DELTA_BYTE_ARRAY, .. }
            | Page::DataPageV2 { encoding: Encoding::DELTA_BYTE_ARRAY, .. } => {
                refuse("expected texts that are plain, in a dictionary or behind their lengths, got prefixes".into())
            }
            Page::DataPage { encoding: Encoding::DELTA_LENGTH_BYTE_ARRAY, .. }
            | Page::DataPageV2 { encoding: Encoding::DELTA_LENGTH_BYTE_ARRAY, .. } => {
                let (claimed, values) = (self.lengths(&page), page.num_values());
                if claimed.is_none_or(|claimed| claimed > u64::from(values)) {
                    return refuse(format!("a page of {values} values cannot have {claimed:?} lengths"));
                }
                Ok(page)
            }
            _ => Ok(page),
        }
    }

    /// How many lengths a page says that it has: the third number of its values.
    fn lengths(&self, page: &Page) -> Option<u64> {
        let (bytes, levels) = match page {
            // Their length in four bytes, then which values are missing.
            Page::DataPage { buf, .. } if self.optional => (buf, 4 + u32::from_le_bytes(*buf.first_chunk()?) as usize),
            Page::DataPage { buf, .. } => (buf, 0),
            Page::DataPageV2 { buf, def_levels_byte_len, rep_levels_byte_len, .. } => {
                (buf, *def_levels_byte_len as usize + *rep_levels_byte_len as usize)
            }
            Page::DictionaryPage { .. } => return None,
        };
        let mut bytes = bytes.get(levels..)?.iter().copied();
        (0..3).map(|_| varint(|| bytes.next())).last()?
    }
}

impl Iterator for Pages {
    type Item = Result<Page, ParquetError>;

    fn next(&mut self) -> Option<Self::Item> {
        self.get_next_page().transpose()
    }
}

impl PageReader for Pages {
    fn get_next_page(&mut self) -> Result<Option<Page>, ParquetError> {
        self.inner.get_next_page()?.map(|page| self.check(page)).transpose()
    }

    fn peek_next_page(&mut self) -> Result<Option<PageMetadata>, ParquetError> {
        self.inner.peek_next_page()
    }

    fn skip_next_page(&mut self) -> Result<(), ParquetError> {
        self.inner.skip_next_page()
    }
}

/// Bits of a value of a type, at least.
fn value_bits(kind: PhysicalType) -> usize {
    match kind {
        PhysicalType::BOOLEAN | PhysicalType::FIXED_LEN_BYTE_ARRAY => 1,
        PhysicalType::INT32 | PhysicalType::FLOAT | PhysicalType::BYTE_ARRAY => 32,
        PhysicalType::INT64 | PhysicalType::DOUBLE => 64,
        PhysicalType::INT96 => 96,
    }
}

/// What of a file fails at its end.
struct Ending<R>(R);

impl<R: Read> Read for Ending<R> {
    fn read(&mut self, buf: &mut [u8]) -> io::Result<usize> {
        match self.0.read(buf)? {
            0 if !buf.is_empty() => Err(io::ErrorKind::UnexpectedEof.into()),
            read => Ok(read),
        }
    }
}

/// Columns of a Parquet file.
pub struct ParquetTable {
    file: PathBuf,
    reader: SerializedFileReader<Bounded>,
    columns: Vec<String>,
    /// Rank of each column among the leaves of the file.
    leaves: Vec<usize>,
    /// Whether a column's integers have no sign.
    unsigned: Vec<bool>,
    /// Row groups that are not begun.
    groups: std::ops::Range<usize>,
    /// The group that is being read.
    open: Vec<ColumnReader>,
    left: usize,
    batches: Vec<VecDeque<Value>>,
    row: u64,
}

impl std::fmt::Debug for ParquetTable {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.debug_struct("ParquetTable").field("file", &self.file).field("row", &self.row).finish_non_exhaustive()
    }
}

/// Runs code of the library, which panics on some broken files.
fn guarded<T>(file: &Path, place: &Place, work: impl FnOnce() -> Result<T, ParquetError>) -> Result<T, FileError> {
    let outcome = catch_unwind(AssertUnwindSafe(work));
    let message = match outcome {
        Ok(Ok(value)) => return Ok(value),
        Ok(Err(error)) if error.to_string().contains("Disabled feature") => {
            let message = "expected a file compressed with snappy, zstd or not at all, got another compression";
            return Err(FileError::new(file, place.clone(), message, HINT));
        }
        Ok(Err(error)) => error.to_string(),
        Err(_) => "its pages are damaged".to_owned(),
    };
    let message = format!("expected a Parquet file: {}", message.trim_start_matches("Parquet error: "));
    Err(FileError::new(file, place.clone(), message, HINT))
}

impl ParquetTable {
    /// Opens a file and reads its schema.
    ///
    /// # Errors
    /// It cannot be read, or is none.
    pub fn open(file: &Path) -> Result<Self, FileError> {
        let opened = File::open(file).map_err(|error| FileError::unreadable(file, &error))?;
        let reader = guarded(file, &Place::File, || {
            let bounded = Bounded(opened);
            if bounded.footer()?.is_some_and(|footer| !is_plausible(&footer)) {
                return Err(ParquetError::General("its footer is damaged".into()));
            }
            SerializedFileReader::new(bounded)
        })?;
        let schema = reader.metadata().file_metadata().schema_descr_ptr();
        let (mut columns, mut leaves, mut unsigned) = (Vec::new(), Vec::new(), Vec::new());
        for leaf in 0..schema.num_columns() {
            let column = schema.column(leaf);
            let simple = matches!(
                column.physical_type(),
                PhysicalType::BOOLEAN
                    | PhysicalType::INT32
                    | PhysicalType::INT64
                    | PhysicalType::FLOAT
                    | PhysicalType::DOUBLE
                    | PhysicalType::BYTE_ARRAY
            ) && column.converted_type() != ConvertedType::DECIMAL;
            if simple && column.path().parts().len() == 1 && column.max_rep_level() == 0 && column.max_def_level() <= 1
            {
                columns.push(column.name().to_owned());
                leaves.push(leaf);
                unsigned.push(column.converted_type() == ConvertedType::UINT_64);
            }
        }
        if columns.is_empty() {
            return Err(FileError::new(file, Place::File, "expected columns of numbers or texts, got none", HINT));
        }
        let groups = 0..reader.num_row_groups();
        let batches = vec![VecDeque::new(); columns.len()];
        Ok(Self {
            file: file.to_owned(),
            reader,
            columns,
            leaves,
            unsigned,
            groups,
            open: Vec::new(),
            left: 0,
            batches,
            row: 0,
        })
    }

    /// Fills the batches; false at the end of the file.
    fn fill(&mut self) -> Result<bool, FileError> {
        let place = Place::Row(self.row + 1);
        while self.left == 0 {
            let Some(group) = self.groups.next() else { return Ok(false) };
            let (reader, leaves) = (&self.reader, &self.leaves);
            (self.open, self.left) = guarded(&self.file, &place, || {
                let group = reader.get_row_group(group)?;
                let rows = usize::try_from(group.metadata().num_rows()).unwrap_or(0);
                let column = |&leaf: &usize| {
                    let description = group.metadata().schema_descr().column(leaf);
                    let pages = Pages {
                        inner: group.get_column_page_reader(leaf)?,
                        value_bits: value_bits(description.physical_type()),
                        optional: description.max_def_level() > 0,
                    };
                    Ok(get_column_reader(description, Box::new(pages)))
                };
                let columns = leaves.iter().map(column).collect::<Result<_, ParquetError>>()?;
                Ok((columns, rows))
            })?;
        }
        let wanted = self.left.min(BATCH);
        for ((reader, batch), &unsigned) in self.open.iter_mut().zip(&mut self.batches).zip(&self.unsigned) {
            guarded(&self.file, &place, || read_batch(reader, wanted, unsigned, batch))?;
            if batch.len() != wanted {
                let message = format!("expected {wanted} values in every column, got {}", batch.len());
                return Err(FileError::new(&self.file, place, message, HINT));
            }
        }
        self.left -= wanted;
        Ok(true)
    }
}

impl Table for ParquetTable {
    fn columns(&self) -> &[String] {
        &self.columns
    }

    fn next(&mut self, row: &mut Vec<Value>) -> Result<bool, FileError> {
        if self.batches[0].is_empty() && !self.fill()? {
            return Ok(false);
        }
        self.row += 1;
        row.clear();
        row.extend(self.batches.iter_mut().map(|batch| batch.pop_front().unwrap_or(Value::Null)));
        Ok(true)
    }

    fn place(&self, column: Option<usize>) -> Place {
        match column.and_then(|column| self.columns.get(column)) {
            None => Place::Row(self.row),
            Some(name) => Place::Cell { row: self.row, name: name.clone() },
        }
    }

    fn file(&self) -> &Path {
        &self.file
    }
}

fn read_batch(
    reader: &mut ColumnReader,
    rows: usize,
    unsigned: bool,
    out: &mut VecDeque<Value>,
) -> Result<(), ParquetError> {
    match reader {
        ColumnReader::BoolColumnReader(reader) => typed(reader, rows, out, |value| Ok(Value::Truth(*value))),
        ColumnReader::Int32ColumnReader(reader) => {
            typed(reader, rows, out, |value| Ok(Value::Integer((*value).into())))
        }
        ColumnReader::Int64ColumnReader(reader) => typed(reader, rows, out, |value| {
            Ok(if unsigned && *value < 0 {
                Value::Text(value.cast_unsigned().to_string())
            } else {
                Value::Integer(*value)
            })
        }),
        ColumnReader::FloatColumnReader(reader) => typed(reader, rows, out, |value| Ok(number((*value).into()))),
        ColumnReader::DoubleColumnReader(reader) => typed(reader, rows, out, |value| Ok(number(*value))),
        ColumnReader::ByteArrayColumnReader(reader) => typed(reader, rows, out, |value| {
            let text = std::str::from_utf8(value.data())
                .map_err(|_| ParquetError::General("expected text in UTF-8, got other bytes".into()))?;
            Ok(Value::text(text.trim()))
        }),
        ColumnReader::Int96ColumnReader(_) | ColumnReader::FixedLenByteArrayColumnReader(_) => {
            Err(ParquetError::General("expected a column of numbers or texts".into()))
        }
    }
}

/// A number; pandas writes a missing one as NaN.
fn number(value: f64) -> Value {
    if value.is_nan() { Value::Null } else { Value::Number(value) }
}

fn typed<T: DataType>(
    reader: &mut ColumnReaderImpl<T>,
    rows: usize,
    out: &mut VecDeque<Value>,
    convert: impl Fn(&T::T) -> Result<Value, ParquetError>,
) -> Result<(), ParquetError> {
    let (mut levels, mut values) = (Vec::new(), Vec::new());
    while out.len() < rows {
        levels.clear();
        values.clear();
        let (records, _, _) = reader.read_records(rows - out.len(), Some(&mut levels), None, &mut values)?;
        if records == 0 {
            return Ok(());
        }
        if levels.is_empty() {
            for value in &values {
                out.push_back(convert(value)?);
            }
        } else {
            let mut values = values.iter();
            for level in &levels {
                out.push_back(match (*level > 0).then(|| values.next()).flatten() {
                    Some(value) => convert(value)?,
                    None => Value::Null,
                });
            }
        }
    }
    Ok(())
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_page_says_how_large_it_is() {
        // A data page of 2,147,483,647 bytes: zigzag 4,294,967,294.
        assert_eq!(page_bytes(&[0x15, 0, 0x15, 0xfe, 0xff, 0xff, 0xff, 0x0f, 0x15]), Some(i32::MAX as u64));
        assert_eq!(page_bytes(&[0x15, 4, 0x15, 32]), Some(16));
        for other in [&[0x15, 4, 0x15, 1][..], &[0x15, 4, 0x25, 32], &[0x15, 4, 0x15], &[0x15; 1], &[]] {
            assert_eq!(page_bytes(other), None, "{other:?}");
        }
    }
}
