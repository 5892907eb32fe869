//! Basis functions Φ(s,a) of the reward R = wᵀΦ.

use crate::mdp::TabularMdp;

/// Φ, one sparse row a state-action pair.
#[derive(Debug, Clone, PartialEq)]
pub struct Basis {
    n_pairs: usize,
    n_functions: usize,
    kind: Kind,
}

#[derive(Debug, Clone, PartialEq)]
enum Kind {
    /// Φ_b(s,a) = [s = b].
    State { n_actions: usize },
    /// Φ_b(s,a) = [(s,a) = b].
    StateAction,
    /// Entries that are not zero, row by row.
    Features { offsets: Vec<usize>, columns: Vec<u32>, values: Vec<f64> },
}

/// Why a table is not a basis.
#[derive(Debug, Clone, PartialEq, thiserror::Error)]
pub enum BasisError {
    /// Wrong number of entries.
    #[error(
        "expected a feature table of {n_pairs} rows and {n_basis} columns with at least one column, got {got} entries"
    )]
    Shape {
        /// Number of state-action pairs.
        n_pairs: usize,
        /// Number of features.
        n_basis: usize,
        /// What came.
        got: usize,
    },
    /// Not a number.
    #[error("expected finite features, got {value} in row {row}")]
    NotFinite {
        /// State-action pair.
        row: usize,
        /// What came.
        value: f64,
    },
}

impl Basis {
    /// Dirac on states, `n_states` functions.
    #[must_use]
    pub fn state(mdp: &TabularMdp) -> Self {
        Self { n_pairs: mdp.n_pairs(), n_functions: mdp.n_states(), kind: Kind::State { n_actions: mdp.n_actions() } }
    }

    /// Dirac on state-action pairs, `n_states * n_actions` functions.
    #[must_use]
    pub fn state_action(mdp: &TabularMdp) -> Self {
        Self { n_pairs: mdp.n_pairs(), n_functions: mdp.n_pairs(), kind: Kind::StateAction }
    }

    /// A feature table of shape (`n_states * n_actions`, `n_basis`), row-major.
    ///
    /// # Errors
    /// Another shape, or an entry that is not finite.
    pub fn features(mdp: &TabularMdp, n_basis: usize, table: &[f64]) -> Result<Self, BasisError> {
        let n_pairs = mdp.n_pairs();
        if n_basis == 0 || n_pairs.checked_mul(n_basis) != Some(table.len()) {
            return Err(BasisError::Shape { n_pairs, n_basis, got: table.len() });
        }
        let (mut offsets, mut columns, mut values) = (vec![0], Vec::new(), Vec::new());
        for (row, features) in table.chunks_exact(n_basis).enumerate() {
            for (column, &value) in features.iter().enumerate() {
                if !value.is_finite() {
                    return Err(BasisError::NotFinite { row, value });
                }
                if value != 0.0 {
                    columns.push(column as u32);
                    values.push(value);
                }
            }
            offsets.push(columns.len());
        }
        Ok(Self { n_pairs, n_functions: n_basis, kind: Kind::Features { offsets, columns, values } })
    }

    /// Number of basis functions B.
    pub fn len(&self) -> usize {
        self.n_functions
    }

    /// Never: a basis has at least one function.
    pub fn is_empty(&self) -> bool {
        self.n_functions == 0
    }

    /// Calls `visit` with each basis function that is not zero at a pair, and its value there.
    pub fn for_each(&self, pair: usize, mut visit: impl FnMut(usize, f64)) {
        match &self.kind {
            Kind::State { n_actions } => visit(pair / n_actions, 1.0),
            Kind::StateAction => visit(pair, 1.0),
            Kind::Features { offsets, columns, values } => {
                for entry in offsets[pair]..offsets[pair + 1] {
                    visit(columns[entry] as usize, values[entry]);
                }
            }
        }
    }

    /// R(s,a) = wᵀΦ(s,a), shape (`n_states * n_actions`,).
    pub fn reward(&self, weights: &[f64]) -> Vec<f64> {
        let mut reward = vec![0.0; self.n_pairs];
        for (pair, r) in reward.iter_mut().enumerate() {
            self.for_each(pair, |b, value| *r += value * weights[b]);
        }
        reward
    }

    /// Σ_{s,a} values(s,a) Φ(s,a), shape (`n_basis`,).
    pub fn project(&self, values: &[f64]) -> Vec<f64> {
        let mut projected = vec![0.0; self.n_functions];
        for (pair, &v) in values.iter().enumerate() {
            if v != 0.0 {
                self.for_each(pair, |b, value| projected[b] += value * v);
            }
        }
        projected
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn rewards_and_projections_are_adjoint() {
        let mdp = TabularMdp::new(2, 2, vec![0, 1, 2, 3, 4], vec![0, 1, 1, 0], vec![1.0; 4], None).expect("a model");
        let table = [1.0, 0.0, -2.0, 0.0, 3.0, 0.5, 0.0, 0.0, 4.0, 1.0, 1.0, 1.0];
        let all = [Basis::state(&mdp), Basis::state_action(&mdp), Basis::features(&mdp, 3, &table).expect("a basis")];
        assert_eq!(all.each_ref().map(Basis::len), [2, 4, 3]);
        for basis in all {
            let weights: Vec<f64> = (0..basis.len()).map(|b| 1.0 + b as f64).collect();
            let values = [0.5, -1.0, 2.0, 0.25];
            let left: f64 = basis.reward(&weights).iter().zip(values).map(|(r, v)| r * v).sum();
            let right: f64 = basis.project(&values).iter().zip(&weights).map(|(p, w)| p * w).sum();
            assert!((left - right).abs() < 1e-12);
        }
        assert!(matches!(Basis::features(&mdp, 3, &table[1..]), Err(BasisError::Shape { .. })));
        assert!(matches!(Basis::features(&mdp, 0, &[]), Err(BasisError::Shape { .. })));
        assert!(matches!(
            Basis::features(&mdp, 1, &[0.0, 0.0, f64::NAN, 0.0]),
            Err(BasisError::NotFinite { row: 2, .. })
        ));
    }
}
