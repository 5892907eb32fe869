//! Trajectories as a count of their steps reads them: one statement over one moment of the store, each row looked at where
//! SQLite holds it, nothing copied, widened or hashed, and the rewards left on the disk.

use super::{
    Arrays, Collection, Filter, Recording, StoreError,
    filter::{Condition, stored_uuid},
    packing::{self, Packing, torn},
    trajectories::{Collections, blob},
};
use crate::statistics::PackedIndices;
use rusqlite::{Connection, Row, params_from_iter};
use std::{ops::ControlFlow, path::Path, sync::Arc};
use uuid::Uuid;

/// A collection is read along its index where that leaves out so many rows for each that it holds: a step along the table
/// costs a fraction of a look-up in it.
const WORTH_AN_INDEX: i64 = 4;

/// A trajectory, without its rewards, for as long as the reader stands on it.
#[derive(Debug)]
pub struct Stored<'a> {
    id: Uuid,
    collection_row: i64,
    collection: &'a Arc<Collection>,
    final_state: Option<u32>,
    states: PackedIndices<'a>,
    actions: PackedIndices<'a>,
}

impl Stored<'_> {
    /// Its id.
    pub fn id(&self) -> Uuid {
        self.id
    }

    /// What it has in common with others.
    pub fn collection(&self) -> &Collection {
        self.collection
    }

    /// The same number for all that have everything in common, within one reading.
    pub fn collection_row(&self) -> i64 {
        self.collection_row
    }

    /// State before each step.
    pub fn states(&self) -> PackedIndices<'_> {
        self.states
    }

    /// Action of each step; empty where only the states were seen.
    pub fn actions(&self) -> PackedIndices<'_> {
        self.actions
    }

    /// A copy that stays.
    pub fn recording(&self) -> Recording {
        let arrays = Arrays {
            states: packing::widened(self.states),
            actions: packing::widened(self.actions),
            final_state: self.final_state,
            ..Arrays::default()
        };
        Recording::from_stored(self.id, Collection::clone(self.collection), None, arrays)
    }
}

/// Calls `visit` with every trajectory that the filter selects, in the order in which they were recorded.
pub(super) fn scan<B>(
    connection: &Connection,
    path: &Path,
    filter: &Filter,
    mut visit: impl FnMut(&Stored<'_>) -> ControlFlow<B>,
) -> Result<ControlFlow<B>, StoreError> {
    let fail = |e: rusqlite::Error| StoreError::from_sqlite(path, &e);
    let condition = condition(connection, filter).map_err(fail)?;
    let columns = "trajectory_id, collection, packing, final_state, states, actions";
    let sql = if filter.ids.is_empty() {
        format!("SELECT {columns} FROM trajectories WHERE {} ORDER BY seq", condition.sql())
    } else {
        // The rows first: else their arrays would be sorted with them.
        let rows = format!("SELECT seq FROM trajectories WHERE {}", condition.sql());
        format!("SELECT {columns} FROM trajectories WHERE seq IN ({rows}) ORDER BY seq")
    };
    let mut statement = connection.prepare(&sql).map_err(fail)?;
    let mut rows = statement.query(params_from_iter(condition.values())).map_err(fail)?;
    let mut collections = Collections::default();
    let mut last: Option<(i64, Arc<Collection>)> = None;
    while let Some(row) = rows.next().map_err(fail)? {
        let id = stored_uuid(row.get_ref(0).map_err(fail)?)?;
        let collection_row = row.get(1).map_err(fail)?;
        let (_, collection) = match last.take() {
            Some(same) if same.0 == collection_row => last.insert(same),
            _ => last.insert((collection_row, collections.get(connection, collection_row).map_err(fail)?)),
        };
        let Some((states, actions)) = arrays(row).map_err(fail)? else {
            return Err(torn(format!("trajectory {id}")));
        };
        let final_state = row.get(3).map_err(fail)?;
        let stored = Stored { id, collection_row, collection, final_state, states, actions };
        if let ControlFlow::Break(value) = visit(&stored) {
            return Ok(ControlFlow::Break(value));
        }
    }
    Ok(ControlFlow::Continue(()))
}

fn arrays<'a>(row: &'a Row<'_>) -> rusqlite::Result<Option<(PackedIndices<'a>, PackedIndices<'a>)>> {
    let Some(packing) = Packing::of_code(row.get(2)?) else { return Ok(None) };
    Ok(packing.states(blob(row, 4)?).zip(packing.actions(blob(row, 5)?)))
}

/// Along the index only where it leaves out most of the table.
fn condition(connection: &Connection, filter: &Filter) -> rusqlite::Result<Condition> {
    let condition = Condition::new(connection, filter)?;
    let Some(collection) = condition.indexed() else { return Ok(condition) };
    let sql =
        "SELECT count(*), (SELECT coalesce(max(seq), 0) FROM trajectories) FROM trajectories WHERE collection = ?";
    let (selected, all): (i64, i64) = connection.query_row(sql, [collection], |row| Ok((row.get(0)?, row.get(1)?)))?;
    if selected.saturating_mul(WORTH_AN_INDEX) < all {
        Ok(condition)
    } else {
        Condition::along_table(connection, filter)
    }
}
