//! M = I − γP_π in sparse rows whose pattern is the model's, whatever the policy.

use crate::mdp::TabularMdp;
use crate::mdp::numeric::norm;

/// Invariants: columns rise within a row; every row holds its diagonal entry.
#[derive(Clone)]
pub(super) struct Matrix {
    offsets: Vec<usize>,
    columns: Vec<u32>,
    values: Vec<f64>,
    /// Where each row's diagonal entry is.
    diagonal: Vec<usize>,
    /// Which entry each transition of the model adds to.
    entry_of_transition: Vec<u32>,
}

impl Matrix {
    /// The pattern of a model, all numbers 0.
    ///
    /// # Panics
    /// Where the model has 2³² or more transitions.
    pub(super) fn of_model(mdp: &TabularMdp) -> Self {
        let (n, n_actions) = (mdp.n_states(), mdp.n_actions());
        let next_states = mdp.next_states();
        assert!(u32::try_from(next_states.len() + n).is_ok(), "expected fewer than 4294967296 transitions");
        let mut matrix = Self {
            offsets: Vec::with_capacity(n + 1),
            columns: Vec::new(),
            values: Vec::new(),
            diagonal: Vec::with_capacity(n),
            entry_of_transition: Vec::with_capacity(next_states.len()),
        };
        matrix.offsets.push(0);
        let mut entry_of_column = vec![0_u32; n];
        // the state for which a column was seen last
        let mut seen = vec![usize::MAX; n];
        for state in 0..n {
            let begin = matrix.columns.len();
            let transitions = mdp.row_offsets()[state * n_actions]..mdp.row_offsets()[(state + 1) * n_actions];
            for &column in std::iter::once(&(state as u32)).chain(&next_states[transitions.clone()]) {
                if std::mem::replace(&mut seen[column as usize], state) != state {
                    matrix.columns.push(column);
                }
            }
            matrix.columns[begin..].sort_unstable();
            for (entry, &column) in matrix.columns.iter().enumerate().skip(begin) {
                entry_of_column[column as usize] = entry as u32;
            }
            matrix.diagonal.push(entry_of_column[state] as usize);
            matrix.entry_of_transition.extend(next_states[transitions].iter().map(|&s| entry_of_column[s as usize]));
            matrix.offsets.push(matrix.columns.len());
        }
        matrix.values = vec![0.0; matrix.columns.len()];
        matrix
    }

    /// I − γP_π of a policy, shape (`n_states * n_actions`,).
    pub(super) fn fill(&mut self, mdp: &TabularMdp, policy: &[f64], discount: f64) {
        self.values.fill(0.0);
        for &entry in &self.diagonal {
            self.values[entry] = 1.0;
        }
        for (&weight, rows) in policy.iter().zip(mdp.row_offsets().windows(2)) {
            if weight != 0.0 {
                let row = rows[0]..rows[1];
                for (&entry, &p) in self.entry_of_transition[row.clone()].iter().zip(&mdp.probabilities()[row]) {
                    self.values[entry as usize] -= discount * weight * p;
                }
            }
        }
    }

    pub(super) fn n_states(&self) -> usize {
        self.diagonal.len()
    }

    pub(super) fn n_entries(&self) -> usize {
        self.columns.len()
    }

    pub(super) fn offsets(&self) -> &[usize] {
        &self.offsets
    }

    pub(super) fn columns(&self) -> &[u32] {
        &self.columns
    }

    pub(super) fn values(&self) -> &[f64] {
        &self.values
    }

    /// Where each row's diagonal entry is.
    pub(super) fn diagonal(&self) -> &[usize] {
        &self.diagonal
    }

    /// Columns and values of a row.
    pub(super) fn row(&self, state: usize) -> (&[u32], &[f64]) {
        let entries = self.offsets[state]..self.offsets[state + 1];
        (&self.columns[entries.clone()], &self.values[entries])
    }

    /// out = M x or Mᵀ x.
    pub(super) fn multiply(&self, x: &[f64], transposed: bool, out: &mut [f64]) {
        if transposed {
            out.fill(0.0);
            for (state, &x) in x.iter().enumerate() {
                let (columns, values) = self.row(state);
                for (&s, &m) in columns.iter().zip(values) {
                    out[s as usize] += m * x;
                }
            }
        } else {
            for (state, o) in out.iter_mut().enumerate() {
                let (columns, values) = self.row(state);
                *o = columns.iter().zip(values).map(|(&s, &m)| m * x[s as usize]).sum();
            }
        }
    }

    /// ‖b − M x‖ / ‖b‖ or that of Mᵀ; 0 where b = 0.
    pub(super) fn relative_residual(&self, x: &[f64], b: &[f64], transposed: bool) -> f64 {
        let mut rest = vec![0.0; b.len()];
        self.multiply(x, transposed, &mut rest);
        for (r, &b) in rest.iter_mut().zip(b) {
            *r = b - *r;
        }
        let (rest, whole) = (norm(&rest), norm(b));
        if whole == 0.0 { rest } else { rest / whole }
    }
}
