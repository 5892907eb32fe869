//! `soak`: holds a server under load for as long as one likes, and prints what was seen.
//!
//! `cargo run --release -p mazeway-bench-soak -- --minutes 60` builds the server in the same profile first. Linux alone: it
//! looks into `/proc` and runs `chrt`, `taskset` and `kill`.

use clap::{Args, Parser, Subcommand};
use mazeway_bench_soak::{
    load::{Kind, Share},
    run::{Plan, run},
};
use std::{path::PathBuf, process::ExitCode, time::Duration};

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
    /// The server on the first core, all else on the second: as if on two machines.
    #[arg(long)]
    pinned: bool,
    /// Print one JSON object instead of tables.
    #[arg(long)]
    json: bool,
    /// The binary `server`; built from the present sources where it is not given.
    #[arg(long, value_name = "FILE")]
    server: Option<PathBuf>,
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
    let RunArgs { minutes, pinned, json, server } = cli.run;
    let time = Duration::try_from_secs_f64(minutes * 60.0).unwrap_or(Duration::from_mins(5));
    let soak = std::env::current_exe().expect("a path of this program");
    let plan = Plan { server: server.unwrap_or_else(mazeway_bench_program::server), soak, time, pinned };
    match run(&plan) {
        Ok(report) => {
            if json {
                println!("{}", report.to_json());
            } else {
                print!("{}", report.tables());
            }
            ExitCode::SUCCESS
        }
        Err(error) => {
            eprintln!("error: {error}");
            ExitCode::FAILURE
        }
    }
}
