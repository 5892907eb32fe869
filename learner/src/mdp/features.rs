//! A user's features Φ(s,a): named columns over state-action pairs, sparse row by row.
//!
//! Invariants: at least one feature; as many names as features; every value finite.

/// A named feature table over the state-action pairs of a process.
#[derive(Debug, Clone, PartialEq)]
pub struct Features {
    names: Vec<String>,
    offsets: Vec<usize>,
    columns: Vec<u32>,
    values: Vec<f64>,
}

/// Why a table is not one of features.
#[derive(Debug, Clone, PartialEq, thiserror::Error)]
pub enum FeaturesError {
    /// Wrong number of entries.
    #[error(
        "expected a feature table of {n_rows} rows and {n_features} columns with at least one column, got {got} entries"
    )]
    Shape {
        /// Number of rows.
        n_rows: usize,
        /// Number of features.
        n_features: usize,
        /// What came.
        got: usize,
    },
    /// Not a number.
    #[error("expected finite features, got {value} for feature {name} in row {row}")]
    NotFinite {
        /// Row of the table.
        row: usize,
        /// Name of the feature.
        name: String,
        /// What came.
        value: f64,
    },
    /// A name that no feature has.
    #[error("expected one of the features {known}, got {name}")]
    Unknown {
        /// What came.
        name: String,
        /// What there is.
        known: String,
    },
}

impl Features {
    /// Features of state-action pairs: `table` has shape (`n_pairs`, `names.len()`), row-major.
    ///
    /// # Errors
    /// Another shape, or an entry that is not finite.
    pub fn of_pairs(n_pairs: usize, names: Vec<String>, table: &[f64]) -> Result<Self, FeaturesError> {
        Self::new(n_pairs, 1, names, table)
    }

    /// Features of states, the same for every action: `table` has shape (`n_states`, `names.len()`), row-major.
    ///
    /// # Errors
    /// Another shape, or an entry that is not finite.
    pub fn of_states(
        n_states: usize,
        n_actions: usize,
        names: Vec<String>,
        table: &[f64],
    ) -> Result<Self, FeaturesError> {
        Self::new(n_states, n_actions, names, table)
    }

    fn new(n_rows: usize, repeated: usize, names: Vec<String>, table: &[f64]) -> Result<Self, FeaturesError> {
        let n_features = names.len();
        if n_features == 0 || n_rows.checked_mul(n_features) != Some(table.len()) {
            return Err(FeaturesError::Shape { n_rows, n_features, got: table.len() });
        }
        let (mut offsets, mut columns, mut values) = (vec![0], Vec::new(), Vec::new());
        for (row, features) in table.chunks_exact(n_features).enumerate() {
            for (name, &value) in names.iter().zip(features) {
                if !value.is_finite() {
                    return Err(FeaturesError::NotFinite { row, name: name.clone(), value });
                }
            }
            for _ in 0..repeated {
                for (column, &value) in features.iter().enumerate().filter(|(_, value)| **value != 0.0) {
                    columns.push(column as u32);
                    values.push(value);
                }
                offsets.push(columns.len());
            }
        }
        Ok(Self { names, offsets, columns, values })
    }

    /// The features of these names, in their order.
    ///
    /// # Errors
    /// A name that no feature has, or no name.
    pub fn select(&self, names: &[String]) -> Result<Self, FeaturesError> {
        let unknown = |name: &String| FeaturesError::Unknown { name: name.clone(), known: self.names.join(", ") };
        let wanted: Vec<usize> = names
            .iter()
            .map(|name| self.names.iter().position(|known| known == name).ok_or_else(|| unknown(name)))
            .collect::<Result<_, _>>()?;
        let mut table = vec![0.0; self.n_pairs() * names.len()];
        for (pair, row) in table.chunks_exact_mut(names.len().max(1)).enumerate() {
            let (columns, values) = self.row(pair);
            for (slot, &column) in row.iter_mut().zip(&wanted) {
                if let Some(entry) = columns.iter().position(|&c| c as usize == column) {
                    *slot = values[entry];
                }
            }
        }
        Self::of_pairs(self.n_pairs(), names.to_vec(), &table)
    }

    /// Names, shape (`n_features`,).
    pub fn names(&self) -> &[String] {
        &self.names
    }

    /// Number of features, at least 1.
    #[expect(clippy::len_without_is_empty, reason = "there is always a feature")]
    pub fn len(&self) -> usize {
        self.names.len()
    }

    /// Number of state-action pairs.
    pub fn n_pairs(&self) -> usize {
        self.offsets.len() - 1
    }

    /// Φ(s,a) of a pair: the features that are not zero there, rising, and their values.
    pub fn row(&self, pair: usize) -> (&[u32], &[f64]) {
        let entries = self.offsets[pair]..self.offsets[pair + 1];
        (&self.columns[entries.clone()], &self.values[entries])
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn names(names: &[&str]) -> Vec<String> {
        names.iter().map(|&name| name.to_owned()).collect()
    }

    #[test]
    fn rows_hold_what_is_not_zero() {
        let features = Features::of_states(2, 2, names(&["x", "y"]), &[1.0, 0.0, -2.0, 3.0]).expect("features");
        assert_eq!((features.len(), features.n_pairs()), (2, 4));
        for pair in 0..2 {
            assert_eq!(features.row(pair), ([0].as_slice(), [1.0].as_slice()));
            assert_eq!(features.row(2 + pair), ([0, 1].as_slice(), [-2.0, 3.0].as_slice()));
        }
        let turned = features.select(&names(&["y", "x"])).expect("both");
        assert_eq!(turned.row(0), ([1].as_slice(), [1.0].as_slice()));
        assert_eq!(turned.row(2), ([0, 1].as_slice(), [3.0, -2.0].as_slice()));
    }

    #[test]
    fn what_is_no_table_is_refused() {
        let error = Features::of_pairs(2, names(&["x"]), &[0.0]).expect_err("too short");
        assert_eq!(error, FeaturesError::Shape { n_rows: 2, n_features: 1, got: 1 });
        assert!(matches!(Features::of_pairs(2, Vec::new(), &[]), Err(FeaturesError::Shape { .. })));
        let error = Features::of_pairs(2, names(&["x"]), &[0.0, f64::NAN]).expect_err("not a number");
        assert_eq!(error.to_string(), "expected finite features, got NaN for feature x in row 1");
        let features = Features::of_pairs(1, names(&["x", "y"]), &[0.0, 1.0]).expect("features");
        let error = features.select(&names(&["z"])).expect_err("unknown");
        assert_eq!(error.to_string(), "expected one of the features x, y, got z");
        assert!(matches!(features.select(&[]), Err(FeaturesError::Shape { .. })));
    }
}
