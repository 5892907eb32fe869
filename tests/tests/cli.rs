//! The `learner` command as a person or a script meets it: output, errors, exit codes.

use assert_cmd::Command;
use mazeway_client::{Learner, Recorder};
use mazeway_proto::learner as pb;
use mazeway_tests::{
    authority::Authority,
    learner::trajectory,
    programs::{Service, program},
};
use serde_json::Value;
use std::{io::Read as _, path::Path, process::Stdio};
use tempfile::TempDir;

fn learner(arguments: &[&str]) -> Command {
    command("learner", arguments)
}

fn command(name: &str, arguments: &[&str]) -> Command {
    let mut command = Command::new(program(name));
    for (name, _) in std::env::vars().filter(|(name, _)| name.starts_with("MAZEWAY_") || name == "RUST_LOG") {
        command.env_remove(name);
    }
    command.args(arguments);
    command
}

fn in_directory(data: &Path, arguments: &[&str]) -> Command {
    let mut command = learner(arguments);
    command.arg("--data").arg(data);
    command
}

/// Runs and expects a refusal: nothing on standard output, one `error:` line and one `hint:` line on standard error.
fn refused(mut command: Command, code: i32) -> (String, String) {
    let output = command.output().expect("a process");
    let said = String::from_utf8(output.stderr).expect("text");
    assert_eq!(output.status.code(), Some(code), "{said}");
    assert!(output.stdout.is_empty());
    let lines = said.lines().collect::<Vec<_>>();
    let [error, hint] = lines[..] else { panic!("expected two lines, got {said:?}") };
    let error = error.strip_prefix("error: ").unwrap_or_else(|| panic!("expected an error, got {said:?}"));
    let hint = hint.strip_prefix("hint: ").unwrap_or_else(|| panic!("expected a hint, got {said:?}"));
    assert!(!error.ends_with('.') && !hint.ends_with('.'), "{said:?}");
    (error.to_owned(), hint.to_owned())
}

/// Runs and expects success without a word on standard error.
fn said(mut command: Command) -> String {
    let output = command.output().expect("a process");
    let complaint = String::from_utf8_lossy(&output.stderr);
    assert!(output.status.success() && complaint.is_empty(), "{complaint}");
    String::from_utf8(output.stdout).expect("text")
}

/// A directory with twelve trajectories.
async fn recorded() -> TempDir {
    let data = tempfile::tempdir().expect("a directory");
    let service = Service::learner(data.path());
    let mut recorder = Recorder::connect(service.address()).await.expect("a learner");
    for number in 0..12 {
        recorder.record(trajectory(number)).await.expect("a trajectory");
    }
    recorder.finish().await.expect("everything stored");
    service.kill();
    data
}

#[test]
fn wrong_usage_is_one_error_and_one_hint() {
    let cases: [(&[&str], &str, &str); 9] = [
        (&[], "expected a command, got none", "'learner --help'"),
        (&["lisst"], "unrecognized subcommand 'lisst'", "did you mean 'list'? see 'learner --help'"),
        (&["list", "--jsn"], "unexpected argument '--jsn' found", "did you mean '--json'? see 'learner list --help'"),
        (&["show"], "the following required arguments were not provided: <ID>", "see 'learner show --help'"),
        (&["show", "x"], "expected an id or its first 8 or more characters, got 'x'", "learner list"),
        (&["delete"], "expected what to delete, got no condition", "--style"),
        (&["serve", "--listen", "here"], "invalid value 'here' for '--listen <ADDR>'", "'learner serve --help'"),
        (&["serve", "--listen", "0.0.0.0:0"], "0.0.0.0:0 is reached from other machines", "--insecure"),
        (&["export", "--format", "xml"], "invalid value 'xml' for '--format <FORMAT>'", "'learner export --help'"),
    ];
    for (arguments, error, hint) in cases {
        let said = refused(learner(arguments), 2);
        assert!(said.0.starts_with(error), "{arguments:?}: {said:?}");
        assert!(said.1.contains(hint), "{arguments:?}: {said:?}");
    }
}

#[test]
fn a_token_that_is_asked_for_wrongly_is_a_wrong_call_of_either_program() {
    for name in ["server", "learner"] {
        let cases: [(&[&str], &str); 6] = [
            (&["token"], "the following required arguments were not provided: --scopes <SCOPES> <NAME>"),
            (&["token", "me"], "the following required arguments were not provided: --scopes <SCOPES>"),
            (&["token", "a b", "--scopes", "act"], "invalid value 'a b' for '<NAME>': expected 1 to 64 letters"),
            (&["token", "me", "--scopes", "all"], "invalid value 'all' for '--scopes <SCOPES>'"),
            (
                &["token", "me", "--scopes", "act", "--expires-in", "1000000y"],
                "invalid value '1000000y' for '--expires-in <TIME>': expected a time above 0 and up to a hundred years",
            ),
            (&["token", "me", "--scopes", "act", "--expires-in", "0s"], "invalid value '0s' for '--expires-in <TIME>'"),
        ];
        for (arguments, error) in cases {
            let said = refused(command(name, arguments), 2);
            assert!(said.0.starts_with(error), "{name} {arguments:?}: {said:?}");
            assert_eq!(said.1, format!("see '{name} token --help'"), "{arguments:?}");
        }
    }
    let said = refused(command("server", &["--lissten", "127.0.0.1:0"]), 2);
    assert_eq!(said.1, "see 'server --help'");
}

#[test]
fn a_file_of_which_nothing_reads_is_to_be_restored() {
    let data = tempfile::tempdir().expect("a directory");
    let file = data.path().join("mazeway.sqlite3");
    // Nothing at all, and nothing that is a database.
    for (content, error) in [(String::new(), "there is nothing in it"), ("no database".repeat(200), "not a database")] {
        std::fs::write(&file, &content).expect("a file");
        for arguments in [&["verify"][..], &["repair"]] {
            let said = refused(in_directory(data.path(), arguments), 1);
            assert!(said.0.contains(error), "{arguments:?}: {said:?}");
            assert!(said.1.starts_with("restore a copy"), "{arguments:?}: {said:?}");
        }
        let output = in_directory(data.path(), &["verify", "--json"]).output().expect("a process");
        let object: Value = serde_json::from_slice(&output.stdout).expect("JSON");
        assert_eq!((output.status.code(), &object["sound"]), (Some(1), &Value::Bool(false)), "{object}");
        assert_eq!(std::fs::read(&file).expect("a file"), content.as_bytes(), "it is left alone");
    }
}

#[tokio::test(flavor = "multi_thread")]
async fn a_service_that_fails_within_a_command_is_told_in_two_lines() {
    let data = recorded().await;
    said(in_directory(data.path(), &["vacuum"]));
    let file = data.path().join("mazeway.sqlite3");
    let mut bytes = std::fs::read(&file).expect("a database");
    // The schema reads, and nothing else.
    let page = 8192;
    bytes[page..].fill(0xaa);
    std::fs::write(&file, &bytes).expect("a file");
    for arguments in [&["list"][..], &["export"]] {
        let (error, hint) = refused(in_directory(data.path(), arguments), 1);
        assert!(hint.contains("learner verify"), "{arguments:?}: {error}; {hint}");
    }
}

#[test]
fn failures_say_what_to_do() {
    let data = tempfile::tempdir().expect("a directory");
    // Nobody answers.
    let said = refused(learner(&["list", "--addr", "127.0.0.1:1"]), 1);
    assert!(said.0.starts_with("cannot reach a server at 127.0.0.1:1"), "{said:?}");
    assert!(said.1.contains("learner serve"), "{said:?}");
    let said = refused(learner(&["list", "--addr", "not an address"]), 1);
    assert!(said.0.starts_with("expected an address such as"), "{said:?}");
    // Nothing of this name.
    let said = refused(in_directory(data.path(), &["show", "0123abcd"]), 1);
    assert_eq!(said.0, "there is no fit, trajectory or model '0123abcd'");
    // A directory that is none.
    let file = data.path().join("file");
    std::fs::write(&file, "x").expect("a file");
    for command in [&["list"][..], &["serve", "--listen", "127.0.0.1:0"]] {
        let said = refused(in_directory(&file, command), 1);
        assert!(said.0.starts_with("cannot use the data directory"), "{said:?}");
        assert!(said.1.contains("--data DIR"), "{said:?}");
    }
    // A port that is taken.
    let taken = std::net::TcpListener::bind("127.0.0.1:0").expect("a port");
    let address = taken.local_addr().expect("an address").to_string();
    let said = refused(in_directory(data.path(), &["serve", "--listen", &address]), 1);
    assert!(said.0.starts_with(&format!("cannot listen on {address}")), "{said:?}");
    // A file that is no database.
    let other = tempfile::tempdir().expect("a directory");
    std::fs::write(other.path().join("mazeway.sqlite3"), "no database".repeat(200)).expect("a file");
    let said = refused(in_directory(other.path(), &["list"]), 1);
    assert!(said.0.contains("file is not a database"), "{said:?}");
}

#[test]
fn help_names_every_command() {
    let text = said(learner(&["--help"]));
    for command in ["fit", "list", "show", "export", "delete", "serve"] {
        assert!(text.lines().any(|line| line.trim_start().starts_with(command)), "{text}");
        let text = said(learner(&[command, "--help"]));
        assert!(text.contains(&format!("Usage: learner {command}")) && text.contains("--data"), "{text}");
    }
    assert_eq!(said(learner(&["--version"])), format!("learner {}\n", env!("CARGO_PKG_VERSION")));
}

#[test]
fn an_empty_directory_says_how_to_begin() {
    let data = tempfile::tempdir().expect("a directory");
    insta::assert_snapshot!(said(in_directory(data.path(), &["list"])), @r"
    recordings: none yet; 'learner fit --style aggressive' lets an expert demonstrate

    models: none yet

    fits: none yet
    ");
    let object: Value = serde_json::from_str(&said(in_directory(data.path(), &["list", "--json"]))).expect("JSON");
    assert_eq!(object, serde_json::json!({"recordings": [], "models": [], "fits": []}));
}

#[tokio::test(flavor = "multi_thread")]
async fn what_is_recorded_is_listed_shown_exported_and_deleted() {
    let data = recorded().await;
    let list: Value = serde_json::from_str(&said(in_directory(data.path(), &["list", "--json"]))).expect("JSON");
    let groups = list["recordings"].as_array().expect("groups");
    let counts = groups.iter().map(|g| (g["style"].as_str(), g["trajectories"].as_u64())).collect::<Vec<_>>();
    assert_eq!(counts, [(Some("brisk"), Some(8)), (Some("calm"), Some(4))]);
    let steps = (0..12).map(|n| trajectory(n).states.len() as u64 / 4).sum::<u64>();
    assert_eq!(groups.iter().map(|g| g["steps"].as_u64().unwrap_or(0)).sum::<u64>(), steps);
    let text = said(in_directory(data.path(), &["list", "--style", "calm"]));
    assert!(text.contains("calm") && !text.contains("brisk"), "{text}");
    let rows = said(in_directory(data.path(), &["list", "--trajectories"]));
    assert!((0..12).all(|n| rows.contains(&trajectory(n).trajectory_id)), "{rows}");

    let one = trajectory(5);
    let shown = said(in_directory(data.path(), &["show", &one.trajectory_id]));
    assert!(shown.contains("final state  56") && shown.lines().count() > 10, "{shown}");
    let shown: Value =
        serde_json::from_str(&said(in_directory(data.path(), &["show", &one.trajectory_id, "--json"]))).expect("JSON");
    assert_eq!((&shown["kind"], &shown["final_state"]), (&"trajectory".into(), &56.into()));

    let lines = said(in_directory(data.path(), &["export"]));
    let ids = lines.lines().map(|line| serde_json::from_str::<Value>(line).expect("JSON")["id"].clone());
    assert!(ids.eq((0..12).map(|n| Value::from(trajectory(n).trajectory_id))));
    let csv = data.path().join("out.csv");
    let path = csv.to_str().expect("a path");
    assert_eq!(said(in_directory(data.path(), &["export", "--format", "csv", "--out", path])), "");
    let text = std::fs::read_to_string(&csv).expect("a file");
    assert_eq!(text.lines().count() as u64, 1 + steps);
    assert!(text.starts_with("id,env,model,style,source,seed,"), "{text}");

    let (error, hint) = refused(in_directory(data.path(), &["delete", "--style", "calm"]), 1);
    assert_eq!(error, "this would delete 4 trajectories");
    assert!(hint.contains("--yes"));
    assert_eq!(said(in_directory(data.path(), &["delete", "--style", "calm", "--yes"])), "deleted 4 trajectories\n");
    let list: Value = serde_json::from_str(&said(in_directory(data.path(), &["list", "--json"]))).expect("JSON");
    assert_eq!(list["recordings"].as_array().map(Vec::len), Some(1));
}

#[tokio::test(flavor = "multi_thread")]
async fn a_directory_is_listed_while_a_service_records_into_it() {
    let data = tempfile::tempdir().expect("a directory");
    let service = Service::learner(data.path());
    let mut recorder = Recorder::connect(service.address()).await.expect("a learner");
    let mut seen = 0;
    for round in 0..4_u128 {
        for number in round * 20..round * 20 + 20 {
            recorder.record(trajectory(number)).await.expect("a trajectory");
        }
        recorder.flush().await.expect("stored");
        let path = data.path().to_owned();
        let list = tokio::task::spawn_blocking(move || said(in_directory(&path, &["list", "--json"]))).await;
        let list: Value = serde_json::from_str(&list.expect("a list")).expect("JSON");
        let groups = list["recordings"].as_array().expect("groups");
        seen = groups.iter().map(|g| g["trajectories"].as_u64().unwrap_or(0)).sum::<u64>();
        assert_eq!(seen as u128, round * 20 + 20);
    }
    // The running service says the same.
    let learner_client = Learner::connect(service.address()).await.expect("a learner");
    assert_eq!(learner_client.count_trajectories(&pb::TrajectoryFilter::default()).await.expect("a count"), seen);
    let address = service.address().to_owned();
    let over = tokio::task::spawn_blocking(move || said(learner(&["list", "--json", "--addr", &address]))).await;
    assert!(over.expect("a list").contains("\"trajectories\":"));
}

#[tokio::test(flavor = "multi_thread")]
async fn a_closed_pipe_is_no_panic() {
    let data = recorded().await;
    for arguments in [&["list", "--trajectories"][..], &["export"], &["--help"]] {
        let mut command = std::process::Command::new(program("learner"));
        command.args(arguments).env("MAZEWAY_DATA", data.path());
        let mut child = command.stdout(Stdio::piped()).stderr(Stdio::piped()).spawn().expect("a process");
        // Nobody reads: the other end is closed before anything is written.
        drop(child.stdout.take());
        let status = child.wait().expect("an end");
        let mut complaint = String::new();
        child.stderr.take().expect("a pipe").read_to_string(&mut complaint).expect("text");
        assert!(status.success() && complaint.is_empty(), "{arguments:?}: {status} {complaint}");
    }
}

#[cfg(unix)]
#[test]
fn a_service_that_is_told_to_stop_ends_well() {
    let data = tempfile::tempdir().expect("a directory");
    let mut command = std::process::Command::new(program("learner"));
    command.args(["serve", "--listen", "127.0.0.1:0", "--data"]).arg(data.path());
    let mut child = command.stdout(Stdio::piped()).spawn().expect("a process");
    let mut line = [0; 13];
    child.stdout.as_mut().expect("a pipe").read_exact(&mut line).expect("a line");
    assert_eq!(&line, b"listening on ");
    let stop = std::process::Command::new("kill").args(["-TERM", &child.id().to_string()]).status().expect("kill");
    assert!(stop.success());
    assert!(child.wait().expect("an end").success());
    // The log is folded into the database.
    assert!(!data.path().join("mazeway.sqlite3-wal").exists());
}

#[tokio::test]
async fn a_running_learner_is_reached_over_tls_with_a_token() {
    let (authority, data) = (Authority::new(), tempfile::tempdir().expect("a directory"));
    let tokens = authority.path("tokens");
    let mut make = learner(&["token", "me", "--scopes", "act,record,fit,admin", "--append"]);
    make.arg(&tokens);
    let secret = said(make).trim().to_owned();
    let (cert, key) = authority.sign("a service");
    let mut serve = std::process::Command::new(program("learner"));
    serve.args(["serve", "--listen", "127.0.0.1:0", "--tokens"]).arg(&tokens);
    serve
        .arg("--tls-cert")
        .arg(authority.file("cert.pem", &cert))
        .arg("--tls-key")
        .arg(authority.file("key.pem", &key));
    serve.arg("--data").arg(data.path());
    let service = Service::start(serve);
    let address = format!("https://{}", service.address());
    let (token, ca) = (authority.file("token", &format!("{secret}\n")), authority.root_file());
    let list = |arguments: &[&str]| learner(&[&["list", "--json", "--addr", &address], arguments].concat());

    let mut known = list(&["--token-file"]);
    known.arg(&token).arg("--tls-ca").arg(&ca);
    said(known);
    let mut known = list(&[]);
    known.env("MAZEWAY_TOKEN", &secret).env("MAZEWAY_TLS_CA", &ca);
    said(known);
    // Without the token, without the authority, with files that are none.
    let mut unknown = list(&["--tls-ca"]);
    unknown.arg(&ca);
    let (_, hint) = refused(unknown, 1);
    assert!(hint.contains("--token-file"), "{hint}");
    let mut strange = list(&["--token-file"]);
    strange.arg(&token);
    let (error, _) = refused(strange, 1);
    assert!(!error.contains(&secret), "{error}");
    let (error, hint) = refused(list(&["--token-file", "/nowhere/token"]), 2);
    assert!(error.contains("/nowhere/token") && hint.contains("--token-file"), "{error}; {hint}");
    // A token in the clear leaves the machine only by request.
    let mut clear = learner(&["list", "--addr", "robots.example:50052", "--token-file"]);
    clear.arg(&token);
    let (error, hint) = refused(clear, 2);
    assert!(error.contains("https://") && hint.contains("--token-in-clear"), "{error}; {hint}");
}
