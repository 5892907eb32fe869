//! Soft values of one reward after another, each near the last: what a sampler evaluates thousands of times.
//!
//! V = log Σ_a exp(R + γPV) is solved by Newton's method. Its matrix J = I − γP_π is inverted once; where a proposed reward
//! changes the policy in a few states, J changes in those rows alone, and Woodbury's identity gives the step from the old
//! inverse and a system of their number. The step is the error of the values but for terms of its square, so a proposal that
//! cannot be accepted is given up as soon as twice that error does not save it.
//!
//! Deliberately absent: processes so large that a dense inverse is a burden; see [`MAX_STATES`].

use crate::mdp::{TabularMdp, max_abs};
use nalgebra::{DMatrix, DVector};

/// Most states whose inverse is kept (2 MB a chain).
pub(super) const MAX_STATES: usize = 500;
/// A row of the matrix counts as changed where the policy moved by so much in total.
const CHANGED: f64 = 0.02;
/// Wanted accuracy of the log-likelihood, in nats.
const ACCURACY: f64 = 0.01;
/// A Newton step is so much shorter than the error that it removes, at worst.
const SAFETY: f64 = 2.0;
/// Residuals below this share of the largest wait for the next step.
const NEGLIGIBLE: f64 = 1e-4;
const MAX_ROUNDS: u32 = 50;
/// Accepted changes after which the inverse is computed anew.
const REFRESH: u32 = 100;

/// A process at a reward, ready to be asked about others.
pub(super) struct SoftProcess<'a> {
    mdp: &'a TabularMdp,
    discount: f64,
    counts: &'a [f64],
    /// States that were demonstrated.
    visited: Vec<bool>,
    n_steps: f64,
    /// V at the present reward.
    values: Vec<f64>,
    log_likelihood: f64,
    /// π at the present reward.
    policy: Vec<f64>,
    /// The policy whose matrix is inverted: the present one but for small changes.
    inverted: Vec<f64>,
    inverse: DMatrix<f64>,
    since_refresh: u32,
    proposal: Proposal,
}

/// Working memory, and the outcome of the last proposal.
struct Proposal {
    values: Vec<f64>,
    action_values: Vec<f64>,
    policy: Vec<f64>,
    residual: Vec<f64>,
    step: Vec<f64>,
    changed: Vec<usize>,
    /// Rows −γ (P_π − P_inverted) of the changed states, sparse.
    rows: Vec<Vec<(usize, f64)>>,
    log_likelihood: f64,
}

impl<'a> SoftProcess<'a> {
    /// Starts at a reward R(s,a); `counts` are N(s,a). Both have shape (`n_states * n_actions`,).
    pub(super) fn new(mdp: &'a TabularMdp, discount: f64, counts: &'a [f64], reward: &[f64]) -> Self {
        let (n_states, n_pairs) = (mdp.n_states(), mdp.n_pairs());
        let uniform = vec![1.0 / mdp.n_actions() as f64; n_pairs];
        let proposal = Proposal {
            values: vec![0.0; n_states],
            action_values: vec![0.0; n_pairs],
            policy: uniform.clone(),
            residual: vec![0.0; n_states],
            step: vec![0.0; n_states],
            changed: Vec::new(),
            rows: Vec::new(),
            log_likelihood: f64::NEG_INFINITY,
        };
        let mut process = Self {
            mdp,
            discount,
            counts,
            visited: counts.chunks_exact(mdp.n_actions()).map(|n| n.iter().any(|&n| n > 0.0)).collect(),
            n_steps: counts.iter().sum(),
            values: vec![0.0; n_states],
            log_likelihood: f64::NEG_INFINITY,
            policy: uniform.clone(),
            inverted: uniform,
            inverse: DMatrix::identity(n_states, n_states),
            since_refresh: 0,
            proposal,
        };
        process.refresh();
        if process.propose(reward, f64::NEG_INFINITY).is_some() {
            process.accept();
        }
        process
    }

    /// ℓ at the present reward; −∞ where it could not be computed.
    pub(super) fn log_likelihood(&self) -> f64 {
        self.log_likelihood
    }

    /// π(a|s) at the present reward, shape (`n_states * n_actions`,).
    pub(super) fn policy(&self) -> &[f64] {
        &self.policy
    }

    /// ℓ at another reward, to [`ACCURACY`]; `None` where it certainly lies below `threshold`, or has no value.
    pub(super) fn propose(&mut self, reward: &[f64], threshold: f64) -> Option<f64> {
        self.proposal.values.copy_from_slice(&self.values);
        for _ in 0..MAX_ROUNDS {
            let log_likelihood = self.look(reward);
            if !log_likelihood.is_finite() {
                return None;
            }
            self.step()?;
            let proposal = &mut self.proposal;
            let (low, high) = proposal
                .step
                .iter()
                .fold((f64::INFINITY, f64::NEG_INFINITY), |(low, high), &d| (low.min(d), high.max(d)));
            // log π does not see a shift of all values; the largest difference of their errors moves it by γ times that at most
            let error = SAFETY * self.discount * self.n_steps * (high - low);
            if !error.is_finite() || log_likelihood + error < threshold {
                return None;
            }
            for (v, d) in proposal.values.iter_mut().zip(&proposal.step) {
                *v += d;
            }
            let rounding = 1e-12 * (1.0 + max_abs(&proposal.values));
            if error <= ACCURACY || high - low <= rounding {
                proposal.log_likelihood = log_likelihood;
                return (log_likelihood >= threshold).then_some(log_likelihood);
            }
        }
        None
    }

    /// Moves to the reward last proposed.
    pub(super) fn accept(&mut self) {
        self.values.copy_from_slice(&self.proposal.values);
        self.policy.copy_from_slice(&self.proposal.policy);
        self.log_likelihood = self.proposal.log_likelihood;
        self.since_refresh += 1;
        if self.since_refresh >= REFRESH || 4 * self.proposal.changed.len() > self.mdp.n_states() {
            self.refresh();
        } else if !self.proposal.changed.is_empty() {
            self.fold();
        }
    }

    /// Q, π, residuals and ℓ at the proposal's values.
    fn look(&mut self, reward: &[f64]) -> f64 {
        let n_actions = self.mdp.n_actions();
        let Proposal { values, action_values, policy, residual, changed, rows, .. } = &mut self.proposal;
        self.mdp.action_values_into(reward, self.discount, values, action_values);
        changed.clear();
        let mut log_likelihood = 0.0;
        for (state, (q, pi)) in
            action_values.chunks_exact(n_actions).zip(policy.chunks_exact_mut(n_actions)).enumerate()
        {
            let largest = q.iter().copied().fold(f64::NEG_INFINITY, f64::max);
            let mut mass = 0.0;
            for (p, q) in pi.iter_mut().zip(q) {
                *p = (q - largest).exp();
                mass += *p;
            }
            let value = largest + mass.ln();
            residual[state] = value - values[state];
            let pairs = state * n_actions..(state + 1) * n_actions;
            if self.visited[state] {
                log_likelihood += self.counts[pairs.clone()].iter().zip(q).map(|(n, q)| n * (q - value)).sum::<f64>();
            }
            let mut moved = 0.0;
            for (p, old) in pi.iter_mut().zip(&self.inverted[pairs]) {
                *p /= mass;
                moved += (*p - old).abs();
            }
            if moved > CHANGED {
                changed.push(state);
            }
        }
        rows.resize_with(rows.len().max(changed.len()), Vec::new);
        log_likelihood
    }

    /// The Newton step from the proposal's values; `None` where the system is singular to working precision.
    fn step(&mut self) -> Option<()> {
        self.fill_rows();
        let Proposal { residual, step, changed, rows, .. } = &mut self.proposal;
        step.fill(0.0);
        let negligible = NEGLIGIBLE * max_abs(residual);
        for (column, &r) in self.inverse.column_iter().zip(residual.iter()) {
            if r.abs() > negligible {
                for (d, x) in step.iter_mut().zip(column.iter()) {
                    *d += r * x;
                }
            }
        }
        if !changed.is_empty() {
            let rows = &rows[..changed.len()];
            let system = capacitance(&self.inverse, changed, rows);
            let right = DVector::from_iterator(rows.len(), rows.iter().map(|row| dot_sparse(row, step)));
            let correction = system.lu().solve(&right)?;
            for (&state, &c) in changed.iter().zip(correction.iter()) {
                for (d, x) in step.iter_mut().zip(self.inverse.column(state).iter()) {
                    *d -= c * x;
                }
            }
        }
        Some(())
    }

    /// Rows of the matrix that the proposal changes.
    fn fill_rows(&mut self) {
        let n_actions = self.mdp.n_actions();
        let Proposal { policy, changed, rows, .. } = &mut self.proposal;
        for (row, &state) in rows.iter_mut().zip(changed.iter()) {
            row.clear();
            let pairs = state * n_actions..(state + 1) * n_actions;
            let moves = policy[pairs.clone()].iter().zip(&self.inverted[pairs.clone()]);
            for (pair, (new, old)) in pairs.zip(moves) {
                let moved = self.discount * (new - old);
                let (next, probabilities) = self.mdp.row(pair);
                row.extend(next.iter().zip(probabilities).map(|(&s, &p)| (s as usize, -moved * p)));
            }
        }
    }

    /// Takes the changed rows into the inverse.
    fn fold(&mut self) {
        self.fill_rows();
        let n_actions = self.mdp.n_actions();
        let Proposal { changed, rows, .. } = &self.proposal;
        let rows = &rows[..changed.len()];
        let columns = self.inverse.select_columns(changed.iter());
        let projected = DMatrix::from_fn(rows.len(), self.inverse.ncols(), |i, j| {
            rows[i].iter().map(|&(s, x)| x * self.inverse[(s, j)]).sum::<f64>()
        });
        match capacitance(&self.inverse, changed, rows).lu().solve(&projected) {
            Some(solved) => {
                self.inverse.gemm(-1.0, &columns, &solved, 1.0);
                for &state in changed {
                    let pairs = state * n_actions..(state + 1) * n_actions;
                    self.inverted[pairs.clone()].copy_from_slice(&self.policy[pairs]);
                }
            }
            None => self.refresh(),
        }
    }

    /// Inverts the present policy's matrix from scratch.
    fn refresh(&mut self) {
        self.since_refresh = 0;
        self.inverted.copy_from_slice(&self.policy);
        let (n_states, n_actions) = (self.mdp.n_states(), self.mdp.n_actions());
        let mut matrix = DMatrix::identity(n_states, n_states);
        for (pair, &p) in self.policy.iter().enumerate() {
            let (next, probabilities) = self.mdp.row(pair);
            for (&s, &q) in next.iter().zip(probabilities) {
                matrix[(pair / n_actions, s as usize)] -= self.discount * p * q;
            }
        }
        // diagonally dominant by rows: always invertible for a discount below 1
        self.inverse = matrix.try_inverse().unwrap_or_else(|| DMatrix::identity(n_states, n_states));
    }
}

/// I + U J⁻¹ E: the small matrix of Woodbury's identity.
fn capacitance(inverse: &DMatrix<f64>, changed: &[usize], rows: &[Vec<(usize, f64)>]) -> DMatrix<f64> {
    DMatrix::from_fn(rows.len(), rows.len(), |i, j| {
        let column = inverse.column(changed[j]);
        f64::from(u8::from(i == j)) + rows[i].iter().map(|&(s, x)| x * column[s]).sum::<f64>()
    })
}

fn dot_sparse(row: &[(usize, f64)], dense: &[f64]) -> f64 {
    row.iter().map(|&(s, x)| x * dense[s]).sum()
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::irl::random::Stream;
    use crate::mdp::{SoftSolver, log_sum_exp};

    /// Twelve states in a ring; the actions go either way or stay, each slipping.
    fn ring() -> TabularMdp {
        let n = 12_u32;
        let (mut offsets, mut next, mut probabilities) = (vec![0], Vec::new(), Vec::new());
        for state in 0..n {
            for step in [1, n - 1, 0] {
                let mut row = vec![((state + step) % n, 0.8), ((state + 1) % n, 0.1), ((state + n - 1) % n, 0.1)];
                row.sort_by_key(|entry| entry.0);
                let mut merged: Vec<(u32, f64)> = Vec::new();
                for (s, p) in row {
                    match merged.last_mut() {
                        Some(last) if last.0 == s => last.1 += p,
                        _ => merged.push((s, p)),
                    }
                }
                for (s, p) in merged {
                    next.push(s);
                    probabilities.push(p);
                }
                offsets.push(next.len());
            }
        }
        TabularMdp::new(12, 3, offsets, next, probabilities, None).expect("a model")
    }

    fn exact(mdp: &TabularMdp, discount: f64, counts: &[f64], reward: &[f64]) -> f64 {
        let mut solver = SoftSolver::new(mdp, discount);
        solver.solve(reward);
        let rows = solver.action_values().chunks_exact(3).zip(counts.chunks_exact(3));
        rows.map(|(q, n)| n.iter().zip(q).map(|(n, x)| n * (x - log_sum_exp(q))).sum::<f64>()).sum()
    }

    #[test]
    fn a_walk_over_rewards_keeps_the_likelihood() {
        let mdp = ring();
        for discount in [0.0, 0.9, 0.999] {
            let mut stream = Stream::new(5, 0);
            let counts: Vec<f64> = (0..36).map(|_| (10.0 * stream.uniform()).floor()).collect();
            let mut reward = vec![0.0; 36];
            let mut process = SoftProcess::new(&mdp, discount, &counts, &reward);
            for step in 0..400 {
                let before = reward.clone();
                let state = (12.0 * stream.uniform()) as usize;
                let worth = if stream.uniform() < 0.5 { 0.0 } else { 20.0 * stream.uniform() };
                reward[3 * state..3 * state + 3].fill(worth);
                let found = process.propose(&reward, f64::NEG_INFINITY).expect("a likelihood");
                let want = exact(&mdp, discount, &counts, &reward);
                assert!((found - want).abs() <= 2.0 * ACCURACY, "step {step} at {discount}: {found} for {want}");
                if stream.uniform() < 0.6 {
                    process.accept();
                    assert_eq!(process.log_likelihood(), found);
                } else {
                    reward = before;
                }
            }
        }
    }

    #[test]
    fn gives_up_only_what_lies_below() {
        let mdp = ring();
        let mut stream = Stream::new(6, 0);
        let counts: Vec<f64> = (0..36).map(|_| (10.0 * stream.uniform()).floor()).collect();
        let mut process = SoftProcess::new(&mdp, 0.95, &counts, &[0.0; 36]);
        let (mut kept, mut given_up) = (0, 0);
        for _ in 0..300 {
            let mut reward = vec![0.0; 36];
            for pair in &mut reward {
                *pair = 3.0 * stream.uniform() * stream.uniform();
            }
            let want = exact(&mdp, 0.95, &counts, &reward);
            let threshold = want + 20.0 * (stream.uniform() - 0.5);
            let found = process.propose(&reward, threshold);
            if (want - threshold).abs() > 2.0 * ACCURACY {
                assert_eq!(found.is_some(), want > threshold);
            }
            if found.is_some() {
                kept += 1;
            } else {
                given_up += 1;
            }
        }
        assert!(kept > 50 && given_up > 50, "{kept} kept, {given_up} given up");
    }

    #[test]
    fn what_has_no_value_is_refused() {
        let mdp = ring();
        let counts = vec![1.0; 36];
        let mut process = SoftProcess::new(&mdp, 0.9, &counts, &[0.0; 36]);
        assert_eq!(process.propose(&[f64::INFINITY; 36], f64::NEG_INFINITY), None);
        assert!(process.propose(&[1.0; 36], f64::NEG_INFINITY).is_some());
    }
}
