//! Sparse LU of I − γP_π without pivots, in an order of minimum degree.
//!
//! The order and the fill depend on the model alone (on the pattern of M + Mᵀ, so that L and Uᵀ share it) and are found
//! once; a policy costs the numbers. The order is the plain greedy one (Tinney & Walker 1967) on the elimination graph
//! itself: for the few thousand states that are factored at all, quotient graphs save nothing.

use super::pattern::Matrix;
use std::cmp::Reverse;
use std::collections::BinaryHeap;

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
}

impl Symbolic {
    /// None where the factorisation would take more than `bearable` multiplications.
    pub(super) fn minimum_degree(matrix: &Matrix, bearable: u64) -> Option<Self> {
        let n = matrix.n_states();
        let mut neighbours: Vec<Vec<u32>> = vec![Vec::new(); n];
        for state in 0..n {
            for &s in matrix.row(state).0 {
                if s as usize != state {
                    neighbours[state].push(s);
                    neighbours[s as usize].push(state as u32);
                }
            }
        }
        let mut queue = BinaryHeap::with_capacity(2 * n);
        for (state, all) in neighbours.iter_mut().enumerate() {
            all.sort_unstable();
            all.dedup();
            queue.push(Reverse((all.len(), state as u32)));
        }
        let mut order = Vec::with_capacity(n);
        let mut eliminated = vec![false; n];
        let mut structure: Vec<Vec<u32>> = Vec::with_capacity(n);
        let mut multiplications = 0_u64;
        let mut merged = Vec::new();
        while let Some(Reverse((degree, state))) = queue.pop() {
            let v = state as usize;
            if eliminated[v] || neighbours[v].len() != degree {
                continue;
            }
            multiplications += (degree * degree) as u64;
            if multiplications > bearable {
                return None;
            }
            if degree + 1 == n - order.len() {
                // what is left is one clique: any order is as good
                multiplications += (0..degree as u64).map(|d| d * d).sum::<u64>();
                if multiplications > bearable {
                    return None;
                }
                let left: Vec<u32> = (0..n as u32).filter(|&s| !eliminated[s as usize]).collect();
                structure.extend((0..left.len()).map(|first| left[first + 1..].to_vec()));
                order.extend(left);
                break;
            }
            eliminated[v] = true;
            order.push(state);
            let clique = std::mem::take(&mut neighbours[v]);
            for &u in &clique {
                merge(&neighbours[u as usize], &clique, u, state, &mut merged);
                if merged != neighbours[u as usize] {
                    queue.push(Reverse((merged.len(), u)));
                    std::mem::swap(&mut neighbours[u as usize], &mut merged);
                }
            }
            structure.push(clique);
        }
        let mut place = vec![0; n];
        for (at, &state) in order.iter().enumerate() {
            place[state as usize] = at as u32;
        }
        Some(Self::from_structure(order, place, structure))
    }

    fn from_structure(order: Vec<u32>, place: Vec<u32>, structure: Vec<Vec<u32>>) -> Self {
        let n = order.len();
        let mut upper = Rows { offsets: vec![0], columns: Vec::new() };
        let mut in_row = vec![0; n + 1];
        for row in structure {
            let begin = upper.columns.len();
            upper.columns.extend(row.iter().map(|&s| place[s as usize]));
            upper.columns[begin..].sort_unstable();
            upper.offsets.push(upper.columns.len());
            for &column in &upper.columns[begin..] {
                in_row[column as usize + 1] += 1;
            }
        }
        for row in 0..n {
            in_row[row + 1] += in_row[row];
        }
        // L has the pattern of Uᵀ
        let mut lower = Rows { offsets: in_row.clone(), columns: vec![0; upper.columns.len()] };
        for row in 0..n {
            for &column in &upper.columns[upper.range(row)] {
                lower.columns[in_row[column as usize]] = row as u32;
                in_row[column as usize] += 1;
            }
        }
        Self { order, place, upper, lower }
    }
}

/// (a ∪ clique) without u and v; both rise, and so does the result.
fn merge(a: &[u32], clique: &[u32], u: u32, v: u32, out: &mut Vec<u32>) {
    out.clear();
    let (mut i, mut j) = (0, 0);
    while i < a.len() || j < clique.len() {
        let left = a.get(i).copied().unwrap_or(u32::MAX);
        let right = clique.get(j).copied().unwrap_or(u32::MAX);
        let next = left.min(right);
        i += usize::from(left == next);
        j += usize::from(right == next);
        if next != u && next != v {
            out.push(next);
        }
    }
}

/// L (unit diagonal) and U of M in the order of a [`Symbolic`].
#[derive(Clone)]
pub(super) struct Factor {
    symbolic: Symbolic,
    upper: Vec<f64>,
    lower: Vec<f64>,
    inverse_diagonal: Vec<f64>,
    work: Vec<f64>,
}

impl Factor {
    pub(super) fn new(symbolic: Symbolic) -> Self {
        let (n, fill) = (symbolic.order.len(), symbolic.upper.columns.len());
        Self {
            symbolic,
            upper: vec![0.0; fill],
            lower: vec![0.0; fill],
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
                lower[at] = multiplier;
                if multiplier != 0.0 {
                    let range = symbolic.upper.range(pivot);
                    subtract(work, multiplier, &symbolic.upper.columns[range.clone()], &upper[range]);
                }
            }
            inverse_diagonal[row] = 1.0 / std::mem::take(&mut work[row]);
            let range = symbolic.upper.range(row);
            for (u, &column) in upper[range.clone()].iter_mut().zip(&symbolic.upper.columns[range]) {
                *u = std::mem::take(&mut work[column as usize]);
            }
        }
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
fn subtract(y: &mut [f64], factor: f64, columns: &[u32], values: &[f64]) {
    let (Some(&first), Some(&last)) = (columns.first(), columns.last()) else { return };
    if (last - first) as usize + 1 == columns.len() {
        for (y, &v) in y[first as usize..=last as usize].iter_mut().zip(values) {
            *y -= factor * v;
        }
    } else {
        for (&column, &v) in columns.iter().zip(values) {
            y[column as usize] -= factor * v;
        }
    }
}

fn product(y: &[f64], columns: &[u32], values: &[f64]) -> f64 {
    columns.iter().zip(values).map(|(&column, &v)| v * y[column as usize]).sum()
}
