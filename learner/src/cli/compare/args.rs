//! Flags of `learner compare`, as typed.

use crate::cli::{
    AccessArgs,
    fit::learning::{LearningArgs, method_ids},
};
use clap::Args;
use std::path::PathBuf;

/// Help of `--methods`: all ids.
fn methods_help() -> String {
    format!(
        "Methods, separated by commas, or all: {}; options may differ, as in em:m_step=simplex",
        method_ids().join(", ")
    )
}

/// What `learner compare` takes.
#[derive(Debug, Clone, Args)]
#[command(after_help = "\
Every seed has one list of demonstrations; the first L of it are what every method learns from, so that methods are compared on
the same data. Fits run on all cores. What is finished is kept in DIR: the same command goes on where it was interrupted.

Examples:
  learner compare                                                    every method on the paper's maze
  learner compare --methods em-tied,bc --trajectories 5,20 --seeds 8 a quick look
  learner compare --layout maze.txt --env-option slip=0.1 --json     a maze of your own, drawn with '.' and '#'
  learner compare --env Highway-v0 --style legal --methods em-tied,bc")]
pub struct CompareArgs {
    /// Methods
    #[arg(long, value_name = "LIST", value_delimiter = ',', default_value = "all", help = methods_help())]
    pub methods: Vec<String>,
    /// Numbers of demonstrations, separated by commas
    #[arg(long, value_name = "LIST", value_delimiter = ',', default_value = "1,2,5,10,20,50,100",
          value_parser = clap::value_parser!(u32).range(1..=10_000_000))]
    pub trajectories: Vec<u32>,
    /// How many seeds; each gives one list of demonstrations
    #[arg(long, value_name = "N", default_value_t = 20, value_parser = clap::value_parser!(u32).range(1..=100_000))]
    pub seeds: u32,
    /// Environment
    #[arg(long, default_value = "Maze-v0", value_name = "ID")]
    pub env: String,
    /// Style of the expert [default: the environment's first]
    #[arg(long, value_name = "NAME")]
    pub style: Option<String>,
    /// File with a maze drawn with '.' for free cells and '#' for walls
    #[arg(long, value_name = "FILE")]
    pub layout: Option<PathBuf>,
    /// Option of the environment, such as slip=0.1; may be given several times
    #[arg(long = "env-option", value_name = "KEY=VALUE")]
    pub env_options: Vec<String>,
    /// Steps of each demonstration [default: 5 on the highway, 50 elsewhere]
    #[arg(long, value_name = "STEPS", value_parser = clap::value_parser!(u32).range(1..=1_000_000))]
    pub horizon: Option<u32>,
    /// Episodes of the expert, none of them demonstrated, that the log-likelihood of each seed's fits is taken on
    #[arg(long, value_name = "N", default_value_t = 100, value_parser = clap::value_parser!(u32).range(1..=1_000_000))]
    pub rollouts: u32,
    /// Fits at a time [default: as many as there are cores]
    #[arg(long, value_name = "N", value_parser = clap::value_parser!(u16).range(1..=1024))]
    pub threads: Option<u16>,

    /// How to learn
    #[command(flatten)]
    pub learning: LearningArgs,

    /// Directory that holds the reports [default: the platform's data directory]
    #[arg(long, value_name = "DIR", env = "MAZEWAY_DATA", help_heading = "Where")]
    pub data: Option<PathBuf>,
    /// Address of a running environment server [default: start one]
    #[arg(long, value_name = "HOST:PORT", help_heading = "Where")]
    pub env_addr: Option<String>,
    #[command(flatten)]
    pub access: AccessArgs,
    /// Directory for the tables, the pictures and what is finished [default: reports/compare-ENV-STYLE in the data directory]
    #[arg(long, value_name = "DIR", help_heading = "Where")]
    pub out: Option<PathBuf>,
    /// Print one JSON array and nothing else on standard output
    #[arg(long)]
    pub json: bool,
}
