//! Flags of `learner fit`, as typed. Nothing here is checked against anything but itself.

use crate::cli::StoreArgs;
use clap::{Args, ValueEnum};
use std::path::PathBuf;

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

/// What `learner fit` takes.
#[derive(Debug, Clone, Args)]
#[command(after_help = "\
Examples:
  learner fit --style aggressive                       learn the aggressive style on the highway
  learner fit --env Maze-v0 --method em                the paper's algorithm on the paper's maze
  learner fit --style legal --json | jq .agreement     one number for a script
  learner fit --style bad --addr 127.0.0.1:50052       use a running learner and environment server")]
pub struct FitArgs {
    /// Environment to learn in
    #[arg(long, default_value = "Highway-v0", value_name = "ID")]
    pub env: String,
    /// What the demonstrators were after [default: the environment's first style]
    #[arg(long, value_name = "NAME")]
    pub style: Option<String>,
    /// Method: em-tied, em, em-mixture or bc
    #[arg(long, default_value = "em-tied", value_name = "NAME", help_heading = "Learning")]
    pub method: String,
    /// Demonstrations to learn from [default: 200 on the highway, 100 elsewhere; your own recordings: all]
    #[arg(long, value_name = "N", value_parser = clap::value_parser!(u32).range(1..=10_000_000))]
    pub trajectories: Option<u32>,
    /// Steps of each demonstration [default: 5 on the highway, 50 elsewhere; your own recordings: all]
    #[arg(long, value_name = "STEPS", value_parser = clap::value_parser!(u32).range(1..=1_000_000))]
    pub horizon: Option<u32>,
    /// Which recordings to use: "expert" (the scripted one), "any", or the source that `learner list` shows
    /// [default: your own recordings of the style if there are any, else the expert's]
    #[arg(long, value_name = "SOURCE")]
    pub source: Option<String>,
    /// Fail if nothing is recorded, rather than let the scripted expert demonstrate
    #[arg(long)]
    pub no_demonstrate: bool,
    /// Option of the environment, such as density=6; may be given several times
    #[arg(long = "env-option", value_name = "KEY=VALUE")]
    pub env_options: Vec<String>,

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

    /// Seed of demonstrations, roll-outs and the method
    #[arg(long, default_value_t = 0, value_name = "SEED")]
    pub seed: u32,
    /// Episodes of 200 steps that each driver is judged by
    #[arg(long, default_value_t = 400, value_name = "N", value_parser = clap::value_parser!(u32).range(2..=1_000_000))]
    pub rollouts: u32,

    /// Where recordings are read from and the fit is kept
    #[command(flatten)]
    pub store: StoreArgs,
    /// Address of a running environment server [default: the learner's host at port 50051 with --addr, else start one]
    #[arg(long, value_name = "HOST:PORT", help_heading = "Where")]
    pub env_addr: Option<String>,
    /// Directory for the report and its pictures [default: reports/ENV-STYLE-METHOD in the data directory]
    #[arg(long, value_name = "DIR", help_heading = "Where")]
    pub out: Option<PathBuf>,
    /// Print one JSON object and nothing else on standard output
    #[arg(long)]
    pub json: bool,
}
