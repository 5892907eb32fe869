//! Inverse reinforcement learning: one file a method, one trait, one registry.
//!
//! A method takes a [`Problem`] and returns a [`Fit`]. Stopping is a value: a fit that did not converge still gives its
//! best. Deliberately absent: where the data come from and where the fit goes.

use crate::trajectory::Trajectory;
use serde::{Deserialize, Serialize};
use std::ops::ControlFlow;

/// Prior over the number of steps, SPEC §1.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum HorizonPrior {
    /// (1 − γ) γ^(k−1), normalised over 1..K.
    #[default]
    Geometric,
    /// 1/K.
    Uniform,
}

/// Basis functions Φ of the reward.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum BasisKind {
    /// Dirac on states, shape (n_states,).
    #[default]
    State,
    /// Dirac on state-action pairs, shape (n_states * n_actions,).
    StateAction,
}

/// Reward step of `em`, SPEC §5.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum MStep {
    /// Non-negative least squares, Hahn & Zoubir (2015) eq. 10.
    #[default]
    Nnls,
    /// Exact maximiser of Q on the simplex.
    Simplex,
}

/// Responsibilities of `em`, SPEC §5.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum Responsibility {
    /// ρ_k = 1.
    #[default]
    Approximate,
    /// The product of the rewards along the demonstrations, in log space.
    Exact,
}

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

/// Penalty on the weights of `em-tied`, SPEC §6.
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
    /// Strength of the penalty.
    pub penalty_strength: f64,
    /// Change of the objective below which a fit has converged.
    pub tolerance: f64,
    /// Iterations after which a fit stops all the same.
    pub max_iterations: u32,
    /// Pseudo-count of `bc`.
    pub smoothing: f64,
    /// Seed of methods that draw numbers.
    pub seed: u64,
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
            penalty_strength: 1.0,
            tolerance: 1e-6,
            max_iterations: 1000,
            smoothing: 0.0,
            seed: 0,
        }
    }
}

/// How a fit stopped.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum Stopped {
    /// The change fell below the tolerance.
    Converged,
    /// The iterations ran out.
    MaxIterations,
    /// No further improvement at this precision.
    Stalled,
    /// Nothing to iterate.
    ClosedForm,
}

/// One iteration of a fit.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
pub struct TraceEntry {
    /// From 1 on.
    pub iteration: u32,
    /// What the method maximises.
    pub objective: f64,
    /// What the stopping rule watches.
    pub change: f64,
    /// Seconds since the fit began; never part of a result's comparison.
    pub elapsed_secs: f64,
}

/// A learned reward and policy.
#[derive(Debug, Clone, PartialEq)]
pub struct Fit {
    /// w, shape (n_basis,).
    pub weights: Vec<f64>,
    /// R(s,a), shape (n_states * n_actions,).
    pub reward: Vec<f64>,
    /// The stochastic policy that explains the demonstrations, π(a|s), shape (n_states * n_actions,).
    pub policy: Vec<f64>,
    /// The greedy policy to act with, ties split evenly, shape (n_states * n_actions,).
    pub greedy_policy: Vec<f64>,
    /// V(s) under the reward and the planner, shape (n_states,).
    pub state_values: Vec<f64>,
    /// Standard errors of the weights from the exact Hessian (unpenalised likelihood only), shape (n_basis,).
    pub standard_errors: Option<Vec<f64>>,
    /// One entry an iteration.
    pub trace: Vec<TraceEntry>,
    /// How it stopped.
    pub stopped: Stopped,
    /// Iterations done.
    pub iterations: u32,
    /// What a careful reader should know.
    pub warnings: Vec<String>,
}

/// Called after every iteration; `Break` cancels the fit.
pub type Progress<'a> = &'a mut dyn FnMut(&TraceEntry) -> ControlFlow<()>;

/// Placeholder that keeps the import until [`Trajectory`] is used by the problem.
#[doc(hidden)]
pub type Demonstrations = Vec<Trajectory>;
