//! From flags to a job, checked without I/O: whatever can be refused before a server is asked is refused here.

use super::{args::FitArgs, learning};
use crate::cli::error::CliError;
use mazeway_client::Options;
use mazeway_proto::learner::{self as pb, FitOptions};

/// Which recordings a fit learns from.
#[derive(Debug, Clone, PartialEq, Eq)]
pub enum Source {
    /// The user's own where there are any, else the scripted expert's.
    Preferred,
    /// The scripted expert's.
    Expert,
    /// Whatever is recorded under the style.
    Any,
    /// This source.
    Named(String),
}

/// A checked job.
#[derive(Debug, Clone, PartialEq)]
pub struct Job {
    /// Environment.
    pub env_id: String,
    /// Options of the environment.
    pub env_options: Options,
    /// Style; `None`: the environment's first.
    pub style: Option<String>,
    /// Method id.
    pub method: &'static str,
    /// Number of trajectories, where given.
    pub trajectories: Option<u32>,
    /// Steps of each, where given.
    pub horizon: Option<u32>,
    /// Which recordings.
    pub source: Source,
    /// Whether the scripted expert may demonstrate.
    pub demonstrate: bool,
    /// Options of the fit; horizon and basis are filled in once the environment is known.
    pub options: FitOptions,
    /// Basis, where given.
    pub basis: Option<pb::Basis>,
    /// Seed.
    pub seed: u32,
    /// Episodes of a roll-out.
    pub rollouts: u32,
    /// Model of an imported environment, where given.
    pub model: Option<AskedModel>,
}

/// Which model of an imported environment.
#[derive(Debug, Clone, PartialEq)]
pub enum AskedModel {
    /// The one whose id begins so.
    Id(String),
    /// One that is estimated from the recordings, with a prior that is worth so many transitions.
    Estimate(f64),
}

fn asked_model(args: &FitArgs) -> Result<Option<AskedModel>, CliError> {
    match args.model.as_deref() {
        None => Ok(None),
        Some("estimate") if args.model_prior.is_finite() && args.model_prior >= 0.0 => {
            Ok(Some(AskedModel::Estimate(args.model_prior)))
        }
        Some("estimate") => Err(CliError::usage(
            format!("expected --model-prior to be a number of at least 0, got {}", args.model_prior),
            "leave it out for a prior that is worth one transition",
        )),
        Some(id) if !id.is_empty() && id.len() <= 64 && id.bytes().all(|b| b.is_ascii_hexdigit()) => {
            Ok(Some(AskedModel::Id(id.to_ascii_lowercase())))
        }
        Some(id) => Err(CliError::usage(
            format!("expected the beginning of a model's id or 'estimate' for --model, got '{id}'"),
            "see the models with 'learner list --models'",
        )),
    }
}

/// Default number of trajectories and steps of each.
pub fn default_sizes(env_id: &str) -> (u32, u32) {
    if env_id == "Highway-v0" { (200, 5) } else { (100, 50) }
}

/// Default basis.
pub fn default_basis(env_id: &str) -> pb::Basis {
    if env_id == "Highway-v0" { pb::Basis::StateAction } else { pb::Basis::State }
}

impl Job {
    /// Discount of the fit, and of the optimal expert.
    pub fn discount(&self) -> f64 {
        self.options.discount.unwrap_or(0.9)
    }

    /// Checks the flags.
    ///
    /// # Errors
    /// An unknown method, numbers out of range, malformed options: all usage errors.
    pub fn new(args: &FitArgs) -> Result<Self, CliError> {
        let method = learning::method(&args.method, "--method")?;
        args.learning.check(args.horizon)?;
        Ok(Self {
            env_id: args.env.clone(),
            env_options: args.env_options.iter().map(|text| env_option(text)).collect::<Result<_, _>>()?,
            style: args.style.clone(),
            method: method.id(),
            trajectories: args.trajectories,
            horizon: args.horizon,
            source: match args.source.as_deref() {
                None => Source::Preferred,
                Some("expert") => Source::Expert,
                Some("any") => Source::Any,
                Some(name) => Source::Named(name.to_owned()),
            },
            demonstrate: !args.no_demonstrate,
            options: FitOptions { horizon: args.horizon, ..args.learning.options(u64::from(args.seed)) },
            basis: args.learning.basis(),
            seed: args.seed,
            rollouts: args.rollouts,
            model: asked_model(args)?,
        })
    }
}

/// Parses `key=value`; a value that is not JSON is a string.
pub fn env_option(text: &str) -> Result<(String, serde_json::Value), CliError> {
    let (key, value) = text.split_once('=').filter(|(key, _)| !key.is_empty()).ok_or_else(|| {
        CliError::usage(
            format!("expected KEY=VALUE for --env-option, got '{text}'"),
            "for example: --env-option density=6",
        )
    })?;
    let value = serde_json::from_str(value).unwrap_or_else(|_| serde_json::Value::String(value.to_owned()));
    Ok((key.to_owned(), value))
}

#[cfg(test)]
mod tests {
    use super::*;
    use clap::Parser;

    #[derive(Parser)]
    struct Cli {
        #[command(flatten)]
        fit: FitArgs,
    }

    fn job(flags: &[&str]) -> Result<Job, CliError> {
        let cli = Cli::try_parse_from(std::iter::once("fit").chain(flags.iter().copied())).expect("flags parse");
        Job::new(&cli.fit)
    }

    #[test]
    fn defaults_are_the_documented_ones() {
        let job = job(&[]).unwrap();
        assert_eq!((job.env_id.as_str(), job.method), ("Highway-v0", "em-tied"));
        assert_eq!(job.options.discount, Some(0.9));
        assert_eq!(job.source, Source::Preferred);
        assert!(job.demonstrate);
        assert_eq!(default_sizes("Highway-v0"), (200, 5));
        assert_eq!(default_sizes("Maze-v0"), (100, 50));
    }

    #[test]
    fn wrong_values_are_usage_errors() {
        for flags in [
            vec!["--method", "magic"],
            vec!["--discount", "1.5"],
            vec!["--discount", "NaN"],
            vec!["--penalty-strength=-1"],
            vec!["--env-option", "density"],
            vec!["--env-option", "=6"],
        ] {
            let error = job(&flags).expect_err("refused");
            assert_eq!(error.code, 2, "{flags:?}");
            assert!(!error.hint.is_empty(), "{flags:?}");
        }
    }

    #[test]
    fn environment_options_are_json_where_they_can_be() {
        let job = job(&["--env-option", "density=6", "--env-option", "observation=kinematics"]).unwrap();
        assert_eq!(job.env_options["density"], serde_json::json!(6));
        assert_eq!(job.env_options["observation"], serde_json::json!("kinematics"));
    }
}
