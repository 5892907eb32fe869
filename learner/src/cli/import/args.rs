//! Flags of `learner import`, and the job they make: whatever can be refused without reading a file is refused here.

use crate::cli::{StoreArgs, error::CliError};
use clap::{Args, ValueEnum};
use mazeway_learner::files::{Format, ReadOptions};
use std::path::PathBuf;

/// Formats of demonstrations.
#[derive(Debug, Clone, Copy, PartialEq, Eq, ValueEnum)]
pub enum FormatArg {
    /// One line a step, under a header
    Csv,
    /// One JSON object a line: a trajectory, or a step
    Jsonl,
    /// One row a step
    Parquet,
}

/// What becomes of transitions that the model rules out.
#[derive(Debug, Clone, Copy, PartialEq, Eq, ValueEnum)]
pub enum ImpossibleArg {
    /// Nothing is stored
    Refuse,
    /// The trajectory is cut there; both parts are stored
    Split,
    /// They are stored as they are
    Keep,
}

/// What `learner import` takes.
#[derive(Debug, Clone, Args)]
#[command(after_help = "\
Examples:
  learner import --env Road --model road.json drives.csv       a model and demonstrations in it
  learner import --env Road drives.parquet --style calm        more of them, in the model that is stored
  learner import --env Road --model estimate drives.csv        no model: estimate one from the demonstrations
  learner import --env Road drives.csv --column trajectory=vehicle --column step=second

docs/DATA.md describes the formats, with an example each.")]
pub struct ImportArgs {
    /// Demonstrations: .csv, .tsv, .jsonl or .parquet files
    #[arg(value_name = "FILE")]
    pub files: Vec<PathBuf>,
    /// The process: a .json file, a table of transitions (.parquet, .csv), a directory of tables; or "estimate", from the
    /// demonstrations [default: the model that is stored for the environment]
    #[arg(long, value_name = "FILE|estimate", help_heading = "Model")]
    pub model: Option<String>,
    /// With --model estimate: a model file without transitions, for labels, features and terminal states
    #[arg(long, value_name = "FILE", help_heading = "Model")]
    pub describe: Option<PathBuf>,
    /// With --model estimate: how many transitions the prior of each state-action pair is worth
    #[arg(long, value_name = "COUNT", default_value_t = 1.0, help_heading = "Model")]
    pub model_prior: f64,
    /// Where the same transitions are stored with other labels, features, start or rewards: take these instead
    #[arg(long, help_heading = "Model")]
    pub replace: bool,
    /// Environment that model and demonstrations are of [default: as the files say]
    #[arg(long, value_name = "NAME")]
    pub env: Option<String>,
    /// What the demonstrators were after [default: as the files say, else "expert"]
    #[arg(long, value_name = "NAME")]
    pub style: Option<String>,
    /// Who acted [default: as the files say, else "file:" and the file's name]
    #[arg(long, value_name = "NAME")]
    pub source: Option<String>,
    /// Format of the demonstrations [default: by the extension]
    #[arg(long, value_enum, value_name = "FORMAT", help_heading = "Format")]
    pub format: Option<FormatArg>,
    /// A column that has another name than ours, such as step=frame; may be given several times
    #[arg(long = "column", value_name = "OURS=THEIRS", help_heading = "Format")]
    pub columns: Vec<String>,
    /// What stands between the fields of a CSV file [default: a comma; a tab in .tsv files]
    #[arg(long, value_name = "CHARACTER", help_heading = "Format")]
    pub delimiter: Option<char>,
    /// The rows of several trajectories alternate: hold all of them in memory until the end of the file
    #[arg(long, help_heading = "Format")]
    pub interleaved: bool,
    /// What becomes of transitions that cannot happen in the model
    #[arg(long, value_enum, default_value = "refuse", value_name = "WHAT")]
    pub impossible: ImpossibleArg,
    /// Print one JSON object and nothing else on standard output
    #[arg(long)]
    pub json: bool,
    /// Where all is stored
    #[command(flatten)]
    pub store: StoreArgs,
}

/// Where the model comes from.
#[derive(Debug, Clone, PartialEq, Eq)]
pub enum ModelSource {
    /// It is stored already.
    Stored,
    /// A file or a directory.
    File(PathBuf),
    /// The demonstrations, described by a file where there is one.
    Estimate(Option<PathBuf>),
}

/// A checked job.
#[derive(Debug, Clone)]
pub struct Job {
    /// Demonstrations.
    pub files: Vec<PathBuf>,
    /// How to read them.
    pub options: ReadOptions,
    /// Where the model comes from.
    pub model: ModelSource,
    /// Strength of the prior.
    pub model_prior: f64,
    /// Whether a description takes the place of another.
    pub replace: bool,
    /// Environment, where given.
    pub env: Option<String>,
    /// Style, where given.
    pub style: Option<String>,
    /// Source, where given.
    pub source: Option<String>,
    /// What becomes of impossible transitions.
    pub impossible: ImpossibleArg,
}

impl Job {
    /// Checks the flags.
    ///
    /// # Errors
    /// Nothing to import, flags that do not go together: all usage errors.
    pub fn new(args: &ImportArgs) -> Result<Self, CliError> {
        let model = match args.model.as_deref() {
            None => ModelSource::Stored,
            Some("estimate") => ModelSource::Estimate(args.describe.clone()),
            Some(file) => ModelSource::File(file.into()),
        };
        let estimates = matches!(model, ModelSource::Estimate(_));
        if args.files.is_empty() && (model == ModelSource::Stored || estimates) {
            return Err(CliError::usage(
                "expected something to import, got no file",
                "name demonstrations, a model with --model, or both: learner import --env NAME --model FILE FILE",
            ));
        }
        if args.describe.is_some() && !estimates {
            return Err(CliError::usage(
                "expected --describe with --model estimate alone",
                "a model from a file brings its own labels and features",
            ));
        }
        if !(args.model_prior.is_finite() && args.model_prior >= 0.0) {
            return Err(CliError::usage(
                format!("expected --model-prior to be a number of at least 0, got {}", args.model_prior),
                "leave it out for a prior that is worth one transition",
            ));
        }
        for (flag, value) in [("--env", &args.env), ("--style", &args.style)] {
            if value.as_deref() == Some("") {
                return Err(CliError::usage(
                    format!("expected a name for {flag}, got an empty one"),
                    "leave the flag out",
                ));
            }
        }
        let delimiter = args.delimiter.map(|character| u8::try_from(character).map_err(|_| character)).transpose();
        let delimiter = delimiter.map_err(|character| {
            CliError::usage(format!("expected one byte for --delimiter, got '{character}'"), "such as ';'")
        })?;
        Ok(Self {
            files: args.files.clone(),
            options: ReadOptions {
                format: args.format.map(|format| match format {
                    FormatArg::Csv => Format::Csv,
                    FormatArg::Jsonl => Format::JsonLines,
                    FormatArg::Parquet => Format::Parquet,
                }),
                columns: args.columns.iter().map(|text| column(text)).collect::<Result<_, _>>()?,
                delimiter,
                interleaved: args.interleaved,
            },
            model,
            model_prior: args.model_prior,
            replace: args.replace,
            env: args.env.clone(),
            style: args.style.clone(),
            source: args.source.clone(),
            impossible: args.impossible,
        })
    }
}

fn column(text: &str) -> Result<(String, String), CliError> {
    let parts = text.split_once('=').filter(|(ours, theirs)| ReadOptions::is_column(ours) && !theirs.is_empty());
    parts.map(|(ours, theirs)| (ours.to_owned(), theirs.to_owned())).ok_or_else(|| {
        CliError::usage(
            format!("expected OURS=THEIRS for --column, got '{text}'"),
            "ours are trajectory, step, state, action, next_state, reward, style, source, env, seed, terminated, truncated",
        )
    })
}
