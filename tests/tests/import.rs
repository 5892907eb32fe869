//! `learner import` and back: models and demonstrations from files, through the real binary into the real store.

use mazeway_tests::desk::{learner, object, refused, said};
use serde_json::Value;
use std::{
    fs,
    path::{Path, PathBuf},
};
use tempfile::TempDir;

fn examples() -> PathBuf {
    Path::new(env!("CARGO_MANIFEST_DIR")).join("..").join("docs").join("examples").join("commute")
}

fn example(name: &str) -> String {
    examples().join(name).to_str().expect("a path in UTF-8").to_owned()
}

fn directory() -> TempDir {
    tempfile::tempdir().expect("a directory")
}

fn write(data: &TempDir, name: &str, content: impl AsRef<[u8]>) {
    fs::write(data.path().join(name), content).expect("a file");
}

/// The example's model is stored.
fn with_model() -> TempDir {
    let data = directory();
    said(&data, &["import", "--model", &example("commute.json")]);
    data
}

#[test]
fn every_format_says_the_same() {
    let data = directory();
    let first = object(&data, &["import", "--model", &example("commute.json"), &example("walks.csv"), "--source", "x"]);
    assert_eq!(first["env"], "Commute");
    assert_eq!((&first["trajectories"], &first["steps"], &first["stored"]), (&3.into(), &12.into(), &3.into()));
    assert_eq!(first["styles"], serde_json::json!(["stroller"]));
    assert_eq!(first["model"]["stored"], true);
    // The same demonstrations as JSON lines, and the same model as tables: nothing is new.
    let tables = example("tables");
    let again =
        object(&data, &["import", "--model", &tables, "--env", "Commute", &example("walks.jsonl"), "--source", "x"]);
    assert_eq!((&again["stored"], &again["already_stored"]), (&0.into(), &3.into()));
    assert_eq!(again["model"]["id"], first["model"]["id"]);
    assert_eq!(again["model"]["stored"], false);
    // As Parquet, with labels and without.
    for flags in [&["--labels"][..], &[]] {
        let out = [&["export", "--format", "parquet", "--out", "walks.parquet"], flags].concat();
        assert_eq!(said(&data, &out), "");
        let back = object(&data, &["import", "walks.parquet"]);
        assert_eq!((&back["stored"], &back["already_stored"], &back["steps"]), (&0.into(), &3.into(), &12.into()));
    }
    // A step a line.
    let rows = [
        r#"{"trajectory":"mon","step":0,"state":"home","action":"walk"}"#,
        r#"{"trajectory":"mon","step":1,"state":"street","action":0}"#,
        r#"{"trajectory":"mon","step":2,"state":2,"action":"walk"}"#,
        r#"{"trajectory":"mon","step":3,"state":"office"}"#,
    ];
    write(&data, "rows.jsonl", rows.join("\n"));
    let rows = object(&data, &["import", "--env", "Commute", "rows.jsonl"]);
    assert_eq!((&rows["stored"], &rows["steps"]), (&1.into(), &3.into()));
    assert_eq!(rows["sources"], serde_json::json!(["file:rows.jsonl"]));
}

#[test]
fn what_is_exported_is_what_was_imported() {
    let data = directory();
    said(&data, &["import", "--model", &example("commute.json"), &example("walks.csv")]);
    for format in ["csv", "jsonl", "parquet"] {
        let elsewhere = directory();
        said(&elsewhere, &["import", "--model", &example("commute.json")]);
        let file = format!("out.{format}");
        let path = elsewhere.path().join(&file);
        said(&data, &["export", "--format", format, "--out", path.to_str().expect("a path")]);
        let summary = object(&elsewhere, &["import", &file]);
        assert_eq!((&summary["stored"], &summary["ignored_columns"]), (&3.into(), &serde_json::json!([])), "{format}");
        let both = [&data, &elsewhere].map(|data| said(data, &["export"]));
        assert_eq!(both[0], both[1], "{format}");
    }
}

#[test]
fn each_mistake_in_demonstrations_is_put_to_its_place() {
    let data = with_model();
    let cases: [(&str, &str, &str); 21] = [
        ("a.csv", "", "a.csv, line 1: expected a header, got an empty file"),
        ("a.csv", "trajectory,step,action\n", "a.csv, line 1: expected a column 'state', got trajectory, step, action"),
        ("a.csv", "trajectory,state,action\n", "a.csv: expected at least one demonstration, got none"),
        (
            "a.csv",
            "trajectory,state,action\nx,home,walk\nx,moon,walk\n",
            "a.csv, line 3, column 2 (state): expected one of the 4 states, such as 'home', got 'moon'",
        ),
        (
            "a.csv",
            "trajectory,state,action\nx,home,fly\n",
            "a.csv, line 2, column 3 (action): expected one of the 2 actions, such as 'walk', got 'fly'",
        ),
        (
            "a.csv",
            "trajectory,step,state,action\nx,0,home,walk\nx,2,street,walk\n",
            "a.csv, line 3, column 2 (step): expected step 1 of trajectory 'x', got '2'",
        ),
        (
            "a.csv",
            "trajectory,state,action\nx,home,walk\ny,home,walk\nx,street,walk\n",
            "a.csv, line 4, column 1 (trajectory): expected the rows of trajectory 'x' together, got more of them",
        ),
        (
            "a.csv",
            "trajectory,state,action\nx,home,walk\nx,street\n",
            "a.csv, line 3: expected 3 fields as in the header, got 2",
        ),
        (
            "a.csv",
            "trajectory,state,action,reward\nx,home,walk,much\n",
            "a.csv, line 2, column 4 (reward): expected a finite number, got 'much'",
        ),
        (
            "a.csv",
            "trajectory,state,action\n,home,walk\n",
            "a.csv, line 2, column 1 (trajectory): expected the id of a trajectory, got nothing",
        ),
        (
            "a.csv",
            "trajectory,state,action\nx,home,walk\nx,street,\nx,park,walk\n",
            "a.csv, line 4, column 1 (trajectory): expected no row of trajectory 'x' after the one without an action, got one",
        ),
        (
            "a.csv",
            "trajectory,state,action,next_state\nx,home,walk,street\nx,home,walk,street\n",
            "a.csv, line 3, column 2 (state): expected the state that the row before of trajectory 'x' leads to, got 'home'",
        ),
        (
            "a.csv",
            "trajectory,state,action,terminated\nx,home,walk,maybe\n",
            "a.csv, line 2, column 4 (terminated): expected true or false, got 'maybe'",
        ),
        ("a.jsonl", "", "a.jsonl: expected a JSON object a line, got an empty file"),
        (
            "a.jsonl",
            "{\"trajectory\":\"x\",\"states\":[\"home\"],\"actions\":[\"walk\"]}\n{\"trajectory\":\"y\",\"states\":[0,7]}\n",
            "a.jsonl, line 2, column 32: expected one of the 4 states, such as 'home', got '7'",
        ),
        (
            "a.jsonl",
            "{\"trajectory\":\"x\",\"states\":[0],\"actions\":[0]\n",
            "a.jsonl, line 1, column 44: EOF while parsing an object",
        ),
        (
            "a.jsonl",
            "{\"states\":[0],\"actions\":[0]}\n",
            "a.jsonl, line 1, column 28: expected the id of a trajectory, got none",
        ),
        (
            "a.jsonl",
            "{\"trajectory\":\"x\",\"states\":[0,1],\"actions\":[0]}\n",
            "a.jsonl, line 1, column 47: expected an action for each of the 2 steps of trajectory 'x' or for none, got 1",
        ),
        (
            "a.jsonl",
            "{\"trajectory\":\"x\",\"step\":0,\"state\":\"moon\",\"action\":0}\n",
            "a.jsonl, line 1, column 28: expected one of the 4 states, such as 'home', got 'moon'",
        ),
        ("a.parquet", "PAR1 not a file PAR1", "a.parquet: expected a Parquet file: "),
        ("a.xls", "x", "a.xls: expected a file of a known format, got another extension"),
    ];
    for (name, content, expected) in cases {
        write(&data, name, content);
        let error = refused(&data, &["import", "--env", "Commute", name], 1);
        assert!(error == expected || (name == "a.parquet" && error.starts_with(expected)), "{content:?}: {error}");
    }
    assert!(said(&data, &["export"]).is_empty(), "nothing of a wrong file is stored");
    write(&data, "a.csv", "trajectory,state,action,env\nx,home,walk,Commute\ny,home,walk,Flight\n");
    let error = refused(&data, &["import", "a.csv"], 1);
    assert_eq!(error, "a.csv, line 3: expected demonstrations of Commute, got one of Flight");
    let error = refused(&data, &["import", "--env", "Commute", "missing.csv"], 1);
    assert!(error.starts_with("missing.csv: cannot read it: "), "{error}");
    write(&data, "a.csv", b"trajectory,state,action\nx,h\xffme,walk\n");
    let error = refused(&data, &["import", "--env", "Commute", "a.csv"], 1);
    assert_eq!(error, "a.csv, line 2, column 2 (state): expected text in UTF-8, got other bytes");
}

#[test]
fn each_mistake_in_a_model_is_put_to_its_place() {
    let data = directory();
    let model = |rows: &str| {
        format!(
            "{{\n  \"env\": \"M\",\n  \"states\": [\"a\", \"b\"], \"actions\": [\"go\"],\n  \"transitions\": [\n{rows}\n  ]\n}}\n"
        )
    };
    let whole = "[\"a\", \"go\", \"b\", 1.0],\n[\"b\", \"go\", \"a\", 1.0]";
    let with = |extra: &str| model(whole).replace("\"env\": \"M\",", &format!("\"env\": \"M\", {extra},"));
    let cases = [
        (
            model("[\"a\", \"go\", \"c\", 1.0]"),
            "m.json, line 5, column 21: expected one of the 2 states, such as 'a', got 'c'",
        ),
        (
            model("[\"a\", \"go\", \"b\", 0.25],\n[\"b\", \"go\", \"a\", 1.0]"),
            "m.json, line 5, column 22: expected the probabilities of state 'a' and action 'go' to sum to 1, got 0.25",
        ),
        (
            model("[\"a\", \"go\", \"b\", 1.0],\n[\"b\", \"go\", \"a\", 1.0],\n[\"b\", \"go\", \"a\", 0.0]"),
            "m.json, line 7, column 21: expected each transition once, got state 'b' and action 'go' to 'a' again",
        ),
        (model("[\"a\", \"go\", \"b\", 1.0]"), "m.json: expected transitions of state 'b' and action 'go', got none"),
        (model("[\"a\", \"go\", \"b\", 1.5]"), "m.json, line 5, column 21: expected a probability, got 1.5"),
        (model("[\"a\", \"go\", \"b\"]"), "m.json, line 5, column 16: expected a list of 4, got 3"),
        (model("[\"a\", \"go\", \"b\", 1.0"), "m.json, line 7, column 1: expected `,` or `]`"),
        (
            with("\"colour\": 1"),
            "m.json, line 2, column 22: expected one of the keys env, states, actions, transitions, features, start, terminal, rewards, got 'colour'",
        ),
        (
            with("\"terminal\": [\"a\"]"),
            "m.json, line 5, column 21: expected nothing to leave the terminal state 'a', got a transition",
        ),
        (
            with("\"start\": [[\"a\", 0.5]]"),
            "m.json, line 2, column 35: expected start probabilities that sum to 1, got 0.5",
        ),
        (
            with("\"features\": {\"names\": [\"x\"], \"states\": [[\"a\", 1]]}"),
            "m.json, line 8, column 1: expected features of state 'b', got none",
        ),
        (
            with("\"features\": {\"names\": [\"x\"], \"states\": [[\"a\", \"much\"]]}"),
            "m.json, line 2, column 67: expected a finite number, got 'much'",
        ),
        (
            with("\"features\": {\"names\": [\"x\", \"x\"], \"states\": []}"),
            "m.json, line 2, column 46: expected each feature once, got 'x' again",
        ),
        (
            model(whole).replace("[\"a\", \"b\"]", "[\"a\", \"a\"]"),
            "m.json, line 3, column 22: expected each state once, got 'a' again",
        ),
        (
            model(whole).replace("\"states\"", "\"terminal\""),
            "m.json, line 8, column 1: expected the key states: a list of labels, or how many there are",
        ),
    ];
    let mut wrong = Vec::new();
    for (content, expected) in cases {
        write(&data, "m.json", &content);
        let error = refused(&data, &["import", "--model", "m.json"], 1);
        if error != expected {
            wrong.push(format!("{content}\n  expected {expected}\n  got      {error}"));
        }
    }
    assert!(wrong.is_empty(), "{}", wrong.join("\n"));
    // Tables name the line of the entry that is to blame, and the field.
    fs::create_dir(data.path().join("m")).expect("a directory");
    for (table, content, expected) in [
        (
            "transitions.csv",
            "state,action,next_state,probability\n0,0,1,1\n1,0,0,0.5\n",
            "m/transitions.csv, line 3: expected the probabilities of state '1' and action '0' to sum to 1, got 0.5",
        ),
        (
            "transitions.csv",
            "state,action,next_state,probability\n0,0,1,1\n1,0,0,x\n",
            "m/transitions.csv, line 3, column 4 (probability): expected a finite number, got 'x'",
        ),
        (
            "transitions.csv",
            "state,action,next_state\n0,0,1\n",
            "m/transitions.csv, line 1: expected a column 'probability', got state, action, next_state",
        ),
    ] {
        write(&data, &format!("m/{table}"), content);
        assert_eq!(refused(&data, &["import", "--model", "m", "--env", "M"], 1), expected);
    }
    write(&data, "m/transitions.csv", "state,action,next_state,probability\na,0,b,1\nb,0,a,1\n");
    write(&data, "m/states.csv", "state,speed\na,1\nb,\n");
    let error = refused(&data, &["import", "--model", "m", "--env", "M"], 1);
    assert_eq!(error, "m/states.csv, line 3, column 2 (speed): expected a finite number, got nothing");
    let error = refused(&data, &["import", "--model", "nothing.json"], 1);
    assert!(error.starts_with("nothing.json: cannot read it: "), "{error}");
}

#[test]
fn what_is_called_wrongly_is_said_before_anything_is_read() {
    let data = directory();
    for (arguments, expected) in [
        (&["import"][..], "expected something to import, got no file"),
        (&["import", "x.csv", "--column", "pace=speed"], "expected OURS=THEIRS for --column, got 'pace=speed'"),
        (&["import", "x.csv", "--describe", "m.json"], "expected --describe with --model estimate alone"),
        (
            &["import", "x.csv", "--model", "estimate", "--model-prior=-1"],
            "expected --model-prior to be a number of at least 0, got -1",
        ),
        (&["import", "x.csv", "--env", ""], "expected a name for --env, got an empty one"),
        (&["import", "x.csv", "--delimiter", "→"], "expected one byte for --delimiter, got '→'"),
        (
            &["fit", "--env", "Commute", "--features", "x", "--basis", "state"],
            "expected --features without another --basis, got both",
        ),
        (
            &["fit", "--env", "Commute", "--model", "mine"],
            "expected the beginning of a model's id or 'estimate' for --model, got 'mine'",
        ),
    ] {
        assert_eq!(refused(&data, arguments, 2), expected);
    }
    write(&data, "x.csv", "trajectory,state,action\na,0,0\n");
    assert_eq!(refused(&data, &["import", "x.csv"], 2), "expected to be told the environment, which no file names");
    assert_eq!(
        refused(&data, &["import", "x.csv", "--env", "Nowhere"], 1),
        "expected a model of Nowhere, got none stored"
    );
}

#[test]
fn impossible_transitions_are_reported_and_not_silently_used() {
    let data = with_model();
    // From home nobody walks to the park.
    let walks = "trajectory,step,state,action\nx,0,home,walk\nx,1,park,walk\nx,2,office,\ny,7,home,walk\ny,8,street,bus\ny,9,office,\n";
    write(&data, "walks.csv", walks);
    let import = ["import", "--env", "Commute", "walks.csv"];
    assert_eq!(
        refused(&data, &import, 1),
        "1 of 4 transitions, in 1 of 2 trajectories, cannot happen in the model, such as \
         walks.csv:2 from state 'home' by action 'walk' to 'park'"
    );
    assert!(said(&data, &["export"]).is_empty());
    let split = object(&data, &[&import[..], &["--impossible", "split"]].concat());
    assert_eq!((&split["stored"], &split["impossible"]["transitions"]), (&3.into(), &1.into()));
    let again = object(&data, &[&import[..], &["--impossible", "split"]].concat());
    assert_eq!((&again["stored"], &again["already_stored"]), (&0.into(), &3.into()));
    let kept = said(&data, &[&import[..], &["--impossible", "keep"]].concat());
    assert!(
        kept.contains("warning     1 of 4 transitions") && kept.contains("recorded    1 new, 1 known already"),
        "{kept}"
    );
}

#[test]
fn columns_may_have_other_names_and_rows_may_alternate() {
    let data = with_model();
    let log = "second;vehicle;state;action;weather\n0;x;home;walk;rain\n0;y;home;walk;rain\n1;x;street;bus;sun\n1;y;street;walk;sun\n";
    write(&data, "log.csv", log);
    let import = [
        "import",
        "--env",
        "Commute",
        "log.csv",
        "--delimiter",
        ";",
        "--column",
        "trajectory=vehicle",
        "--column",
        "step=second",
    ];
    let error = refused(&data, &import, 1);
    assert_eq!(
        error,
        "log.csv, line 4, column 2 (vehicle): expected the rows of trajectory 'x' together, got more of them"
    );
    let summary = object(&data, &[&import[..], &["--interleaved"]].concat());
    assert_eq!((&summary["stored"], &summary["steps"]), (&2.into(), &4.into()));
    assert_eq!(summary["ignored_columns"], serde_json::json!(["weather"]));
    let error = refused(
        &data,
        &["import", "--env", "Commute", "log.csv", "--delimiter", ";", "--column", "trajectory=driver"],
        1,
    );
    assert_eq!(error, "log.csv, line 1: expected a column 'driver' for trajectory, got none");
}

#[test]
fn one_process_may_be_described_anew() {
    let data = with_model();
    let text = fs::read_to_string(examples().join("commute.json")).expect("the example");
    let other = text.replace("[\"park\", 1, 0]", "[\"park\", 2, 0]");
    assert_ne!(text, other);
    write(&data, "other.json", other);
    let error = refused(&data, &["import", "--model", "other.json"], 1);
    assert!(error.contains("is stored already, for environment \"Commute\", with other features"), "{error}");
    let replaced = object(&data, &["import", "--model", "other.json", "--replace"]);
    assert_eq!(replaced["model"]["stored"], true);
    let known = object(&data, &["import", "--model", "other.json"]);
    assert_eq!((&known["model"]["stored"], &known["model"]["id"]), (&false.into(), &replaced["model"]["id"]));
    let listed = object(&data, &["list", "--models"]);
    assert_eq!(listed["models"].as_array().expect("a list").len(), 1);
    assert_eq!(listed["models"][0]["features"], serde_json::json!(["green", "noise"]));
}

#[test]
fn features_are_fitted_without_any_environment_server() {
    let data = directory();
    said(&data, &["import", "--model", &example("commute.json"), &example("walks.csv")]);
    let fit = ["fit", "--env", "Commute", "--features", "all", "--penalty", "l2", "--penalty-strength", "0.1"];
    let result = object(&data, &fit);
    assert_eq!((&result["env"], &result["style"]), (&"Commute".into(), &"stroller".into()));
    // The stroller walks wherever it can.
    assert_eq!(result["agreement"], 1.0);
    let features = result["features"].as_array().expect("a list");
    let names: Vec<_> = features.iter().map(|feature| feature["name"].as_str().expect("a name")).collect();
    assert_eq!(names, ["green", "noise"]);
    let number = |rank: usize, key: &str| features[rank][key].as_f64().expect("a number");
    assert!(features[0]["weight"]["mean"].as_f64() > Some(0.0), "{result}");
    // Four of the twelve steps are in the park.
    assert!((number(0, "demonstrated") - 4.0 / 12.0).abs() < 1e-12, "{result}");
    assert!(number(0, "learned") > number(0, "random"));
    let page = fs::read_to_string(data.path().join(result["report"].as_str().expect("a path"))).expect("the report");
    assert!(page.contains("Weights of the features") && page.contains("street") && !page.contains("state 1"));
    let text = said(&data, &fit);
    assert!(text.contains("Features") && text.contains("green") && text.contains("park"), "{text}");
    // One feature alone; one that there is not; and the fit as it is shown, by labels.
    let one = object(&data, &["fit", "--env", "Commute", "--features", "green"]);
    assert_eq!(one["features"].as_array().expect("a list").len(), 1);
    let output = learner(&data, &["fit", "--env", "Commute", "--features", "blue"]).output().expect("a process");
    let error = String::from_utf8_lossy(&output.stderr);
    assert_eq!((output.status.code(), error.lines().count()), (Some(2), 2), "{error}");
    assert!(error.contains("expected one of the features green, noise, got blue"), "{error}");
    let fits = object(&data, &["list", "--fits"]);
    let id = fits["fits"][0]["id"].as_str().expect("an id").to_owned();
    let shown = said(&data, &["show", &id]);
    assert!(shown.contains("street") && shown.contains("walk") && shown.contains("green"), "{shown}");
    // Every method that applies.
    for method in ["em", "em-mixture", "bc"] {
        object(&data, &["fit", "--env", "Commute", "--method", method]);
    }
    let error = refused(&data, &["fit", "--env", "Commute", "--style", "commuter", "--json"], 1);
    assert_eq!(error, "nothing is recorded for Commute under style 'commuter'");
}

#[test]
fn a_model_is_estimated_and_says_where_it_has_no_data() {
    let data = directory();
    let import = ["import", "--env", "Walks", "--model", "estimate", &example("walks.csv")];
    let summary = object(&data, &import);
    // home, office, park and street by walk alone; nothing leaves the office.
    assert_eq!(summary["model"]["unseen_pairs"], serde_json::json!([["office", "walk"]]));
    assert_eq!((&summary["model"]["pairs"], &summary["model"]["estimated"]), (&4.into(), &true.into()));
    let again = object(&data, &import);
    assert_eq!((&again["stored"], &again["model"]["stored"]), (&0.into(), &false.into()));
    let text = said(&data, &["fit", "--env", "Walks"]);
    assert!(text.contains("no data     1 of 4 state-action pairs (office/walk)"), "{text}");
    assert!(text.contains("warning: the model has no data for 1 of 4 state-action pairs"), "{text}");

    // Described by a model file: its features, its terminal state, its two actions.
    let described = text_without_transitions();
    write(&data, "space.json", described);
    let summary = object(&data, &["import", "--model", "estimate", "--describe", "space.json", &example("walks.csv")]);
    assert_eq!(summary["env"], "Commute");
    assert_eq!(summary["model"]["unseen_pairs"].as_array().expect("a list").len(), 5);
    let result = object(&data, &["fit", "--env", "Commute", "--features", "all"]);
    assert_eq!(result["features"].as_array().expect("a list").len(), 2);
    // From what is recorded, without a file.
    let result = object(&data, &["fit", "--env", "Commute", "--model", "estimate", "--model-prior", "0.5"]);
    // Nobody took a bus: it is taken to go where walking goes, and no reward of states tells the two apart.
    assert_eq!(result["agreement"], 0.5);
    // With one action alone, the prior is what was seen whatever it is worth: the model is the same.
    let models = object(&data, &["list", "--models", "--env", "Commute"]);
    assert_eq!(models["models"].as_array().expect("a list").len(), 1);
}

fn text_without_transitions() -> String {
    let text = fs::read_to_string(examples().join("commute.json")).expect("the example");
    let mut value: Value = serde_json::from_str(&text).expect("JSON");
    value.as_object_mut().expect("an object").remove("transitions");
    value.to_string()
}

#[test]
fn states_alone_are_demonstrations_too() {
    let data = with_model();
    write(&data, "seen.csv", "trajectory,state\nx,home\nx,street\nx,park\nx,office\ny,home\ny,street\ny,park\n");
    let summary = object(&data, &["import", "--env", "Commute", "seen.csv"]);
    assert_eq!((&summary["stored"], &summary["steps"]), (&2.into(), &5.into()));
    write(&data, "never.csv", "trajectory,state\nz,home\nz,park\n");
    let error = refused(&data, &["import", "--env", "Commute", "never.csv"], 1);
    assert!(error.ends_with("such as never.csv:2 from state 'home' to 'park'"), "{error}");
    // Back and forth, and fitted: the actions are inferred.
    said(&data, &["export", "--format", "parquet", "--out", "seen.parquet"]);
    let again = object(&data, &["import", "seen.parquet"]);
    assert_eq!((&again["stored"], &again["already_stored"]), (&0.into(), &2.into()));
    object(&data, &["fit", "--env", "Commute", "--method", "em", "--features", "all"]);
}

#[test]
fn a_model_of_many_blocks_comes_back_whole() {
    let data = directory();
    let n = 6_000;
    let row = |state: usize, action: usize| {
        let next = (state + action + 1) % n;
        format!("{state},{action},{next},0.75\n{state},{action},{state},0.25\n")
    };
    let rows = (0..n).flat_map(|state| [row(state, 0), row(state, 1)]).collect::<String>();
    let table = format!("state,action,next_state,probability\n{rows}");
    write(&data, "ring.csv", table);
    let stored = object(&data, &["import", "--env", "Ring", "--model", "ring.csv"]);
    assert_eq!(stored["model"]["pairs"], 2 * n);
    // The model that is checked against is the stored one.
    write(&data, "walk.csv", format!("trajectory,state,action\nx,{},1\nx,0,0\nx,1,\n", n - 2));
    assert_eq!(object(&data, &["import", "--env", "Ring", "walk.csv"])["stored"], 1);
    write(&data, "walk.csv", format!("trajectory,state,action\nx,{},1\nx,1,0\nx,2,\n", n - 2));
    let error = refused(&data, &["import", "--env", "Ring", "walk.csv"], 1);
    assert!(error.ends_with(&format!("walk.csv:2 from state '{}' by action '1' to '1'", n - 2)), "{error}");
}
