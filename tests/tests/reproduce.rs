//! `learner reproduce` at its quickest, and what `learner fit` judges beyond a fit, through the real binary.

use mazeway_tests::programs::program;
use serde_json::Value;
use std::{path::Path, process::Output};

fn learner(arguments: &[&str]) -> Output {
    std::process::Command::new(program("learner"))
        .args(arguments)
        .env_remove("MAZEWAY_DATA")
        .output()
        .expect("the binary runs")
}

fn object(output: &Output) -> Value {
    let (text, errors) = (String::from_utf8_lossy(&output.stdout), String::from_utf8_lossy(&output.stderr));
    assert!(output.status.success(), "{errors}");
    serde_json::from_str(&text).unwrap_or_else(|error| panic!("{error}: {text}"))
}

fn path(path: &Path) -> &str {
    path.to_str().expect("a readable path")
}

const CLOSED: &str =
    ".........\n.###.###.\n.#.....#.\n.#.#.#.#.\n......#..\n.#.#.#.#.\n.#.....#.\n.###.###.\n.........\n";

#[test]
fn everything_is_drawn_with_one_command() {
    let out = tempfile::tempdir().expect("a directory");
    let arguments = [
        "reproduce",
        "--out",
        path(out.path()),
        "--seeds",
        "2",
        "--rollouts",
        "4",
        "--methods",
        "em,bc",
        "--trajectories",
        "2,5",
    ];
    let output = learner(&arguments);
    assert!(output.status.success(), "{}", String::from_utf8_lossy(&output.stderr));
    let text = String::from_utf8_lossy(&output.stdout).into_owned();
    let written = std::fs::read_to_string(out.path().join("reproduce.txt")).expect("the tables");
    assert!(text.starts_with(&written), "what is told is what is written");
    for part in ["# Figure 1", "# Figure 2", "# Figure 3", "# Where the paper's algorithm is weak", "# Transfer"] {
        assert!(written.contains(part), "{part}");
    }
    for file in [
        "figure1-em/figure1.png",
        "figure1-em-tied/figure1.png",
        "figure2/agreement.png",
        "figure2/comparison.json",
        "figure3-legal-em/policy.png",
        "weak-points/evd.png",
        "transfer/highway-bad/report.html",
    ] {
        assert!(out.path().join(file).is_file(), "{file}");
    }
    let refused = learner(&["reproduce", "--out", path(out.path()), "--methods", "magic"]);
    assert_eq!(refused.status.code(), Some(2), "{}", String::from_utf8_lossy(&refused.stderr));
}

#[test]
fn a_fit_is_cross_validated_and_its_predictions_come_true() {
    let data = tempfile::tempdir().expect("a directory");
    let fit = |folds: &str| {
        let arguments =
            ["fit", "--env", "Maze-v0", "--trajectories", "20", "--rollouts", "2", "--json", "--method", "em"];
        learner(&[&arguments[..], &["--folds", folds, "--data", path(data.path())]].concat())
    };
    let (first, second) = (object(&fit("5")), object(&fit("5")));
    let validation = &first["validation"];
    assert_eq!(validation, &second["validation"], "folds are by index");
    assert_eq!((&validation["folds"], &validation["trajectories"]), (&5.into(), &20.into()));
    assert_eq!(validation["held_out"]["steps"], 1000);
    let interval = &validation["held_out"]["log_likelihood"];
    let [low, mean, high] = ["low", "mean", "high"].map(|end| interval[end].as_f64().expect("a number"));
    assert!(low < mean && mean < high && high < 0.0 && mean > (0.25_f64).ln(), "better than chance: {interval}");
    let bins = validation["calibration"]["bins"].as_array().expect("bins");
    assert_eq!(bins.iter().map(|bin| bin["predictions"].as_u64().expect("a count")).sum::<u64>(), 4000);
    let report = Path::new(first["report"].as_str().expect("a path")).parent().expect("a directory");
    assert!(report.join("calibration.png").is_file());
    let refused = fit("21");
    let errors = String::from_utf8_lossy(&refused.stderr).into_owned();
    assert!(!refused.status.success() && errors.contains("2 to 20 folds"), "{errors}");
}

#[test]
fn what_is_not_determined_is_shown_so() {
    let data = tempfile::tempdir().expect("a directory");
    let arguments = ["fit", "--env", "Maze-v0", "--penalty", "none", "--posterior", "none", "--trajectories", "20"];
    let more = ["--rollouts", "2", "--data", path(data.path())];
    let result = object(&learner(&[&arguments[..], &more, &["--json"]].concat()));
    let uncertainty = &result["uncertainty"];
    assert_eq!(uncertainty["source"], "standard-errors");
    let count = |name: &str| uncertainty[name].as_array().expect("an array").iter().filter(|x| x.is_null()).count();
    assert!(count("standard_deviations") > 0, "{uncertainty}");
    assert_eq!(count("low"), count("standard_deviations"));
    let report = Path::new(result["report"].as_str().expect("a path")).parent().expect("a directory");
    for picture in ["uncertainty.svg", "weights.svg"] {
        let svg = std::fs::read_to_string(report.join(picture)).expect(picture);
        assert!(svg.contains(">?<") || svg.contains("not determined"), "{picture}");
    }
    let text = String::from_utf8_lossy(&learner(&[&arguments[..], &more].concat()).stdout).into_owned();
    assert!(text.contains("not determined by the data") && text.contains('∞'), "{text}");
}

#[test]
fn a_reward_serves_in_a_maze_that_a_policy_does_not_know() {
    let directory = tempfile::tempdir().expect("a directory");
    let layout = directory.path().join("closed.txt");
    std::fs::write(&layout, CLOSED).expect("written");
    let arguments = ["fit", "--env", "Maze-v0", "--trajectories", "50", "--rollouts", "2", "--json", "--data"];
    let more = [path(directory.path()), "--plan-in-layout", path(&layout)];
    let result = object(&learner(&[&arguments[..], &more].concat()));
    let transfer = &result["transfer"];
    assert_eq!(transfer["new_states"], 0);
    let rows = transfer["rows"].as_array().expect("rows");
    let lost = |rank: usize| rows[rank]["expected_value_difference"].as_f64().expect("a number");
    assert!(rows[2]["name"].as_str().expect("a name").starts_with("bc"), "{transfer}");
    assert!(lost(0) < lost(1) && lost(0) < lost(2), "the reward beats both policies: {transfer}");
    assert!(lost(3) < 1e-9, "nothing beats the optimum: {transfer}");
}
