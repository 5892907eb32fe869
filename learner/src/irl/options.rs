//! What decides a fit beside model and data.

use super::FitError;
use crate::mdp::{HorizonPrior, PlannerKind};
use serde::{Deserialize, Serialize};

/// Basis functions Φ of the reward.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum BasisKind {
    /// Dirac on states, shape (`n_states`,).
    #[default]
    State,
    /// Dirac on state-action pairs, shape (`n_states * n_actions`,).
    StateAction,
    /// The features of [`Problem::features`](super::Problem::features).
    Features,
}

/// Reward step of `em`.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum MStep {
    /// Non-negative least squares, Hahn & Zoubir (2015) eq. 10.
    #[default]
    Nnls,
    /// Exact maximiser of Q on the simplex.
    Simplex,
}

/// Responsibilities of `em`.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum Responsibility {
    /// ρ_k = 1.
    #[default]
    Approximate,
    /// The product of the rewards along the demonstrations, in log space.
    Exact,
}

/// Penalty on the weights of `em-tied`.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum Penalty {
    /// strength · Σ w, w ≥ 0.
    #[default]
    L1,
    /// strength / 2 · |w|², w free.
    L2,
    /// None, w free: maximum likelihood.
    None,
}

/// What `em-tied` acts on.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum PosteriorKind {
    /// The optimum alone: a point estimate.
    None,
    /// The posterior mean, from a Gaussian around the optimum.
    Laplace,
    /// The posterior mean, from Markov chain Monte Carlo under a sparse prior whose strength is learned.
    #[default]
    Mcmc,
}

/// Prior of `birl` over the reward of each basis function, Ramachandran & Amir (2007) §3.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum RewardPrior {
    /// Uniform on [0, 1].
    Uniform,
    /// Exponential on [0, 1], density ∝ exp(−5w): most rewards are small.
    #[default]
    Exponential,
    /// Beta(½, ½): rewards are near 0 or near 1.
    Beta,
}

/// Everything that decides a fit beside model and data.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(default)]
pub struct FitOptions {
    /// γ.
    pub discount: f64,
    /// K: steps of each trajectory that are used; `None`: the longest trajectory's.
    pub horizon: Option<u32>,
    /// p(k).
    pub horizon_prior: HorizonPrior,
    /// Φ.
    pub basis: BasisKind,
    /// Reward step of `em`.
    pub m_step: MStep,
    /// ρ_k of `em`.
    pub responsibility: Responsibility,
    /// Policy step.
    pub planner: PlannerKind,
    /// The basis function that eq. 10 takes as the reference.
    pub reference_basis: u32,
    /// Penalty of `em-tied`.
    pub penalty: Penalty,
    /// Strength of the penalty; `None`: the method's own, or learned from the data where the method can.
    pub penalty_strength: Option<f64>,
    /// What `em-tied` acts on.
    pub posterior: PosteriorKind,
    /// Prior of `birl`.
    pub reward_prior: RewardPrior,
    /// β of `birl`: how sharply the expert prefers better actions.
    pub rationality: f64,
    /// Chains of methods that sample.
    pub chains: u32,
    /// Draws that each chain keeps; `None`: the method's own number.
    pub draws: Option<u32>,
    /// Draws that each chain makes first and forgets; `None`: the method's own number.
    pub warm_up: Option<u32>,
    /// Change of the objective below which a fit has converged.
    pub tolerance: f64,
    /// Iterations after which a fit stops all the same.
    pub max_iterations: u32,
    /// Pseudo-count of `bc`.
    pub smoothing: f64,
    /// Seed of methods that draw numbers.
    pub seed: u64,
    /// Names of the features that the basis takes, in this order; empty: all of them. Looked at where the basis is
    /// [`BasisKind::Features`] alone.
    pub features: Vec<String>,
}

impl Default for FitOptions {
    fn default() -> Self {
        Self {
            discount: 0.9,
            horizon: None,
            horizon_prior: HorizonPrior::default(),
            basis: BasisKind::default(),
            m_step: MStep::default(),
            responsibility: Responsibility::default(),
            planner: PlannerKind::default(),
            reference_basis: 0,
            penalty: Penalty::default(),
            penalty_strength: None,
            posterior: PosteriorKind::default(),
            reward_prior: RewardPrior::default(),
            rationality: 10.0,
            chains: 4,
            draws: None,
            warm_up: None,
            tolerance: 1e-6,
            max_iterations: 1000,
            smoothing: 0.0,
            seed: 0,
            features: Vec::new(),
        }
    }
}

impl FitOptions {
    /// Checks every field that stands on its own.
    pub(super) fn check(&self) -> Result<(), FitError> {
        let invalid = |field, message| Err(FitError::InvalidOption { field, message });
        if !(0.0..=1.0).contains(&self.discount) {
            return invalid("discount", format!("expected a number in [0, 1], got {}", self.discount));
        }
        if self.horizon == Some(0) {
            return invalid("horizon", "expected at least 1 step, got 0".to_owned());
        }
        if self.max_iterations == 0 {
            return invalid("max_iterations", "expected at least 1 iteration, got 0".to_owned());
        }
        if self.chains == 0 {
            return invalid("chains", "expected at least 1 chain, got 0".to_owned());
        }
        if self.draws == Some(0) {
            return invalid("draws", "expected at least 1 draw a chain, got 0".to_owned());
        }
        let not_negative = [
            ("penalty_strength", self.penalty_strength.unwrap_or(0.0)),
            ("rationality", self.rationality),
            ("tolerance", self.tolerance),
            ("smoothing", self.smoothing),
        ];
        for (field, value) in not_negative {
            if !(value.is_finite() && value >= 0.0) {
                return invalid(field, format!("expected a finite number that is not negative, got {value}"));
            }
        }
        Ok(())
    }
}
