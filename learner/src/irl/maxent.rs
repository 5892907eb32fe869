//! `maxent`: maximum entropy over trajectories, Ziebart, Maas, Bagnell & Dey (2008).
//!
//! A trajectory of m steps from s₁ has the probability Π P(s'|s,a) exp(Σ wᵀΦ(s,a)) / Z_m(s₁) (their eq. 4). The partition function
//! follows backward, Z_m(s) = Σ_a exp R(s,a) Σ P(s'|s,a) Z_{m−1}(s'), Z_0 = 1, and the derivative of its logarithm is the
//! expected number of passages under that distribution: one pass forward. Both are exact here; the authors' own forward pass
//! mixes this distribution's actions with the model's transitions, and then no objective belongs to it.
//!
//! Where transitions are random this is not what an expert can do: the distribution also prefers lucky transitions, as if
//! the expert chose them (`mce` mends that). The reward is undiscounted over the demonstrations' own number of steps.

use super::penalty::{Penalised, maximise};
use super::visits::Visits;
use super::{Basis, Fit, FitError, Method, Problem, Progress, Trace};
use crate::mdp::{TabularMdp, log_sum_exp};

/// Strength of the penalty for one trajectory where the options name none. It grows with √L, as the standard error of a
/// visit count does.
const STRENGTH: f64 = 2.0;
/// Most messages (steps times pairs) that are kept, 400 MB.
const MAX_MESSAGES: usize = 50_000_000;
/// Below this a sum of scaled partition functions may have lost its digits.
const TINY: f64 = 1e-250;

/// Maximum entropy over trajectories.
pub(super) struct MaxEnt;

impl Method for MaxEnt {
    fn id(&self) -> &'static str {
        "maxent"
    }

    fn description(&self) -> &'static str {
        "maximum entropy over trajectories, Ziebart et al. (2008)"
    }

    fn fit(&self, problem: &Problem<'_>, progress: Progress<'_>) -> Result<Fit, FitError> {
        problem.check()?;
        let mut trace = Trace::new(progress);
        let options = problem.options;
        let basis = problem.basis();
        let mut paths = Paths::new(problem.mdp, &basis, &Visits::new(problem))?;
        let penalised = Penalised::new(options, STRENGTH * (problem.statistics.n_trajectories() as f64).sqrt());
        let found = maximise(problem, &penalised, &basis, &mut trace, |weights| paths.value_and_gradient(weights))?;
        Fit::planned(problem, &basis, found.weights, trace, found.stopped, found.warnings)
    }
}

/// Log-likelihood of the demonstrated trajectories given where they start, up to a constant.
///
/// Only the numbers of starts and of lengths are known, so a length is taken to say nothing about the start.
struct Paths<'a> {
    mdp: &'a TabularMdp,
    basis: &'a Basis,
    /// Σ_k N_k, shape (`n_states * n_actions`,).
    counts: Vec<f64>,
    /// N_0(s), shape (`n_states`,).
    starts: Vec<f64>,
    /// Share of trajectories with m = 1, 2, … steps, shape (steps,).
    lengths: Vec<f64>,
    /// log Z_m(s), m = 0, 1, …, shape (steps + 1, `n_states`).
    log_partitions: Vec<f64>,
    /// log exp R(s,a) Σ P Z_{m−1}, m = 1, 2, …, shape (steps, `n_states * n_actions`).
    messages: Vec<f64>,
}

impl<'a> Paths<'a> {
    fn new(mdp: &'a TabularMdp, basis: &'a Basis, visits: &Visits<'_>) -> Result<Self, FitError> {
        let steps = visits.steps();
        let got = steps.saturating_mul(mdp.n_pairs());
        if got > MAX_MESSAGES {
            return Err(FitError::TooLarge { what: "messages (steps times pairs)", limit: MAX_MESSAGES, got });
        }
        Ok(Self {
            mdp,
            basis,
            counts: visits.counts(),
            starts: visits.starts(),
            lengths: (0..steps).map(|k| (visits.alive(k) - visits.alive(k + 1)) / visits.alive(0)).collect(),
            log_partitions: vec![0.0; (steps + 1) * mdp.n_states()],
            messages: vec![0.0; got],
        })
    }

    /// Σ_l (wᵀf_l − log Z(s₁)) and its gradient, shape (`n_basis`,): demonstrated features minus expected ones.
    fn value_and_gradient(&mut self, weights: &[f64]) -> (f64, Vec<f64>) {
        let reward = self.basis.reward(weights);
        self.backward(&reward);
        let n = self.mdp.n_states();
        let mut value: f64 = reward.iter().zip(&self.counts).map(|(r, n)| r * n).sum();
        for (m, share) in self.lengths.iter().enumerate() {
            let log_z = &self.log_partitions[(m + 1) * n..(m + 2) * n];
            value -= self.starts.iter().zip(log_z).map(|(start, z)| share * start * z).sum::<f64>();
        }
        (value, self.basis.project(&self.forward()))
    }

    fn backward(&mut self, reward: &[f64]) {
        let (n, n_pairs, n_actions) = (self.mdp.n_states(), self.mdp.n_pairs(), self.mdp.n_actions());
        let mut scaled = vec![0.0; n];
        let mdp = self.mdp;
        for m in 0..self.lengths.len() {
            let (before, after) = self.log_partitions.split_at_mut((m + 1) * n);
            let before = &before[m * n..];
            let largest = scale_into(before, &mut scaled);
            let messages = &mut self.messages[m * n_pairs..(m + 1) * n_pairs];
            for (pair, (message, r)) in messages.iter_mut().zip(reward).enumerate() {
                let sum = mdp.expected(pair, &scaled);
                *message = r + if sum > TINY { largest + sum.ln() } else { log_expected(mdp, pair, before) };
            }
            for (z, messages) in after.iter_mut().zip(messages.chunks_exact(n_actions)) {
                *z = log_sum_exp(messages);
            }
        }
    }

    /// Demonstrated minus expected passages, shape (`n_states * n_actions`,).
    fn forward(&self) -> Vec<f64> {
        let (n, n_pairs, n_actions) = (self.mdp.n_states(), self.mdp.n_pairs(), self.mdp.n_actions());
        let mut gap = self.counts.clone();
        let mut occupancy = vec![0.0; n];
        let mut scaled = vec![0.0; n];
        for m in (0..self.lengths.len()).rev() {
            for (o, start) in occupancy.iter_mut().zip(&self.starts) {
                *o += self.lengths[m] * start;
            }
            let (before, now) = (&self.log_partitions[m * n..(m + 1) * n], &self.log_partitions[(m + 1) * n..]);
            scale_into(before, &mut scaled);
            let messages = &self.messages[m * n_pairs..(m + 1) * n_pairs];
            let mut next_occupancy = vec![0.0; n];
            for (pair, message) in messages.iter().enumerate() {
                let state = pair / n_actions;
                let passages = occupancy[state] * (message - now[state]).exp();
                if passages == 0.0 {
                    continue;
                }
                gap[pair] -= passages;
                let (next, p) = self.mdp.row(pair);
                let sum = self.mdp.expected(pair, &scaled);
                if sum > TINY {
                    for (&s, &p) in next.iter().zip(p) {
                        next_occupancy[s as usize] += passages * p * scaled[s as usize] / sum;
                    }
                } else {
                    let log_sum = log_expected(self.mdp, pair, before);
                    for (&s, &p) in next.iter().zip(p) {
                        next_occupancy[s as usize] += passages * p * (before[s as usize] - log_sum).exp();
                    }
                }
            }
            occupancy = next_occupancy;
        }
        gap
    }
}

/// log Σ P exp(values) of one pair, without underflow.
fn log_expected(mdp: &TabularMdp, pair: usize, values: &[f64]) -> f64 {
    let (next, p) = mdp.row(pair);
    let terms = next.iter().zip(p).filter(|(_, p)| **p > 0.0);
    log_sum_exp(&terms.map(|(&s, p)| p.ln() + values[s as usize]).collect::<Vec<_>>())
}

/// exp(values − the largest), and the largest.
fn scale_into(values: &[f64], scaled: &mut [f64]) -> f64 {
    let largest = values.iter().copied().fold(f64::NEG_INFINITY, f64::max);
    for (s, v) in scaled.iter_mut().zip(values) {
        *s = (v - largest).exp();
    }
    largest
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::irl::FitOptions;
    use crate::irl::test_cases::{Case, gradient_error};

    #[test]
    fn the_gradient_is_the_gap_of_the_passages() {
        for seed in 0..8 {
            let case = Case::new(seed, 6, 3);
            for basis in case.bases() {
                let options = FitOptions::default();
                let mut paths = Paths::new(&case.mdp, &basis, &Visits::new(&case.problem(&options))).expect("small");
                let error = gradient_error(basis.len(), seed, |w| paths.value_and_gradient(w));
                assert!(error < 1e-6, "{error}");
            }
        }
    }

    /// Every trajectory of two steps, enumerated.
    #[test]
    fn the_partition_function_sums_over_all_trajectories() {
        let case = Case::with_lengths(3, 4, 2, &[2]);
        let basis = Basis::state_action(&case.mdp);
        let options = FitOptions::default();
        let mut paths = Paths::new(&case.mdp, &basis, &Visits::new(&case.problem(&options))).expect("small");
        let weights: Vec<f64> = (0..8).map(|b| f64::from(b) * 0.7 - 2.0).collect();
        let (value, _) = paths.value_and_gradient(&weights);
        let mut want: f64 = weights.iter().zip(case.statistics.counts(None)).map(|(w, n)| w * n).sum();
        for state in 0..4 {
            let mut sum = 0.0;
            for first in 0..2 {
                let (next, p) = case.mdp.row(2 * state + first);
                for (&s, &p) in next.iter().zip(p) {
                    for second in 0..2 {
                        sum += p * (weights[2 * state + first] + weights[2 * s as usize + second]).exp();
                    }
                }
            }
            let starts: f64 = case
                .statistics
                .step_counts(0)
                .iter()
                .filter(|(pair, _)| *pair as usize / 2 == state)
                .map(|c| c.1)
                .sum();
            want -= starts * sum.ln();
        }
        assert!((value - want).abs() < 1e-10, "{value} and {want}");
    }

    #[test]
    fn large_rewards_do_not_underflow() {
        let case = Case::new(1, 6, 2);
        let basis = Basis::state(&case.mdp);
        let options = FitOptions::default();
        let mut paths = Paths::new(&case.mdp, &basis, &Visits::new(&case.problem(&options))).expect("small");
        let (value, gradient) = paths.value_and_gradient(&[1e5, -1e5, 3e5, 0.0, -4e5, 5.0]);
        assert!(value.is_finite() && gradient.iter().all(|g| g.is_finite()));
        // as many passages are expected as were demonstrated
        let gap: f64 = gradient.iter().sum();
        assert!(gap.abs() < 1e-6, "{gap}");
    }
}
