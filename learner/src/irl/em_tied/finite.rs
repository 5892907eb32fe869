//! Log-likelihood of soft-optimal behaviour over a finite horizon without discount, with its exact gradient and Hessian.
//!
//! With t steps to go, V_t = log Σ_a exp Q_t, Q_t = R + P V_{t−1} and V_0 = 0: a policy for every t. Step k = 0, 1, … of the
//! demonstrations has K − k steps to go, so ℓ = Σ_k Σ_{s,a} N_k(s,a) (Q_{K−k}(s,a) − V_{K−k}(s)). Memory is O(K · states): the
//! values are kept, action values and policies are made again on the way back.

use super::SoftLikelihood;
use crate::irl::{Basis, FitError};
use crate::mdp::{Policy, TabularMdp, log_sum_exp};
use crate::statistics::Statistics;
use nalgebra::DMatrix;

/// Values kept at once: 512 MB.
const MAX_VALUES: usize = 64 << 20;

/// ℓ(w) of the counts of every step, for γ = 1.
pub struct FiniteLikelihood<'a> {
    mdp: &'a TabularMdp,
    basis: &'a Basis,
    statistics: &'a Statistics,
    horizon: usize,
    /// V_t for t = 0..=K, row after row.
    values: Vec<f64>,
    reward: Vec<f64>,
    /// Q_K of the weights last evaluated.
    action_values: Vec<f64>,
    policy: Vec<f64>,
}

impl<'a> FiniteLikelihood<'a> {
    /// Of the first `horizon` ≥ 1 steps of the demonstrations.
    ///
    /// # Errors
    /// More values (horizon times states) than fit into memory.
    pub fn new(
        mdp: &'a TabularMdp,
        basis: &'a Basis,
        statistics: &'a Statistics,
        horizon: u32,
    ) -> Result<Self, FitError> {
        let horizon = horizon.max(1) as usize;
        let got = horizon.saturating_mul(mdp.n_states());
        if got > MAX_VALUES {
            return Err(FitError::TooLarge { what: "values (horizon times states)", limit: MAX_VALUES, got });
        }
        Ok(Self {
            mdp,
            basis,
            statistics,
            horizon,
            values: vec![0.0; (horizon + 1) * mdp.n_states()],
            reward: vec![0.0; mdp.n_pairs()],
            action_values: vec![0.0; mdp.n_pairs()],
            policy: vec![0.0; mdp.n_pairs()],
        })
    }

    /// ℓ(w) and dℓ/dw, shape (`n_basis`,).
    ///
    /// From t = K down, v_t(s) = −N_{K−t}(s) + Σ q_{t+1} P(s|·) is the derivative with respect to V_t(s) and
    /// q_t(s,a) = N_{K−t}(s,a) + π_t(a|s) v_t(s) that with respect to Q_t(s,a); the derivative with respect to R is Σ_t q_t.
    pub fn value_and_gradient(&mut self, weights: &[f64]) -> (f64, Vec<f64>) {
        self.solve(weights);
        let mut log_likelihood = 0.0;
        let mut by_reward = vec![0.0; self.mdp.n_pairs()];
        self.backward(|step| {
            log_likelihood += step.log_likelihood;
            for (sum, q) in by_reward.iter_mut().zip(step.by_action_value) {
                *sum += q;
            }
        });
        (log_likelihood, self.basis.project(&by_reward))
    }

    /// d²ℓ/dw², shape (`n_basis`, `n_basis`): Σ_t Σ_s v_t(s) Cov_{a ~ π_t(s)}(g_b, g_c) with g_b = dQ_t/dw_b, as over an infinite
    /// horizon. Takes K · states · `n_basis` numbers of memory.
    pub fn hessian(&mut self, weights: &[f64]) -> DMatrix<f64> {
        self.hessian_and_terms(weights).0
    }

    /// The Hessian, and for each b the sum of the absolute terms whose differences make its diagonal entry.
    pub(super) fn hessian_and_terms(&mut self, weights: &[f64]) -> (DMatrix<f64>, Vec<f64>) {
        self.solve(weights);
        let (mdp, basis) = (self.mdp, self.basis);
        let (n_states, n_actions, n_basis) = (mdp.n_states(), mdp.n_actions(), basis.len());
        // dV_t/dw, one matrix (n_basis, n_states) for each t
        let mut sensitivities = vec![DMatrix::<f64>::zeros(n_basis, n_states)];
        for t in 1..=self.horizon {
            let policy = self.step_policy(t);
            let mut next = DMatrix::zeros(n_basis, n_states);
            for state in 0..n_states {
                for (action, &p) in policy[state * n_actions..][..n_actions].iter().enumerate() {
                    let mut column = next.column_mut(state);
                    let pair = mdp.pair(state, action);
                    basis.for_each(pair, |b, value| column[b] += p * value);
                    let (to, probabilities) = mdp.row(pair);
                    for (&to, &q) in to.iter().zip(probabilities) {
                        column.axpy(p * q, &sensitivities[t - 1].column(to as usize), 1.0);
                    }
                }
            }
            sensitivities.push(next);
        }
        let mut hessian = DMatrix::zeros(n_basis, n_basis);
        let mut terms = vec![0.0; n_basis];
        let mut centred = DMatrix::zeros(n_basis, n_actions);
        self.backward(|step| {
            let (now, before) = (&sensitivities[step.to_go], &sensitivities[step.to_go - 1]);
            for (state, &v) in step.by_state_value.iter().enumerate() {
                for action in 0..n_actions {
                    let pair = mdp.pair(state, action);
                    let mut column = centred.column_mut(action);
                    column.axpy(-1.0, &now.column(state), 0.0);
                    let (to, probabilities) = mdp.row(pair);
                    for (&to, &q) in to.iter().zip(probabilities) {
                        column.axpy(q, &before.column(to as usize), 1.0);
                    }
                    basis.for_each(pair, |b, value| column[b] += value);
                    for (b, term) in terms.iter_mut().enumerate() {
                        *term += (v * step.policy[pair]).abs() * now[(b, state)].powi(2);
                    }
                }
                let weighted = DMatrix::from_fn(n_basis, n_actions, |b, action| {
                    v * step.policy[mdp.pair(state, action)] * centred[(b, action)]
                });
                hessian.gemm(1.0, &weighted, &centred.transpose(), 1.0);
            }
        });
        (hessian, terms)
    }

    /// Q of the first step, of the weights last evaluated, shape (`n_states * n_actions`,).
    pub fn action_values(&self) -> &[f64] {
        &self.action_values
    }

    /// V of the first step, shape (`n_states`,).
    pub fn state_values(&self) -> &[f64] {
        &self.values[self.horizon * self.mdp.n_states()..]
    }

    /// π of the first step, shape (`n_states * n_actions`,).
    pub fn policy(&self) -> &[f64] {
        &self.policy
    }

    /// V_t for all t, and Q and π of the first step.
    fn solve(&mut self, weights: &[f64]) {
        self.reward = self.basis.reward(weights);
        let (n_states, n_actions) = (self.mdp.n_states(), self.mdp.n_actions());
        for t in 1..=self.horizon {
            let (before, now) = self.values.split_at_mut(t * n_states);
            self.mdp.action_values_into(&self.reward, 1.0, &before[(t - 1) * n_states..], &mut self.action_values);
            for (v, q) in now.iter_mut().zip(self.action_values.chunks_exact(n_actions)) {
                *v = log_sum_exp(q);
            }
        }
        self.policy = self.step_policy(self.horizon);
    }

    /// π with t steps to go.
    fn step_policy(&self, t: usize) -> Vec<f64> {
        let n_states = self.mdp.n_states();
        let values = self.mdp.action_values(&self.reward, 1.0, &self.values[(t - 1) * n_states..][..n_states]);
        // normalised: of large values exp(Q − V) would keep few digits
        Policy::boltzmann(self.mdp.n_actions(), &values, 1.0).into_probabilities()
    }

    /// The adjoint recursion from the first step to the last.
    fn backward(&self, mut visit: impl FnMut(&Step<'_>)) {
        let (n_states, n_actions) = (self.mdp.n_states(), self.mdp.n_actions());
        let mut by_state_value = vec![0.0; n_states];
        let mut by_action_value = vec![0.0; self.mdp.n_pairs()];
        for to_go in (1..=self.horizon).rev() {
            let counts = self.statistics.step_counts(self.horizon - to_go);
            let policy = self.step_policy(to_go);
            let mut log_likelihood = 0.0;
            by_action_value.fill(0.0);
            for &(pair, count) in counts {
                let pair = pair as usize;
                let q = self.reward[pair] + self.mdp.expected(pair, &self.values[(to_go - 1) * n_states..][..n_states]);
                log_likelihood += count * (q - self.values[to_go * n_states + pair / n_actions]);
                by_action_value[pair] += count;
                by_state_value[pair / n_actions] -= count;
            }
            for (pair, (q, p)) in by_action_value.iter_mut().zip(&policy).enumerate() {
                *q += p * by_state_value[pair / n_actions];
            }
            visit(&Step {
                to_go,
                log_likelihood,
                policy: &policy,
                by_state_value: &by_state_value,
                by_action_value: &by_action_value,
            });
            by_state_value = self.mdp.propagate(&by_action_value);
        }
    }
}

impl SoftLikelihood for FiniteLikelihood<'_> {
    fn value_and_gradient(&mut self, weights: &[f64]) -> (f64, Vec<f64>) {
        FiniteLikelihood::value_and_gradient(self, weights)
    }

    fn hessian_and_terms(&mut self, weights: &[f64]) -> (DMatrix<f64>, Vec<f64>) {
        FiniteLikelihood::hessian_and_terms(self, weights)
    }

    fn action_values(&self) -> &[f64] {
        FiniteLikelihood::action_values(self)
    }

    fn state_values(&self) -> &[f64] {
        FiniteLikelihood::state_values(self)
    }

    fn policy(&self) -> &[f64] {
        FiniteLikelihood::policy(self)
    }

    fn converged(&self) -> bool {
        true
    }
}

/// One step of the adjoint recursion.
struct Step<'a> {
    to_go: usize,
    log_likelihood: f64,
    policy: &'a [f64],
    by_state_value: &'a [f64],
    by_action_value: &'a [f64],
}
