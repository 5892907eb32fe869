//! Trajectories as a Parquet file, a row a step, with the columns that the CSV has.

use mazeway_proto::learner as pb;
use parquet::{
    basic::Compression,
    column::writer::ColumnWriter,
    data_type::ByteArray,
    errors::ParquetError,
    file::{properties::WriterProperties, writer::SerializedFileWriter},
    schema::parser::parse_message_type,
};
use std::{io::Write, sync::Arc};

/// Rows of a row group.
const GROUP_ROWS: usize = 1 << 17;

/// Columns of an exported row, in order.
pub const COLUMNS: [&str; 15] = [
    "id",
    "env",
    "model",
    "style",
    "source",
    "seed",
    "n_states",
    "n_actions",
    "step",
    "state",
    "action",
    "reward",
    "next_state",
    "terminated",
    "truncated",
];

/// One step of a trajectory, as it is written.
#[derive(Debug, Clone, PartialEq)]
pub struct Step {
    /// Index in the trajectory.
    pub step: u64,
    /// State before it.
    pub state: u32,
    /// Action, where it was seen.
    pub action: Option<u32>,
    /// Reward, where it is known.
    pub reward: Option<f64>,
    /// State after it, where it is known.
    pub next_state: Option<u32>,
    /// The episode came to an end of its own here.
    pub terminated: bool,
    /// The episode was cut off here.
    pub truncated: bool,
}

/// How states and actions are written.
pub trait Naming {
    /// A state.
    fn state(&self, index: u32) -> String;
    /// An action.
    fn action(&self, index: u32) -> String;
}

/// A Parquet file that is being written.
pub struct ParquetExport<W: Write + Send> {
    writer: SerializedFileWriter<W>,
    rows: Vec<Row>,
    trajectories: Vec<pb::Trajectory>,
    labels: bool,
}

/// A row that waits for its group.
struct Row {
    trajectory: usize,
    step: Step,
    /// State, action and next state by their labels.
    labels: [Option<String>; 3],
}

impl<W: Write + Send> std::fmt::Debug for ParquetExport<W> {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.debug_struct("ParquetExport").field("rows", &self.rows.len()).finish_non_exhaustive()
    }
}

impl<W: Write + Send> ParquetExport<W> {
    /// Begins a file; states and actions are written as indices, or as labels.
    ///
    /// # Errors
    /// It cannot be written.
    pub fn new(out: W, labels: bool) -> Result<Self, ParquetError> {
        let label = "(UTF8)";
        let (cell, plain) = if labels { ("BINARY", label) } else { ("INT64", "") };
        let schema = format!(
            "message trajectories {{
                REQUIRED BINARY id {label}; REQUIRED BINARY env {label}; REQUIRED BINARY model {label};
                REQUIRED BINARY style {label}; REQUIRED BINARY source {label}; OPTIONAL INT64 seed (UINT_64);
                REQUIRED INT64 n_states; REQUIRED INT64 n_actions; REQUIRED INT64 step;
                REQUIRED {cell} state {plain}; OPTIONAL {cell} action {plain}; OPTIONAL DOUBLE reward;
                OPTIONAL {cell} next_state {plain}; REQUIRED BOOLEAN terminated; REQUIRED BOOLEAN truncated;
            }}"
        );
        let properties = WriterProperties::builder().set_compression(Compression::SNAPPY).build();
        let writer = SerializedFileWriter::new(out, Arc::new(parse_message_type(&schema)?), Arc::new(properties))?;
        Ok(Self { writer, rows: Vec::new(), trajectories: Vec::new(), labels })
    }

    /// Writes a trajectory's steps, under the names that `naming` gives where labels are written.
    ///
    /// # Errors
    /// The file cannot be written.
    pub fn write(
        &mut self,
        trajectory: &pb::Trajectory,
        steps: Vec<Step>,
        naming: Option<&dyn Naming>,
    ) -> Result<(), ParquetError> {
        let rank = self.trajectories.len();
        let empty = bytes::Bytes::new;
        self.trajectories.push(pb::Trajectory {
            states: empty(),
            actions: empty(),
            rewards: empty(),
            ..trajectory.clone()
        });
        let state = |index: u32| naming.map_or_else(|| index.to_string(), |naming| naming.state(index));
        let action = |index: u32| naming.map_or_else(|| index.to_string(), |naming| naming.action(index));
        let labels = |step: &Step| {
            if self.labels {
                [Some(state(step.state)), step.action.map(action), step.next_state.map(state)]
            } else {
                [None, None, None]
            }
        };
        let rows: Vec<Row> =
            steps.into_iter().map(|step| Row { trajectory: rank, labels: labels(&step), step }).collect();
        self.rows.extend(rows);
        if self.rows.len() >= GROUP_ROWS { self.flush() } else { Ok(()) }
    }

    /// Writes what is left and the footer.
    ///
    /// # Errors
    /// The file cannot be written.
    pub fn finish(mut self) -> Result<(), ParquetError> {
        self.flush()?;
        self.writer.close().map(|_| ())
    }

    fn flush(&mut self) -> Result<(), ParquetError> {
        if self.rows.is_empty() {
            return Ok(());
        }
        let rows = std::mem::take(&mut self.rows);
        let trajectories = std::mem::take(&mut self.trajectories);
        let labels = self.labels;
        let mut group = self.writer.next_row_group()?;
        for name in COLUMNS {
            let Some(mut column) = group.next_column()? else { break };
            let cells = Cells { rows: &rows, trajectories: &trajectories, labels };
            cells.write(name, column.untyped())?;
            column.close()?;
        }
        group.close().map(|_| ())
    }
}

/// The rows of a group.
struct Cells<'a> {
    rows: &'a [Row],
    trajectories: &'a [pb::Trajectory],
    labels: bool,
}

impl Cells<'_> {
    fn write(&self, name: &str, column: &mut ColumnWriter<'_>) -> Result<(), ParquetError> {
        let of = |rank: usize| &self.trajectories[rank];
        match name {
            "id" => self.texts(column, |rank, _| Some(of(rank).trajectory_id.clone())),
            "env" => self.texts(column, |rank, _| Some(of(rank).env_id.clone())),
            "model" => self.texts(column, |rank, _| Some(of(rank).model_id.clone())),
            "style" => self.texts(column, |rank, _| Some(of(rank).style.clone())),
            "source" => self.texts(column, |rank, _| Some(of(rank).source.clone())),
            "seed" => self.integers(column, |rank, _| of(rank).seed.map(u64::cast_signed)),
            "n_states" => self.integers(column, |rank, _| Some(of(rank).n_states.into())),
            "n_actions" => self.integers(column, |rank, _| Some(of(rank).n_actions.into())),
            "step" => self.integers(column, |_, step| Some(step.step as i64)),
            "state" => self.indices(column, 0, |step| Some(step.state)),
            "action" => self.indices(column, 1, |step| step.action),
            "next_state" => self.indices(column, 2, |step| step.next_state),
            "reward" => self.rewards(column),
            "terminated" => self.truths(column, |step| step.terminated),
            _ => self.truths(column, |step| step.truncated),
        }
    }

    fn split<T>(&self, cell: impl Fn(usize, &Step) -> Option<T>) -> (Vec<T>, Vec<i16>) {
        split(self.rows.iter().map(|row| cell(row.trajectory, &row.step)))
    }

    fn indices(
        &self,
        column: &mut ColumnWriter<'_>,
        rank: usize,
        index: impl Fn(&Step) -> Option<u32>,
    ) -> Result<(), ParquetError> {
        if self.labels {
            let labels = self.rows.iter().map(|row| row.labels[rank].clone());
            return write_texts(column, split(labels));
        }
        self.integers(column, |_, step| index(step).map(i64::from))
    }

    fn texts(
        &self,
        column: &mut ColumnWriter<'_>,
        cell: impl Fn(usize, &Step) -> Option<String>,
    ) -> Result<(), ParquetError> {
        write_texts(column, self.split(cell))
    }

    fn integers(
        &self,
        column: &mut ColumnWriter<'_>,
        cell: impl Fn(usize, &Step) -> Option<i64>,
    ) -> Result<(), ParquetError> {
        let ColumnWriter::Int64ColumnWriter(column) = column else { return Err(other_type()) };
        let (values, levels) = self.split(cell);
        column.write_batch(&values, Some(&levels), None).map(|_| ())
    }

    fn rewards(&self, column: &mut ColumnWriter<'_>) -> Result<(), ParquetError> {
        let ColumnWriter::DoubleColumnWriter(column) = column else { return Err(other_type()) };
        let (values, levels) = self.split(|_, step| step.reward);
        column.write_batch(&values, Some(&levels), None).map(|_| ())
    }

    fn truths(&self, column: &mut ColumnWriter<'_>, cell: impl Fn(&Step) -> bool) -> Result<(), ParquetError> {
        let ColumnWriter::BoolColumnWriter(column) = column else { return Err(other_type()) };
        let (values, levels) = self.split(|_, step| Some(cell(step)));
        column.write_batch(&values, Some(&levels), None).map(|_| ())
    }
}

/// Values that are there, and the levels that say where.
fn split<T>(cells: impl Iterator<Item = Option<T>>) -> (Vec<T>, Vec<i16>) {
    let (mut values, mut levels) = (Vec::new(), Vec::new());
    for cell in cells {
        levels.push(i16::from(cell.is_some()));
        values.extend(cell);
    }
    (values, levels)
}

fn write_texts(column: &mut ColumnWriter<'_>, cells: (Vec<String>, Vec<i16>)) -> Result<(), ParquetError> {
    let ColumnWriter::ByteArrayColumnWriter(column) = column else { return Err(other_type()) };
    let (values, levels) = cells;
    let values: Vec<ByteArray> = values.into_iter().map(|text| text.into_bytes().into()).collect();
    column.write_batch(&values, Some(&levels), None).map(|_| ())
}

fn other_type() -> ParquetError {
    ParquetError::General("a column of another type than the schema says".into())
}
