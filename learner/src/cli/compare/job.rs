//! From flags to a checked comparison.

use super::args::CompareArgs;
use crate::cli::{
    error::CliError,
    fit::{
        job::{default_basis, default_sizes, env_option},
        learning,
    },
};
use mazeway_client::Options;
use mazeway_learner::irl::{FitOptions, METHODS, Method};
use serde_json::Value;

/// Steps of all demonstrations of a comparison at most: they are held in memory.
const MOST_STEPS: u64 = 500_000_000;

/// A method with its options, under the name that the tables give it.
#[derive(Clone)]
pub struct Entry {
    /// Name.
    pub name: String,
    /// Method.
    pub method: &'static dyn Method,
    /// Options; the seed is that of the cell.
    pub options: FitOptions,
}

impl Entry {
    /// Parses `method` or `method:option=value:…`.
    ///
    /// # Errors
    /// No such method or option.
    pub fn parse(text: &str, common: &FitOptions) -> Result<Self, CliError> {
        let mut parts = text.split(':');
        let method = learning::method(parts.next().unwrap_or_default(), "--methods")?;
        let mut options = serde_json::to_value(common).map_err(|error| unexpected(&error))?;
        for part in parts {
            let wrong = |what: String| {
                CliError::usage(
                    format!("{what} in '{text}' for --methods"),
                    "options are those of the fit, as in em:m_step=simplex:reference_basis=28",
                )
            };
            let (key, value) =
                part.split_once('=').ok_or_else(|| wrong(format!("expected OPTION=VALUE, got '{part}'")))?;
            let key = key.replace('-', "_");
            let slot = options
                .get_mut(&key)
                .filter(|_| key != "seed")
                .ok_or_else(|| wrong(format!("unknown option '{key}'")))?;
            *slot = serde_json::from_str(value).unwrap_or_else(|_| Value::String(value.to_owned()));
            let _: FitOptions =
                serde_json::from_value(options.clone()).map_err(|error| wrong(format!("{key}: {error}")))?;
        }
        let options = serde_json::from_value(options).map_err(|error| unexpected(&error))?;
        Ok(Self { name: text.to_owned(), method, options })
    }
}

fn unexpected(error: &serde_json::Error) -> CliError {
    CliError::failure(format!("options of a fit cannot be written down: {error}"), "report this as a defect")
}

/// A checked comparison.
#[derive(Clone)]
pub struct Job {
    /// Environment.
    pub env_id: String,
    /// Its options.
    pub env_options: Options,
    /// Style; `None`: the environment's first.
    pub style: Option<String>,
    /// What is compared, in this order.
    pub entries: Vec<Entry>,
    /// The entry that the others are held against.
    pub baseline: String,
    /// Rising numbers of demonstrations.
    pub trajectories: Vec<u32>,
    /// Number of seeds.
    pub seeds: u32,
    /// Steps of each demonstration.
    pub horizon: u32,
    /// Whether these were asked for.
    pub horizon_asked: bool,
    /// Held-out episodes of each seed.
    pub rollouts: u32,
    /// Fits at a time.
    pub threads: usize,
}

impl Job {
    /// Checks the flags.
    ///
    /// # Errors
    /// Unknown methods, numbers out of range, malformed options, a layout that cannot be read: usage errors.
    pub fn new(args: &CompareArgs) -> Result<Self, CliError> {
        args.learning.check(args.horizon)?;
        let horizon = args.horizon.unwrap_or(default_sizes(&args.env).1);
        let mut options = args.learning.options(0);
        options.horizon = Some(horizon);
        options.basis = args.learning.basis().unwrap_or_else(|| default_basis(&args.env)).into();
        let common = mazeway_learner::fit_options(Some(&options))
            .map_err(|error| CliError::usage(error.to_string(), "see 'learner compare --help'"))?;
        let mut entries: Vec<Entry> = Vec::new();
        for text in &args.methods {
            let texts = if text == "all" { learning::method_ids() } else { vec![text.as_str()] };
            for text in texts {
                if !entries.iter().any(|entry| entry.name == text) {
                    entries.push(Entry::parse(text, &common)?);
                }
            }
        }
        let default = METHODS[0].id();
        let baseline = entries.iter().find(|entry| entry.name == default).unwrap_or(&entries[0]).name.clone();
        let mut trajectories = args.trajectories.clone();
        trajectories.sort_unstable();
        trajectories.dedup();
        let most = trajectories.last().copied().unwrap_or(1);
        let steps = (u64::from(most) + u64::from(args.rollouts)) * u64::from(horizon) * u64::from(args.seeds);
        check_steps(steps)?;
        Ok(Self {
            env_id: args.env.clone(),
            env_options: env_options(&args.env_options, args.layout.as_deref())?,
            style: args.style.clone(),
            entries,
            baseline,
            trajectories,
            seeds: args.seeds,
            horizon,
            horizon_asked: args.horizon.is_some(),
            rollouts: args.rollouts,
            threads: args.threads.map_or_else(
                || std::thread::available_parallelism().map_or(1, std::num::NonZeroUsize::get),
                usize::from,
            ),
        })
    }

    /// Takes the length of the demonstrations for the horizon, unless one was asked for.
    pub fn set_horizon(&mut self, longest: u32) {
        if !self.horizon_asked {
            self.horizon = longest;
            self.entries.iter_mut().for_each(|entry| entry.options.horizon = Some(longest));
        }
    }

    /// Whether recordings of so many steps can be compared on.
    ///
    /// # Errors
    /// They are too many: each seed holds those that it draws.
    pub fn check_steps(&self, steps: u64) -> Result<(), CliError> {
        check_steps(steps.saturating_mul(u64::from(self.seeds)))
    }

    /// Discount of all fits and of the expert.
    pub fn discount(&self) -> f64 {
        self.entries[0].options.discount
    }

    /// Number of fits.
    pub fn cells(&self) -> usize {
        self.entries.len() * self.trajectories.len() * self.seeds as usize
    }
}

fn check_steps(steps: u64) -> Result<(), CliError> {
    if steps <= MOST_STEPS {
        return Ok(());
    }
    Err(CliError::usage(
        format!("expected at most {MOST_STEPS} steps in all, got {steps}: demonstrations times steps times seeds"),
        "compare with fewer --trajectories, --seeds or a shorter --horizon",
    ))
}

/// Options of an environment as typed, with the layout of a file among them.
///
/// # Errors
/// What is no `key=value`; a file that cannot be read.
pub fn env_options(texts: &[String], layout: Option<&std::path::Path>) -> Result<Options, CliError> {
    let mut options: Options = texts.iter().map(|text| env_option(text)).collect::<Result<_, _>>()?;
    if let Some(path) = layout {
        let text = std::fs::read_to_string(path).map_err(|error| {
            CliError::usage(
                format!("cannot read --layout {}: {error}", path.display()),
                "name a text file of rows of '.' (free) and '#' (wall)",
            )
        })?;
        options.insert("layout".to_owned(), Value::String(text.trim_end().to_owned()));
    }
    Ok(options)
}

#[cfg(test)]
mod tests {
    use super::*;
    use clap::Parser;
    use mazeway_learner::irl::{MStep, Penalty};

    #[derive(Parser)]
    struct Cli {
        #[command(flatten)]
        compare: CompareArgs,
    }

    fn job(flags: &[&str]) -> Result<Job, CliError> {
        let cli = Cli::try_parse_from(std::iter::once("compare").chain(flags.iter().copied())).expect("flags parse");
        Job::new(&cli.compare)
    }

    #[test]
    fn lists_are_sorted_and_without_repetition() {
        let job = job(&["--methods", "bc,em-tied,bc", "--trajectories", "20,1,5,20", "--seeds", "3"]).expect("a job");
        assert_eq!(job.entries.iter().map(|e| e.name.as_str()).collect::<Vec<_>>(), ["bc", "em-tied"]);
        assert_eq!((job.trajectories.as_slice(), job.cells()), ([1, 5, 20].as_slice(), 18));
        assert_eq!((job.baseline.as_str(), job.horizon, job.discount()), ("em-tied", 50, 0.9));
    }

    #[test]
    fn all_is_the_registry() {
        let job = job(&[]).expect("a job");
        assert_eq!(job.entries.len(), METHODS.len());
        assert_eq!(job.baseline, METHODS[0].id());
    }

    #[test]
    fn methods_take_options_of_their_own() {
        let job =
            job(&["--methods", "em:m-step=simplex:reference_basis=28,em,em-tied:penalty=l2:penalty_strength=0.5"])
                .expect("a job");
        assert_eq!((job.entries[0].options.m_step, job.entries[0].options.reference_basis), (MStep::Simplex, 28));
        assert_eq!((job.entries[1].options.m_step, job.entries[1].name.as_str()), (MStep::Nnls, "em"));
        assert_eq!((job.entries[2].options.penalty, job.entries[2].options.penalty_strength), (Penalty::L2, Some(0.5)));
    }

    #[test]
    fn what_makes_no_sense_is_refused() {
        for flags in [
            ["--methods", "magic"],
            ["--methods", "em:colour=red"],
            ["--methods", "em:m_step=round"],
            ["--methods", "em:seed=1"],
            ["--methods", "em:m_step"],
            ["--layout", "no such file"],
            ["--env-option", "slip"],
            ["--discount", "1.5"],
            ["--trajectories", "10000000"],
        ] {
            let error = job(&flags).err().expect("refused");
            assert_eq!(error.code, 2, "{flags:?}");
        }
    }
}
