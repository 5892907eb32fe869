//! Flags that say how to learn, for every command that fits; and what they are on the wire.

use crate::cli::error::CliError;
use clap::{Args, ValueEnum};
use mazeway_learner::irl;
use mazeway_proto::learner::{self as pb, FitOptions};

/// The word of --features that means every one.
const ALL_FEATURES: &str = "all";

/// The default method's id.
pub fn default_method() -> &'static str {
    irl::METHODS[0].id()
}

/// Help of `--method`: all ids.
pub fn method_help() -> String {
    format!("Method: {}", method_ids().join(", "))
}

/// All methods, the default first.
pub fn method_ids() -> Vec<&'static str> {
    irl::METHODS.iter().map(|method| method.id()).collect()
}

/// The method of a name that came with a flag.
///
/// # Errors
/// There is none: a usage error.
pub fn method(name: &str, flag: &str) -> Result<&'static dyn irl::Method, CliError> {
    irl::method(name).ok_or_else(|| {
        CliError::usage(
            format!("unknown method '{name}' for {flag}"),
            format!("choose one of {}", method_ids().join(", ")),
        )
    })
}

/// Prior over the number of steps.
#[derive(Debug, Clone, Copy, PartialEq, Eq, ValueEnum)]
pub enum HorizonPriorArg {
    /// (1 - discount) discount^(k-1), normalised over 1..horizon
    Geometric,
    /// 1 / horizon
    Uniform,
}

/// Basis functions of the reward.
#[derive(Debug, Clone, Copy, PartialEq, Eq, ValueEnum)]
pub enum BasisArg {
    /// One function a state
    State,
    /// One function a state-action pair
    StateAction,
    /// The features of the model
    Features,
}

/// Reward step of `em`.
#[derive(Debug, Clone, Copy, PartialEq, Eq, ValueEnum)]
pub enum MStepArg {
    /// Non-negative least squares on the stationarity conditions
    Nnls,
    /// Exact maximiser on the simplex
    Simplex,
}

/// Responsibilities of `em`.
#[derive(Debug, Clone, Copy, PartialEq, Eq, ValueEnum)]
pub enum ResponsibilityArg {
    /// One for every horizon
    Approximate,
    /// The product of the rewards along the demonstrations
    Exact,
}

/// Planner that turns the reward into a policy.
#[derive(Debug, Clone, Copy, PartialEq, Eq, ValueEnum)]
pub enum PlannerArg {
    /// Value iteration
    ValueIteration,
    /// Policy iteration
    PolicyIteration,
    /// Soft (maximum entropy) value iteration
    SoftValueIteration,
    /// Expectation maximisation over a mixture of horizons (Toussaint and Storkey 2006)
    ExpectationMaximization,
}

/// Penalty on the weights of `em-tied`.
#[derive(Debug, Clone, Copy, PartialEq, Eq, ValueEnum)]
pub enum PenaltyArg {
    /// Strength times the sum of the weights, which are not negative
    L1,
    /// Half the strength times the sum of the squared weights, which are free
    L2,
    /// None, free weights: maximum likelihood
    None,
}

/// What `em-tied` acts on.
#[derive(Debug, Clone, Copy, PartialEq, Eq, ValueEnum)]
pub enum PosteriorArg {
    /// The optimum alone: a point estimate
    None,
    /// The posterior mean, from a Gaussian around the optimum
    Laplace,
    /// The posterior mean, from Markov chain Monte Carlo under a sparse prior whose strength is learned
    Mcmc,
}

/// Prior of `birl`.
#[derive(Debug, Clone, Copy, PartialEq, Eq, ValueEnum)]
pub enum RewardPriorArg {
    /// Uniform on [0, 1]
    Uniform,
    /// Exponential on [0, 1]: most rewards are small
    Exponential,
    /// Beta(1/2, 1/2): rewards are near 0 or near 1
    Beta,
}

/// How to learn.
#[derive(Debug, Clone, Args)]
pub struct LearningArgs {
    /// Discount
    #[arg(long, default_value_t = 0.9, value_name = "GAMMA", help_heading = "Learning")]
    pub discount: f64,
    /// Prior over the number of steps
    #[arg(long, value_enum, default_value = "geometric", value_name = "PRIOR", help_heading = "Learning")]
    pub horizon_prior: HorizonPriorArg,
    /// Basis of the reward [default: state-action on the highway, state elsewhere]
    #[arg(long, value_enum, value_name = "BASIS", help_heading = "Learning")]
    pub basis: Option<BasisArg>,
    /// Reward step of em
    #[arg(long, value_enum, default_value = "nnls", value_name = "STEP", help_heading = "Learning")]
    pub m_step: MStepArg,
    /// Responsibilities of em
    #[arg(long, value_enum, default_value = "approximate", value_name = "KIND", help_heading = "Learning")]
    pub responsibility: ResponsibilityArg,
    /// Planner that turns the reward into a policy
    #[arg(long, value_enum, default_value = "value-iteration", value_name = "PLANNER", help_heading = "Learning")]
    pub planner: PlannerArg,
    /// Basis function that em's nnls takes as the reference
    #[arg(long, default_value_t = 0, value_name = "RANK", help_heading = "Learning")]
    pub reference_basis: u32,
    /// Penalty on the weights of em-tied
    #[arg(long, value_enum, default_value = "l1", value_name = "PENALTY", help_heading = "Learning")]
    pub penalty: PenaltyArg,
    /// Strength of the penalty [default: the method's own]
    #[arg(long, value_name = "STRENGTH", help_heading = "Learning")]
    pub penalty_strength: Option<f64>,
    /// Pseudo-count of bc on every action
    #[arg(long, default_value_t = 0.0, value_name = "COUNT", help_heading = "Learning")]
    pub smoothing: f64,
    /// Change of the objective below which the fit has converged
    #[arg(long, default_value_t = 1e-6, value_name = "CHANGE", help_heading = "Learning")]
    pub tolerance: f64,
    /// Iterations after which the fit stops all the same
    #[arg(long, default_value_t = 1000, value_name = "N", help_heading = "Learning",
          value_parser = clap::value_parser!(u32).range(1..))]
    pub max_iterations: u32,
    /// What em-tied acts on [default: mcmc]
    #[arg(long, value_enum, value_name = "KIND", help_heading = "Learning")]
    pub posterior: Option<PosteriorArg>,
    /// Prior of birl over the reward of each basis function [default: exponential]
    #[arg(long, value_enum, value_name = "PRIOR", help_heading = "Learning")]
    pub reward_prior: Option<RewardPriorArg>,
    /// How sharply birl's expert prefers better actions [default: 10]
    #[arg(long, value_name = "BETA", help_heading = "Learning")]
    pub rationality: Option<f64>,
    /// Chains of methods that sample [default: 4]
    #[arg(long, value_name = "N", help_heading = "Learning", value_parser = clap::value_parser!(u32).range(1..=1000))]
    pub chains: Option<u32>,
    /// Draws that each chain keeps [default: the method's own]
    #[arg(long, value_name = "N", help_heading = "Learning", value_parser = clap::value_parser!(u32).range(1..=1_000_000))]
    pub draws: Option<u32>,
    /// Take these features of the model for the basis of the reward, as in x,y; "all" takes every one
    #[arg(long, value_name = "NAMES", value_delimiter = ',', help_heading = "Learning")]
    pub features: Vec<String>,
    /// Draws that each chain makes first and forgets [default: the method's own]
    #[arg(long, value_name = "N", help_heading = "Learning", value_parser = clap::value_parser!(u32).range(..=1_000_000))]
    pub warm_up: Option<u32>,
}

impl LearningArgs {
    /// Checks the numbers.
    ///
    /// # Errors
    /// Numbers out of range: usage errors.
    pub fn check(&self, horizon: Option<u32>) -> Result<(), CliError> {
        let bounded = self.discount == 1.0 && horizon.is_some();
        if !(bounded || self.discount >= 0.0 && self.discount < 1.0) {
            return Err(CliError::usage(
                format!("expected --discount in [0, 1), or 1 with a --horizon, got {}", self.discount),
                "a discount close to 1, such as 0.99, looks far ahead",
            ));
        }
        if !self.features.is_empty() && self.basis.is_some_and(|basis| basis != BasisArg::Features) {
            return Err(CliError::usage(
                "expected --features without another --basis, got both",
                "the features are the basis: leave out --basis",
            ));
        }
        if self.features.iter().any(String::is_empty) {
            return Err(CliError::usage(
                "expected names of features between the commas of --features, got an empty one",
                "such as --features speed,gap or --features all",
            ));
        }
        for (flag, value) in [
            ("--penalty-strength", self.penalty_strength.unwrap_or(0.0)),
            ("--rationality", self.rationality.unwrap_or(0.0)),
            ("--smoothing", self.smoothing),
            ("--tolerance", self.tolerance),
        ] {
            if !value.is_finite() || value < 0.0 {
                return Err(CliError::usage(
                    format!("expected {flag} to be a number of at least 0, got {value}"),
                    "leave it out for the default: learner fit --help",
                ));
            }
        }
        Ok(())
    }

    /// Basis, where given.
    pub fn basis(&self) -> Option<pb::Basis> {
        let features = (!self.features.is_empty()).then_some(BasisArg::Features);
        self.basis.or(features).map(|basis| match basis {
            BasisArg::State => pb::Basis::State,
            BasisArg::StateAction => pb::Basis::StateAction,
            BasisArg::Features => pb::Basis::Features,
        })
    }

    /// The options on the wire; horizon and basis are for the caller to fill in.
    pub fn options(&self, seed: u64) -> FitOptions {
        let args = self;
        FitOptions {
            discount: Some(args.discount),
            horizon: None,
            horizon_prior: match args.horizon_prior {
                HorizonPriorArg::Geometric => pb::HorizonPrior::Geometric,
                HorizonPriorArg::Uniform => pb::HorizonPrior::Uniform,
            }
            .into(),
            basis: pb::Basis::Unspecified.into(),
            m_step: match args.m_step {
                MStepArg::Nnls => pb::MStep::Nnls,
                MStepArg::Simplex => pb::MStep::Simplex,
            }
            .into(),
            responsibility: match args.responsibility {
                ResponsibilityArg::Approximate => pb::Responsibility::Approximate,
                ResponsibilityArg::Exact => pb::Responsibility::Exact,
            }
            .into(),
            planner: match args.planner {
                PlannerArg::ValueIteration => pb::Planner::ValueIteration,
                PlannerArg::PolicyIteration => pb::Planner::PolicyIteration,
                PlannerArg::SoftValueIteration => pb::Planner::SoftValueIteration,
                PlannerArg::ExpectationMaximization => pb::Planner::ExpectationMaximization,
            }
            .into(),
            reference_basis: Some(args.reference_basis),
            penalty: match args.penalty {
                PenaltyArg::L1 => pb::Penalty::L1,
                PenaltyArg::L2 => pb::Penalty::L2,
                PenaltyArg::None => pb::Penalty::None,
            }
            .into(),
            penalty_strength: args.penalty_strength,
            tolerance: Some(args.tolerance),
            max_iterations: Some(args.max_iterations),
            smoothing: Some(args.smoothing),
            seed: Some(seed),
            posterior: args.posterior.map_or(0, |posterior| {
                match posterior {
                    PosteriorArg::None => pb::PosteriorKind::None,
                    PosteriorArg::Laplace => pb::PosteriorKind::Laplace,
                    PosteriorArg::Mcmc => pb::PosteriorKind::Mcmc,
                }
                .into()
            }),
            reward_prior: args.reward_prior.map_or(0, |prior| {
                match prior {
                    RewardPriorArg::Uniform => pb::RewardPrior::Uniform,
                    RewardPriorArg::Exponential => pb::RewardPrior::Exponential,
                    RewardPriorArg::Beta => pb::RewardPrior::Beta,
                }
                .into()
            }),
            rationality: args.rationality,
            chains: args.chains,
            draws: args.draws,
            warm_up: args.warm_up,
            features: self.features.iter().filter(|name| *name != ALL_FEATURES).cloned().collect(),
        }
    }
}
