//! `learner compare` as a person or a program runs it: the grid through the real binary, cut off and taken up again.

use mazeway_tests::programs::{Service, program};
use serde_json::Value;
use std::{
    path::{Path, PathBuf},
    process::{Command, Output, Stdio},
    time::{Duration, Instant},
};

fn layout(name: &str) -> PathBuf {
    Path::new(env!("CARGO_MANIFEST_DIR")).join("data/layouts").join(name).with_extension("txt")
}

fn compare(out: &Path, arguments: &[&str]) -> Command {
    let mut command = Command::new(program("learner"));
    command.arg("compare").arg("--out").arg(out).args(arguments).env_remove("MAZEWAY_DATA");
    command
}

fn run(out: &Path, arguments: &[&str]) -> Output {
    compare(out, arguments).output().expect("the binary runs")
}

/// The array that `--json` prints, which is all that it prints.
fn array(output: &Output) -> Vec<Value> {
    let (text, errors) = (String::from_utf8_lossy(&output.stdout), String::from_utf8_lossy(&output.stderr));
    assert!(output.status.success(), "{errors}");
    assert_eq!(errors, "", "nothing on standard error");
    serde_json::from_str(&text).unwrap_or_else(|error| panic!("{error}: {text}"))
}

/// Without what a clock decides.
fn timeless(mut rows: Vec<Value>) -> Vec<Value> {
    for row in &mut rows {
        row.as_object_mut().expect("an object").remove("fit_secs").expect("a time");
    }
    rows
}

const SMALL: [&str; 7] = ["--methods", "em-tied:posterior=none,bc", "--trajectories", "2,5", "--seeds", "3", "--json"];

#[test]
fn the_array_has_the_documented_keys_and_everything_else_is_written_beside_it() {
    let out = tempfile::tempdir().expect("a directory");
    let rows = array(&run(out.path(), &SMALL));
    assert_eq!(rows.len(), 4);
    for (row, (method, l)) in
        rows.iter().zip([("em-tied:posterior=none", 2), ("em-tied:posterior=none", 5), ("bc", 2), ("bc", 5)])
    {
        let keys: Vec<&str> = row.as_object().expect("an object").keys().map(String::as_str).collect();
        let mut expected = ["method", "trajectories", "seeds", "agreement", "evd", "fit_secs"];
        expected.sort_unstable();
        assert_eq!(keys, expected);
        assert_eq!((&row["method"], &row["trajectories"], &row["seeds"]), (&method.into(), &l.into(), &3.into()));
        for measure in ["agreement", "evd"] {
            let [mean, low, high] = ["mean", "low", "high"].map(|end| row[measure][end].as_f64().expect("a number"));
            assert!(low <= mean && mean <= high, "{row}");
        }
        assert!((0.2..=1.0).contains(&row["agreement"]["mean"].as_f64().expect("a number")), "{row}");
        assert!(row["evd"]["mean"].as_f64().expect("a number") >= 0.0, "{row}");
        assert!(row["fit_secs"].as_f64().expect("a number") > 0.0, "{row}");
    }
    let read = |name: &str| std::fs::read_to_string(out.path().join(name)).expect(name);
    assert_eq!(serde_json::from_str::<Vec<Value>>(&read("comparison.json")).expect("JSON"), rows);
    assert_eq!(read("comparison.csv").lines().count(), 5);
    let paired: Value = serde_json::from_str(&read("paired.json")).expect("JSON");
    assert_eq!(paired["pairs"].as_array().expect("pairs").len(), 2);
    assert!(paired["verdict"].as_str().expect("a verdict").contains("em-tied"), "{paired}");
    assert!(read("table.txt").contains("verdict:"));
    for picture in ["agreement", "evd"] {
        assert!(read(&format!("{picture}.svg")).contains("<svg"));
        assert!(std::fs::read(out.path().join(format!("{picture}.png"))).expect(picture).starts_with(b"\x89PNG"));
    }
}

#[test]
fn demonstrations_of_a_seed_are_those_of_a_fit_with_that_seed() {
    let (out, data) = (tempfile::tempdir().expect("a directory"), tempfile::tempdir().expect("a directory"));
    let methods = ["--methods", "bc", "--trajectories", "7", "--seeds", "1", "--json"];
    let rows = array(&run(out.path(), &methods));
    let fit = Command::new(program("learner"))
        .args(["fit", "--env", "Maze-v0", "--method", "bc", "--trajectories", "7", "--json", "--rollouts", "2"])
        .arg("--data")
        .arg(data.path())
        .output()
        .expect("the binary runs");
    let fit: Value = serde_json::from_slice(&fit.stdout).expect("an object");
    assert_eq!(rows[0]["agreement"]["mean"], fit["agreement"]);
    assert_eq!(rows[0]["evd"]["mean"], fit["expected_value_difference"]);
    assert_eq!(rows[0]["agreement"]["low"], Value::Null, "one seed says nothing about the spread");
}

#[test]
fn the_number_of_threads_changes_no_number() {
    let numbers = |threads: &str| {
        let out = tempfile::tempdir().expect("a directory");
        timeless(array(&run(out.path(), &[&SMALL[..], &["--threads", threads]].concat())))
    };
    assert_eq!(numbers("1"), numbers("2"));
}

#[test]
fn a_killed_comparison_goes_on_where_it_was() {
    let grid =
        ["--methods", "em-tied:posterior=none,em,bc", "--trajectories", "1,2,3,4,5,6,7,8,9,10,20,50", "--seeds", "20"];
    let out = tempfile::tempdir().expect("a directory");
    let journal = out.path().join("journal.jsonl");
    let lines = || std::fs::read(&journal).map_or(0, |text| text.split(|&byte| byte == b'\n').count() - 1);
    let mut child = compare(out.path(), &[&grid[..], &["--threads", "1"]].concat())
        .stdout(Stdio::null())
        .stderr(Stdio::null())
        .spawn()
        .expect("a process");
    let deadline = Instant::now() + Duration::from_mins(2);
    while lines() < 40 {
        assert!(Instant::now() < deadline, "no progress");
        std::thread::sleep(Duration::from_millis(2));
    }
    child.kill().expect("a process to kill");
    child.wait().expect("a process to wait for");
    let finished = lines();
    assert!(finished < 720, "killed in the middle");
    let kept = std::fs::read(&journal).expect("a journal");
    // A power cut may tear the last line.
    let mut torn = kept.clone();
    torn.extend(b"{\"key\":\"0123\",\"cell\":{\"meth");
    std::fs::write(&journal, torn).expect("written");

    let output = run(out.path(), &grid);
    let text = String::from_utf8_lossy(&output.stdout).into_owned();
    assert!(output.status.success(), "{}", String::from_utf8_lossy(&output.stderr));
    assert!(text.contains(&format!("found       {finished} of 720 fits")), "{text}");
    assert!(text.contains(&format!("fitted      {} fits", 720 - finished)), "{text}");
    let whole = std::fs::read(&journal).expect("a journal");
    let whole_lines = whole[..kept.len()].split(|&byte| byte == b'\n').count() - 1;
    assert!(whole_lines == finished && whole.starts_with(&kept[..kept.iter().rposition(|&b| b == b'\n').unwrap_or(0)]));
    assert_eq!(lines(), 720);

    let elsewhere = tempfile::tempdir().expect("a directory");
    let at_once = timeless(array(&run(elsewhere.path(), &[&grid[..], &["--json"]].concat())));
    let resumed = timeless(array(&run(out.path(), &[&grid[..], &["--json"]].concat())));
    assert_eq!(at_once, resumed);
    // Other options are other fits.
    let other = run(out.path(), &[&grid[..], &["--discount", "0.8"]].concat());
    assert!(!String::from_utf8_lossy(&other.stdout).contains("found"), "nothing of it was finished");
}

#[test]
fn layouts_and_running_servers() {
    let server = Service::server();
    let given = layout("small");
    let options = ["--methods", "bc", "--trajectories", "5", "--seeds", "2", "--env-option", "slip=0.1", "--json"];
    let with_layout = ["--layout", given.to_str().expect("a path")];
    let [embedded, remote, plain] = [
        [&options[..], &with_layout].concat(),
        [&options[..], &with_layout, &["--env-addr", server.address()]].concat(),
        options.to_vec(),
    ]
    .map(|arguments| timeless(array(&run(tempfile::tempdir().expect("a directory").path(), &arguments))));
    assert_eq!(embedded, remote);
    assert_ne!(embedded, plain, "another maze");
}

#[test]
fn where_the_truth_is_not_known_unseen_steps_judge() {
    let out = tempfile::tempdir().expect("a directory");
    let rows = array(&run(
        out.path(),
        &[
            "--env",
            "Highway-v0",
            "--style",
            "legal",
            "--methods",
            "bc,em",
            "--trajectories",
            "20,100",
            "--seeds",
            "2",
            "--json",
        ],
    ));
    assert_eq!(rows.len(), 4);
    for row in &rows {
        assert_eq!(row["evd"], Value::Null);
        assert!(row["log_likelihood"]["mean"].as_f64().expect("a number") <= 0.0, "{row}");
        assert!((0.3..=1.0).contains(&row["agreement"]["mean"].as_f64().expect("a number")), "{row}");
    }
    assert!(out.path().join("log_likelihood.png").is_file());
}

#[test]
fn a_method_that_refuses_does_not_end_the_others() {
    let out = tempfile::tempdir().expect("a directory");
    let rows = array(&run(
        out.path(),
        &["--methods", "em:reference_basis=99,bc", "--trajectories", "5", "--seeds", "2", "--json"],
    ));
    assert_eq!((&rows[0]["seeds"], &rows[0]["agreement"]), (&0.into(), &Value::Null));
    assert!(rows[0]["refused"].as_str().expect("a reason").contains("reference_basis"), "{}", rows[0]);
    assert_eq!(rows[1]["seeds"], 2);
    assert!(std::fs::read_to_string(out.path().join("table.txt")).expect("a table").contains("refused: em:"));
}

#[test]
fn wrong_usage_is_said_in_two_lines() {
    let out = tempfile::tempdir().expect("a directory");
    for (arguments, said) in [
        (["--methods", "magic"], "magic"),
        (["--layout", "/no/such/file"], "--layout"),
        (["--env-option", "slip=2"], "slip"),
        (["--env", "Nowhere-v0"], "Nowhere-v0"),
        (["--style", "nobody"], "nobody"),
        (["--trajectories", "0"], "--trajectories"),
    ] {
        let output = run(out.path(), &arguments);
        let errors = String::from_utf8_lossy(&output.stderr).into_owned();
        assert_eq!(output.status.code(), Some(2), "{arguments:?}: {errors}");
        let lines: Vec<_> = errors.lines().collect();
        assert_eq!(lines.len(), 2, "{arguments:?}: {errors}");
        assert!(lines[0].starts_with("error: ") && lines[0].contains(said), "{arguments:?}: {errors}");
        assert!(lines[1].starts_with("hint: "), "{arguments:?}: {errors}");
    }
}
