//! BiCGSTAB (van der Vorst 1992), preconditioned by the incomplete LU factorisation without fill (Meijerink & van der Vorst
//! 1977), which exists for every M-matrix and makes a splitting whose plain iteration converges too; or by the whole
//! factorisation of an earlier policy.

use super::direct::{Factor, Kept};
use super::pattern::Matrix;
use crate::mdp::numeric::{dot, max_abs, norm};

/// Residual relative to the solution that rounding allows: as good as a factorisation's.
const ROUNDING: f64 = 1e-14;
/// How much above that it may have stalled.
const STALLED: f64 = 10.0;
/// Iterations between two restarts.
const MAX_ITERATIONS: u32 = 1000;
/// Iterations after which the pace tells whether those that are allowed suffice.
const PACE_TOLD: u32 = 4;

/// What nearly solves against M.
pub(super) trait Precondition {
    /// y ← M⁻¹ y or M⁻ᵀ y, nearly.
    fn apply(&self, matrix: &Matrix, transposed: bool, y: &mut [f64]);
}

impl<V: Kept> Precondition for Factor<V> {
    fn apply(&self, _matrix: &Matrix, transposed: bool, y: &mut [f64]) {
        let x = self.solve(y, transposed);
        y.copy_from_slice(&x);
    }
}

/// How long an iteration may go on.
#[derive(Debug, Clone, Copy)]
pub(super) struct Patience {
    /// So many iterations, about, at most.
    pub(super) most: u32,
    /// It ends before where its pace does not lead to the end within these.
    pub(super) minds_pace: bool,
}

/// What an iteration came to.
pub(super) struct Iterated {
    pub(super) x: Vec<f64>,
    /// Its residual is within what was wanted, or of rounding.
    pub(super) converged: bool,
    pub(super) iterations: u32,
}

/// L (unit diagonal) and U on the pattern of M, with the diagonal of U inverted.
#[derive(Default)]
pub(super) struct Incomplete {
    values: Vec<f64>,
    inverse_diagonal: Vec<f64>,
}

impl Incomplete {
    pub(super) fn factorise(&mut self, matrix: &Matrix) {
        let (offsets, columns, diagonal) = (matrix.offsets(), matrix.columns(), matrix.diagonal());
        let n = matrix.n_states();
        self.values.clear();
        self.values.extend_from_slice(matrix.values());
        self.inverse_diagonal.resize(n, 0.0);
        let values = &mut self.values;
        // entry of each column in the present row
        let mut entry = vec![usize::MAX; n];
        for row in 0..n {
            for at in offsets[row]..offsets[row + 1] {
                entry[columns[at] as usize] = at;
            }
            for at in offsets[row]..diagonal[row] {
                let pivot = columns[at] as usize;
                let multiplier = values[at] * self.inverse_diagonal[pivot];
                values[at] = multiplier;
                if multiplier != 0.0 {
                    for above in diagonal[pivot] + 1..offsets[pivot + 1] {
                        let target = entry[columns[above] as usize];
                        if target != usize::MAX {
                            values[target] -= multiplier * values[above];
                        }
                    }
                }
            }
            self.inverse_diagonal[row] = 1.0 / values[diagonal[row]];
            for &column in &columns[offsets[row]..offsets[row + 1]] {
                entry[column as usize] = usize::MAX;
            }
        }
    }

    /// x ← x + (LU)⁻¹ (b − M x): slow and sure.
    pub(super) fn sweeps(
        &self,
        matrix: &Matrix,
        b: &[f64],
        transposed: bool,
        mut x: Vec<f64>,
        tolerance: f64,
        most: u64,
    ) -> Vec<f64> {
        let mut step = vec![0.0; b.len()];
        for _ in 0..most {
            matrix.multiply(&x, transposed, &mut step);
            for (s, &b) in step.iter_mut().zip(b) {
                *s = b - *s;
            }
            if norm(&step) <= (tolerance * norm(b)).max(ROUNDING * norm(&x)) {
                break;
            }
            self.apply(matrix, transposed, &mut step);
            for (x, &s) in x.iter_mut().zip(&step) {
                *x += s;
            }
            if max_abs(&step) <= f64::EPSILON * max_abs(&x) {
                break;
            }
        }
        x
    }
}

impl Precondition for Incomplete {
    fn apply(&self, matrix: &Matrix, transposed: bool, y: &mut [f64]) {
        let (offsets, columns, diagonal) = (matrix.offsets(), matrix.columns(), matrix.diagonal());
        let n = y.len();
        let part = |range: std::ops::Range<usize>| columns[range.clone()].iter().zip(&self.values[range]);
        if transposed {
            for row in 0..n {
                let known = y[row] * self.inverse_diagonal[row];
                y[row] = known;
                for (&column, &u) in part(diagonal[row] + 1..offsets[row + 1]) {
                    y[column as usize] -= u * known;
                }
            }
            for row in (0..n).rev() {
                let known = y[row];
                for (&column, &l) in part(offsets[row]..diagonal[row]) {
                    y[column as usize] -= l * known;
                }
            }
        } else {
            for row in 0..n {
                let known: f64 = part(offsets[row]..diagonal[row]).map(|(&column, &l)| l * y[column as usize]).sum();
                y[row] -= known;
            }
            for row in (0..n).rev() {
                let known: f64 =
                    part(diagonal[row] + 1..offsets[row + 1]).map(|(&column, &u)| u * y[column as usize]).sum();
                y[row] = (y[row] - known) * self.inverse_diagonal[row];
            }
        }
    }
}

/// x of M x = b or Mᵀ x = b, to a residual of `tolerance` relative to b (or of rounding), as far as patience goes.
/// Restarted from the true residual, so that rounding does not end it early.
pub(super) fn bicgstab(
    (matrix, preconditioner): (&Matrix, &impl Precondition),
    b: &[f64],
    transposed: bool,
    tolerance: f64,
    start: Option<&[f64]>,
    patience: Patience,
) -> Iterated {
    let n = b.len();
    let target = tolerance * norm(b);
    if target == 0.0 {
        return Iterated { x: vec![0.0; n], converged: true, iterations: 0 };
    }
    let mut x = start.map_or_else(|| vec![0.0; n], <[f64]>::to_vec);
    let (mut residual, mut product) = (vec![0.0; n], vec![0.0; n]);
    let (mut p_hat, mut s_hat, mut t) = (vec![0.0; n], vec![0.0; n], vec![0.0; n]);
    let mut last = f64::INFINITY;
    let (mut iterations, mut hopeless) = (0, false);
    loop {
        matrix.multiply(&x, transposed, &mut product);
        for ((r, &b), &mx) in residual.iter_mut().zip(b).zip(&product) {
            *r = b - mx;
        }
        let begun_at = norm(&residual);
        if begun_at <= target.max(ROUNDING * norm(&x)) {
            return Iterated { x, converged: true, iterations };
        }
        if iterations >= patience.most || hopeless {
            break;
        }
        if !begun_at.is_finite() || begun_at >= last {
            // rounding may hold it a little above what was wanted
            let stalled_close = begun_at <= (STALLED * target).max(STALLED * ROUNDING * norm(&x));
            if stalled_close {
                return Iterated { x, converged: true, iterations };
            }
            break;
        }
        last = begun_at;
        let shadow = residual.clone();
        let mut direction = residual.clone();
        let mut rho = dot(&shadow, &residual);
        for _ in 0..MAX_ITERATIONS.min(patience.most - iterations) {
            iterations += 1;
            p_hat.copy_from_slice(&direction);
            preconditioner.apply(matrix, transposed, &mut p_hat);
            matrix.multiply(&p_hat, transposed, &mut product);
            let curvature = dot(&shadow, &product);
            if curvature == 0.0 {
                break;
            }
            let alpha = rho / curvature;
            for ((r, x), (&v, &p)) in residual.iter_mut().zip(&mut x).zip(product.iter().zip(&p_hat)) {
                *r -= alpha * v;
                *x += alpha * p;
            }
            if norm(&residual) <= target {
                break;
            }
            s_hat.copy_from_slice(&residual);
            preconditioner.apply(matrix, transposed, &mut s_hat);
            matrix.multiply(&s_hat, transposed, &mut t);
            let t_norm = dot(&t, &t);
            if t_norm == 0.0 {
                break;
            }
            let omega = dot(&t, &residual) / t_norm;
            for ((r, x), (&t, &s)) in residual.iter_mut().zip(&mut x).zip(t.iter().zip(&s_hat)) {
                *r -= omega * t;
                *x += omega * s;
            }
            let next_rho = dot(&shadow, &residual);
            let size = norm(&residual);
            if size <= target || next_rho == 0.0 || omega == 0.0 || !size.is_finite() {
                break;
            }
            if patience.minds_pace && iterations >= PACE_TOLD {
                let (done, wanted) = ((begun_at / size).ln(), (begun_at / target).ln());
                hopeless = done * f64::from(patience.most) < wanted * f64::from(iterations);
                if hopeless {
                    break;
                }
            }
            let beta = next_rho / rho * (alpha / omega);
            rho = next_rho;
            for ((p, &r), &v) in direction.iter_mut().zip(&residual).zip(&product) {
                *p = r + beta * (*p - omega * v);
            }
        }
    }
    if x.iter().any(|x| !x.is_finite()) {
        x.fill(0.0);
    }
    Iterated { x, converged: false, iterations }
}
