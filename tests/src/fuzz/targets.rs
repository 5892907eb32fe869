//! What reads bytes from outside, each as a function from bytes to an answer.
//!
//! A reader checks what comes out as well: it has the shape that its type promises.

use super::requests;
use crate::{learner::trajectory, memory};
use clap::CommandFactory as _;
use mazeway_learner::{
    files::{Collector, Demonstration, Names, ParquetExport, ReadOptions, Step, read, read_model},
    store::{self, Arrays, Collection, Filter, Model, Recording, Rows, Store},
};
use mazeway_proto::{env::ModelHeader, learner as pb};
use mazeway_server::config::Cli;
use mazeway_serving::{
    grant::{Quotas, Scope},
    settings,
    tokens::{self, Tokens},
};
use prost::Message as _;
use std::{
    cell::RefCell,
    fs,
    ops::ControlFlow,
    path::{Path, PathBuf},
};
use uuid::Uuid;

/// A decoder of bytes from outside.
#[derive(Debug, Clone, Copy)]
pub struct Target {
    /// Its name, and that of its corpus.
    pub name: &'static str,
    /// Reads: what came out, or why nothing did.
    pub read: fn(&[u8]) -> Result<String, String>,
    /// Inputs to begin with that are made or kept elsewhere.
    pub seeds: fn() -> Vec<Vec<u8>>,
    /// Pieces of the format.
    pub words: &'static [&'static [u8]],
    /// Bytes of an input at most.
    pub max_bytes: usize,
}

const TEXT: &[&[u8]] = &[
    b",",
    b"\"",
    b"\n",
    b"\r\n",
    b"\t",
    b"[",
    b"]",
    b"{",
    b"}",
    b":",
    b"1e999",
    b"-1",
    b"-0",
    b"1e-999",
    b"NaN",
    b"null",
    b"true",
    b"\xff",
    b"\xef\xbb\xbf",
    b"\0",
    b"4294967295",
    b"4294967296",
    b"99999999999999999999",
    b"2147483648",
    b"0.1",
    b"\\u0000",
    b"\\ud800",
    b"state",
    b"action",
    b"next_state",
    b"reward",
    b"trajectory",
    b"step",
    b"style",
    b"probability",
    b"home",
    b"walk",
    b"\"states\":",
    b"\"actions\":",
    b"\"transitions\":",
    b"\"features\":",
    b"\"n_states\":",
    b"\"terminal\":",
    b"[[[[[[[[[[[[[[[[",
];
const PARQUET: &[&[u8]] = &[
    b"PAR1",
    b"\x15\x00",
    b"\x15\x02",
    b"\x19\x18",
    b"\x18\x05state",
    b"\x1c",
    b"\xff\xff\xff\xff\x0f",
    b"\x00\x00\x00\x7f",
];
const WIRE: &[&[u8]] =
    &[b"\x08", b"\x0a", b"\x12", b"\x1a", b"\x22", b"\x2a", b"\x32\xff\xff\xff\xff\x07", b"\x0a\x00", b"Test-v0"];
const DATABASE: &[&[u8]] =
    &[b"SQLite format 3\0", b"\x0d", b"\x0a", b"\x05", b"\x02", b"\x00\x00\x00\x00", b"\x10\x00", b"CREATE TABLE"];

const TOML: &[&[u8]] = &[
    b"[[token]]\n",
    b"name = ",
    b"sha256 = ",
    b"scopes = [",
    b"\"act\"",
    b"expires = 2027-01-01T00:00:00Z\n",
    b"max-sessions = ",
    b"max_sessions = ",
    b"insecure = true\n",
    b"-1",
    b"1e999",
    b"99999999999999999999",
    b"\"",
    b"'''",
    b"\n",
    b"{",
    b"}",
    b"\xff",
    b"\\u0000",
];

/// All of them.
pub const TARGETS: [Target; 13] = [
    Target {
        name: "demonstrations-csv",
        read: |bytes| demonstrations("x.csv", bytes),
        seeds: || examples(&["walks.csv"]),
        words: TEXT,
        max_bytes: 2000,
    },
    Target {
        name: "demonstrations-json-lines",
        read: |bytes| demonstrations("x.jsonl", bytes),
        seeds: || examples(&["walks.jsonl"]),
        words: TEXT,
        max_bytes: 2000,
    },
    Target {
        name: "demonstrations-parquet",
        read: |bytes| demonstrations("x.parquet", bytes),
        seeds: parquet,
        words: PARQUET,
        max_bytes: 8000,
    },
    Target {
        name: "model-json",
        read: |bytes| model("x.json", bytes),
        seeds: || examples(&["commute.json"]),
        words: TEXT,
        max_bytes: 4000,
    },
    Target {
        name: "model-csv",
        read: |bytes| model("x.csv", bytes),
        seeds: || examples(&["tables/transitions.csv"]),
        words: TEXT,
        max_bytes: 2000,
    },
    Target {
        name: "model-parquet",
        read: |bytes| model("x.parquet", bytes),
        seeds: parquet,
        words: PARQUET,
        max_bytes: 8000,
    },
    Target { name: "packed-arrays", read: packed_arrays, seeds: trajectories, words: WIRE, max_bytes: 2000 },
    Target { name: "model-message", read: model_message, seeds: model_messages, words: WIRE, max_bytes: 2000 },
    Target {
        name: "environment-requests",
        read: requests::environment,
        seeds: requests::environment_seeds,
        words: WIRE,
        max_bytes: 2000,
    },
    Target {
        name: "learner-requests",
        read: requests::learner,
        seeds: requests::learner_seeds,
        words: WIRE,
        max_bytes: 2000,
    },
    Target { name: "settings-file", read: settings_file, seeds: settings_files, words: TOML, max_bytes: 2000 },
    Target { name: "tokens-file", read: tokens_file, seeds: tokens_files, words: TOML, max_bytes: 2000 },
    Target { name: "store-file", read: store_file, seeds: Vec::new, words: DATABASE, max_bytes: 40_000 },
];

/// The target of a name.
pub fn find(name: &str) -> Option<&'static Target> {
    static ALL: [Target; 13] = TARGETS;
    ALL.iter().find(|target| target.name == name)
}

fn examples(names: &[&str]) -> Vec<Vec<u8>> {
    let examples = Path::new(env!("CARGO_MANIFEST_DIR")).join("..").join("docs").join("examples").join("commute");
    names.iter().filter_map(|name| fs::read(examples.join(name)).ok()).collect()
}

/// Demonstrations as `learner export --format parquet` writes them.
fn parquet() -> Vec<Vec<u8>> {
    let mut bytes = Vec::new();
    let mut export = ParquetExport::new(&mut bytes, false).expect("a file");
    for number in 0..3 {
        let step = |step: u32| Step {
            step: u64::from(step),
            state: step % 4,
            action: Some((step + number as u32) % 4),
            reward: Some(f64::from(step) / 4.0),
            next_state: Some((step + 1) % 4),
            terminated: false,
            truncated: step == 5,
        };
        export.write(&trajectory(number), (0..6).map(step).collect(), None).expect("rows");
    }
    export.finish().expect("a file");
    vec![bytes]
}

/// A directory of this thread, in memory where the machine has one.
fn directory() -> PathBuf {
    thread_local! {
        static DIRECTORY: RefCell<Option<tempfile::TempDir>> = const { RefCell::new(None) };
    }
    DIRECTORY.with_borrow_mut(|directory| directory.get_or_insert_with(memory).path().to_owned())
}

fn demonstrations(name: &str, bytes: &[u8]) -> Result<String, String> {
    let file = directory().join(name);
    fs::write(&file, bytes).expect("a file");
    let (mut trajectories, mut steps) = (0, 0);
    let mut check = |d: Demonstration| {
        let n = d.states.len();
        assert!(n > 0 && d.places.len() == n);
        assert!(d.actions.len() == n || (d.actions.is_empty() && d.final_state.is_some()));
        assert!(d.rewards.is_empty() || d.rewards.len() == n && d.rewards.iter().all(|r| r.is_finite()));
        trajectories += 1;
        steps += n;
        ControlFlow::Continue(())
    };
    let labels = |noun, labels: [&str; 4]| Names::labelled(noun, labels.map(str::to_owned).to_vec()).expect("names");
    let (states, actions) =
        (labels("state", ["home", "street", "park", "office"]), labels("action", ["walk", "bus", "x", "y"]));
    let options = ReadOptions { interleaved: bytes.len().is_multiple_of(2), ..ReadOptions::default() };
    let read_known = read(&file, &options, &mut &states, &mut &actions, &mut check);
    let (mut states, mut actions) = (Collector::new("state"), Collector::new("action"));
    let read_any = read(&file, &ReadOptions::default(), &mut states, &mut actions, &mut check);
    let names = read_any.is_ok() && states.finish().is_ok() && actions.finish().is_ok();
    match read_known.and(read_any) {
        Ok(_) => Ok(format!("{trajectories} trajectories, {steps} steps, names {names}")),
        Err(error) => {
            assert!(error.file == file && !error.message.is_empty() && !error.hint.is_empty());
            Err(error.message)
        }
    }
}

fn model(name: &str, bytes: &[u8]) -> Result<String, String> {
    let file = directory().join(name);
    fs::write(&file, bytes).expect("a file");
    let model = read_model(&file).map_err(|error| {
        assert!(error.file == file && !error.message.is_empty());
        error.message
    })?;
    let model = model.into_model("Fuzz".into()).map_err(|error| error.message)?;
    Ok(format!("{} states", model.n_states))
}

fn settings_files() -> Vec<Vec<u8>> {
    let text =
        "max-sessions = 10\nlisten = \"127.0.0.1:0\"\nkeepalive-secs = 2.5\nopen_reflection = true\ntokens = \"t\"\n";
    vec![text.into()]
}

fn settings_file(bytes: &[u8]) -> Result<String, String> {
    let text = std::str::from_utf8(bytes).map_err(|error| error.to_string())?;
    let values =
        settings::values(text, &Cli::command()).inspect_err(|error| assert!(!error.contains('\n'), "{error}"))?;
    Ok(format!("{} settings", values.len()))
}

fn tokens_files() -> Vec<Vec<u8>> {
    let quotas = Quotas { max_sessions: Some(3), ..Quotas::default() };
    let entry = |name: &str| tokens::mint(name, &Scope::ALL, &quotas, None).expect("a token").entry;
    vec![entry("alice").into(), format!("{}expires = 2027-01-01T00:00:00Z\n\n{}", entry("alice"), entry("bob")).into()]
}

fn tokens_file(bytes: &[u8]) -> Result<String, String> {
    let text = std::str::from_utf8(bytes).map_err(|error| error.to_string())?;
    let tokens = Tokens::parse(text).inspect_err(|error| assert!(!error.contains('\n'), "{error}"))?;
    assert!(tokens.find(b"mzw_").is_none());
    Ok(format!("{} tokens", tokens.len()))
}

fn trajectories() -> Vec<Vec<u8>> {
    (0..12).map(|number| trajectory(number).encode_to_vec()).collect()
}

/// A trajectory as it comes over the wire, and as it is put together again from the store.
fn packed_arrays(bytes: &[u8]) -> Result<String, String> {
    let t = pb::Trajectory::decode(bytes).map_err(|error| error.to_string())?;
    let collection = Collection {
        env_id: t.env_id,
        model_id: t.model_id,
        style: t.style,
        source: t.source,
        n_states: t.n_states,
        n_actions: t.n_actions,
    };
    let arrays = Arrays {
        states: t.states,
        actions: t.actions,
        rewards: t.rewards,
        final_state: t.final_state,
        terminated: t.terminated,
        truncated: t.truncated,
    };
    let id = Uuid::parse_str(&t.trajectory_id).map_err(|error| error.to_string())?;
    let recording = Recording::new(id, collection, t.seed, arrays).map_err(|error| error.to_string())?;
    let trajectory = recording.trajectory().expect("what was checked is a trajectory");
    assert_eq!(trajectory.len(), recording.steps() as usize);
    assert_eq!(recording.content_hash(), recording.clone().content_hash());
    Ok("a trajectory".into())
}

fn model_messages() -> Vec<Vec<u8>> {
    let header = ModelHeader { env_id: "Test-v0".into(), n_states: 2, n_actions: 1, ..ModelHeader::default() };
    let rows = [store::pack_u32(&[2, 1]), store::pack_u32(&[0, 1, 1]), store::pack_f64(&[0.5, 0.5, 1.0])];
    let mut input = vec![4 * 2, 4 * 3, 8 * 3];
    for row in &rows {
        input.extend(&row[..]);
    }
    input.extend(header.encode_to_vec());
    vec![input]
}

/// Three lengths, three arrays of so many bytes, a header.
fn model_message(bytes: &[u8]) -> Result<String, String> {
    let (lengths, mut rest) = bytes.split_at_checked(3).ok_or("too short")?;
    let mut array = |length: u8| {
        let (array, after) = rest.split_at(usize::from(length).min(rest.len()));
        rest = after;
        array.to_vec().into()
    };
    let (row_lengths, next_states, probabilities) = (array(lengths[0]), array(lengths[1]), array(lengths[2]));
    let rows = Rows { row_lengths, next_states, probabilities, ..Rows::default() };
    let header = ModelHeader::decode(rest).map_err(|error| error.to_string())?;
    let model = Model::new(header, rows).map_err(|error| error.to_string())?;
    assert_eq!(model.model_id().len(), 64);
    Ok("a model".into())
}

/// A database: verified, or opened and read in every way; which of the two is up to its bytes, for most of the time goes into
/// opening it. One in 64 is verified, read and repaired, which takes longer than all else.
fn store_file(bytes: &[u8]) -> Result<String, String> {
    let directory = directory().join("store");
    fs::create_dir_all(&directory).expect("a directory");
    // What a store keeps beside its database is the same for every input, and dear to make.
    for entry in fs::read_dir(&directory).expect("a directory") {
        let path = entry.expect("an entry").path();
        if path.file_name().is_some_and(|name| name.to_string_lossy().starts_with(store::FILE_NAME)) {
            fs::remove_file(path).expect("a file");
        }
    }
    fs::write(directory.join(store::FILE_NAME), bytes).expect("a file");
    let text = |error: store::StoreError| error.to_string();
    let part = bytes.iter().fold(0_u8, |sum, byte| sum.wrapping_add(*byte)) % 16;
    if part > 8 {
        return read_store(&directory).map(|()| "read".into()).map_err(text);
    }
    let found = store::verify(&directory).map_err(text)?;
    if found.is_sound() {
        read_store(&directory).map_err(text)?;
        return Ok("sound".into());
    }
    if part == 0 && bytes.len().is_multiple_of(4) {
        let _ = read_store(&directory);
        let repaired = store::repair(&directory).map_err(text)?;
        assert!(repaired.kept.is_none() || store::verify(&directory).is_ok_and(|found| found.is_sound()));
    }
    let why = found.damage.first().map(|damage| damage.message.clone()).or(found.structure.first().cloned());
    Err(why.unwrap_or_default())
}

fn read_store(directory: &Path) -> Result<(), store::StoreError> {
    let store = Store::open(directory)?;
    let filter = Filter::default();
    store.count(&filter)?;
    store.summaries(&filter, 0, 100)?;
    let mut cursor = store.cursor(&filter)?;
    while !store.next_page(&mut cursor)?.is_empty() {}
    for model in store.models("")? {
        store.model(&model.header.model_id)?;
    }
    for fit in store.fits("", "", i64::MAX, 100)? {
        store.fit(&fit.fit_id)?;
        store.fit_trajectories(&fit.fit_id, 0, 1000)?;
    }
    let _ = store.for_each(&filter, |stored| {
        stored.recording();
        ControlFlow::<()>::Continue(())
    })?;
    Ok(())
}
