//! `learner fit` as a person or a program runs it: the whole job through the real binary, embedded and over the network.

use mazeway_tests::programs::{Service, program};
use serde_json::Value;
use std::{path::Path, process::Output};

fn learner(arguments: &[&str]) -> Output {
    std::process::Command::new(program("learner"))
        .args(arguments)
        .env_remove("MAZEWAY_DATA")
        .output()
        .expect("the binary runs")
}

fn fit(data: &Path, arguments: &[&str]) -> Output {
    let data = data.to_str().expect("a readable path");
    learner(&[&["fit", "--data", data, "--rollouts", "100"], arguments].concat())
}

/// The object that `--json` prints, which is all that it prints.
fn object(output: &Output) -> Value {
    let (text, errors) = (String::from_utf8_lossy(&output.stdout), String::from_utf8_lossy(&output.stderr));
    assert!(output.status.success(), "{errors}");
    assert_eq!(errors, "", "nothing on standard error");
    serde_json::from_str(&text).unwrap_or_else(|error| panic!("{error}: {text}"))
}

fn mean(result: &Value, driver: &str, event: &str) -> f64 {
    let interval = &result["drivers"][driver][event];
    let number = |name: &str| interval[name].as_f64().unwrap_or_else(|| panic!("{driver} {event} {name}: {interval}"));
    assert!(number("low") <= number("mean") && number("mean") <= number("high"), "{driver} {event}");
    number("mean")
}

fn keys(value: &Value) -> Vec<&str> {
    value.as_object().expect("an object").keys().map(String::as_str).collect()
}

#[test]
fn three_styles_are_learned_and_drive_differently() {
    let data = tempfile::tempdir().expect("a directory");
    let result = |style| object(&fit(data.path(), &["--style", style, "--json"]));
    let [aggressive, bad, legal] = ["aggressive", "bad", "legal"].map(result);
    for (style, result, agreement) in [("aggressive", &aggressive, 0.95), ("bad", &bad, 0.85), ("legal", &legal, 0.95)]
    {
        let mut names = keys(result);
        names.sort_unstable();
        let mut expected = [
            "env",
            "style",
            "method",
            "trajectories",
            "horizon",
            "drivers",
            "agreement",
            "states_covered",
            "stopped",
            "iterations",
            "fit_secs",
            "total_secs",
            "report",
            "uncertainty",
            "hyperparameters",
        ];
        expected.sort_unstable();
        assert_eq!(names, expected);
        assert_eq!(
            (&result["env"], &result["style"], &result["method"]),
            (&"Highway-v0".into(), &style.into(), &"em-tied".into())
        );
        assert_eq!((&result["trajectories"], &result["horizon"]), (&200.into(), &5.into()));
        assert_eq!(result["stopped"], "converged");
        assert!(result["agreement"].as_f64().expect("a number") >= agreement, "{style}: {}", result["agreement"]);
        let report = std::fs::read_to_string(result["report"].as_str().expect("a path")).expect("the report");
        assert!(report.contains("<svg") && report.contains("data:image/png"), "{style}: pictures in the page");
    }

    let learned = |result, event| mean(result, "learned", event);
    assert!(learned(&aggressive, "collisions") <= 0.05);
    assert!(learned(&aggressive, "overtakes_right") >= 0.05);
    assert!(
        learned(&bad, "collisions") >= 0.1 && learned(&bad, "collisions") >= 4.0 * learned(&aggressive, "collisions")
    );
    assert!(learned(&legal, "collisions") <= 0.005);
    assert!(learned(&legal, "overtakes_right") <= 0.004);
    assert!(learned(&aggressive, "speed_mps") > mean(&aggressive, "random", "speed_mps"));

    let expert = |result, event| mean(result, "expert", event);
    assert!(expert(&bad, "collisions") >= 10.0 * expert(&aggressive, "collisions"));
    assert!(expert(&legal, "overtakes_right") < 0.002 && expert(&aggressive, "overtakes_right") >= 0.05);
    assert!(expert(&legal, "collisions") <= 0.005 && expert(&aggressive, "collisions") <= 0.02);
}

#[test]
fn a_second_run_finds_the_recordings_and_gives_the_same_numbers() {
    let data = tempfile::tempdir().expect("a directory");
    let arguments = ["--style", "legal", "--trajectories", "40"];
    let first = fit(data.path(), &arguments);
    let first_text = String::from_utf8_lossy(&first.stdout).into_owned();
    assert!(first.status.success(), "{}", String::from_utf8_lossy(&first.stderr));
    assert!(first_text.contains("recorded    40 demonstrations of 5 steps"), "{first_text}");
    assert!(!first_text.contains('\u{1b}'), "no colours and no bars where the output is no terminal");
    for told in ["model ", "fitted ", "judged ", "expert", "learned", "random", "report ", "report.html"] {
        assert!(first_text.contains(told), "{told:?} in {first_text}");
    }
    let second = fit(data.path(), &arguments);
    let second_text = String::from_utf8_lossy(&second.stdout).into_owned();
    assert!(second_text.contains("found       40 recordings"), "{second_text}");
    assert!(!second_text.contains("recorded "), "{second_text}");
    // More of them: what is there is kept, what is missing is recorded.
    let more = fit(data.path(), &["--style", "legal", "--trajectories", "60", "--no-demonstrate"]);
    assert_eq!(more.status.code(), Some(1));
    let more = fit(data.path(), &["--style", "legal", "--trajectories", "60"]);
    let more_text = String::from_utf8_lossy(&more.stdout).into_owned();
    assert!(more_text.contains("found       40 of 60") && more_text.contains("recorded    20 "), "{more_text}");

    let numbers = |data: &Path| {
        let mut result = object(&fit(data, &["--style", "legal", "--trajectories", "40", "--json"]));
        for varying in ["fit_secs", "total_secs", "report"] {
            result.as_object_mut().expect("an object").remove(varying).expect(varying);
        }
        result
    };
    let elsewhere = tempfile::tempdir().expect("a directory");
    assert_eq!(numbers(data.path()), numbers(elsewhere.path()), "same seed, same numbers");
}

#[test]
fn the_maze_is_learned_and_drawn() {
    let data = tempfile::tempdir().expect("a directory");
    let result = object(&fit(data.path(), &["--env", "Maze-v0", "--json"]));
    assert_eq!((&result["trajectories"], &result["horizon"]), (&100.into(), &50.into()));
    assert!(result.get("drivers").is_none());
    assert!(result["agreement"].as_f64().expect("a number") >= 0.97, "{}", result["agreement"]);
    let lost = result["expected_value_difference"].as_f64().expect("a number");
    assert!((0.0..0.05).contains(&lost), "{lost}");
    let directory = Path::new(result["report"].as_str().expect("a path")).parent().expect("a directory").to_owned();
    for picture in ["figure1", "visits", "reward", "policy", "true_reward", "optimal_policy", "trace"] {
        let svg = std::fs::read_to_string(directory.join(format!("{picture}.svg"))).expect(picture);
        assert!(svg.contains("<svg"), "{picture}");
        let png = std::fs::read(directory.join(format!("{picture}.png"))).expect(picture);
        assert!(png.starts_with(b"\x89PNG") && png.len() > 1000, "{picture}");
    }
    let of = |method: &str| object(&fit(data.path(), &["--env", "Maze-v0", "--method", method, "--json"]));
    for method in ["em", "em-mixture", "bc"] {
        let other = of(method);
        assert_eq!(other["method"], method);
        assert!(
            other["agreement"].as_f64().expect("a number") <= result["agreement"].as_f64().expect("a number"),
            "{method}"
        );
    }
}

#[test]
fn every_option_of_the_paper_s_algorithm_runs() {
    let data = tempfile::tempdir().expect("a directory");
    let fitted = |options: &[&str]| {
        let arguments = [&["--env", "Maze-v0", "--method", "em", "--trajectories", "20", "--json"], options].concat();
        object(&fit(data.path(), &arguments))["agreement"].as_f64().expect("a number")
    };
    let nnls = fitted(&["--m-step", "nnls", "--horizon-prior", "geometric", "--planner", "expectation-maximization"]);
    let simplex = fitted(&["--m-step", "simplex", "--horizon-prior", "uniform", "--planner", "policy-iteration"]);
    assert!(nnls > 0.4 && simplex > 0.2, "{nnls} {simplex}");
    let exact = ["--responsibility", "exact", "--basis", "state-action", "--planner", "soft-value-iteration"];
    assert!(fitted(&exact) < nnls, "the exact product loses its data");
    let text = fit(data.path(), &["--env", "Maze-v0", "--method", "em", "--responsibility", "exact"]);
    let text = String::from_utf8_lossy(&text.stdout).into_owned();
    assert!(text.contains("warning:"), "and says so: {text}");
}

#[test]
fn running_services_do_the_same_as_embedded_ones() {
    let (data, out) = (tempfile::tempdir().expect("a directory"), tempfile::tempdir().expect("a directory"));
    let socket = format!("unix:{}", data.path().join("env.sock").display());
    let (service, server) = (Service::learner(data.path()), Service::server_at(&socket));
    let over_the_network = learner(&[
        "fit",
        "--style",
        "bad",
        "--trajectories",
        "50",
        "--rollouts",
        "100",
        "--json",
        "--addr",
        service.address(),
        "--env-addr",
        server.address(),
        "--out",
        out.path().to_str().expect("a path"),
    ]);
    let mut remote = object(&over_the_network);
    let elsewhere = tempfile::tempdir().expect("a directory");
    let mut embedded = object(&fit(elsewhere.path(), &["--style", "bad", "--trajectories", "50", "--json"]));
    assert!(out.path().join("report.html").is_file());
    for result in [&mut remote, &mut embedded] {
        for varying in ["fit_secs", "total_secs", "report"] {
            result.as_object_mut().expect("an object").remove(varying).expect(varying);
        }
    }
    assert_eq!(remote, embedded);
}

#[test]
fn what_cannot_be_done_is_said_in_two_lines() {
    let data = tempfile::tempdir().expect("a directory");
    let refused = |arguments: &[&str], code: i32, said: &str| {
        let output = fit(data.path(), arguments);
        let errors = String::from_utf8_lossy(&output.stderr).into_owned();
        assert_eq!(output.status.code(), Some(code), "{arguments:?}: {errors}");
        let lines: Vec<_> = errors.lines().collect();
        assert_eq!(lines.len(), 2, "{arguments:?}: {errors}");
        assert!(lines[0].starts_with("error: ") && lines[0].contains(said), "{arguments:?}: {errors}");
        assert!(lines[1].starts_with("hint: ") && lines[1].len() > 10, "{arguments:?}: {errors}");
    };
    refused(&["--method", "magic"], 2, "magic");
    refused(&["--trajectories", "0"], 2, "--trajectories");
    refused(&["--horizon", "many"], 2, "--horizon");
    refused(&["--discount", "1.5"], 2, "--discount");
    refused(&["--basis", "pixels"], 2, "pixels");
    refused(&["--frobnicate"], 2, "--frobnicate");
    refused(&["--env", "Nowhere-v0"], 2, "Nowhere-v0");
    refused(&["--env-option", "density=1e9"], 2, "density");
    refused(&["--env-option", "colour=red"], 2, "colour");
    refused(&["--env", "Maze-v0", "--no-demonstrate"], 1, "nothing is recorded");
    refused(&["--env", "Maze-v0", "--style", "nobody"], 1, "nobody");
    refused(&["--env", "Maze-v0", "--source", "keyboard"], 1, "nothing is recorded");
    refused(&["--env", "Maze-v0", "--method", "em", "--reference-basis", "57"], 2, "reference_basis");
    let unreachable = learner(&["fit", "--addr", "127.0.0.1:1", "--env-addr", "127.0.0.1:1"]);
    assert_eq!(unreachable.status.code(), Some(1));
    assert!(String::from_utf8_lossy(&unreachable.stderr).starts_with("error: cannot reach"));
}
