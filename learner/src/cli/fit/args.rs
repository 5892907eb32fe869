//! Flags of `learner fit`, as typed. Nothing here is checked against anything but itself.

use super::learning::{self, LearningArgs};
use crate::cli::StoreArgs;
use clap::Args;
use std::path::PathBuf;

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
    /// Method
    #[arg(long, default_value = learning::default_method(), value_name = "NAME", help = learning::method_help(),
          help_heading = "Learning")]
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

    /// Model of an environment that was imported: the beginning of its id, or "estimate" from the recordings
    /// [default: the one that was stored last]
    #[arg(long, value_name = "ID|estimate")]
    pub model: Option<String>,
    /// With --model estimate: how many transitions the prior of each state-action pair is worth
    #[arg(long, value_name = "COUNT", default_value_t = 1.0)]
    pub model_prior: f64,
    /// Cross-validate over so many folds of the trajectories: held-out log-likelihood, agreement and calibration
    #[arg(long, value_name = "N", value_parser = clap::value_parser!(u32).range(2..=10_000), help_heading = "Judging")]
    pub folds: Option<u32>,
    /// Plan on the learned reward in this stored model too, by the beginning of its id; its states are matched by label
    #[arg(long, value_name = "MODEL", help_heading = "Judging", conflicts_with_all = ["plan_in_options", "plan_in_layout"])]
    pub plan_in: Option<String>,
    /// Plan on the learned reward in the environment under this option too, such as density=6; may be given several times
    #[arg(long = "plan-in-option", value_name = "KEY=VALUE", help_heading = "Judging")]
    pub plan_in_options: Vec<String>,
    /// Plan on the learned reward in the maze drawn in this file too, with '.' for free cells and '#' for walls
    #[arg(long, value_name = "FILE", help_heading = "Judging")]
    pub plan_in_layout: Option<PathBuf>,

    /// How to learn
    #[command(flatten)]
    pub learning: LearningArgs,

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
