//! Which trajectories are meant, and how that is asked of the database.
//!
//! Invariant: rows come in the order in which they were recorded, whatever the filter, and neither by sorting all of
//! them nor by holding them: one collection is read along its index, several along the table.

use super::StoreError;
use rusqlite::{
    Connection, ToSql,
    types::{Value, ValueRef},
};
use uuid::Uuid;

/// Conditions that a trajectory must all meet. The default has none.
#[derive(Debug, Clone, PartialEq, Eq, Default, Hash)]
pub struct Filter {
    /// These alone; empty means any.
    pub ids: Vec<Uuid>,
    /// This environment; empty means any.
    pub env_id: String,
    /// This style; empty means any.
    pub style: String,
    /// This model; empty means any.
    pub model_id: String,
    /// This source; empty means any.
    pub source: String,
    /// Seeds from this on; a trajectory without a seed passes.
    pub min_seed: Option<u64>,
    /// Seeds below this; a trajectory without a seed passes.
    pub max_seed: Option<u64>,
    /// At least so many steps.
    pub min_steps: u32,
    /// Recorded at or after this, in microseconds since the Unix epoch.
    pub recorded_from_us: Option<i64>,
    /// Recorded before this, in microseconds since the Unix epoch.
    pub recorded_until_us: Option<i64>,
}

impl Filter {
    /// Whether it selects everything.
    pub fn is_empty(&self) -> bool {
        *self == Self::default()
    }
}

/// A filter as the condition of a query on `trajectories`.
#[derive(Debug, Clone)]
pub(super) struct Condition {
    sql: String,
    values: Vec<Value>,
    /// The collection along whose index the rows are read.
    indexed: Option<i64>,
}

impl Condition {
    /// Looks up what the filter's labels stand for and writes the condition.
    pub(super) fn new(connection: &Connection, filter: &Filter) -> rusqlite::Result<Self> {
        Self::made(connection, filter, true)
    }

    /// As [`Condition::new`], for one who reads along the table whatever the filter: faster where it selects much of it.
    pub(super) fn along_table(connection: &Connection, filter: &Filter) -> rusqlite::Result<Self> {
        Self::made(connection, filter, false)
    }

    fn made(connection: &Connection, filter: &Filter, along_index: bool) -> rusqlite::Result<Self> {
        let mut condition = Self { sql: "TRUE".into(), values: Vec::new(), indexed: None };
        let labels = [
            ("env_id", &filter.env_id),
            ("style", &filter.style),
            ("model_id", &filter.model_id),
            ("source", &filter.source),
        ];
        let labels = labels.into_iter().filter(|(_, label)| !label.is_empty()).collect::<Vec<_>>();
        if !labels.is_empty() {
            let columns = labels.iter().map(|(column, _)| format!("{column} = ?")).collect::<Vec<_>>();
            let mut statement =
                connection.prepare(&format!("SELECT id FROM collections WHERE {}", columns.join(" AND ")))?;
            let values = rusqlite::params_from_iter(labels.iter().map(|(_, label)| label.as_str()));
            let ids = statement.query_map(values, |row| row.get::<_, i64>(0))?;
            let ids = ids.map(|id| id.map(|id| id.to_string())).collect::<rusqlite::Result<Vec<_>>>()?;
            match ids.as_slice() {
                [only] if along_index => {
                    condition.indexed = only.parse().ok();
                    condition.and(&format!("collection = {only}"), []);
                }
                // The unary plus keeps SQLite from the index: it would have to sort what it finds there.
                _ => condition.and(&format!("+collection IN ({})", ids.join(", ")), []),
            }
        }
        if !filter.ids.is_empty() {
            condition.and_ids(&filter.ids);
        }
        if filter.min_seed.is_some() || filter.max_seed.is_some() {
            condition.and_seeds(filter.min_seed.unwrap_or(0), filter.max_seed);
        }
        if filter.min_steps > 0 {
            condition.and("steps >= ?", [Value::from(filter.min_steps)]);
        }
        if let Some(from) = filter.recorded_from_us {
            condition.and("recorded_at >= ?", [Value::from(from)]);
        }
        if let Some(until) = filter.recorded_until_us {
            condition.and("recorded_at < ?", [Value::from(until)]);
        }
        Ok(condition)
    }

    /// One condition more.
    pub(super) fn and<const N: usize>(&mut self, sql: &str, values: [Value; N]) {
        self.sql = format!("{} AND {sql}", self.sql);
        self.values.extend(values);
    }

    /// One of these ids.
    pub(super) fn and_ids(&mut self, ids: &[Uuid]) {
        let ids = serde_json::Value::from(ids.iter().map(|id| id.simple().to_string()).collect::<Vec<_>>());
        self.and("trajectory_id IN (SELECT unhex(value) FROM json_each(?))", [Value::from(ids.to_string())]);
    }

    /// Seeds from `min` on and below `max`. They are stored by their bits, so that the upper half of them is negative:
    /// the range is asked for in two halves.
    fn and_seeds(&mut self, min: u64, max: Option<u64>) {
        const HALF: u64 = 1 << 63;
        let last = match max {
            Some(0) => return self.and("seed IS NULL", []),
            Some(max) => max - 1,
            None => u64::MAX,
        };
        let mut ranges = Vec::new();
        if min < HALF && min <= last {
            ranges.push((min as i64, last.min(HALF - 1) as i64));
        }
        if last >= HALF && min <= last {
            ranges.push((min.max(HALF) as i64, last as i64));
        }
        let mut sql = "(seed IS NULL".to_owned();
        for (low, high) in ranges {
            sql.push_str(" OR seed BETWEEN ? AND ?");
            self.values.extend([Value::from(low), Value::from(high)]);
        }
        self.sql = format!("{} AND {sql})", self.sql);
    }

    /// The collection along whose index the rows are read, where they are.
    pub(super) fn indexed(&self) -> Option<i64> {
        self.indexed
    }

    /// To stand after `WHERE`.
    pub(super) fn sql(&self) -> &str {
        &self.sql
    }

    /// The values alone.
    pub(super) fn into_values(self) -> Vec<Value> {
        self.values
    }

    /// To be bound, in order.
    pub(super) fn values(&self) -> impl Iterator<Item = &dyn ToSql> {
        self.values.iter().map(|value| value as &dyn ToSql)
    }
}

/// Reads an id that the store itself wrote: 16 bytes; in schema 1 its text.
pub(super) fn stored_uuid(id: ValueRef<'_>) -> Result<Uuid, StoreError> {
    let read = match id {
        ValueRef::Blob(bytes) => Uuid::from_slice(bytes).map_err(|e| e.to_string()),
        ValueRef::Text(text) => Uuid::try_parse_ascii(text).map_err(|e| e.to_string()),
        other => Err(format!("expected 16 bytes, got {}", other.data_type())),
    };
    read.map_err(|message| StoreError::Corrupt { what: "trajectory id".into(), message })
}
