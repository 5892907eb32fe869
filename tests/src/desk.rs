//! The command `learner` over a data directory of its own, as a person uses it who works there: files are named without their path,
//! and nothing of the machine's settings gets in.

use crate::programs::program;
use serde_json::Value;
use std::process::Command;
use tempfile::TempDir;

/// The command, in the directory.
pub fn learner(data: &TempDir, arguments: &[&str]) -> Command {
    let mut command = Command::new(program("learner"));
    for (name, _) in std::env::vars().filter(|(name, _)| name.starts_with("MAZEWAY_") || name == "RUST_LOG") {
        command.env_remove(name);
    }
    command.current_dir(data.path()).args(arguments).args(["--data", "store"]);
    command
}

/// What it says on standard output; it complains of nothing.
///
/// # Panics
/// It fails, or complains.
pub fn said(data: &TempDir, arguments: &[&str]) -> String {
    let output = learner(data, arguments).output().expect("a process");
    let complaint = String::from_utf8_lossy(&output.stderr);
    assert!(output.status.success() && complaint.is_empty(), "{arguments:?}: {complaint}");
    String::from_utf8(output.stdout).expect("text")
}

/// The same with `--json`.
///
/// # Panics
/// As [`said`], or that is no JSON.
pub fn object(data: &TempDir, arguments: &[&str]) -> Value {
    let text = said(data, &[arguments, &["--json"]].concat());
    serde_json::from_str(&text).unwrap_or_else(|error| panic!("{error}: {text}"))
}

/// The `error:` line of a command that failed and may have told of its way until there; a `hint:` line follows it.
///
/// # Panics
/// It does not fail, or says otherwise.
pub fn failed(data: &TempDir, arguments: &[&str], code: i32) -> String {
    told(data, arguments, code).1
}

/// The same of a command that was refused before it did anything: nothing is on standard output.
///
/// # Panics
/// As [`failed`], or something was said.
pub fn refused(data: &TempDir, arguments: &[&str], code: i32) -> String {
    let (output, error) = told(data, arguments, code);
    assert!(output.is_empty(), "{arguments:?}");
    error
}

/// Standard output, and the error of the two lines on standard error.
fn told(data: &TempDir, arguments: &[&str], code: i32) -> (Vec<u8>, String) {
    let output = learner(data, arguments).output().expect("a process");
    let said = String::from_utf8(output.stderr).expect("text");
    assert_eq!(output.status.code(), Some(code), "{arguments:?}: {said}");
    let lines = said.lines().collect::<Vec<_>>();
    let [error, hint] = lines[..] else { panic!("expected two lines, got {said:?}") };
    assert!(hint.starts_with("hint: ") && hint.len() > 10, "{said:?}");
    let error = error.strip_prefix("error: ").unwrap_or_else(|| panic!("expected an error, got {said:?}"));
    (output.stdout, error.to_owned())
}
