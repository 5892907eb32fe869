//! What a remote step costs beside the loopback itself and beside a bare gRPC stream; how that scales; what memory it takes.
//!
//! `cargo run --release -p mazeway-bench-wire -- [--json FILE] [--modes pinned,idle] [--parts round_trips,…] [--quick]`
//!
//! Client and server are processes of their own: the binary `server` and, for everything else, this program started again.
//! All peers of a table are measured in turn, in rounds, so that what disturbs the machine disturbs them alike; a figure is
//! the median of its rounds with the quartiles. Mode `pinned` runs both ends on one core (`taskset -c 0`), where the price
//! is that of the instructions; mode `idle` leaves them to the scheduler, where waking a halted core adds to it. Compare
//! within one mode.
//!
//! `--json FILE` writes one object (`-`: to standard output, instead of the tables). Its fields are lists of records:
//!
//! | list | fields of a record |
//! |---|---|
//! | `round_trips` | `mode`, `name`, `median`, `low`, `high`: µs from a request to its answer, one maze |
//! | `pipelined` | `mode`, `name`, `in_flight`, `median`, `low`, `high`: steps a second, one maze, sent ahead |
//! | `batches` | `mode`, `env`, `num_envs`, `name`, `median`, `low`, `high`: environments' steps a second, batch after batch |
//! | `rollouts` | `mode`, `env`, `controller`, `promised`, `met`, `median`, `low`, `high`: steps a second that reach the client |
//! | `ratios` | `mode`, `name`, `value`, `limit` (null where none is promised), `met` |
//! | `memory` | `name`, `env`, `count`, `bytes`, `limit`, `met`: resident bytes of the server for one of `name`, see [`memory`] |
//! | `scale` | `sessions`, `name`, `median`, `low`, `high`: steps a second of all together, each with a stream of its own |
//! | `watching` | `mode`, `env`, `name`, `median`, `low`, `high`, `pictures`: µs from a step's request to its answer; pictures read |
//!
//! and beside them `benchmark` ("wire"), `cores`, `cpu`, `rounds`. Names in `round_trips`: `raw_tcp`, `raw_unix` (blocking
//! sockets, the floor), `tonic_bidi_tcp`, `tonic_bidi_unix`, `tonic_bidi_tcp_multi_thread` (server on tokio's
//! multi-threaded runtime), `tonic_unary_tcp`, `env_step_tcp`, `env_step_unix` ([`mazeway_client::Env::step`]),
//! `env_step_tcp_multi_thread` (the client on that runtime), `unary_step_tcp` (the RPC `Step`). In `batches`:
//! `vector_env_step` and `tonic_bidi_echo`, which carries the same number of bytes either way. In `watching`:
//! `unwatched` and `watched`, by fifty viewers of whom forty read nothing.

mod figures;
mod memory;
mod peers;
mod process;
mod rollouts;
mod round_trips;
mod scale;
mod throughput;
mod watching;

use clap::{Parser, ValueEnum};
use figures::Report;
use mazeway_client::{ConnectOptions, Connection};
use std::{
    path::PathBuf,
    process::{Command, Stdio},
    time::Duration,
};

/// How the ends share the machine.
#[derive(Debug, Clone, Copy, PartialEq, Eq, ValueEnum)]
enum Mode {
    Pinned,
    Idle,
}

/// What is measured.
#[derive(Debug, Clone, Copy, PartialEq, Eq, ValueEnum)]
#[value(rename_all = "snake_case")]
enum Part {
    RoundTrips,
    Pipelined,
    Batches,
    Rollouts,
    Memory,
    Scale,
    Watching,
}

#[derive(Debug, Parser)]
#[command(about = "Measures Mazeway's wire beside its peers")]
struct Cli {
    /// Where one JSON object of all figures goes; `-` prints it instead of the tables.
    #[arg(long, value_name = "FILE")]
    json: Option<PathBuf>,
    /// Which modes.
    #[arg(long, value_delimiter = ',', default_value = "pinned,idle")]
    modes: Vec<Mode>,
    /// Which parts; memory and scale are measured in mode `idle`.
    #[arg(long, value_delimiter = ',', default_value = "round_trips,pipelined,batches,rollouts,memory,scale,watching")]
    parts: Vec<Part>,
    /// Rounds of every figure.
    #[arg(long, default_value_t = 9)]
    rounds: usize,
    /// Short rounds, few of them: to see that it runs.
    #[arg(long)]
    quick: bool,
    /// Microseconds for which client and server look for bytes before they sleep; 0: they sleep at once.
    #[arg(long, default_value_t = 100, value_name = "N")]
    spin_micros: u64,
    /// The binary `server`; built from the present sources where it is not given.
    #[arg(long, value_name = "FILE")]
    server: Option<PathBuf>,
    /// Measures in the present process and prints the object.
    #[arg(long, hide = true)]
    within: Option<Mode>,
    /// Serves the peers.
    #[arg(long, hide = true)]
    serve_peers: bool,
}

/// What a part needs to know.
struct Setting {
    mode: Mode,
    rounds: usize,
    /// Time of a figure in a round.
    slice: Duration,
    server: PathBuf,
    quick: bool,
    spin_micros: u64,
}

impl Setting {
    /// A connection to Mazeway's server at `address`.
    async fn connect(&self, address: &str) -> Connection {
        let options = ConnectOptions { spin: Duration::from_micros(self.spin_micros), ..ConnectOptions::default() };
        Connection::connect(address, &options).await.expect("connects")
    }
}

fn main() {
    let cli = Cli::parse();
    if cli.serve_peers {
        return peers::serve();
    }
    if let Some(mode) = cli.within {
        let server = cli.server.expect("the first process names it");
        let (rounds, slice) = if cli.quick { (3, Duration::from_millis(5)) } else { (cli.rounds, figures::SLICE) };
        let report = measure(
            &Setting { mode, rounds, slice, server, quick: cli.quick, spin_micros: cli.spin_micros },
            &cli.parts,
        );
        println!("{}", report.to_json());
        return;
    }
    let server = cli.server.clone().unwrap_or_else(mazeway_bench_program::server);
    let mut report = Report::new(cli.rounds);
    for &mode in &cli.modes {
        let (this, parts) = (std::env::current_exe().expect("a path of this program"), parts_of(mode, &cli.parts));
        let mut command = match mode {
            Mode::Pinned => Command::new("taskset"),
            Mode::Idle => Command::new(&this),
        };
        if mode == Mode::Pinned {
            command.args(["-c", "0"]).arg(&this);
        }
        let name = mode.to_possible_value().expect("a name").get_name().to_owned();
        command.args(["--within", &name, "--parts", &parts, "--rounds", &cli.rounds.to_string()]);
        command.args(["--spin-micros", &cli.spin_micros.to_string()]);
        command.arg("--server").arg(&server).args(cli.quick.then_some("--quick"));
        let output = command.stderr(Stdio::inherit()).output().expect("taskset and this program");
        assert!(output.status.success(), "{command:?}: {}", output.status);
        report.merge(&String::from_utf8_lossy(&output.stdout));
    }
    report.add_ratios();
    match cli.json.as_deref() {
        Some(path) if path.as_os_str() == "-" => println!("{}", report.to_json()),
        path => {
            print!("{}", report.tables());
            if let Some(path) = path {
                std::fs::write(path, report.to_json()).expect("a file that can be written");
            }
        }
    }
}

fn parts_of(mode: Mode, parts: &[Part]) -> String {
    let of_all_modes = |part: &&Part| mode == Mode::Idle || !matches!(part, Part::Memory | Part::Scale);
    let names = parts.iter().filter(of_all_modes).filter_map(ValueEnum::to_possible_value);
    names.map(|value| value.get_name().to_owned()).collect::<Vec<_>>().join(",")
}

fn measure(setting: &Setting, parts: &[Part]) -> Report {
    let mut report = Report::new(setting.rounds);
    for part in parts {
        match part {
            Part::RoundTrips => round_trips::measure(setting, &mut report),
            Part::Pipelined => throughput::pipelined(setting, &mut report),
            Part::Batches => throughput::batches(setting, &mut report),
            Part::Rollouts => rollouts::measure(setting, &mut report),
            Part::Memory => memory::measure(setting, &mut report),
            Part::Scale => scale::measure(setting, &mut report),
            Part::Watching => watching::measure(setting, &mut report),
        }
    }
    report
}
