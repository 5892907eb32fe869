//! `learner reproduce`: the paper's figures, its experiment with three styles, its weak points and transfer, in one command.
//!
//! Every number comes out of the jobs that `learner fit` and `learner compare` do, over the same servers; nothing here computes
//! what those do not. A comparison that was cut off goes on where it was.

mod tables;

use super::{
    AccessArgs,
    compare::{self, CompareArgs},
    data_directory,
    error::CliError,
    fit::{self, FitArgs, narrate::Narrator},
    scene::Environments,
};
use clap::{Args, Parser};
use mazeway_learner::{
    eval::comparison::Comparison,
    report::{Report, write},
};
use std::{ffi::OsString, fmt::Write as _, path::PathBuf};

/// What `learner reproduce` takes.
#[derive(Debug, Clone, Args)]
#[command(after_help = "\
Figure 1: the maze, its estimated reward and learned policy. Figure 2: methods over the number of demonstrations. Figure 3: the
highway in three styles. After them: where the paper's algorithm is weak, and what a reward is worth in another model.")]
pub struct ReproduceArgs {
    /// How many seeds; fewer are quicker
    #[arg(long, value_name = "N", default_value_t = 20, value_parser = clap::value_parser!(u32).range(1..=100_000))]
    seeds: u32,
    /// Methods of Figure 2, separated by commas
    #[arg(long, value_name = "LIST", default_value = "all")]
    methods: String,
    /// Numbers of demonstrations of Figure 2, separated by commas
    #[arg(long, value_name = "LIST", default_value = "1,2,5,10,20,50,100")]
    trajectories: String,
    /// Episodes of 200 steps that each driver of Figure 3 is judged by
    #[arg(long, value_name = "N", default_value_t = 400, value_parser = clap::value_parser!(u32).range(2..=1_000_000))]
    rollouts: u32,
    /// Directory that holds the reports [default: the platform's data directory]
    #[arg(long, value_name = "DIR", env = "MAZEWAY_DATA")]
    data: Option<PathBuf>,
    /// Directory for figures and tables [default: reports/reproduce in the data directory]
    #[arg(long, value_name = "DIR")]
    out: Option<PathBuf>,
}

#[derive(Parser)]
struct Fit {
    #[command(flatten)]
    args: FitArgs,
}

#[derive(Parser)]
struct Compare {
    #[command(flatten)]
    args: CompareArgs,
}

/// The maze of the paper with the eastern way into its centre closed.
const CLOSED: &str =
    ".........\n.###.###.\n.#.....#.\n.#.#.#.#.\n......#..\n.#.#.#.#.\n.#.....#.\n.###.###.\n.........\n";

/// Where results go, and what was told so far.
struct Run {
    out: PathBuf,
    /// One for all, so that each model is estimated once.
    environments: Environments,
    narrator: Narrator,
    text: String,
}

impl Run {
    /// Tells a part, now and in the file at the end.
    fn tell(&mut self, text: &str) -> Result<(), CliError> {
        self.narrator.line(text)?;
        let _ = writeln!(self.text, "{text}");
        Ok(())
    }

    /// `learner fit` with these arguments; its report goes to `name`.
    async fn fit(&self, name: &str, arguments: &[&str]) -> Result<Report, CliError> {
        let directory = self.out.join(name);
        let typed = ["fit", "--source", "expert"].into_iter().chain(arguments.iter().copied()).map(OsString::from);
        let places = [
            "--data".into(),
            self.out.join("recordings").into_os_string(),
            "--out".into(),
            directory.clone().into_os_string(),
            "--env-addr".into(),
            self.environments.address.clone().into(),
        ];
        let args = Fit::try_parse_from(typed.chain(places)).map_err(|error| internal(&error))?.args;
        let (report, _) = Box::pin(fit::make(&args, Narrator::quiet())).await?;
        let failed = |error: mazeway_learner::report::ReportError| cannot_write(&error);
        write::write(&report, &directory).map_err(failed)?;
        Ok(report)
    }

    /// `learner compare` with these arguments; everything that it writes goes to `name`.
    async fn compare(&self, name: &str, arguments: &[&str]) -> Result<(Comparison, String), CliError> {
        let typed = std::iter::once("compare").chain(arguments.iter().copied());
        let args = Compare::try_parse_from(typed)
            .map_err(|error| {
                CliError::usage(
                    error.to_string().lines().next().unwrap_or_default().trim_start_matches("error: ").to_owned(),
                    "see 'learner reproduce --help'",
                )
            })?
            .args;
        let job = compare::job::Job::new(&args)?;
        let directory = self.out.join(name);
        let connection = &self.environments.connection;
        let (comparison, _) = compare::compare(&job, connection, Narrator::quiet(), |_| Ok(directory.clone())).await?;
        compare::output::write(&job, &comparison, &directory)?;
        let table = compare::output::table(&job, &comparison);
        Ok((comparison, table))
    }
}

/// Draws everything.
///
/// # Errors
/// Wrong usage, a service that fails, a directory that cannot be written to.
pub async fn run(args: ReproduceArgs) -> Result<(), CliError> {
    let out = match &args.out {
        Some(out) => out.clone(),
        None => data_directory(args.data.clone())?.join("reports").join("reproduce"),
    };
    std::fs::create_dir_all(&out).map_err(|error| {
        CliError::failure(
            format!("cannot make {}: {error}", out.display()),
            "choose a directory that you may write to with --out DIR",
        )
    })?;
    let environments = Environments::start(None, &AccessArgs::default()).await?;
    let mut run = Run { out, environments, narrator: Narrator::new(false), text: String::new() };
    let outcome = draw(&mut run, &args).await;
    let stopped = run.environments.stop().await;
    outcome.and(stopped)
}

async fn draw(run: &mut Run, args: &ReproduceArgs) -> Result<(), CliError> {
    figure1(run).await?;
    figure2(run, args).await?;
    figure3(run, args).await?;
    weak_points(run, args).await?;
    transfer(run, args).await?;
    let written =
        write::replace(&run.out, "reproduce.txt", run.text.as_bytes()).map_err(|error| cannot_write(&error))?;
    Ok(run.narrator.step("wrote", written.display())?)
}

/// The maze: estimated reward and learned policy, by the paper's algorithm and by the default.
async fn figure1(run: &mut Run) -> Result<(), CliError> {
    run.tell("# Figure 1: the maze, 100 demonstrations of 50 steps, seed 0\n")?;
    let mut rows = Vec::new();
    for method in ["em", "em-tied"] {
        let report = run.fit(&format!("figure1-{method}"), &["--env", "Maze-v0", "--method", method]).await?;
        rows.push(tables::maze_row(method, &report));
    }
    run.tell(&tables::maze(&rows))?;
    run.tell("picture: figure1-em/figure1.png, figure1-em-tied/figure1.png\n")
}

/// Methods over the number of demonstrations.
async fn figure2(run: &mut Run, args: &ReproduceArgs) -> Result<(), CliError> {
    run.tell("# Figure 2: methods over the number of demonstrations\n")?;
    let seeds = args.seeds.to_string();
    let arguments = ["--methods", &args.methods, "--trajectories", &args.trajectories, "--seeds", &seeds];
    let (_, table) = run.compare("figure2", &arguments).await?;
    run.tell(&table)?;
    run.tell("picture: figure2/agreement.png, figure2/evd.png\n")
}

/// Three styles on the highway.
async fn figure3(run: &mut Run, args: &ReproduceArgs) -> Result<(), CliError> {
    let rollouts = args.rollouts.to_string();
    run.tell(&format!(
        "# Figure 3: the highway in three styles, 200 snapshots of 5 steps each, seed 0; {rollouts} episodes of 200 steps a driver\n"
    ))?;
    for style in ["aggressive", "bad", "legal"] {
        let mut reports = Vec::new();
        for method in ["em", "em-tied", "bc"] {
            let arguments = ["--style", style, "--method", method, "--rollouts", &rollouts];
            reports.push((method, run.fit(&format!("figure3-{style}-{method}"), &arguments).await?));
        }
        run.tell(&tables::drivers(style, &reports))?;
    }
    run.tell("picture: figure3-STYLE-METHOD/policy.png, reward.png and report.html\n")
}

/// What the exact product does, the dependence on the reference, and counts against rewards.
async fn weak_points(run: &mut Run, args: &ReproduceArgs) -> Result<(), CliError> {
    run.tell("# Where the paper's algorithm is weak\n")?;
    let methods = "em,em:responsibility=exact,em:m_step=simplex,em:horizon_prior=uniform,em:reference_basis=4,\
                   em:reference_basis=8,em:reference_basis=13,em:reference_basis=28,em:reference_basis=56";
    let seeds = args.seeds.to_string();
    let (_, table) =
        run.compare("weak-points", &["--methods", methods, "--trajectories", "1,5,20,100", "--seeds", &seeds]).await?;
    run.tell(&table)?;
    let mut rows = Vec::new();
    for method in ["em", "em-tied"] {
        for seed in 0..args.seeds.min(5) {
            let seed = seed.to_string();
            let report = run
                .fit(&format!("counts/{method}-{seed}"), &["--env", "Maze-v0", "--method", method, "--seed", &seed])
                .await?;
            rows.push((method, report));
        }
    }
    run.tell(&tables::counts(&rows))
}

/// Fit in one model, act in another.
async fn transfer(run: &mut Run, args: &ReproduceArgs) -> Result<(), CliError> {
    run.tell("# Transfer: learned in one model, used in another\n")?;
    let layout = write::replace(&run.out, "closed.txt", CLOSED.as_bytes()).map_err(|error| cannot_write(&error))?;
    let layout = layout.to_string_lossy().into_owned();
    for trajectories in ["10", "100"] {
        let mut transfers = Vec::new();
        for seed in 0..args.seeds {
            let seed = seed.to_string();
            let arguments =
                ["--env", "Maze-v0", "--trajectories", trajectories, "--seed", &seed, "--plan-in-layout", &layout];
            let report = run.fit(&format!("transfer/maze-{trajectories}-{seed}"), &arguments).await?;
            transfers.extend(report.transfer);
        }
        let title = format!("the maze with the eastern way into its centre closed, {trajectories} demonstrations");
        run.tell(&tables::mazes_transferred(&title, &transfers))?;
    }
    let rollouts = args.rollouts.to_string();
    for style in ["aggressive", "bad", "legal"] {
        let arguments = ["--style", style, "--rollouts", &rollouts, "--plan-in-option", "density=7"];
        let report = run.fit(&format!("transfer/highway-{style}"), &arguments).await?;
        if let Some(transfer) = &report.transfer {
            run.tell(&tables::highway_transferred(style, transfer))?;
        }
    }
    Ok(())
}

fn internal(error: &clap::Error) -> CliError {
    CliError::failure(format!("wrong arguments within: {error}"), "report this as a defect")
}

fn cannot_write(error: &dyn std::fmt::Display) -> CliError {
    CliError::failure(error.to_string(), "choose a directory that you may write to with --out DIR")
}
