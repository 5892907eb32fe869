//! `soak`: holds a server under load for as long as one likes, and prints what was seen.
//!
//! Ends with 1 and a line that says what was missed where it was not what docs/RELIABILITY.md promises.
//! `cargo run --release -p mazeway-bench-soak -- --minutes 60` builds the server in the same profile first. Linux alone: it
//! looks into `/proc` and runs `chrt`, `taskset` and `kill`.

use clap::{Args, Parser, Subcommand};
use mazeway_bench_program::{cargo, profile};
use mazeway_bench_soak::{
    fits,
    load::{Kind, Share},
    report::MOST_MEDIANS,
    run::{Plan, run},
};
use std::{io, path::PathBuf, process::ExitCode, time::Duration};

#[derive(Debug, Parser)]
#[command(about = "Holds a server under the load of two thousand sessions", args_conflicts_with_subcommands = true)]
struct Cli {
    #[command(subcommand)]
    part: Option<Part>,
    #[command(flatten)]
    run: RunArgs,
}

#[derive(Debug, Args)]
struct RunArgs {
    /// How long the load lasts.
    #[arg(long, default_value_t = 5.0, value_name = "N")]
    minutes: f64,
    /// The server on the first core, all else on the second, where the client that is timed comes first: as if on three
    /// machines.
    #[arg(long)]
    pinned: bool,
    /// Instead of the load, a learner on the cores of the server that fits without end: how long steps take beside fits.
    #[arg(long)]
    fits: bool,
    /// Print one JSON object instead of tables.
    #[arg(long)]
    json: bool,
    /// The binary `server`; built from the present sources where it is not given.
    #[arg(long, value_name = "FILE")]
    server: Option<PathBuf>,
    /// The binary `learner`, for `--fits`; likewise.
    #[arg(long, value_name = "FILE")]
    learner: Option<PathBuf>,
}

#[derive(Debug, Subcommand)]
enum Part {
    /// A process of the load
    #[command(hide = true)]
    Load(LoadArgs),
    /// A process that sends back what it gets
    #[command(hide = true)]
    Echo,
}

#[derive(Debug, Args)]
struct LoadArgs {
    #[arg(long)]
    address: String,
    #[arg(long, value_enum)]
    kind: Kind,
    #[arg(long)]
    connections: usize,
    #[arg(long)]
    sessions: usize,
    #[arg(long)]
    lease_secs: u64,
}

fn main() -> ExitCode {
    let cli = Cli::parse();
    if let Some(part) = cli.part {
        let runtime = tokio::runtime::Builder::new_current_thread().enable_all().build().expect("a runtime");
        match part {
            Part::Load(LoadArgs { address, kind, connections, sessions, lease_secs }) => {
                let share = Share { kind, connections, sessions, lease: Duration::from_secs(lease_secs) };
                runtime.block_on(share.run(address));
            }
            Part::Echo => runtime.block_on(mazeway_bench_soak::probe::echo_back()).expect("a port"),
        }
        return ExitCode::SUCCESS;
    }
    match cli.run.run() {
        Ok(missed) if missed.is_empty() => ExitCode::SUCCESS,
        Ok(missed) => {
            eprintln!("error: missed: {}", missed.join("; "));
            ExitCode::FAILURE
        }
        Err(error) => {
            eprintln!("error: {error}");
            ExitCode::FAILURE
        }
    }
}

impl RunArgs {
    /// Runs, prints what was seen, and gives what should have been.
    fn run(self) -> io::Result<Vec<String>> {
        let Self { minutes, pinned, json, fits, server, learner } = self;
        let time = Duration::try_from_secs_f64(minutes * 60.0).unwrap_or(Duration::from_mins(5));
        let server = server.unwrap_or_else(mazeway_bench_program::server);
        let plan = Plan { server, soak: std::env::current_exe()?, time, pinned };
        // Where all share all cores, how long one waits is up to the scheduler.
        let most_medians = if pinned { MOST_MEDIANS } else { f64::INFINITY };
        let (object, tables, missed) = if fits {
            let report = fits::run(&plan, &learner.unwrap_or_else(build_learner))?;
            (report.to_json(), report.tables(), report.missed(most_medians))
        } else {
            let report = run(&plan)?;
            (report.to_json(), report.tables(), report.missed(most_medians))
        };
        if json {
            println!("{object}");
        } else {
            print!("{tables}");
        }
        Ok(missed)
    }
}

/// Builds `learner` beside the present program.
fn build_learner() -> PathBuf {
    let own = std::env::current_exe().expect("a path of this program");
    let directory = own.parent().expect("a profile's directory");
    let mut cargo = cargo();
    cargo.args(["build", "--quiet", "-p", "mazeway-learner", "--bin", "learner", "--profile", profile(directory)]);
    let status = cargo.current_dir(env!("CARGO_MANIFEST_DIR")).status().expect("cargo");
    assert!(status.success(), "{cargo:?}: {status}");
    directory.join("learner")
}
