//! Bytes from outside, mutated: whatever they are, what reads them ends in a value or in an error that says why.
//!
//! Two drive them. `tests/bench/fuzz` is guided by coverage, for millions of inputs. [`run`] is for the tests, the same every time:
//! inputs are mutated from a corpus that is kept in the repository, and an input that leads to an answer not seen before (a
//! message with its numbers and names taken out) joins the corpus of the run. A panic is caught with its input, memory is
//! metered by the caller, a hang is an execution that takes longer than [`SLOW`].

pub mod mutate;
pub mod requests;
pub mod targets;

use mutate::{Mutator, below};
use rand_pcg::Pcg64Mcg;
use std::{
    collections::HashSet,
    fs::{self, File},
    io::{self, Read as _},
    panic::{AssertUnwindSafe, catch_unwind},
    path::{Path, PathBuf},
    time::{Duration, Instant},
};
use targets::Target;

/// Bytes that one execution may hold at its peak.
pub const MAX_BYTES: u64 = 256 << 20;
/// Time that one execution may take, on a machine that is busy.
pub const SLOW: Duration = Duration::from_secs(20);

/// What a run did.
#[derive(Debug, Clone, Copy, Default)]
pub struct Tally {
    /// Inputs that were read.
    pub executions: u64,
    /// Of these, how many were accepted.
    pub accepted: u64,
    /// Different answers.
    pub answers: usize,
    /// Bytes that an execution held at most.
    pub peak_bytes: u64,
    /// Seconds that an execution took at most.
    pub longest_secs: f64,
}

/// Where the inputs of a target are kept.
pub fn corpus_directory(target: &Target) -> PathBuf {
    Path::new(env!("CARGO_MANIFEST_DIR")).join("data").join("fuzz").join(target.name)
}

/// What a run of `fuzz` has found that leads to code of its own, packed.
fn archive(target: &Target) -> PathBuf {
    corpus_directory(target).with_extension("tar.zst")
}

/// The inputs that are kept: seeds, those that failed once, in the order of their names, and what a long run has found.
///
/// # Panics
/// They do not read.
pub fn corpus(target: &Target) -> Vec<Vec<u8>> {
    let mut inputs = (target.seeds)();
    if let Ok(files) = fs::read_dir(corpus_directory(target)) {
        let mut files = files.map(|file| file.expect("a file").path()).collect::<Vec<_>>();
        files.sort();
        inputs.extend(files.iter().map(|file| fs::read(file).expect("an input")));
    }
    if let Ok(packed) = File::open(archive(target)) {
        let unpacked = zstd::Decoder::new(packed).expect("an archive");
        for entry in tar::Archive::new(unpacked).entries().expect("an archive") {
            let mut input = Vec::new();
            entry.and_then(|mut entry| entry.read_to_end(&mut input)).expect("an input");
            inputs.push(input);
        }
    }
    assert!(!inputs.is_empty(), "{}: no inputs", target.name);
    inputs
}

/// Keeps what a long run has found, instead of what one before it had.
///
/// # Errors
/// It cannot be written.
pub fn keep_corpus(target: &Target, inputs: &[Vec<u8>]) -> io::Result<()> {
    let mut archive = tar::Builder::new(zstd::Encoder::new(File::create(archive(target))?, 19)?);
    for (number, input) in inputs.iter().enumerate() {
        let mut header = tar::Header::new_ustar();
        header.set_size(input.len() as u64);
        header.set_mode(0o644);
        archive.append_data(&mut header, format!("{number:05}"), &input[..])?;
    }
    archive.into_inner()?.finish()?.sync_all()
}

/// Reads the inputs that are kept, and so many that are mutated from them. `meter` calls what it is given and tells how many
/// bytes were held at its peak.
///
/// # Panics
/// An execution panics, takes too long or too much memory; the input is written to the temporary directory.
pub fn run(target: &Target, executions: u64, seed: u64, mut meter: impl FnMut(&mut dyn FnMut()) -> u64) -> Tally {
    let mut mutator = Mutator::new(Pcg64Mcg::new(u128::from(seed)), target.words);
    let mut pool = corpus(target);
    let kept = pool.len();
    let mut seen = HashSet::new();
    let mut tally = Tally::default();
    for execution in 0..kept as u64 + executions {
        let input = match usize::try_from(execution) {
            Ok(first) if first < kept => pool[first].clone(),
            _ => mutator.mutate(&pool, target.max_bytes),
        };
        let begun = Instant::now();
        let mut answer = None;
        let peak = meter(&mut || {
            answer = Some(catch_unwind(AssertUnwindSafe(|| (target.read)(&input))));
        });
        let took = begun.elapsed();
        let failure = match &answer {
            Some(Ok(_)) => judge(peak, took),
            Some(Err(_)) | None => Some("panicked".to_owned()),
        };
        if let Some(failure) = failure {
            let file = std::env::temp_dir().join(format!("{}-{seed}-{execution}", target.name));
            fs::write(&file, &input).expect("a file for the input");
            panic!("{}: execution {execution} of seed {seed} {failure}; its input is {}", target.name, file.display());
        }
        tally.executions += 1;
        tally.peak_bytes = tally.peak_bytes.max(peak);
        tally.longest_secs = tally.longest_secs.max(took.as_secs_f64());
        let Some(Ok(answer)) = answer else { continue };
        tally.accepted += u64::from(answer.is_ok());
        if seen.insert(shape(&answer)) && execution >= kept as u64 {
            pool.push(input);
        } else if answer.is_ok() && execution.is_multiple_of(64) && pool.len() < 4 * kept + 256 {
            // What is accepted goes deeper than what is refused.
            pool.push(input);
        } else if pool.len() > kept + 64 && execution.is_multiple_of(4096) {
            let i = kept + below(mutator.rng(), pool.len() - kept);
            pool.swap_remove(i);
        }
    }
    tally.answers = seen.len();
    tally
}

/// What is wrong with an execution that held so many bytes at its peak and took so long.
pub fn judge(peak_bytes: u64, took: Duration) -> Option<String> {
    if peak_bytes > MAX_BYTES {
        return Some(format!("held {peak_bytes} bytes"));
    }
    (took > SLOW).then(|| format!("took {took:?}"))
}

/// An answer without the numbers and the quoted names in it.
fn shape(answer: &Result<String, String>) -> String {
    let (kind, text) = match answer {
        Ok(text) => ("ok: ", text),
        Err(text) => ("error: ", text),
    };
    let mut shape = kind.to_owned();
    let mut quoted = false;
    for c in text.chars().take(300) {
        match c {
            '"' | '\'' | '`' => quoted = !quoted,
            _ if quoted => {}
            '0'..='9' if shape.ends_with('#') => {}
            '0'..='9' => shape.push('#'),
            c => shape.push(c),
        }
    }
    shape
}
