//! The binary `server`: what it prints, what it refuses, how it ends.

use std::{
    io::{BufRead as _, BufReader, Read as _},
    net::TcpStream,
    process::{Child, Command, Stdio},
};

fn server(arguments: &[&str]) -> Command {
    let mut command = Command::new(env!("CARGO_BIN_EXE_server"));
    command.args(arguments).stdout(Stdio::piped()).stderr(Stdio::piped());
    // Settings of whoever runs the tests are none of theirs.
    for (name, _) in std::env::vars().filter(|(name, _)| name.starts_with("MAZEWAY_")) {
        command.env_remove(name);
    }
    command
}

/// Starts a server and reads the line with its address.
fn start(command: &mut Command) -> (Child, String) {
    let mut child = command.spawn().expect("starts");
    let mut line = String::new();
    BufReader::new(child.stdout.as_mut().expect("piped")).read_line(&mut line).expect("a line");
    let address = line.trim_end().strip_prefix("listening on ").expect(&line).to_owned();
    (child, address)
}

fn fails(command: &mut Command) -> (Option<i32>, String) {
    let output = command.output().expect("runs");
    assert!(output.stdout.is_empty(), "{output:?}");
    (output.status.code(), String::from_utf8(output.stderr).expect("text"))
}

#[cfg(unix)]
#[test]
fn it_says_where_it_listens_and_ends_on_a_signal() {
    for signal in ["TERM", "INT"] {
        let (mut child, address) = start(&mut server(&["--listen", "127.0.0.1:0"]));
        assert!(!address.ends_with(":0"), "{address}");
        TcpStream::connect(&address).expect("it listens there");
        let kill = Command::new("kill").args(["-s", signal, &child.id().to_string()]).status().expect("kill runs");
        assert!(kill.success());
        let status = child.wait().expect("ends");
        let mut rest = String::new();
        child.stderr.take().expect("piped").read_to_string(&mut rest).expect("text");
        assert!(status.success() && rest.is_empty(), "SIG{signal}: {status}, {rest}");
    }
}

#[test]
fn settings_come_from_the_environment_too() {
    let (mut child, address) =
        start(server(&[]).env("MAZEWAY_SERVER_LISTEN", "127.0.0.1:0").env("MAZEWAY_SERVER_MAX_SESSIONS", "3"));
    TcpStream::connect(address).expect("it listens there");
    child.kill().expect("ends");
    child.wait().expect("ends");
}

#[test]
fn an_address_that_others_reach_wants_a_word() {
    let (code, text) = fails(&mut server(&["--listen", "0.0.0.0:0"]));
    let lines: Vec<_> = text.lines().collect();
    assert_eq!((code, lines.len()), (Some(2), 2), "{text}");
    assert!(
        lines[0].starts_with("error: 0.0.0.0:0 ") && lines[1].starts_with("hint: ") && lines[1].contains("--insecure")
    );
    let (mut child, address) = start(&mut server(&["--listen", "0.0.0.0:0", "--insecure"]));
    assert!(address.starts_with("0.0.0.0:"), "{address}");
    child.kill().expect("ends");
    child.wait().expect("ends");
}

#[test]
fn a_port_in_use_is_an_error_with_a_hint() {
    let (mut child, address) = start(&mut server(&["--listen", "127.0.0.1:0"]));
    let (code, text) = fails(&mut server(&["--listen", &address]));
    assert_eq!(code, Some(1), "{text}");
    assert!(text.starts_with(&format!("error: cannot listen on {address}: ")) && text.contains("\nhint: "), "{text}");
    child.kill().expect("ends");
    child.wait().expect("ends");
}

#[cfg(unix)]
#[test]
fn a_unix_socket_is_private_survives_a_crash_and_goes_at_the_end() {
    use std::os::unix::{fs::PermissionsExt as _, net::UnixStream};
    let path = std::env::temp_dir().join(format!("mazeway-binary-{}.sock", std::process::id()));
    let listen = format!("unix:{}", path.display());
    let (mut child, address) = start(&mut server(&["--listen", &listen]));
    assert_eq!(address, listen);
    UnixStream::connect(&path).expect("it listens there");
    assert_eq!(path.metadata().expect("a socket").permissions().mode() & 0o777, 0o600);
    let (code, text) = fails(&mut server(&["--listen", &listen]));
    assert_eq!(code, Some(1), "{text}");
    assert!(text.starts_with(&format!("error: cannot listen on {listen}: ")) && text.contains("\nhint: "), "{text}");
    // A power cut leaves the socket behind; the next server takes its place.
    child.kill().expect("ends");
    child.wait().expect("ends");
    assert!(path.exists());
    let (mut child, _) = start(&mut server(&["--listen", &listen]));
    UnixStream::connect(&path).expect("it listens there");
    let kill = Command::new("kill").args(["-s", "TERM", &child.id().to_string()]).status().expect("kill runs");
    assert!(kill.success() && child.wait().expect("ends").success());
    assert!(!path.exists(), "the socket stays behind");
    let (code, text) = fails(&mut server(&["--listen", "unix:"]));
    assert_eq!(code, Some(2), "{text}");
}

#[test]
fn wrong_arguments_exit_with_2() {
    for wrong in [&["--port", "1"][..], &["--listen", "nowhere"], &["--default-lease-secs", "-3"], &["extra"]] {
        let (code, text) = fails(&mut server(wrong));
        assert_eq!(code, Some(2), "{text}");
        let lines: Vec<_> = text.lines().collect();
        assert!(
            matches!(lines[..], [error, hint] if error.starts_with("error: ") && hint.starts_with("hint: ")),
            "{text}"
        );
    }
}
