//! Whatever bytes a file holds, reading it ends in what it says or in an error that names the file: never in a panic.

use mazeway_learner::files::{Collector, Demonstration, Names, ReadOptions, read, read_model};
use proptest::prelude::*;
use std::{fs, ops::ControlFlow, path::Path};

fn example(name: &str) -> Vec<u8> {
    let examples = Path::new(env!("CARGO_MANIFEST_DIR")).join("..").join("docs").join("examples").join("commute");
    fs::read(examples.join(name)).expect("an example")
}

/// A change of some bytes.
#[derive(Debug, Clone)]
enum Change {
    Set(prop::sample::Index, u8),
    Insert(prop::sample::Index, Vec<u8>),
    Remove(prop::sample::Index, usize),
    Cut(prop::sample::Index),
}

fn change() -> impl Strategy<Value = Change> {
    let at = any::<prop::sample::Index>;
    let telling = prop::sample::select(vec![
        b",".to_vec(),
        b"\"".to_vec(),
        b"\n".to_vec(),
        b"\r".to_vec(),
        b"[".to_vec(),
        b"}".to_vec(),
        b"1e999".to_vec(),
        b"-1".to_vec(),
        b"NaN".to_vec(),
        b"null".to_vec(),
        b"\xff".to_vec(),
        b"99999999999999999999".to_vec(),
        b"4294967296".to_vec(),
        b"\xef\xbb\xbf".to_vec(),
        b"\0".to_vec(),
        b"state".to_vec(),
    ]);
    prop_oneof![
        (at(), any::<u8>()).prop_map(|(i, byte)| Change::Set(i, byte)),
        (at(), telling).prop_map(|(i, bytes)| Change::Insert(i, bytes)),
        (at(), 1_usize..40).prop_map(|(i, n)| Change::Remove(i, n)),
        at().prop_map(Change::Cut),
    ]
}

fn changed(mut bytes: Vec<u8>, changes: &[Change]) -> Vec<u8> {
    for change in changes {
        if bytes.is_empty() {
            break;
        }
        match change {
            Change::Set(i, byte) => {
                let i = i.index(bytes.len());
                bytes[i] = *byte;
            }
            Change::Insert(i, new) => {
                let i = i.index(bytes.len());
                bytes.splice(i..i, new.iter().copied());
            }
            Change::Remove(i, n) => {
                let i = i.index(bytes.len());
                bytes.drain(i..(i + n).min(bytes.len()));
            }
            Change::Cut(i) => bytes.truncate(i.index(bytes.len())),
        }
    }
    bytes
}

/// Reads demonstrations in both ways; what comes out has the shape that it says.
fn demonstrations(name: &str, bytes: &[u8]) {
    let directory = tempfile::tempdir().expect("a directory");
    let file = directory.path().join(name);
    fs::write(&file, bytes).expect("a file");
    let whole = |d: Demonstration| {
        let steps = d.states.len();
        assert!(steps > 0 && d.places.len() == steps);
        assert!(d.actions.len() == steps || (d.actions.is_empty() && d.final_state.is_some()));
        assert!(d.rewards.is_empty() || d.rewards.len() == steps && d.rewards.iter().all(|r| r.is_finite()));
        ControlFlow::Continue(())
    };
    let labels = |noun, labels: [&str; 4]| Names::labelled(noun, labels.map(str::to_owned).to_vec()).expect("names");
    let (states, actions) =
        (labels("state", ["home", "street", "park", "office"]), labels("action", ["walk", "bus", "x", "y"]));
    for interleaved in [false, true] {
        let options = ReadOptions { interleaved, ..ReadOptions::default() };
        let inside = &mut |d: Demonstration| {
            assert!(d.states.iter().chain(&d.final_state).all(|&state| state < 4) && d.actions.iter().all(|&a| a < 4));
            whole(d)
        };
        if let Err(error) = read(&file, &options, &mut &states, &mut &actions, inside) {
            assert!(error.file == file && !error.message.is_empty() && !error.hint.is_empty());
        }
    }
    let (mut states, mut actions) = (Collector::new("state"), Collector::new("action"));
    if read(&file, &ReadOptions::default(), &mut states, &mut actions, &mut |d| whole(d)).is_ok() {
        // Names that turned up are names, or said to be none.
        let _ = states.finish();
        let _ = actions.finish();
    }
}

fn model(name: &str, bytes: &[u8]) {
    let directory = tempfile::tempdir().expect("a directory");
    let file = directory.path().join(name);
    fs::write(&file, bytes).expect("a file");
    match read_model(&file) {
        Err(error) => assert!(error.file == file && !error.message.is_empty()),
        Ok(model) => {
            let Some(rows) = model.rows else { return };
            for row in rows.offsets.windows(2) {
                let sum: f64 = rows.probabilities[row[0]..row[1]].iter().sum();
                assert!((sum - 1.0).abs() < 1e-9);
                assert!(rows.next_states[row[0]..row[1]].is_sorted_by(|a, b| a < b));
            }
        }
    }
}

proptest! {
    #![proptest_config(ProptestConfig::with_cases(200))]

    #[test]
    fn any_csv(changes in prop::collection::vec(change(), 0..6)) {
        demonstrations("x.csv", &changed(example("walks.csv"), &changes));
    }

    #[test]
    fn any_json_lines(changes in prop::collection::vec(change(), 0..6)) {
        demonstrations("x.jsonl", &changed(example("walks.jsonl"), &changes));
    }

    #[test]
    fn any_json_model(changes in prop::collection::vec(change(), 0..6)) {
        model("x.json", &changed(example("commute.json"), &changes));
    }

    #[test]
    fn any_table_of_transitions(changes in prop::collection::vec(change(), 0..6)) {
        model("x.csv", &changed(example("tables/transitions.csv"), &changes));
    }

    #[test]
    fn any_bytes(bytes in prop::collection::vec(any::<u8>(), 0..300)) {
        for name in ["x.csv", "x.tsv", "x.jsonl", "x.parquet"] {
            demonstrations(name, &bytes);
        }
        for name in ["x.json", "x.csv", "x.parquet"] {
            model(name, &bytes);
        }
    }
}
