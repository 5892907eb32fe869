//! Optimal action values of one reward after another, and their derivatives.
//!
//! As long as the optimal policy π stays, Q* is linear in the reward: with X = (I − γP_π)⁻¹, V = X R_π and dV/dR_π = X. X is
//! kept; where a policy improves in a state, one row of I − γP_π changes and X follows by the Sherman–Morrison formula in
//! O(n²), so that a small move of the reward costs a few products with X and no factorisation. This is Ramachandran &
//! Amir's (2007) observation that a policy found for one reward is the start for the next, taken further.
//! Where γ = 1 there is no stationary policy: backward induction over the horizon keeps the policy of every step.

use crate::irl::Basis;
use crate::mdp::{TabularMdp, max_abs};
use nalgebra::DMatrix;

/// Below this share of the largest action value a better action is rounding.
const MARGIN: f64 = 1e-11;
/// Relative residual of V = R_π + γP_πV beyond which X is computed afresh.
const WORN: f64 = 1e-10;
/// Changes of one row after which X is computed afresh all the same.
const MAX_UPDATES: u32 = 500;
/// Improvements of the policy for one reward; a handful is usual.
const MAX_IMPROVEMENTS: u32 = 1000;

/// Q* of the reward last solved for.
pub(super) struct Optimum<'a> {
    mdp: &'a TabularMdp,
    discount: f64,
    /// Best action of each state; over a finite horizon, of each step but the first, the last step's first.
    chosen: Vec<u32>,
    /// X by columns; empty over a finite horizon.
    inverse: Vec<f64>,
    updates: u32,
    state_values: Vec<f64>,
    action_values: Vec<f64>,
    column: Vec<f64>,
    /// R_π.
    received: Vec<f64>,
    /// K, where γ = 1.
    horizon: Option<u32>,
}

impl<'a> Optimum<'a> {
    /// `horizon` is looked at where `discount` is 1, and at least 1.
    pub(super) fn new(mdp: &'a TabularMdp, discount: f64, horizon: u32) -> Self {
        let n = mdp.n_states();
        let horizon = (discount >= 1.0).then_some(horizon);
        let steps = horizon.map_or(1, |k| k as usize - 1);
        let mut optimum = Self {
            mdp,
            discount,
            chosen: vec![0; n * steps],
            inverse: Vec::new(),
            updates: 0,
            state_values: vec![0.0; n],
            action_values: vec![0.0; mdp.n_pairs()],
            column: vec![0.0; n],
            received: vec![0.0; n],
            horizon,
        };
        if horizon.is_none() {
            optimum.invert();
        }
        optimum
    }

    /// Q*(s,a), shape (`n_states * n_actions`,).
    pub(super) fn action_values(&self) -> &[f64] {
        &self.action_values
    }

    /// Solves for R(s,a), shape (`n_states * n_actions`,), from the last policy on.
    pub(super) fn solve(&mut self, reward: &[f64]) {
        if self.horizon.is_some() {
            self.induce(reward);
            return;
        }
        let n_actions = self.mdp.n_actions();
        for _ in 0..MAX_IMPROVEMENTS {
            self.evaluate(reward);
            let size = max_abs(&self.action_values);
            let worn = self.chosen.iter().enumerate().any(|(state, &action)| {
                let residual = self.action_values[state * n_actions + action as usize] - self.state_values[state];
                residual.abs() > WORN * size
            });
            if (worn && self.updates > 0) || self.updates > MAX_UPDATES {
                self.invert();
                self.evaluate(reward);
            }
            let mut stable = true;
            for state in 0..self.mdp.n_states() {
                let q = &self.action_values[state * n_actions..(state + 1) * n_actions];
                let best = first_best(q);
                if q[best] > q[self.chosen[state] as usize] + MARGIN * size {
                    self.switch(state, best as u32);
                    stable = false;
                }
            }
            if stable {
                break;
            }
        }
    }

    /// dℓ/dR(s,a) from dℓ/dQ*(s,a), both of shape (`n_states * n_actions`,).
    pub(super) fn pull_back(&self, by_value: &[f64]) -> Vec<f64> {
        let (n, n_actions) = (self.mdp.n_states(), self.mdp.n_actions());
        let mut by_reward = by_value.to_vec();
        let mut arrivals = self.mdp.propagate(by_value);
        if self.horizon.is_none() {
            for (state, (column, &action)) in self.inverse.chunks_exact(n).zip(&self.chosen).enumerate() {
                by_reward[state * n_actions + action as usize] += self.discount * dot(column, &arrivals);
            }
            return by_reward;
        }
        for step in self.chosen.chunks_exact(n).rev() {
            let mut next = vec![0.0; n];
            for (state, (&action, &flow)) in step.iter().zip(&arrivals).enumerate() {
                let pair = state * n_actions + action as usize;
                by_reward[pair] += flow;
                let (states, probabilities) = self.mdp.row(pair);
                for (&s, &p) in states.iter().zip(probabilities) {
                    next[s as usize] += flow * p;
                }
            }
            arrivals = next;
        }
        by_reward
    }

    /// dQ*/dw of the pairs of one state after another; `visit` gets the state and dQ*(s,·)/dw, shape (`n_actions`, `n_basis`).
    pub(super) fn for_each_sensitivity(
        &self,
        basis: &Basis,
        wanted: impl Fn(usize) -> bool,
        mut visit: impl FnMut(usize, &[Vec<f64>]),
    ) {
        let (n, n_actions, n_basis) = (self.mdp.n_states(), self.mdp.n_actions(), basis.len());
        // row s: dV(s)/dw
        let mut of_values = vec![0.0; n * n_basis];
        let follow = |pair: usize, of_values: &[f64], weight: f64, row: &mut [f64]| {
            let (states, probabilities) = self.mdp.row(pair);
            for (&s, &p) in states.iter().zip(probabilities) {
                axpy(weight * p, &of_values[s as usize * n_basis..(s as usize + 1) * n_basis], row);
            }
            basis.for_each(pair, |b, value| row[b] += value);
        };
        if self.horizon.is_some() {
            for step in self.chosen.chunks_exact(n) {
                let mut next = vec![0.0; n * n_basis];
                for (state, (row, &action)) in next.chunks_exact_mut(n_basis).zip(step).enumerate() {
                    follow(state * n_actions + action as usize, &of_values, 1.0, row);
                }
                of_values = next;
            }
        } else {
            for (from, (column, &action)) in self.inverse.chunks_exact(n).zip(&self.chosen).enumerate() {
                basis.for_each(from * n_actions + action as usize, |b, value| {
                    for (row, x) in of_values.chunks_exact_mut(n_basis).zip(column) {
                        row[b] += value * x;
                    }
                });
            }
        }
        let mut rows = vec![vec![0.0; n_basis]; n_actions];
        for state in (0..n).filter(|&s| wanted(s)) {
            for (action, row) in rows.iter_mut().enumerate() {
                row.fill(0.0);
                follow(state * n_actions + action, &of_values, self.discount, row);
            }
            visit(state, &rows);
        }
    }

    /// V = X R_π and Q = R + γPV.
    fn evaluate(&mut self, reward: &[f64]) {
        let n_actions = self.mdp.n_actions();
        for ((r, row), &action) in self.received.iter_mut().zip(reward.chunks_exact(n_actions)).zip(&self.chosen) {
            *r = row[action as usize];
        }
        multiply(&self.inverse, &self.received, &mut self.state_values);
        self.mdp.action_values_into(reward, self.discount, &self.state_values, &mut self.action_values);
    }

    /// Another action in one state: I − γP_π gains a row difference, X follows.
    fn switch(&mut self, state: usize, action: u32) {
        let (n, n_actions) = (self.mdp.n_states(), self.mdp.n_actions());
        let before = self.mdp.row(state * n_actions + self.chosen[state] as usize);
        let after = self.mdp.row(state * n_actions + action as usize);
        self.chosen[state] = action;
        self.updates += 1;
        self.column.copy_from_slice(&self.inverse[state * n..(state + 1) * n]);
        let gather = |row: (&[u32], &[f64]), x: &[f64]| -> f64 {
            row.0.iter().zip(row.1).map(|(&s, &p)| p * x[s as usize]).sum()
        };
        let difference = |x: &[f64]| self.discount * (gather(before, x) - gather(after, x));
        let denominator = 1.0 + difference(&self.column);
        // positive in exact arithmetic: the ratio of two determinants of M-matrices
        if denominator.is_nan() || denominator <= 1e-9 {
            self.invert();
            return;
        }
        for column in self.inverse.chunks_exact_mut(n) {
            let share = difference(column) / denominator;
            if share != 0.0 {
                axpy(-share, &self.column, column);
            }
        }
    }

    fn invert(&mut self) {
        let n = self.mdp.n_states();
        let mut matrix = DMatrix::identity(n, n);
        for (state, &action) in self.chosen.iter().enumerate() {
            let (states, probabilities) = self.mdp.row(self.mdp.pair(state, action as usize));
            for (&s, &p) in states.iter().zip(probabilities) {
                matrix[(state, s as usize)] -= self.discount * p;
            }
        }
        let inverse = matrix.try_inverse().expect("strictly diagonally dominant at a discount below 1");
        self.inverse.clear();
        self.inverse.extend_from_slice(inverse.as_slice());
        self.updates = 0;
    }

    fn induce(&mut self, reward: &[f64]) {
        let (n, n_actions) = (self.mdp.n_states(), self.mdp.n_actions());
        self.state_values.fill(0.0);
        self.mdp.action_values_into(reward, 1.0, &self.state_values, &mut self.action_values);
        for step in self.chosen.chunks_exact_mut(n) {
            let q = self.action_values.chunks_exact(n_actions);
            for ((choice, value), q) in step.iter_mut().zip(&mut self.state_values).zip(q) {
                let best = first_best(q);
                (*choice, *value) = (best as u32, q[best]);
            }
            self.mdp.action_values_into(reward, 1.0, &self.state_values, &mut self.action_values);
        }
    }
}

fn first_best(values: &[f64]) -> usize {
    let mut best = 0;
    for (action, &q) in values.iter().enumerate() {
        if q > values[best] {
            best = action;
        }
    }
    best
}

/// y += a x.
pub(super) fn axpy(a: f64, x: &[f64], y: &mut [f64]) {
    for (y, x) in y.iter_mut().zip(x) {
        *y += a * x;
    }
}

/// y = A x of a square A by columns, four at a time.
pub(super) fn multiply(columns: &[f64], x: &[f64], y: &mut [f64]) {
    let n = x.len();
    y.fill(0.0);
    let (fours, rest) = columns.split_at(n * (n - n % 4));
    let (x4, x_rest) = x.split_at(n - n % 4);
    for (block, x) in fours.chunks_exact(4 * n).zip(x4.chunks_exact(4)) {
        let (a, b) = block.split_at(2 * n);
        let ((a, b), (c, d)) = (a.split_at(n), b.split_at(n));
        for ((((y, a), b), c), d) in y.iter_mut().zip(a).zip(b).zip(c).zip(d) {
            *y += (x[0] * a + x[1] * b) + (x[2] * c + x[3] * d);
        }
    }
    for (column, &x) in rest.chunks_exact(n).zip(x_rest) {
        axpy(x, column, y);
    }
}

/// Scalar product in four fixed lanes, which the processor can add at once.
pub(super) fn dot(a: &[f64], b: &[f64]) -> f64 {
    let mut lanes = [0.0; 4];
    let (a4, b4) = (a.chunks_exact(4), b.chunks_exact(4));
    let rest: f64 = a4.remainder().iter().zip(b4.remainder()).map(|(a, b)| a * b).sum();
    for (a, b) in a4.zip(b4) {
        for ((lane, a), b) in lanes.iter_mut().zip(a).zip(b) {
            *lane += a * b;
        }
    }
    (lanes[0] + lanes[1]) + (lanes[2] + lanes[3]) + rest
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::irl::random::Stream;
    use crate::mdp::{PlanOptions, PlannerKind, plan};

    fn mdp(n: usize, n_actions: usize, stream: &mut Stream) -> TabularMdp {
        let (mut offsets, mut next, mut probabilities) = (vec![0], Vec::new(), Vec::new());
        for pair in 0..n * n_actions {
            let mut row: Vec<u32> = (0..3).map(|_| (stream.uniform() * n as f64) as u32).collect();
            row.push((pair / n_actions) as u32);
            row.sort_unstable();
            row.dedup();
            // the last state absorbs
            let row = if pair / n_actions == n - 1 { vec![n as u32 - 1] } else { row };
            let masses: Vec<f64> = row.iter().map(|_| 0.1 + stream.uniform()).collect();
            let total: f64 = masses.iter().sum();
            probabilities.extend(masses.iter().map(|m| m / total));
            next.extend(row);
            offsets.push(next.len());
        }
        TabularMdp::new(n, n_actions, offsets, next, probabilities, None).expect("a model")
    }

    #[test]
    fn a_walk_of_rewards_stays_with_the_planner() {
        let mut stream = Stream::new(1, 0);
        for (n, discount) in [(1, 0.9), (12, 0.0), (12, 0.9), (30, 0.9999), (12, 1.0)] {
            let mdp = mdp(n, 3, &mut stream);
            let basis = Basis::state_action(&mdp);
            let mut optimum = Optimum::new(&mdp, discount, 7);
            let mut reward: Vec<f64> = (0..3 * n).map(|_| stream.uniform()).collect();
            for _ in 0..300 {
                for r in &mut reward {
                    *r = 0.7 * *r + 0.3 * stream.uniform();
                }
                optimum.solve(&reward);
                let options = PlanOptions { discount, horizon: Some(7), ..PlanOptions::default() };
                let want = plan(PlannerKind::PolicyIteration, &mdp, &reward, &options).expect("a plan");
                let size = max_abs(&want.action_values);
                for (q, w) in optimum.action_values().iter().zip(&want.action_values) {
                    assert!((q - w).abs() < 1e-9 * size, "discount {discount}: {q} and {w}");
                }
            }
            // both derivatives agree with each other and with differences
            let by_value: Vec<f64> = (0..3 * n).map(|_| stream.normal()).collect();
            let by_reward = optimum.pull_back(&by_value);
            let mut forward = vec![0.0; 3 * n];
            optimum.for_each_sensitivity(
                &basis,
                |_| true,
                |state, rows| {
                    for (action, row) in rows.iter().enumerate() {
                        axpy(by_value[3 * state + action], row, &mut forward);
                    }
                },
            );
            let objective = |optimum: &mut Optimum, reward: &[f64]| {
                optimum.solve(reward);
                dot(optimum.action_values(), &by_value)
            };
            for b in 0..3 * n {
                assert!((by_reward[b] - forward[b]).abs() < 1e-8 * (1.0 + by_reward[b].abs()) / (1.001 - discount));
                let mut moved = reward.clone();
                moved[b] += 1e-7;
                let above = objective(&mut optimum, &moved);
                moved[b] -= 2e-7;
                let slope = (above - objective(&mut optimum, &moved)) / 2e-7;
                assert!((slope - by_reward[b]).abs() < 1e-3 * (1.0 + by_reward[b].abs()) / (1.001 - discount));
            }
        }
    }
}
