//! Non-negative least squares: Lawson & Hanson (1974), "Solving Least Squares Problems", ch. 23.
//!
//! The passive columns' QR factorisation is updated as columns come and go (Gram-Schmidt with reorthogonalisation to add,
//! Givens rotations to drop), so an exchange costs O(rows · passive) and the normal equations are never formed.

use nalgebra::{DMatrix, DVector};

/// Solution of min ‖A x − b‖ over x ≥ 0.
#[derive(Debug, Clone, PartialEq)]
pub struct Nnls {
    /// x, shape (columns,).
    pub solution: Vec<f64>,
    /// ‖A x − b‖.
    pub residual_norm: f64,
    /// Columns that came in.
    pub iterations: usize,
    /// False where the exchanges ran out; the solution is feasible all the same.
    pub converged: bool,
}

/// A column enters only where it lowers the residual by more than this, relative to the lengths of column and b.
const GRADIENT_TOLERANCE: f64 = 1e-13;
/// A column whose part outside the passive columns' span is shorter than this share of it counts as dependent.
const DEPENDENCE_TOLERANCE: f64 = 1e-11;

/// Solves min ‖A x − b‖ over x ≥ 0. Where columns are linearly dependent one of the solutions is returned.
///
/// # Panics
/// Where `a` and `b` differ in rows.
pub fn nnls(a: &DMatrix<f64>, b: &DVector<f64>) -> Nnls {
    assert_eq!(a.nrows(), b.len(), "expected as many rows as right-hand sides");
    let n = a.ncols();
    let lengths: Vec<f64> = a.column_iter().map(|column| column.norm()).collect();
    let b_length = b.norm();
    let mut x = vec![0.0; n];
    let mut factor = Factor::new(a.nrows());
    let mut iterations = 0;
    let mut converged = true;
    // a column that was refused since x last moved
    let mut refused = vec![false; n];
    loop {
        let residual = b - product(a, &x);
        let entering = (0..n)
            .filter(|j| !refused[*j] && !factor.passive.contains(j))
            .map(|j| (j, a.column(j).dot(&residual)))
            .filter(|&(j, gradient)| gradient > GRADIENT_TOLERANCE * lengths[j] * b_length)
            // scaled, so that the choice does not depend on the columns' units; the first of equals
            .map(|(j, gradient)| (j, gradient / lengths[j]))
            .fold(
                None,
                |best: Option<(usize, f64)>, now| if best.is_none_or(|b| now.1 > b.1) { Some(now) } else { best },
            );
        let Some((entering, _)) = entering else { break };
        if iterations >= 10 * n + 100 {
            converged = false;
            break;
        }
        iterations += 1;
        if !factor.add(entering, &a.column(entering).into_owned()) {
            refused[entering] = true;
            continue;
        }
        let mut candidate = factor.solve(b);
        if candidate.last().is_none_or(|&z| z <= 0.0) {
            factor.drop(factor.passive.len() - 1);
            refused[entering] = true;
            continue;
        }
        refused.fill(false);
        while candidate.iter().any(|&z| z <= 0.0) {
            let step = factor
                .passive
                .iter()
                .zip(&candidate)
                .filter(|&(_, &z)| z <= 0.0)
                .map(|(&j, &z)| x[j] / (x[j] - z))
                .fold(1.0, f64::min);
            let mut leaving = Vec::new();
            for (rank, (&j, &z)) in factor.passive.iter().zip(&candidate).enumerate() {
                let blocked = z <= 0.0 && x[j] / (x[j] - z) <= step;
                x[j] += step * (z - x[j]);
                if blocked || x[j] <= 0.0 {
                    x[j] = 0.0;
                    leaving.push(rank);
                }
            }
            for rank in leaving.into_iter().rev() {
                factor.drop(rank);
            }
            candidate = factor.solve(b);
        }
        for (&j, &z) in factor.passive.iter().zip(&candidate) {
            x[j] = z;
        }
    }
    let residual_norm = (b - product(a, &x)).norm();
    Nnls { solution: x, residual_norm, iterations, converged }
}

fn product(a: &DMatrix<f64>, x: &[f64]) -> DVector<f64> {
    let mut sum = DVector::zeros(a.nrows());
    for (column, &x) in a.column_iter().zip(x) {
        if x != 0.0 {
            sum.axpy(x, &column, 1.0);
        }
    }
    sum
}

/// Thin QR of the passive columns, in the order in which they came.
struct Factor {
    rows: usize,
    passive: Vec<usize>,
    q: Vec<DVector<f64>>,
    /// Columns of R: the i-th holds i + 1 entries.
    r: Vec<Vec<f64>>,
}

impl Factor {
    fn new(rows: usize) -> Self {
        Self { rows, passive: Vec::new(), q: Vec::new(), r: Vec::new() }
    }

    /// False where the column depends on the passive ones.
    fn add(&mut self, index: usize, column: &DVector<f64>) -> bool {
        if self.q.len() >= self.rows {
            return false;
        }
        let mut rest = column.clone();
        let mut coefficients = vec![0.0; self.q.len()];
        for _pass in 0..2 {
            for (q, c) in self.q.iter().zip(&mut coefficients) {
                let projection = q.dot(&rest);
                rest.axpy(-projection, q, 1.0);
                *c += projection;
            }
        }
        let length = rest.norm();
        if length <= DEPENDENCE_TOLERANCE * column.norm() {
            return false;
        }
        coefficients.push(length);
        self.passive.push(index);
        self.q.push(rest / length);
        self.r.push(coefficients);
        true
    }

    fn drop(&mut self, rank: usize) {
        self.passive.remove(rank);
        self.r.remove(rank);
        // what follows is upper Hessenberg: rotate rows (i, i + 1)
        for i in rank..self.r.len() {
            let (above, below) = (self.r[i][i], self.r[i][i + 1]);
            let length = above.hypot(below);
            let (cos, sin) = if length > 0.0 { (above / length, below / length) } else { (1.0, 0.0) };
            for column in &mut self.r[i..] {
                let (upper, lower) = (column[i], column[i + 1]);
                column[i] = cos * upper + sin * lower;
                column[i + 1] = cos * lower - sin * upper;
            }
            self.r[i].truncate(i + 1);
            let (head, tail) = self.q.split_at_mut(i + 1);
            for (upper, lower) in head[i].iter_mut().zip(tail[0].iter_mut()) {
                let (u, l) = (*upper, *lower);
                *upper = cos * u + sin * l;
                *lower = cos * l - sin * u;
            }
        }
        self.q.pop();
    }

    /// Least-squares solution on the passive columns.
    fn solve(&self, b: &DVector<f64>) -> Vec<f64> {
        let mut z: Vec<f64> = self.q.iter().map(|q| q.dot(b)).collect();
        for i in (0..z.len()).rev() {
            z[i] /= self.r[i][i];
            let value = z[i];
            for (z, r) in z[..i].iter_mut().zip(&self.r[i]) {
                *z -= r * value;
            }
        }
        z
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    fn matrix(rows: usize, columns: usize, entries: &[f64]) -> DMatrix<f64> {
        DMatrix::from_iterator(rows, columns, entries.iter().copied().cycle().take(rows * columns))
    }

    /// x ≥ 0, no gradient where x > 0, none that x could follow elsewhere.
    fn assert_optimal(a: &DMatrix<f64>, b: &DVector<f64>, found: &Nnls) {
        assert!(found.converged);
        let residual = b - product(a, &found.solution);
        assert!((residual.norm() - found.residual_norm).abs() < 1e-9);
        for (column, &x) in a.column_iter().zip(&found.solution) {
            let gradient = column.dot(&residual);
            let scale = 1e-8 * (1.0 + column.norm() * b.norm());
            assert!(x >= 0.0);
            assert!(gradient <= scale, "gradient {gradient} at {x}");
            assert!(x == 0.0 || gradient >= -scale, "gradient {gradient} at {x}");
        }
    }

    proptest! {
        #[test]
        fn agrees_with_the_judge(
            (rows, columns) in (1_usize..12, 1_usize..12),
            entries in proptest::collection::vec(-3.0..3.0_f64, 144),
            sides in proptest::collection::vec(-3.0..3.0_f64, 12),
        ) {
            let a = matrix(rows, columns, &entries);
            let b = DVector::from_column_slice(&sides[..rows]);
            let found = nnls(&a, &b);
            assert_optimal(&a, &b, &found);
            let judge_a = ndarray::Array2::from_shape_fn((rows, columns), |(i, j)| a[(i, j)]);
            let judge_b = ndarray::Array1::from_iter(b.iter().copied());
            let (judge, norm) = ::nnls::nnls(judge_a.view(), judge_b.view());
            prop_assert!((norm - found.residual_norm).abs() < 1e-8, "residual {norm}, got {}", found.residual_norm);
            // with more rows than columns the solution is unique
            if rows >= columns {
                for (x, y) in judge.iter().zip(&found.solution) {
                    prop_assert!((x - y).abs() < 1e-6 * (1.0 + x.abs()), "{judge} and {:?}", found.solution);
                }
            }
        }

        #[test]
        fn copes_with_dependent_columns(
            rows in 2_usize..10,
            entries in proptest::collection::vec(-2_i32..3, 100),
            sides in proptest::collection::vec(-3_i32..4, 10),
        ) {
            // small integers: repeated, opposite and zero columns are common
            let entries: Vec<f64> = entries.into_iter().map(f64::from).collect();
            let a = matrix(rows, 10, &entries);
            let b = DVector::from_iterator(rows, sides.into_iter().take(rows).map(f64::from));
            assert_optimal(&a, &b, &nnls(&a, &b));
        }

        #[test]
        fn columns_of_any_unit(exponents in proptest::collection::vec(-4_i32..5, 6), entries in proptest::collection::vec(-3.0..3.0_f64, 48)) {
            let mut a = matrix(8, 6, &entries);
            let b = DVector::from_fn(8, |i, _| entries[47 - i]);
            let plain = nnls(&a, &b);
            for (j, &e) in exponents.iter().enumerate() {
                a.column_mut(j).scale_mut(10_f64.powi(e));
            }
            let scaled = nnls(&a, &b);
            prop_assert!((plain.residual_norm - scaled.residual_norm).abs() < 1e-9);
            for ((x, y), &e) in plain.solution.iter().zip(&scaled.solution).zip(&exponents) {
                prop_assert!((x - y * 10_f64.powi(e)).abs() < 1e-7 * (1.0 + x.abs()));
            }
        }
    }

    #[test]
    fn nothing_to_gain() {
        let a = matrix(2, 2, &[1.0, 0.0, 0.0, 1.0]);
        assert_eq!(nnls(&a, &DVector::from_column_slice(&[-1.0, -2.0])).solution, [0.0, 0.0]);
        assert_eq!(nnls(&a, &DVector::zeros(2)).solution, [0.0, 0.0]);
        assert_eq!(nnls(&DMatrix::zeros(2, 2), &DVector::from_column_slice(&[1.0, 2.0])).solution, [0.0, 0.0]);
    }
}
