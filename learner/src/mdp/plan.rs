//! One door to all planners.

use super::planners::{expectation_maximization, finite, policy_iteration, soft, value_iteration};
use super::policy::Policy;
use super::tabular::TabularMdp;
use serde::{Deserialize, Serialize};

/// Turns a reward into a policy.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum PlannerKind {
    /// Value iteration.
    #[default]
    ValueIteration,
    /// Policy iteration.
    PolicyIteration,
    /// Soft value iteration.
    SoftValueIteration,
    /// Toussaint & Storkey (2006).
    ExpectationMaximization,
}

/// Prior p(k) over the number of steps k = 1..K.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum HorizonPrior {
    /// (1 − γ) γ^(k−1), normalised over 1..K.
    #[default]
    Geometric,
    /// 1/K.
    Uniform,
}

impl HorizonPrior {
    /// p(1), …, p(n) of a prior over 1..`horizon`, for n ≤ `horizon`. The limit γ → 1 of the geometric prior is the uniform one.
    pub fn probabilities(self, discount: f64, horizon: u32, n: usize) -> Vec<f64> {
        let ratio = self.ratio(discount);
        let mut p = self.first(discount, horizon);
        (0..n)
            .map(|_| {
                let now = p;
                p *= ratio;
                now
            })
            .collect()
    }

    /// p(k + 1) / p(k).
    pub(crate) fn ratio(self, discount: f64) -> f64 {
        match self {
            Self::Geometric => discount,
            Self::Uniform => 1.0,
        }
    }

    /// p(1).
    pub(crate) fn first(self, discount: f64, horizon: u32) -> f64 {
        let ratio = self.ratio(discount);
        if ratio == 1.0 {
            1.0 / f64::from(horizon.max(1))
        } else {
            // 1 − γ^K without cancellation as γ → 1
            (1.0 - ratio) / -(f64::from(horizon) * ratio.ln()).exp_m1()
        }
    }
}

/// How to plan.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct PlanOptions {
    /// γ in [0, 1]; 1 needs a horizon.
    pub discount: f64,
    /// Number of steps that are planned over where γ = 1, and the K of [`PlannerKind::ExpectationMaximization`] under a
    /// uniform prior; not used otherwise.
    pub horizon: Option<u32>,
    /// Prior of [`PlannerKind::ExpectationMaximization`].
    pub horizon_prior: HorizonPrior,
}

impl Default for PlanOptions {
    /// Discount 0.9, no horizon, geometric prior.
    fn default() -> Self {
        Self { discount: 0.9, horizon: None, horizon_prior: HorizonPrior::Geometric }
    }
}

/// What a planner returns.
#[derive(Debug, Clone, PartialEq)]
pub struct Plan {
    /// V(s), shape (`n_states`,).
    pub state_values: Vec<f64>,
    /// Q(s,a), shape (`n_states * n_actions`,).
    pub action_values: Vec<f64>,
    /// Best actions, ties split evenly; exp(Q − V) for the soft planner. Over a finite horizon: the first step's.
    pub policy: Policy,
    /// Sweeps, improvements or EM steps done.
    pub iterations: u32,
    /// False where the iterations ran out.
    pub converged: bool,
}

impl Plan {
    /// Best actions under the action values, ties split evenly.
    pub fn greedy_policy(&self) -> Policy {
        Policy::greedy(self.policy.n_actions(), &self.action_values)
    }
}

/// Why there is no plan.
#[derive(Debug, Clone, PartialEq, thiserror::Error)]
pub enum PlanError {
    /// γ outside [0, 1].
    #[error("expected a discount in [0, 1], got {discount}")]
    Discount {
        /// What came.
        discount: f64,
    },
    /// No horizon where one is needed.
    #[error("expected a horizon of at least 1 where the discount is 1 or the horizon prior uniform, got none")]
    Horizon,
    /// A reward of another shape, or not finite.
    #[error("expected {expected} finite rewards, got {reason}")]
    Reward {
        /// Number of state-action pairs.
        expected: usize,
        /// What is wrong.
        reason: String,
    },
    /// The messages of all steps do not fit into memory.
    #[error("expected at most {limit} messages (horizon times states), got {got}")]
    TooLarge {
        /// The limit.
        limit: usize,
        /// What it would take.
        got: usize,
    },
}

/// Plans on R(s,a), shape (`n_states * n_actions`,).
///
/// Where γ = 1, all planners but Toussaint & Storkey's do backward induction over `options.horizon` steps and return the
/// first step's values and policy.
///
/// # Errors
/// A discount outside [0, 1], no horizon where one is needed, a reward of another shape or not finite.
pub fn plan(kind: PlannerKind, mdp: &TabularMdp, reward: &[f64], options: &PlanOptions) -> Result<Plan, PlanError> {
    let discount = options.discount;
    if !(0.0..=1.0).contains(&discount) {
        return Err(PlanError::Discount { discount });
    }
    let expected = mdp.n_pairs();
    if reward.len() != expected {
        return Err(PlanError::Reward { expected, reason: format!("{} rewards", reward.len()) });
    }
    if let Some(pair) = reward.iter().position(|r| !r.is_finite()) {
        return Err(PlanError::Reward { expected, reason: format!("{} at {pair}", reward[pair]) });
    }
    let finite_horizon = || options.horizon.filter(|&k| k > 0).ok_or(PlanError::Horizon);
    match kind {
        PlannerKind::ExpectationMaximization => {
            let horizon = match options.horizon_prior {
                HorizonPrior::Geometric if discount < 1.0 => None,
                _ => Some(finite_horizon()?),
            };
            expectation_maximization::plan(mdp, reward, discount, horizon)
        }
        PlannerKind::SoftValueIteration if discount == 1.0 => Ok(finite::plan(mdp, reward, finite_horizon()?, true)),
        _ if discount == 1.0 => Ok(finite::plan(mdp, reward, finite_horizon()?, false)),
        PlannerKind::ValueIteration => Ok(value_iteration::plan(mdp, reward, discount)),
        PlannerKind::PolicyIteration => Ok(policy_iteration::plan(mdp, reward, discount)),
        PlannerKind::SoftValueIteration => Ok(soft::plan(mdp, reward, discount)),
    }
}
