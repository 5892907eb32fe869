//! Sparse LU of I − γP_π without pivots, in an order of approximate minimum degree (Amestoy, Davis & Duff 1996).
//!
//! The order and the fill depend on the model alone (on the pattern of M + Mᵀ, so that L and Uᵀ share it) and are found
//! once; a policy costs the numbers. The order is the crate `amd`'s; the fill follows from it along the elimination tree
//! (Liu 1990), and is known before any memory is taken for it.

use super::pattern::Matrix;

/// Order of elimination and pattern of the factors.
#[derive(Clone)]
pub(super) struct Symbolic {
    /// State eliminated at each place.
    order: Vec<u32>,
    /// Place of each state.
    place: Vec<u32>,
    upper: Rows,
    lower: Rows,
}

/// Rows of places, rising, without the diagonal.
#[derive(Clone)]
struct Rows {
    offsets: Vec<usize>,
    columns: Vec<u32>,
}

impl Rows {
    fn range(&self, row: usize) -> std::ops::Range<usize> {
        self.offsets[row]..self.offsets[row + 1]
    }

    fn transposed(&self) -> Self {
        let n = self.offsets.len() - 1;
        let mut offsets = vec![0; n + 1];
        for &column in &self.columns {
            offsets[column as usize + 1] += 1;
        }
        for row in 0..n {
            offsets[row + 1] += offsets[row];
        }
        let mut next = offsets.clone();
        let mut columns = vec![0; self.columns.len()];
        for row in 0..n {
            for &column in &self.columns[self.range(row)] {
                columns[next[column as usize]] = row as u32;
                next[column as usize] += 1;
            }
        }
        Self { offsets, columns }
    }
}

impl Symbolic {
    /// None where the factorisation would take more than `bearable` multiplications.
    pub(super) fn of(matrix: &Matrix, bearable: u64) -> Option<Self> {
        let n = matrix.n_states();
        let offsets = matrix.offsets().iter().map(|&at| at as i64).collect::<Vec<_>>();
        let columns = matrix.columns().iter().map(|&column| i64::from(column)).collect::<Vec<_>>();
        let (order, place, _) = amd::order(n as i64, &offsets, &columns, &amd::Control::default()).ok()?;
        let order: Vec<u32> = order.into_iter().map(|state| state as u32).collect();
        let place: Vec<u32> = place.into_iter().map(|at| at as u32).collect();
        let upper = fill(matrix, &order, &place, bearable)?;
        Some(Self { lower: upper.transposed(), order, place, upper })
    }

    /// Multiplications of a factorisation.
    pub(super) fn multiplications(&self) -> u64 {
        self.upper.offsets.windows(2).map(|row| ((row[1] - row[0]) as u64).pow(2)).sum()
    }

    /// Entries of both factors without the diagonal.
    pub(super) fn n_entries(&self) -> usize {
        2 * self.upper.columns.len()
    }
}

/// Rows of U: what a place refers to, and what those that are eliminated before it and lead to it first leave it.
fn fill(matrix: &Matrix, order: &[u32], place: &[u32], bearable: u64) -> Option<Rows> {
    let n = order.len();
    // places after each place that refer to it, or that it refers to
    let mut neighbours: Vec<Vec<u32>> = vec![Vec::new(); n];
    for state in 0..n {
        let at = place[state];
        for &s in matrix.row(state).0 {
            let other = place[s as usize];
            if other != at {
                neighbours[at.min(other) as usize].push(at.max(other));
            }
        }
    }
    let mut upper = Rows { offsets: Vec::with_capacity(n + 1), columns: Vec::new() };
    upper.offsets.push(0);
    let mut children: Vec<Vec<u32>> = vec![Vec::new(); n];
    let mut seen = vec![u32::MAX; n];
    let mut multiplications = 0_u64;
    for at in 0..n {
        let begin = upper.columns.len();
        seen[at] = at as u32;
        for column in std::mem::take(&mut neighbours[at]) {
            if std::mem::replace(&mut seen[column as usize], at as u32) != at as u32 {
                upper.columns.push(column);
            }
        }
        for child in std::mem::take(&mut children[at]) {
            for entry in upper.range(child as usize) {
                let column = upper.columns[entry];
                if std::mem::replace(&mut seen[column as usize], at as u32) != at as u32 {
                    upper.columns.push(column);
                }
            }
        }
        multiplications += ((upper.columns.len() - begin) as u64).pow(2);
        if multiplications > bearable {
            return None;
        }
        upper.columns[begin..].sort_unstable();
        if let Some(&parent) = upper.columns.get(begin) {
            children[parent as usize].push(at as u32);
        }
        upper.offsets.push(upper.columns.len());
    }
    Some(upper)
}

/// A number as factors keep it; all work on them is done in double precision.
pub(super) trait Kept: Copy + Default + Into<f64> {
    /// The nearest.
    fn of(value: f64) -> Self;
}

impl Kept for f64 {
    fn of(value: f64) -> Self {
        value
    }
}

impl Kept for f32 {
    fn of(value: f64) -> Self {
        value as Self
    }
}

/// L (unit diagonal) and U of M in the order of a [`Symbolic`].
#[derive(Clone)]
pub(super) struct Factor<V = f64> {
    symbolic: Symbolic,
    upper: Vec<V>,
    lower: Vec<V>,
    inverse_diagonal: Vec<f64>,
    work: Vec<f64>,
}

impl<V: Kept> Factor<V> {
    pub(super) fn new(symbolic: Symbolic) -> Self {
        let (n, fill) = (symbolic.order.len(), symbolic.upper.columns.len());
        Self {
            symbolic,
            upper: vec![V::default(); fill],
            lower: vec![V::default(); fill],
            inverse_diagonal: vec![0.0; n],
            work: vec![0.0; n],
        }
    }

    /// Row by row: each takes off what the rows before it that it refers to hold.
    pub(super) fn factorise(&mut self, matrix: &Matrix) {
        let Self { symbolic, upper, lower, inverse_diagonal, work } = self;
        for (row, &state) in symbolic.order.iter().enumerate() {
            let (columns, values) = matrix.row(state as usize);
            for (&s, &m) in columns.iter().zip(values) {
                work[symbolic.place[s as usize] as usize] = m;
            }
            for at in symbolic.lower.range(row) {
                let pivot = symbolic.lower.columns[at] as usize;
                let multiplier = std::mem::take(&mut work[pivot]) * inverse_diagonal[pivot];
                lower[at] = V::of(multiplier);
                if multiplier != 0.0 {
                    let range = symbolic.upper.range(pivot);
                    subtract(work, multiplier, &symbolic.upper.columns[range.clone()], &upper[range]);
                }
            }
            inverse_diagonal[row] = 1.0 / std::mem::take(&mut work[row]);
            let range = symbolic.upper.range(row);
            for (u, &column) in upper[range.clone()].iter_mut().zip(&symbolic.upper.columns[range]) {
                *u = V::of(std::mem::take(&mut work[column as usize]));
            }
        }
    }

    /// The order and pattern.
    pub(super) fn symbolic(&self) -> &Symbolic {
        &self.symbolic
    }

    /// x of M x = b or Mᵀ x = b.
    pub(super) fn solve(&self, b: &[f64], transposed: bool) -> Vec<f64> {
        let (mut work, mut x) = (vec![0.0; b.len()], vec![0.0; b.len()]);
        self.solve_into(b, transposed, &mut work, &mut x);
        x
    }

    /// As [`Factor::solve`], in memory that the caller keeps; all of shape (`n_states`,).
    pub(super) fn solve_into(&self, b: &[f64], transposed: bool, y: &mut [f64], x: &mut [f64]) {
        let symbolic = &self.symbolic;
        let n = b.len();
        for (y, &state) in y.iter_mut().zip(&symbolic.order) {
            *y = b[state as usize];
        }
        if transposed {
            for row in 0..n {
                y[row] *= self.inverse_diagonal[row];
                let range = symbolic.upper.range(row);
                let known = y[row];
                subtract(y, known, &symbolic.upper.columns[range.clone()], &self.upper[range]);
            }
            for row in (0..n).rev() {
                let range = symbolic.lower.range(row);
                let known = y[row];
                subtract(y, known, &symbolic.lower.columns[range.clone()], &self.lower[range]);
            }
        } else {
            for row in 0..n {
                let range = symbolic.lower.range(row);
                y[row] -= product(y, &symbolic.lower.columns[range.clone()], &self.lower[range]);
            }
            for row in (0..n).rev() {
                let range = symbolic.upper.range(row);
                y[row] -= product(y, &symbolic.upper.columns[range.clone()], &self.upper[range]);
                y[row] *= self.inverse_diagonal[row];
            }
        }
        for (x, &at) in x.iter_mut().zip(&symbolic.place) {
            *x = y[at as usize];
        }
    }
}

/// y(columns) −= factor · values. Columns rise, so where they are consecutive a plain slice serves.
fn subtract<V: Kept>(y: &mut [f64], factor: f64, columns: &[u32], values: &[V]) {
    let (Some(&first), Some(&last)) = (columns.first(), columns.last()) else { return };
    if (last - first) as usize + 1 == columns.len() {
        for (y, &v) in y[first as usize..=last as usize].iter_mut().zip(values) {
            *y -= factor * v.into();
        }
    } else {
        for (&column, &v) in columns.iter().zip(values) {
            y[column as usize] -= factor * v.into();
        }
    }
}

fn product<V: Kept>(y: &[f64], columns: &[u32], values: &[V]) -> f64 {
    columns.iter().zip(values).map(|(&column, &v)| v.into() * y[column as usize]).sum()
}
