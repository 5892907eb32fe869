//! Linear systems in I − γP_π: policy evaluation, discounted occupancies, gradients of soft values.
//!
//! Small chains are factored once (dense LU) and solved many times; large ones are solved by preconditioned BiCGSTAB (van
//! der Vorst 1992) on the sparse rows, because a sweep-by-sweep solution would need 1/(1 − γ) times as many passes. Where
//! BiCGSTAB does not reach its tolerance the dense factorisation takes over, and beyond its size plain sweeps do.

use super::numeric::{dot, max_abs};
use super::tabular::TabularMdp;
use nalgebra::{DMatrix, DVector, Dyn};

/// Up to this many states the dense factorisation is the faster way.
const DENSE_STATES: usize = 100;
/// Up to this many states it may replace a failed iteration (128 MB).
const DENSE_FALLBACK_STATES: usize = 4000;
/// Wanted residual, relative to the right-hand side.
const RELATIVE_TOLERANCE: f64 = 1e-13;
/// Residual relative to the solution that rounding allows: as good as a factorisation's.
const ROUNDING: f64 = 1e-14;

/// The matrix I − γP_π of a policy, for 0 ≤ γ < 1, ready to be solved against.
pub(crate) struct Resolvent {
    discount: f64,
    chain: Chain,
    dense: Option<Dense>,
}

impl Resolvent {
    /// `policy` has shape (`n_states * n_actions`,).
    pub(crate) fn new(mdp: &TabularMdp, policy: &[f64], discount: f64) -> Self {
        let chain = Chain::new(mdp, policy);
        let dense = (chain.n_states() <= DENSE_STATES).then(|| Dense::new(&chain, discount));
        Self { discount, chain, dense }
    }

    /// x of (I − γP_π) x = b, shape (`n_states`,).
    pub(crate) fn solve(&self, b: &[f64]) -> Vec<f64> {
        self.dispatch(b, false, RELATIVE_TOLERANCE)
    }

    /// As [`Resolvent::solve`], to a residual of `tolerance` relative to b where that saves time.
    pub(crate) fn solve_roughly(&self, b: &[f64], tolerance: f64) -> Vec<f64> {
        self.dispatch(b, false, tolerance.max(RELATIVE_TOLERANCE))
    }

    /// x of (I − γP_π)ᵀ x = b, shape (`n_states`,).
    pub(crate) fn solve_transposed(&self, b: &[f64]) -> Vec<f64> {
        self.dispatch(b, true, RELATIVE_TOLERANCE)
    }

    fn dispatch(&self, b: &[f64], transposed: bool, tolerance: f64) -> Vec<f64> {
        if let Some(dense) = &self.dense {
            return dense.solve(b, transposed);
        }
        let (x, converged) = self.bicgstab(b, transposed, tolerance);
        if converged {
            x
        } else if self.chain.n_states() <= DENSE_FALLBACK_STATES {
            Dense::new(&self.chain, self.discount).solve(b, transposed)
        } else {
            self.sweeps(b, transposed, x)
        }
    }

    /// out = (I − γP_π) x or its transpose.
    fn apply(&self, x: &[f64], transposed: bool, out: &mut [f64]) {
        if transposed {
            self.chain.multiply_transposed(x, out);
        } else {
            self.chain.multiply(x, out);
        }
        for (o, &x) in out.iter_mut().zip(x) {
            *o = x - self.discount * *o;
        }
    }

    /// Diagonally preconditioned; restarted from the true residual, so that rounding does not end it early.
    fn bicgstab(&self, b: &[f64], transposed: bool, tolerance: f64) -> (Vec<f64>, bool) {
        let n = b.len();
        let inverse_diagonal: Vec<f64> = (0..n).map(|s| 1.0 / (1.0 - self.discount * self.chain.diagonal(s))).collect();
        let precondition = |from: &[f64], to: &mut [f64]| {
            for ((t, &f), &d) in to.iter_mut().zip(from).zip(&inverse_diagonal) {
                *t = f * d;
            }
        };
        let target = tolerance * norm(b);
        let mut x = vec![0.0; n];
        if target == 0.0 {
            return (x, true);
        }
        let (mut residual, mut product) = (vec![0.0; n], vec![0.0; n]);
        let (mut p_hat, mut s_hat, mut t) = (vec![0.0; n], vec![0.0; n], vec![0.0; n]);
        for _restart in 0..20 {
            self.apply(&x, transposed, &mut product);
            for ((r, &b), &ax) in residual.iter_mut().zip(b).zip(&product) {
                *r = b - ax;
            }
            let begun_at = norm(&residual);
            if begun_at <= target.max(ROUNDING * norm(&x)) {
                return (x, true);
            }
            let shadow = residual.clone();
            let mut direction = residual.clone();
            let mut rho = dot(&shadow, &residual);
            for _iteration in 0..1000 {
                precondition(&direction, &mut p_hat);
                self.apply(&p_hat, transposed, &mut product);
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
                precondition(&residual, &mut s_hat);
                self.apply(&s_hat, transposed, &mut t);
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
                if norm(&residual) <= target || next_rho == 0.0 || omega == 0.0 {
                    break;
                }
                let beta = next_rho / rho * (alpha / omega);
                rho = next_rho;
                for ((p, &r), &v) in direction.iter_mut().zip(&residual).zip(&product) {
                    *p = r + beta * (*p - omega * v);
                }
            }
            if x.iter().any(|x| !x.is_finite()) {
                return (vec![0.0; n], false);
            }
        }
        (x, false)
    }

    /// x ← b + γ P_π x: slow and sure.
    fn sweeps(&self, b: &[f64], transposed: bool, mut x: Vec<f64>) -> Vec<f64> {
        let mut product = vec![0.0; b.len()];
        for _ in 0..2_000_000 {
            self.apply(&x, transposed, &mut product);
            let mut change = 0.0_f64;
            for ((x, &ax), &b) in x.iter_mut().zip(&product).zip(b) {
                change = change.max((b - ax).abs());
                *x += b - ax;
            }
            if change <= RELATIVE_TOLERANCE * max_abs(&x) {
                break;
            }
        }
        x
    }
}

fn norm(x: &[f64]) -> f64 {
    dot(x, x).sqrt()
}

/// P_π in sparse rows, columns rising.
struct Chain {
    offsets: Vec<usize>,
    columns: Vec<u32>,
    values: Vec<f64>,
}

impl Chain {
    fn new(mdp: &TabularMdp, policy: &[f64]) -> Self {
        let n = mdp.n_states();
        let mut offsets = Vec::with_capacity(n + 1);
        let (mut columns, mut values) = (Vec::new(), Vec::new());
        let mut mass = vec![0.0; n];
        let mut touched: Vec<u32> = Vec::new();
        offsets.push(0);
        for state in 0..n {
            for action in 0..mdp.n_actions() {
                let pair = mdp.pair(state, action);
                let weight = policy[pair];
                if weight > 0.0 {
                    let (next, probabilities) = mdp.row(pair);
                    for (&s, &p) in next.iter().zip(probabilities) {
                        if mass[s as usize] == 0.0 {
                            touched.push(s);
                        }
                        mass[s as usize] += weight * p;
                    }
                }
            }
            touched.sort_unstable();
            touched.dedup();
            for s in touched.drain(..) {
                columns.push(s);
                values.push(std::mem::take(&mut mass[s as usize]));
            }
            offsets.push(columns.len());
        }
        Self { offsets, columns, values }
    }

    fn n_states(&self) -> usize {
        self.offsets.len() - 1
    }

    fn row(&self, state: usize) -> impl Iterator<Item = (usize, f64)> + '_ {
        let entries = self.offsets[state]..self.offsets[state + 1];
        self.columns[entries.clone()].iter().zip(&self.values[entries]).map(|(&s, &p)| (s as usize, p))
    }

    fn diagonal(&self, state: usize) -> f64 {
        self.row(state).find(|&(s, _)| s == state).map_or(0.0, |(_, p)| p)
    }

    fn multiply(&self, x: &[f64], out: &mut [f64]) {
        for (state, o) in out.iter_mut().enumerate() {
            *o = self.row(state).map(|(s, p)| p * x[s]).sum();
        }
    }

    fn multiply_transposed(&self, x: &[f64], out: &mut [f64]) {
        out.fill(0.0);
        for (state, &x) in x.iter().enumerate() {
            for (s, p) in self.row(state) {
                out[s] += p * x;
            }
        }
    }
}

/// Dense LU of I − γP_π, kept apart so that the transpose can be solved too.
struct Dense {
    lower: DMatrix<f64>,
    upper: DMatrix<f64>,
    permutation: nalgebra::PermutationSequence<Dyn>,
}

impl Dense {
    fn new(chain: &Chain, discount: f64) -> Self {
        let n = chain.n_states();
        let mut matrix = DMatrix::identity(n, n);
        for state in 0..n {
            for (s, p) in chain.row(state) {
                matrix[(state, s)] -= discount * p;
            }
        }
        let (permutation, lower, upper) = matrix.lu().unpack();
        Self { lower, upper, permutation }
    }

    // I − γP_π is strictly diagonally dominant for γ < 1, so no pivot is zero.
    fn solve(&self, b: &[f64], transposed: bool) -> Vec<f64> {
        let mut x = DVector::from_column_slice(b);
        if transposed {
            self.upper.tr_solve_upper_triangular_mut(&mut x);
            self.lower.tr_solve_lower_triangular_mut(&mut x);
            self.permutation.inv_permute_rows(&mut x);
        } else {
            self.permutation.permute_rows(&mut x);
            self.lower.solve_lower_triangular_mut(&mut x);
            self.upper.solve_upper_triangular_mut(&mut x);
        }
        x.as_slice().to_vec()
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use rand_core::Rng;
    use rand_pcg::Pcg64;

    /// `n` states in a ring with jumps, two actions.
    fn ring(n: usize, random: &mut Pcg64) -> TabularMdp {
        let (mut offsets, mut next, mut probabilities) = (vec![0], Vec::new(), Vec::new());
        for pair in 0..2 * n {
            let mut row = vec![(pair / 2) as u32, ((pair / 2 + 1) % n) as u32, (random.next_u64() % n as u64) as u32];
            row.sort_unstable();
            row.dedup();
            let p = 1.0 / row.len() as f64;
            probabilities.extend(row.iter().map(|_| p));
            next.extend(row);
            offsets.push(next.len());
        }
        TabularMdp::new(n, 2, offsets, next, probabilities, None).expect("a model")
    }

    #[test]
    fn all_ways_to_solve_agree() {
        let mut random = Pcg64::new(1, 2);
        for n in [1, 2, 50, DENSE_STATES + 60] {
            let mdp = ring(n, &mut random);
            let policy = vec![0.5; 2 * n];
            let b: Vec<f64> = (0..n).map(|i| (i as f64).sin()).collect();
            for discount in [0.0, 0.9, 0.9999] {
                let resolvent = Resolvent::new(&mdp, &policy, discount);
                let dense = Dense::new(&resolvent.chain, discount);
                for transposed in [false, true] {
                    let want = dense.solve(&b, transposed);
                    let (iterated, converged) = resolvent.bicgstab(&b, transposed, RELATIVE_TOLERANCE);
                    assert!(converged, "{n} states, discount {discount}");
                    // sweeps from afar are what the others exist to avoid: from close by they must not wander off
                    let near = want.iter().map(|x| x * (1.0 + 1e-6)).collect();
                    let swept = resolvent.sweeps(&b, transposed, near);
                    let size = max_abs(&want);
                    for ((w, i), s) in want.iter().zip(&iterated).zip(&swept) {
                        assert!((w - i).abs() <= 1e-9 * size, "{n} states, discount {discount}: {w} and {i}");
                        assert!((w - s).abs() <= 1e-8 * size, "{n} states, discount {discount}: {w} and {s}");
                    }
                    let mut back = vec![0.0; n];
                    resolvent.apply(&want, transposed, &mut back);
                    assert!(back.iter().zip(&b).all(|(x, y)| (x - y).abs() <= 1e-12 * (1.0 + size)));
                }
            }
        }
    }
}
