//! The linear programme in sparse rows: values are variables tied to the weights, never eliminated.
//!
//! Variables: w (`n_basis`), then V of each level (`n_states` a level), then one margin y per state that has one. With γ < 1 there
//! is one level, V = R_π + γ P_π V; with γ = 1 level k holds the values of k + 1 steps, one for each step but the last.

use crate::irl::penalty::Penalised;
use crate::irl::{Basis, FitError, Penalty, Problem};
use crate::mdp::TabularMdp;

/// Most values (levels times states) that are taken as variables.
const MAX_VALUES: usize = 100_000;

/// Minimise ½ xᵀ diag(quadratic) x + linearᵀx, rows x = right for the first `n_equal`, rows x ≤ right for the others.
pub(super) struct Programme {
    pub(super) n_variables: usize,
    pub(super) rows: Vec<Vec<(usize, f64)>>,
    pub(super) right: Vec<f64>,
    pub(super) n_equal: usize,
    pub(super) linear: Vec<f64>,
    pub(super) quadratic: Vec<f64>,
}

impl Programme {
    /// `policy` is the one to be explained, shape (`n_states * n_actions`,); margins are asked for where `counts` are.
    pub(super) fn new(
        problem: &Problem<'_>,
        basis: &Basis,
        counts: &[f64],
        policy: &[f64],
        penalised: &Penalised,
    ) -> Result<Self, FitError> {
        let mdp = problem.mdp;
        let (n_states, n_actions, n_basis) = (mdp.n_states(), mdp.n_actions(), basis.len());
        let discount = problem.options.discount;
        let forever = discount < 1.0;
        let levels = if forever { 1 } else { problem.horizon() as usize - 1 };
        let got = levels.saturating_mul(n_states);
        if got > MAX_VALUES {
            return Err(FitError::TooLarge { what: "values (steps times states) for lp", limit: MAX_VALUES, got });
        }
        let n_variables = n_basis + levels * n_states;
        let mut programme = Self {
            n_variables,
            rows: Vec::new(),
            right: Vec::new(),
            n_equal: levels * n_states,
            linear: vec![0.0; n_variables],
            quadratic: vec![0.0; n_variables],
        };
        let action_value = |pair: usize, factor: f64, level: Option<usize>, row: &mut Vec<(usize, f64)>| {
            basis.for_each(pair, |b, value| row.push((b, factor * value)));
            if let Some(level) = level {
                let (next, p) = mdp.row(pair);
                let first = n_basis + level * n_states;
                row.extend(next.iter().zip(p).map(|(&s, &p)| (first + s as usize, factor * discount * p)));
            }
        };
        for level in 0..levels {
            let behind = if forever { Some(level) } else { level.checked_sub(1) };
            for state in 0..n_states {
                let mut row = vec![(n_basis + level * n_states + state, 1.0)];
                for pair in pairs(mdp, state).filter(|&pair| policy[pair] > 0.0) {
                    action_value(pair, -policy[pair], behind, &mut row);
                }
                programme.push(row, 0.0);
            }
        }
        let behind = levels.checked_sub(1);
        for state in 0..n_states {
            let visits: f64 = counts[state * n_actions..(state + 1) * n_actions].iter().sum();
            if visits == 0.0 || pairs(mdp, state).all(|pair| counts[pair] > 0.0) {
                continue;
            }
            // y ≤ Σ_a π(a|s) Q(s,a) − Q(s,b) for all actions b that were not demonstrated
            let margin = programme.n_variables;
            programme.n_variables += 1;
            programme.linear.push(-visits);
            programme.quadratic.push(0.0);
            for other in pairs(mdp, state).filter(|&pair| counts[pair] == 0.0) {
                let mut row = vec![(margin, 1.0)];
                action_value(other, 1.0, behind, &mut row);
                for pair in pairs(mdp, state).filter(|&pair| policy[pair] > 0.0) {
                    action_value(pair, -policy[pair], behind, &mut row);
                }
                programme.push(row, 0.0);
            }
        }
        let lower = if problem.options.penalty == Penalty::L1 { 0.0 } else { 1.0 };
        for b in 0..n_basis {
            match problem.options.penalty {
                Penalty::L1 => programme.linear[b] = penalised.strength(),
                Penalty::L2 => programme.quadratic[b] = penalised.strength(),
                Penalty::None => {}
            }
            programme.push(vec![(b, -1.0)], lower);
            programme.push(vec![(b, 1.0)], 1.0);
        }
        Ok(programme)
    }

    /// Adds a row whose entries may repeat a variable.
    fn push(&mut self, mut row: Vec<(usize, f64)>, right: f64) {
        row.sort_unstable_by_key(|entry| entry.0);
        row.dedup_by(|later, kept| {
            let same = later.0 == kept.0;
            if same {
                kept.1 += later.1;
            }
            same
        });
        row.retain(|entry| entry.1 != 0.0);
        self.rows.push(row);
        self.right.push(right);
    }
}

fn pairs(mdp: &TabularMdp, state: usize) -> std::ops::Range<usize> {
    mdp.pair(state, 0)..mdp.pair(state + 1, 0)
}
