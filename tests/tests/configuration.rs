//! The configuration of both programs, as an operator meets it: a flag wins over a variable, a variable over the file, the
//! file over the default; what is printed can be fed back; what is documented is all there is.

use mazeway_tests::programs::program;
use std::{collections::BTreeMap, fs, path::Path, process::Command};
use tempfile::TempDir;

/// `server config` or `learner config`, far from the settings of whoever runs the tests.
fn config(name: &str) -> Command {
    let mut command = Command::new(program(name));
    command.arg("config");
    for (variable, _) in std::env::vars().filter(|(variable, _)| variable.starts_with("MAZEWAY_")) {
        command.env_remove(variable);
    }
    command
}

fn printed(command: &mut Command) -> String {
    let output = command.output().expect("it runs");
    let error = String::from_utf8_lossy(&output.stderr);
    assert!(output.status.success() && error.is_empty(), "{command:?}: {error}");
    String::from_utf8(output.stdout).expect("text")
}

#[track_caller]
fn refused(command: &mut Command, expected: &str) {
    let output = command.output().expect("it runs");
    let error = String::from_utf8(output.stderr).expect("text");
    let lines: Vec<_> = error.lines().collect();
    assert_eq!((output.status.code(), lines.len(), output.stdout.len()), (Some(2), 2, 0), "{command:?}: {error}");
    assert!(lines[0].starts_with("error: ") && lines[0].contains(expected), "{error}");
    assert!(lines[1].starts_with("hint: "), "{error}");
}

/// Key, value and source of each line that is set.
fn lines(text: &str) -> BTreeMap<String, (String, String)> {
    let set = text.lines().filter(|line| !line.starts_with('#') && !line.is_empty());
    let parts = set.map(|line| {
        let (key, rest) = line.split_once(" = ").expect(line);
        let (value, source) = rest.split_once("  # ").expect(line);
        (key.to_owned(), (value.to_owned(), source.to_owned()))
    });
    parts.collect()
}

fn file(directory: &TempDir, text: &str) -> String {
    let path = directory.path().join("settings.toml");
    fs::write(&path, text).expect("writes");
    path.to_str().expect("a plain path").to_owned()
}

#[test]
fn a_flag_wins_over_a_variable_a_variable_over_the_file_and_the_file_over_the_default() {
    let directory = tempfile::tempdir().expect("a directory");
    for (program, prefix) in [("server", "MAZEWAY_SERVER_"), ("learner", "MAZEWAY_LEARNER_")] {
        let text = "max-connections = 1\nidle_timeout_secs = 2\nstall-timeout-secs = 3\ninsecure = true\n";
        let path = file(&directory, text);
        let variable = |name: &str| format!("{prefix}{name}");
        let mut command = config(program);
        // The file itself is named by a variable.
        command.env(variable("CONFIG"), &path);
        command.env(variable("MAX_CONNECTIONS"), "10").env(variable("IDLE_TIMEOUT_SECS"), "20");
        let text = printed(command.args(["--max-connections", "100"]));
        let settings = lines(&text);
        for (key, value, source) in [
            ("max-connections", "100", "flag --max-connections".to_owned()),
            ("idle-timeout-secs", "20", format!("environment, {prefix}IDLE_TIMEOUT_SECS")),
            ("stall-timeout-secs", "3", format!("file {path}")),
            ("insecure", "true", format!("file {path}")),
            ("call-deadline-secs", "60", format!("default; {prefix}CALL_DEADLINE_SECS")),
        ] {
            assert_eq!(settings.get(key), Some(&(value.to_owned(), source)), "{program}: {key}");
        }
        // Fed back, it says the same of everything.
        let path = file(&directory, &text);
        let again = lines(&printed(config(program).args(["--config", &path])));
        let values = |lines: &BTreeMap<String, (String, String)>| -> Vec<_> {
            lines.iter().map(|(key, (value, _))| (key.clone(), value.clone())).collect()
        };
        assert_eq!(values(&again), values(&settings), "{program}");
    }
}

#[test]
fn what_is_wrong_is_said_in_a_line_with_what_to_do() {
    let directory = tempfile::tempdir().expect("a directory");
    for program in ["server", "learner"] {
        let path = file(&directory, "max-conections = 1\n");
        let expected = "there is no setting \"max-conections\"; did you mean \"max-connections\"?";
        refused(config(program).args(["--config", &path]), expected);
        let path = file(&directory, "call-deadline-secs = \"soon\"\n");
        refused(config(program).args(["--config", &path]), "call-deadline-secs: expected a positive number of seconds");
        refused(config(program).args(["--config", "/nowhere"]), "/nowhere: cannot be read");
        refused(config(program).args(["--max-connections", "many"]), "invalid value 'many'");
    }
}

#[test]
fn numbers_out_of_bounds_are_refused_wherever_they_come_from() {
    let directory = tempfile::tempdir().expect("a directory");
    let most = u64::MAX.to_string();
    let both = [("max-connections", "0"), ("max-metadata-bytes", "0"), ("max-message-bytes", "0")];
    let of_server = [
        ("max-sessions", "0"),
        ("max-envs-per-session", "0"),
        ("max-total-envs", "0"),
        ("max-streams-per-connection", "0"),
        ("max-concurrent-models", "0"),
        ("max-concurrent-models", &most),
        ("max-concurrent-rollouts", &most),
        ("max-viewers", &most),
        ("max-message-bytes", &most),
        ("threads", "1000000"),
    ];
    let of_learner = [
        ("max-concurrent-fits", "0"),
        ("max-concurrent-fits", "1000000"),
        ("max-concurrent-models", "0"),
        ("max-concurrent-models", &most),
        ("max-requests-in-flight", "0"),
        ("max-requests-in-flight", &most),
        ("max-queued-fits", &most),
        ("max-streams-per-connection", "0"),
        ("max-trajectories-per-request", "0"),
        ("keepalive-secs", "1e12"),
        ("shutdown-grace-secs", "0"),
        ("model-patience-secs", "0"),
    ];
    for (program, prefix, own) in
        [("server", "MAZEWAY_SERVER_", &of_server[..]), ("learner", "MAZEWAY_LEARNER_", &of_learner[..])]
    {
        for (key, value) in both.iter().chain(own) {
            let (flag, variable) = (format!("--{key}"), format!("{prefix}{}", key.to_uppercase().replace('-', "_")));
            refused(config(program).args([&flag, *value]), key);
            refused(config(program).env(&variable, value), key);
            let path = file(&directory, &format!("{key} = \"{value}\"\n"));
            refused(config(program).args(["--config", &path]), key);
            // And where it serves.
            let mut serving = Command::new(mazeway_tests::programs::program(program));
            let serve: &[&str] = if program == "learner" { &["serve"] } else { &[] };
            refused(serving.args(serve).args(["--listen", "127.0.0.1:0", &flag, *value]), key);
        }
    }
}

#[test]
fn every_setting_is_documented_with_its_default() {
    let docs = Path::new(env!("CARGO_MANIFEST_DIR")).join("..").join("docs").join("CONFIGURATION.md");
    let docs = fs::read_to_string(docs).expect("the page");
    let mut missing = Vec::new();
    for program in ["server", "learner"] {
        let section =
            docs.split("\n## ").find(|section| section.starts_with(&format!("`{program}"))).expect("a section");
        let mut what = String::new();
        for line in printed(&mut config(program)).lines() {
            // "# help", then "key = value  # default; VARIABLE" or "# key =  # not set; VARIABLE".
            let row = if let Some((key, rest)) = line.trim_start_matches("# ").split_once(" = ")
                && rest.contains("  # default; ")
            {
                let value = rest.split("  # ").next().unwrap_or_default().trim_matches('"');
                format!("| `{key}` | `{value}` | {what} |")
            } else if let Some((key, _)) = line.trim_start_matches("# ").split_once(" =  # not set; ") {
                format!("| `{key}` | | {what} |")
            } else {
                what = line.trim_start_matches("# ").trim_end_matches('.').to_owned();
                continue;
            };
            if !section.contains(&row) {
                missing.push(row);
            }
        }
    }
    assert!(missing.is_empty(), "docs/CONFIGURATION.md lacks\n{}", missing.join("\n"));
}

#[test]
fn a_token_is_made_for_the_file_and_its_secret_is_told_once() {
    let directory = tempfile::tempdir().expect("a directory");
    let path = directory.path().join("tokens.toml");
    let mut secrets = Vec::new();
    for (name, holder) in [("server", "alice"), ("learner", "bob")] {
        let mut command = Command::new(program(name));
        command.args([
            "token",
            holder,
            "--scopes",
            "act,fit",
            "--max-sessions",
            "3",
            "--expires-in",
            "90d",
            "--append",
        ]);
        let secret = printed(command.arg(&path));
        assert!(secret.starts_with("mzw_") && secret.trim_end().len() == 47, "{secret}");
        secrets.push(secret.trim_end().to_owned());
    }
    let text = fs::read_to_string(&path).expect("a file");
    let tokens = mazeway_serving::tokens::Tokens::parse(&text).expect("it reads");
    for (secret, name) in secrets.iter().zip(["alice", "bob"]) {
        assert!(!text.contains(secret.as_str()));
        let grant = tokens.find(secret.as_bytes()).expect("it is known");
        assert_eq!((grant.name.as_str(), grant.quotas.max_sessions), (name, Some(3)));
    }
    // Without a file, the entry is for whoever asks.
    let shown = printed(Command::new(program("server")).args(["token", "carol", "--scopes", "record"]));
    let (secret, entry) = shown.split_once("\n\n").expect("a secret and an entry");
    let tokens = mazeway_serving::tokens::Tokens::parse(entry).expect("it reads");
    assert_eq!(tokens.find(secret.as_bytes()).expect("it is known").name, "carol");
    let mut twice = Command::new(program("server"));
    let output = twice.args(["token", "alice", "--scopes", "act", "--append"]).arg(&path).output().expect("runs");
    let error = String::from_utf8(output.stderr).expect("text");
    assert!(output.status.code() == Some(1) && error.lines().count() == 2, "{error}");
    assert!(error.contains("\"alice\" is there already"), "{error}");
}
