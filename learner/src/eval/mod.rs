//! How good a fit is: agreement, value, likelihood, coverage.
//!
//! Policies are flat π(a|s), shape (`n_states * n_actions`,), as a [`Fit`](crate::irl::Fit) holds them; a greedy policy splits
//! ties evenly, and so does every measure here. Deliberately absent: roll-outs in a simulator, which give the rest.

pub mod calibration;
pub mod comparison;
pub mod transfer;
pub mod validation;

use crate::mdp::{PlanError, PlanOptions, PlannerKind, Policy, TabularMdp, evaluate_policy, plan};
use crate::trajectory::Trajectory;
use serde::{Deserialize, Serialize};

/// A mean with its 95 % confidence interval, in the unit of the mean.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
pub struct Interval {
    /// Estimate.
    pub mean: f64,
    /// Lower end; −∞ where one sample says nothing about the spread.
    pub low: f64,
    /// Upper end; ∞ where one sample says nothing about the spread.
    pub high: f64,
}

/// A probability below this counts as this in a log-likelihood: one impossible step must not hide all the others.
pub const PROBABILITY_FLOOR: f64 = 1e-10;

/// Mean of independent samples with Student's t interval; `None` for no sample.
///
/// Samples are whole episodes, since the steps within one depend on each other.
pub fn mean_interval(samples: &[f64]) -> Option<Interval> {
    if samples.is_empty() {
        return None;
    }
    let n = samples.len() as f64;
    let mean = samples.iter().sum::<f64>() / n;
    if samples.len() == 1 {
        return Some(Interval { mean, low: f64::NEG_INFINITY, high: f64::INFINITY });
    }
    let variance = samples.iter().map(|x| (x - mean).powi(2)).sum::<f64>() / (n - 1.0);
    let half = student_t_975(samples.len() - 1) * (variance / n).sqrt();
    Some(Interval { mean, low: mean - half, high: mean + half })
}

/// Mean per step over episodes of unequal length, Σ total / Σ steps, with the interval of a ratio estimator (Cochran 1977,
/// §6.4) and Student's t; `None` for no step.
pub fn ratio_interval(totals_and_steps: &[(f64, f64)]) -> Option<Interval> {
    let n = totals_and_steps.len() as f64;
    let steps: f64 = totals_and_steps.iter().map(|(_, steps)| steps).sum();
    if steps <= 0.0 {
        return None;
    }
    let mean = totals_and_steps.iter().map(|(total, _)| total).sum::<f64>() / steps;
    if totals_and_steps.len() == 1 {
        return Some(Interval { mean, low: f64::NEG_INFINITY, high: f64::INFINITY });
    }
    let squares: f64 = totals_and_steps.iter().map(|(total, steps)| (total - mean * steps).powi(2)).sum();
    let half = student_t_975(totals_and_steps.len() - 1) * (squares / (n - 1.0) / n).sqrt() / (steps / n);
    Some(Interval { mean, low: mean - half, high: mean + half })
}

/// 0.975 quantile of Student's t with `degrees` ≥ 1 degrees of freedom, to 1e-3 and better.
pub fn student_t_975(degrees: usize) -> f64 {
    const TABLE: [f64; 10] = [12.7062, 4.3027, 3.1824, 2.7764, 2.5706, 2.4469, 2.3646, 2.3060, 2.2622, 2.2281];
    if let Some(&t) = TABLE.get(degrees.max(1) - 1) {
        return t;
    }
    // expansion about the normal quantile, Abramowitz & Stegun 26.7.5
    let (z, v) = (1.959_963_984_540_054_f64, degrees as f64);
    let (z3, z5, z7) = (z.powi(3), z.powi(5), z.powi(7));
    z + (z3 + z) / (4.0 * v)
        + (5.0 * z5 + 16.0 * z3 + 3.0 * z) / (96.0 * v * v)
        + (3.0 * z7 + 19.0 * z5 + 17.0 * z3 - 15.0 * z) / (384.0 * v.powi(3))
}

/// Share of states whose action under `policy` is one that `expert` takes: the mean over all states of the mass that `policy`
/// puts on actions with a positive probability under `expert`.
pub fn state_agreement(policy: &[f64], expert: &[f64], n_actions: usize) -> f64 {
    let agreed: f64 = policy.iter().zip(expert).filter(|(_, expert)| **expert > 0.0).map(|(p, _)| p).sum();
    agreed * n_actions as f64 / policy.len() as f64
}

/// Share of demonstrated steps whose action `policy` takes: Σ N(s,a) π(a|s) / Σ N(s,a); 0 for no step.
pub fn step_agreement(policy: &[f64], counts: &[f64]) -> f64 {
    let steps: f64 = counts.iter().sum();
    if steps == 0.0 {
        return 0.0;
    }
    policy.iter().zip(counts).map(|(p, n)| p * n).sum::<f64>() / steps
}

/// Mean log π(a|s) over counted steps, in nats; 0 for no step. See [`PROBABILITY_FLOOR`].
pub fn log_likelihood_per_step(policy: &[f64], counts: &[f64]) -> f64 {
    let steps: f64 = counts.iter().sum();
    if steps == 0.0 {
        return 0.0;
    }
    policy.iter().zip(counts).map(|(p, n)| n * p.max(PROBABILITY_FLOOR).ln()).sum::<f64>() / steps
}

/// Log-likelihood per step of demonstrations that the fit did not see.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
pub struct HeldOut {
    /// Mean log π(a|s) a step over all episodes, in nats, with its interval over episodes.
    pub log_likelihood: Interval,
    /// Steps whose probability lay below [`PROBABILITY_FLOOR`] and counted as that.
    pub impossible_steps: u64,
    /// Steps in all.
    pub steps: u64,
}

/// Scores held-out trajectories, those without actions left out; `None` for no trajectory.
///
/// # Panics
/// Where a trajectory's states or actions lie outside the policy.
pub fn held_out<'a>(
    policy: &[f64],
    n_actions: usize,
    trajectories: impl IntoIterator<Item = &'a Trajectory>,
) -> Option<HeldOut> {
    let mut episodes = Vec::new();
    let (mut impossible_steps, mut steps) = (0, 0);
    for trajectory in trajectories.into_iter().filter(|trajectory| trajectory.has_actions()) {
        let mut total = 0.0;
        for (&state, &action) in trajectory.states().iter().zip(trajectory.actions()) {
            let p = policy[state as usize * n_actions + action as usize];
            impossible_steps += u64::from(p < PROBABILITY_FLOOR);
            total += p.max(PROBABILITY_FLOOR).ln();
        }
        steps += trajectory.len() as u64;
        episodes.push((total, trajectory.len() as f64));
    }
    Some(HeldOut { log_likelihood: ratio_interval(&episodes)?, impossible_steps, steps })
}

/// What acting on a learned policy loses under the true reward.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
pub struct ExpectedValueDifference {
    /// Σ p(s₁) V*(s₁): discounted sum of the true reward, acting optimally.
    pub optimal_value: f64,
    /// Σ p(s₁) V^π(s₁) of the policy.
    pub policy_value: f64,
    /// `optimal_value − policy_value`, never negative but for rounding. Not normalised: its unit is the reward's, summed over
    /// the effective horizon 1/(1 − γ).
    pub difference: f64,
}

impl ExpectedValueDifference {
    /// The difference as a share of what acting optimally gains over acting at random, given that value; 0 where that gains
    /// nothing.
    pub fn relative_to(&self, random_value: f64) -> f64 {
        let gain = self.optimal_value - random_value;
        if gain > 0.0 { self.difference / gain } else { 0.0 }
    }
}

/// Expected value difference of `policy` under the true reward and the model's initial distribution.
///
/// `horizon` is looked at only where the discount is 1.
///
/// # Errors
/// As [`plan`].
pub fn expected_value_difference(
    mdp: &TabularMdp,
    true_reward: &[f64],
    discount: f64,
    horizon: Option<u32>,
    policy: &Policy,
) -> Result<ExpectedValueDifference, PlanError> {
    let options = PlanOptions { discount, horizon, ..PlanOptions::default() };
    let optimal = plan(PlannerKind::PolicyIteration, mdp, true_reward, &options)?;
    let horizon = if discount < 1.0 { None } else { horizon };
    let values = evaluate_policy(mdp, policy, true_reward, discount, horizon);
    let from_start =
        |values: &[f64]| -> f64 { mdp.initial_distribution().iter().zip(values).map(|(p, v)| p * v).sum() };
    let (optimal_value, policy_value) = (from_start(&optimal.state_values), from_start(&values));
    Ok(ExpectedValueDifference { optimal_value, policy_value, difference: (optimal_value - policy_value).max(0.0) })
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn quantiles_of_student() {
        for (degrees, want) in [(1, 12.7062), (4, 2.7764), (11, 2.2010), (15, 2.1314), (30, 2.0423), (120, 1.9799)] {
            assert!((student_t_975(degrees) - want).abs() < 1e-3, "{degrees}: {}", student_t_975(degrees));
        }
        assert!((student_t_975(1_000_000) - 1.959_966).abs() < 1e-5);
        assert!((1..200).all(|v| student_t_975(v) > student_t_975(v + 1)));
    }

    #[test]
    fn intervals() {
        assert_eq!(mean_interval(&[]), None);
        let one = mean_interval(&[3.0]).expect("a mean");
        assert_eq!((one.mean, one.low, one.high), (3.0, f64::NEG_INFINITY, f64::INFINITY));
        let two = mean_interval(&[1.0, 3.0]).expect("a mean");
        assert!((two.mean - 2.0).abs() < 1e-15 && (two.high - 2.0 - 12.7062).abs() < 1e-9);
        assert!((two.high - two.mean - (two.mean - two.low)).abs() < 1e-12);
    }

    #[test]
    fn a_ratio_of_equal_lengths_is_a_mean() {
        let samples = [0.3, -0.5, 1.25, 0.75];
        let plain = mean_interval(&samples).expect("a mean");
        let ratio = ratio_interval(&samples.map(|x| (x * 5.0, 5.0))).expect("a mean");
        for (a, b) in [(plain.mean, ratio.mean), (plain.low, ratio.low), (plain.high, ratio.high)] {
            assert!((a - b).abs() < 1e-12);
        }
        assert_eq!(ratio_interval(&[]), None);
    }

    #[test]
    fn agreement_splits_ties() {
        let expert = [0.5, 0.5, 0.0, 1.0];
        assert_eq!(state_agreement(&[1.0, 0.0, 0.0, 1.0], &expert, 2), 1.0);
        assert_eq!(state_agreement(&[0.5, 0.5, 0.5, 0.5], &expert, 2), 0.75);
        assert_eq!(step_agreement(&[0.5, 0.5, 0.0, 1.0], &[3.0, 1.0, 2.0, 2.0]), 0.5);
        assert_eq!(step_agreement(&expert, &[0.0; 4]), 0.0);
    }

    #[test]
    fn impossible_steps_are_counted_and_floored() {
        let policy = [1.0, 0.0];
        let trajectories = [
            Trajectory::new(vec![0, 0], vec![0, 1], None, 1, 2).expect("a trajectory"),
            Trajectory::new(vec![0], vec![0], None, 1, 2).expect("a trajectory"),
        ];
        let score = held_out(&policy, 2, &trajectories).expect("a score");
        assert_eq!((score.impossible_steps, score.steps), (1, 3));
        assert!((score.log_likelihood.mean - PROBABILITY_FLOOR.ln() / 3.0).abs() < 1e-12);
        assert!(score.log_likelihood.low < score.log_likelihood.mean && score.log_likelihood.high.is_finite());
        assert_eq!(held_out(&policy, 2, &[]), None);
    }

    #[test]
    fn value_difference_of_a_line_of_states() {
        // two states; action 0 stays, action 1 changes; reward in state 1
        let mdp = TabularMdp::new(2, 2, vec![0, 1, 2, 3, 4], vec![0, 1, 1, 0], vec![1.0; 4], Some(vec![1.0, 0.0]));
        let mdp = mdp.expect("a model");
        let reward = [0.0, 0.0, 1.0, 1.0];
        let stay = Policy::new(2, vec![1.0, 0.0, 1.0, 0.0]).expect("a policy");
        let found = expected_value_difference(&mdp, &reward, 0.5, None, &stay).expect("a difference");
        assert!((found.optimal_value - 1.0).abs() < 1e-12 && found.policy_value.abs() < 1e-12);
        assert!((found.relative_to(0.0) - 1.0).abs() < 1e-12);
        let finite = expected_value_difference(&mdp, &reward, 1.0, Some(4), &stay).expect("a difference");
        assert!((finite.difference - 3.0).abs() < 1e-12);
    }
}
