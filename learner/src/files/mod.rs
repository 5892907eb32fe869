//! Models and demonstrations as files: CSV, JSON lines, Parquet and JSON, as people's own tools write and read them.
//!
//! Formats are described in docs/DATA.md. Invariants: whatever bytes a file holds, reading it ends in what it says or in a
//! [`FileError`] that names the place; demonstrations are read one at a time, in memory that grows with the longest of
//! them and not with the file. Deliberately absent: the store and the wire.

mod columns;
mod csv;
mod demonstrations;
mod error;
mod export;
mod footer;
mod json_lines;
mod model;
mod model_json;
mod model_tables;
mod names;
mod parquet;
mod table;
mod value;

pub use columns::{Format, ReadOptions};
pub use demonstrations::{Demonstration, read};
pub use error::{FileError, Place};
pub use export::{COLUMNS, Naming, ParquetExport, Step};
pub use model::{ModelFile, Rows, read_model};
pub use names::{Collector, Names, Resolve};
pub use value::Value;
