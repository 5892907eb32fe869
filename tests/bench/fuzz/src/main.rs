//! `fuzz`: feeds the readers of bytes from outside with inputs that libFuzzer makes, guided by the code that they reach.
//!
//! `tests/bench/reliability.sh fuzz` builds it with coverage, which a stable compiler gives, and runs every target. What leads to
//! new code is kept under `target/fuzz/corpus`, where a later run begins. A panic, an execution that takes too much memory on its
//! thread or too long (see [`judge`]), and a process of more than [`MAX_PROCESS_MIB`] end the run; the input is kept beside
//! the log.

use bolero::check;
use clap::Parser;
use comfy_table::{CellAlignment, Table, presets};
use mazeway_tests::{
    fuzz::{
        SLOW, corpus, judge, keep_corpus,
        targets::{TARGETS, Target, find},
    },
    memory,
};
use std::{
    env,
    fs::{self, File},
    io,
    path::{Path, PathBuf},
    process::{Command, ExitCode},
    time::{Duration, Instant},
};

/// Tells a child its target.
const TARGET: &str = "MAZEWAY_FUZZ_TARGET";
/// Tells it what libFuzzer is to do, as bolero has it.
const ARGUMENTS: &str = "BOLERO_LIBFUZZER_ARGS";
/// Of a process: its corpus, the services that it asks and what libFuzzer holds of them included.
const MAX_PROCESS_MIB: u32 = 1024;

#[derive(Debug, Parser)]
#[command(about = "Fuzzes the readers of bytes from outside, guided by coverage")]
struct Cli {
    /// The targets; all where none is named.
    #[arg(value_name = "TARGET", value_parser = target)]
    targets: Vec<Target>,
    /// Inputs of each target.
    #[arg(long, default_value_t = 10_000_000, value_name = "N")]
    runs: u64,
    /// Where the mutations begin.
    #[arg(long, default_value_t = 1, value_name = "N")]
    seed: u32,
    /// Where corpora, logs and failing inputs are kept.
    #[arg(long, default_value = "target/fuzz", value_name = "DIR")]
    work: PathBuf,
    /// Instead of fuzzing, put the fewest inputs of each corpus that reach all that it reaches into `tests/data/fuzz`, where
    /// every run of the tests reads them and every further run of this program begins.
    #[arg(long, conflicts_with_all = ["runs", "seed"])]
    keep: bool,
}

fn target(name: &str) -> Result<Target, String> {
    let names = || TARGETS.map(|target| target.name).join(", ");
    find(name).copied().ok_or_else(|| format!("expected one of {}", names()))
}

/// What is wrong where libFuzzer says nothing.
const UNGUIDED: &str = "built without libFuzzer: tests/bench/reliability.sh fuzz builds it";

/// What libFuzzer has told at its end.
struct Outcome {
    inputs: u64,
    covered: u64,
    corpus: usize,
    slowest_secs: u64,
    peak_mib: u64,
}

fn main() -> ExitCode {
    if let Ok(name) = env::var(TARGET) {
        read_inputs(find(&name).expect("the name of a target"));
        return ExitCode::SUCCESS;
    }
    let cli = Cli::parse();
    let targets = if cli.targets.is_empty() { TARGETS.to_vec() } else { cli.targets };
    if cli.keep {
        for target in targets {
            match keep(&target, &cli.work) {
                Ok(inputs) => println!("{}: {inputs} inputs", target.name),
                Err(error) => {
                    eprintln!("error: {}: {error}", target.name);
                    return ExitCode::FAILURE;
                }
            }
        }
        return ExitCode::SUCCESS;
    }
    let mut table = Table::new();
    table.load_style(presets::ASCII_MARKDOWN);
    table.set_header(["target", "inputs", "edges", "corpus", "slowest, s", "process, MiB", "took, s"]);
    for column in table.column_iter_mut().skip(1) {
        column.set_cell_alignment(CellAlignment::Right);
    }
    for target in targets {
        let begun = Instant::now();
        match fuzz(&target, cli.runs, cli.seed, &cli.work) {
            Ok(outcome) => {
                let Outcome { inputs, covered, corpus, slowest_secs, peak_mib } = outcome;
                eprintln!("{}: {inputs} inputs, {covered} edges", target.name);
                let numbers = [inputs, covered, corpus as u64, slowest_secs, peak_mib, begun.elapsed().as_secs()];
                table.add_row([target.name.to_owned()].into_iter().chain(numbers.map(|number| number.to_string())));
            }
            Err(error) => {
                eprintln!("{table}\nerror: {}: {error}", target.name);
                return ExitCode::FAILURE;
            }
        }
    }
    println!("{table}");
    ExitCode::SUCCESS
}

/// In a child: what libFuzzer makes is read.
fn read_inputs(target: &'static Target) {
    check!().with_max_len(target.max_bytes).with_shrink_time(Duration::ZERO).for_each(|input| {
        let begun = Instant::now();
        let peak = allocation_counter::measure(|| drop((target.read)(input))).bytes_max;
        if let Some(failure) = judge(peak, begun.elapsed()) {
            panic!("{failure}");
        }
    });
}

/// Runs a child on a target until it has read so many inputs.
fn fuzz(target: &Target, runs: u64, seed: u32, work: &Path) -> Result<Outcome, String> {
    let kept = grown(target, work)?;
    let logs = logs(work)?;
    let words = logs.join(format!("{}.dict", target.name));
    fs::write(&words, dictionary(target.words)).map_err(text)?;
    let arguments = [
        kept.display().to_string(),
        format!("-artifact_prefix={}/{}-", logs.display(), target.name),
        format!("-dict={}", words.display()),
        format!("-runs={runs}"),
        format!("-seed={seed}"),
        format!("-max_len={}", target.max_bytes),
        format!("-timeout={}", SLOW.as_secs()),
        format!("-rss_limit_mb={MAX_PROCESS_MIB}"),
        "-reload=0".into(),
        "-print_final_stats=1".into(),
    ];
    let said = run_child(target, &arguments, &logs.join(format!("{}-{seed}.log", target.name)))?;
    let number = |name: &str| {
        let line = said.lines().rev().find_map(|line| line.split_once(name))?;
        line.1.split_whitespace().next()?.parse::<u64>().ok()
    };
    let told = (|| {
        Some(Outcome {
            inputs: number("stat::number_of_executed_units:")?,
            covered: number(" cov: ")?,
            corpus: fs::read_dir(&kept).ok()?.count(),
            slowest_secs: number("stat::slowest_unit_time_sec:")?,
            peak_mib: number("stat::peak_rss_mb:")?,
        })
    })();
    told.ok_or_else(|| UNGUIDED.into())
}

/// Puts what is worth keeping of a corpus beside the tests, and says how many inputs that is.
fn keep(target: &Target, work: &Path) -> Result<usize, String> {
    let grown = grown(target, work)?;
    let fewest = work.join("fewest").join(target.name);
    let _ = fs::remove_dir_all(&fewest);
    make_directory(&fewest)?;
    let arguments = [
        "-merge=1".into(),
        format!("-max_len={}", target.max_bytes),
        fewest.display().to_string(),
        grown.display().to_string(),
    ];
    run_child(target, &arguments, &logs(work)?.join(format!("{}-keep.log", target.name)))?;
    let mut inputs = Vec::new();
    for entry in fs::read_dir(&fewest).map_err(text)? {
        inputs.push(fs::read(entry.map_err(text)?.path()).map_err(text)?);
    }
    if inputs.is_empty() {
        return Err(UNGUIDED.into());
    }
    inputs.sort_by(|one, other| (one.len(), one).cmp(&(other.len(), other)));
    keep_corpus(target, &inputs).map_err(text)?;
    Ok(inputs.len())
}

/// Where a corpus grows: what is kept beside the tests and what runs here have found.
fn grown(target: &Target, work: &Path) -> Result<PathBuf, String> {
    let grown = work.join("corpus").join(target.name);
    make_directory(&grown)?;
    for (number, input) in corpus(target).iter().enumerate() {
        fs::write(grown.join(format!("seed-{number:03}")), input).map_err(text)?;
    }
    Ok(grown)
}

/// Has a child of this program do with a target what libFuzzer is told, and gives what it said, which is logged.
fn run_child(target: &Target, arguments: &[String], log: &Path) -> Result<String, String> {
    // A child ends without clearing up.
    let temporary = memory();
    let output = File::create(log).map_err(text)?;
    let status = Command::new(env::current_exe().map_err(text)?)
        .env(TARGET, target.name)
        .env(ARGUMENTS, arguments.join(" "))
        .env("TMPDIR", temporary.path())
        // Each thread would keep memory of its own, which would be told as the process's.
        .env("MALLOC_ARENA_MAX", "2")
        .stdout(output.try_clone().map_err(text)?)
        .stderr(output)
        .status()
        .map_err(text)?;
    if !status.success() {
        return Err(format!("{status}; see {}", log.display()));
    }
    Ok(String::from_utf8_lossy(&fs::read(log).map_err(text)?).into_owned())
}

fn logs(work: &Path) -> Result<PathBuf, String> {
    let logs = work.join("logs");
    make_directory(&logs)?;
    Ok(logs)
}

fn make_directory(path: &Path) -> Result<(), String> {
    fs::create_dir_all(path).map_err(text)
}

fn text(error: io::Error) -> String {
    error.to_string()
}

/// Pieces of a format as libFuzzer reads them.
fn dictionary(words: &[&[u8]]) -> String {
    let mut text = String::new();
    for word in words {
        let escaped = word.iter().flat_map(|byte| ["\\x".to_owned(), format!("{byte:02x}")]);
        text.extend(["\"".to_owned()].into_iter().chain(escaped).chain(["\"\n".to_owned()]));
    }
    text
}
