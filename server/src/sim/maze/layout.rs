//! The grid of a maze: its free cells, their rewards, and where each move leads.
//!
//! Invariant: rows are of equal length and hold at most [`MAX_CELLS`] cells, at least one of them free.

use serde_json::{Map, Value};

use crate::sim::{
    OptionError,
    options::{error, kind},
};

/// Most cells of a grid, walls included, so that no request makes the server allocate without bound.
const MAX_CELLS: usize = 65_536;
/// Largest magnitude of a reward: far beyond use, and safe in every sum.
const MAX_REWARD: f64 = 1e6;

/// A grid with numbered free cells.
#[derive(Debug, Clone)]
pub(super) struct Layout {
    pub(super) rows: u32,
    pub(super) columns: u32,
    /// Row-major cell of each state, rising.
    pub(super) cells: Vec<u32>,
    /// R(s) of each state.
    pub(super) rewards: Vec<f64>,
}

impl Layout {
    /// Reads `layout` and `rewards`.
    pub(super) fn from_options(given: &Map<String, Value>, default: &[&str]) -> Result<Self, OptionError> {
        let mut layout = match given.get("layout") {
            None => Self::from_rows(default)?,
            Some(Value::String(text)) => {
                let text = text.strip_suffix('\n').unwrap_or(text);
                Self::from_rows(&text.split('\n').map(|row| row.strip_suffix('\r').unwrap_or(row)).collect::<Vec<_>>())?
            }
            Some(Value::Array(items)) => {
                let rows: Option<Vec<&str>> = items.iter().map(Value::as_str).collect();
                Self::from_rows(
                    &rows.ok_or_else(|| error("layout", "expected a list of strings, got other items in it"))?,
                )?
            }
            Some(other) => {
                return Err(error("layout", format!("expected a list of strings or one string, got {}", kind(other))));
            }
        };
        layout.rewards = match given.get("rewards") {
            None | Some(Value::Null) => layout.default_rewards()?,
            Some(Value::Array(items)) => layout.read_rewards(items)?,
            Some(other) => return Err(error("rewards", format!("expected a list, got {}", kind(other)))),
        };
        Ok(layout)
    }

    fn from_rows(rows: &[&str]) -> Result<Self, OptionError> {
        let columns = rows.first().map_or(0, |row| row.len());
        if columns == 0 {
            return Err(error("layout", "expected at least one cell, got none"));
        }
        if rows.len().saturating_mul(columns) > MAX_CELLS {
            return Err(error(
                "layout",
                format!("expected at most {MAX_CELLS} cells, got {} rows of {columns}", rows.len()),
            ));
        }
        let mut cells = Vec::new();
        for (index, row) in rows.iter().enumerate() {
            if let Some(wrong) = row.chars().find(|cell| !matches!(cell, '.' | '#')) {
                return Err(error("layout", format!("expected '.' or '#', got {wrong:?} in row {index}")));
            }
            if row.len() != columns {
                return Err(error(
                    "layout",
                    format!("expected rows of equal length {columns}, got {} cells in row {index}", row.len()),
                ));
            }
            let free = row.bytes().enumerate().filter(|&(_, cell)| cell == b'.');
            cells.extend(free.map(|(column, _)| (index * columns + column) as u32));
        }
        if cells.is_empty() {
            return Err(error("layout", "expected at least one free cell '.', got walls only"));
        }
        let rewards = vec![0.0; cells.len()];
        Ok(Self { rows: rows.len() as u32, columns: columns as u32, cells, rewards })
    }

    fn default_rewards(&self) -> Result<Vec<f64>, OptionError> {
        let (bottom, right) = (self.rows - 1, self.columns - 1);
        let places = [(0, 0), (0, right), (bottom, right), (bottom / 2, right / 2)];
        let mut rewards = vec![0.0; self.cells.len()];
        for state in places.into_iter().filter_map(|(row, column)| self.state_at(row, column)) {
            rewards[state as usize] = 1.0;
        }
        if rewards.contains(&1.0) {
            return Ok(rewards);
        }
        Err(error("rewards", "expected rewarded cells, for none of this layout's three corners and centre is free"))
    }

    /// Cells `[row, column]` or `[row, column, reward]`, or one number a state.
    fn read_rewards(&self, items: &[Value]) -> Result<Vec<f64>, OptionError> {
        let n_states = self.cells.len();
        if items.len() > n_states {
            return Err(error(
                "rewards",
                format!("expected at most {n_states} items, one a free cell, got {}", items.len()),
            ));
        }
        if items.first().is_some_and(Value::is_number) {
            if items.len() != n_states {
                return Err(error("rewards", format!("expected {n_states} numbers, one a state, got {}", items.len())));
            }
            return items.iter().map(read_reward).collect();
        }
        let mut rewards = vec![0.0; n_states];
        for item in items {
            let malformed =
                || error("rewards", format!("expected [row, column] or [row, column, reward], got {}", kind(item)));
            let parts = item.as_array().filter(|parts| matches!(parts.len(), 2 | 3)).ok_or_else(malformed)?;
            let (row, column) = index(&parts[0]).zip(index(&parts[1])).ok_or_else(malformed)?;
            let state = self
                .state_at(row, column)
                .ok_or_else(|| error("rewards", format!("expected a free cell, got row {row}, column {column}")))?;
            rewards[state as usize] = parts.get(2).map_or(Ok(1.0), read_reward)?;
        }
        Ok(rewards)
    }

    /// Number of free cells.
    pub(super) fn n_states(&self) -> u32 {
        self.cells.len() as u32
    }

    /// Row and column of a state.
    pub(super) fn position(&self, state: u32) -> (u32, u32) {
        let cell = self.cells[state as usize];
        (cell / self.columns, cell % self.columns)
    }

    /// Row and column of every state.
    pub(super) fn positions(&self) -> impl Iterator<Item = (u32, u32)> + '_ {
        (0..self.n_states()).map(|state| self.position(state))
    }

    /// The state of a cell, where it lies on the grid and is free.
    pub(super) fn state_at(&self, row: u32, column: u32) -> Option<u32> {
        if row >= self.rows || column >= self.columns {
            return None;
        }
        self.cells.binary_search(&(row * self.columns + column)).ok().map(|state| state as u32)
    }

    /// State entered by each direction (north, south, east, west), shape `(n_states, 4)`.
    pub(super) fn moves(&self) -> Vec<u32> {
        let mut next = Vec::with_capacity(self.cells.len() * 4);
        for (state, (row, column)) in self.positions().enumerate() {
            // A wrapped subtraction lies off the grid, as it should.
            let places =
                [(row.wrapping_sub(1), column), (row + 1, column), (row, column + 1), (row, column.wrapping_sub(1))];
            next.extend(places.map(|(row, column)| self.state_at(row, column).unwrap_or(state as u32)));
        }
        next
    }
}

/// A row or column. JSON numbers of other languages may be floating point: 3.0 is 3.
fn index(value: &Value) -> Option<u32> {
    let number = value.as_f64()?;
    (number >= 0.0 && number <= MAX_CELLS as f64 && number.fract() == 0.0).then_some(number as u32)
}

fn read_reward(value: &Value) -> Result<f64, OptionError> {
    match value.as_f64() {
        Some(reward) if reward.abs() <= MAX_REWARD => Ok(reward),
        _ => Err(error(
            "rewards",
            format!("expected a reward from {} to {MAX_REWARD}, got {}", -MAX_REWARD, kind(value)),
        )),
    }
}
