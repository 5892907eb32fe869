//! Hahn & Zoubir's (2015) eq. 10 where C is diagonal, without a matrix.
//!
//! The least-squares problem of [`super::em`] couples its unknowns through the reference function's weight t and the residual
//! ρ of 1ᵀw = 1 alone: given both, every other weight is a quotient. So for a set of positive weights the solution takes two
//! equations, and the set itself is found by the primal-dual active set method (Hintermüller, Ito & Kunisch 2002), a handful
//! of passes over the functions. Deliberately absent: a proof that it ends; where it does not, [`super::nnls`] decides.

/// Passes after which the active sets count as cycling.
const MAX_PASSES: usize = 100;

/// Coefficients of the problem: rows C_i w_i − C_r w_r = c_i − c_r over the functions i that were shown, without the reference
/// r; the same row with C_i = c_i = 0 once for each of those never shown; and Σ w = 1.
pub(super) struct Stationarity<'a> {
    /// c_i of the functions that were shown, without the reference.
    pub linear: &'a [f64],
    /// C_i > 0 of the same.
    pub curvature: &'a [f64],
    /// c_r and C_r > 0, where the reference was shown.
    pub reference: Option<(f64, f64)>,
    /// Number of functions never shown (the reference among them, where it was not): they share one unknown.
    pub hidden: usize,
}

/// The weights of those shown, of the reference (0 where it is hidden), and of the hidden ones together.
#[derive(Debug, Clone, PartialEq)]
pub(super) struct Weights {
    pub shown: Vec<f64>,
    pub reference: f64,
    pub hidden: f64,
}

impl Stationarity<'_> {
    /// The minimum over w ≥ 0; `None` where the active sets cycle.
    pub(super) fn minimise(&self) -> Option<Weights> {
        let (c_r, curvature_r) = self.reference.unwrap_or((0.0, 0.0));
        let hidden = self.hidden as f64;
        let terms = || self.linear.iter().map(|c| c - c_r).zip(self.curvature.iter().copied());
        let mut positive = vec![true; self.linear.len()];
        let (mut with_reference, mut with_hidden) = (self.reference.is_some(), self.hidden > 0);
        for _pass in 0..MAX_PASSES {
            let (mut inverses, mut inverse_squares, mut quotients, mut left_out, mut n_out) = (0.0, 0.0, 0.0, 0.0, 0.0);
            for ((d, c), &is_positive) in terms().zip(&positive) {
                if is_positive {
                    inverses += 1.0 / c;
                    inverse_squares += 1.0 / (c * c);
                    quotients += d / c;
                } else {
                    left_out += d;
                    n_out += 1.0;
                }
            }
            // the equations of ρ and t: a ρ + k t = p, k ρ − m t = q
            let a = 1.0 + inverse_squares;
            let k = 1.0 + curvature_r * inverses;
            let m = curvature_r * curvature_r * (n_out + hidden);
            let (p, q) = (1.0 - quotients, curvature_r * (left_out - hidden * c_r));
            let (rho, t) = match (with_hidden, with_reference) {
                (true, true) => (0.0, -q / m),
                (true, false) => (0.0, 0.0),
                (false, true) => {
                    let determinant = a * m + k * k;
                    ((p * m + k * q) / determinant, (k * p - a * q) / determinant)
                }
                (false, false) => (p / a, 0.0),
            };
            let mut sum = t;
            let mut settled = true;
            let mut shown = Vec::with_capacity(positive.len());
            for ((d, c), is_positive) in terms().zip(&mut positive) {
                let w = (d + curvature_r * t) / c + rho / (c * c);
                let wanted = w > 0.0;
                settled &= wanted == *is_positive;
                let w = if *is_positive { w } else { 0.0 };
                *is_positive = wanted;
                sum += w;
                shown.push(w);
            }
            let rest = if with_hidden { 1.0 - sum } else { 0.0 };
            if self.reference.is_some() {
                let wanted = if with_reference { t > 0.0 } else { k * rho - q > 0.0 };
                settled &= wanted == with_reference;
                with_reference = wanted;
            }
            if self.hidden > 0 {
                let wanted = if with_hidden { rest > 0.0 } else { rho > 0.0 };
                settled &= wanted == with_hidden;
                with_hidden = wanted;
            }
            if settled {
                return Some(Weights { shown, reference: t, hidden: rest });
            }
        }
        None
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::irl::nnls::nnls;
    use nalgebra::{DMatrix, DVector};
    use proptest::prelude::*;

    proptest! {
        #[test]
        fn equals_least_squares_on_the_matrix(
            terms in proptest::collection::vec((0.05..20.0_f64, 0.0..1.0_f64, any::<bool>()), 1..14),
            damped: bool,
            shown_reference: bool,
            hidden in 0_usize..4,
        ) {
            // as in the methods, c = C where the responsibilities are 1 and smaller otherwise
            let terms: Vec<(f64, f64)> =
                terms.iter().map(|t| (if damped && t.2 { t.0 * t.1 } else { t.0 }, t.0)).collect();
            let (reference, shown) = if shown_reference { (Some(terms[0]), &terms[1..]) } else { (None, &terms[..]) };
            prop_assume!(!shown.is_empty());
            let hidden = hidden + usize::from(!shown_reference);
            let (linear, curvature): (Vec<f64>, Vec<f64>) = shown.iter().copied().unzip();
            let problem = Stationarity { linear: &linear, curvature: &curvature, reference, hidden };
            let found = problem.minimise().expect("no cycle");

            let n = shown.len();
            let (c_r, curvature_r) = reference.unwrap_or((0.0, 0.0));
            // columns: shown, reference, hidden
            let mut a = DMatrix::zeros(n + hidden + 1, n + 2);
            let mut b = DVector::zeros(n + hidden + 1);
            for row in 0..n + hidden {
                a[(row, n)] = -curvature_r;
                b[row] = -c_r;
                if row < n {
                    a[(row, row)] = curvature[row];
                    b[row] += linear[row];
                }
            }
            a.row_mut(n + hidden).fill(1.0);
            b[n + hidden] = 1.0;
            if reference.is_none() { a.column_mut(n).fill(0.0); }
            if hidden == 0 { a.column_mut(n + 1).fill(0.0); }
            let want = nnls(&a, &b);
            let mut got = found.shown.clone();
            got.extend([found.reference, found.hidden]);
            for (i, (x, y)) in want.solution.iter().zip(&got).enumerate() {
                prop_assert!((x - y).abs() < 1e-7 * (1.0 + x), "weight {i}: {x} and {y} in {found:?}");
            }
        }
    }
}
