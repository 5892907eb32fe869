//! The programs `server` and `learner` as processes, built from the present sources in the tests' own profile.

use mazeway_bench_program::{cargo, profile};
use std::{
    env,
    io::{BufRead as _, BufReader},
    path::{Path, PathBuf},
    process::{Child, Command, Stdio},
    sync::OnceLock,
};

/// The path of `server` or `learner`.
///
/// # Panics
/// It does not build.
pub fn program(name: &str) -> PathBuf {
    static DIRECTORY: OnceLock<PathBuf> = OnceLock::new();
    let directory = DIRECTORY.get_or_init(|| {
        let own = env::current_exe().expect("a path of this test");
        let profile = profile(own.ancestors().nth(2).expect("a profile's directory"));
        let mut cargo = cargo();
        cargo.args(["build", "--quiet", "--workspace", "--bin", "server", "--bin", "learner", "--profile", profile]);
        // With a test among the targets, dependencies have the features that they have in `cargo test --workspace`: what
        // that has built need not be built again.
        cargo.args(["--test", "kill"]);
        cargo.args(["--message-format", "json-render-diagnostics"]).current_dir(env!("CARGO_MANIFEST_DIR"));
        let output = cargo.stderr(Stdio::inherit()).output().expect("cargo");
        assert!(output.status.success(), "{cargo:?}: {}", output.status);
        String::from_utf8_lossy(&output.stdout)
            .lines()
            .filter_map(|line| serde_json::from_str::<serde_json::Value>(line).ok())
            .filter(|message| message["target"]["kind"][0] == "bin")
            .filter_map(|message| Some(PathBuf::from(message.get("executable")?.as_str()?)))
            .find_map(|program| Some(program.parent()?.to_path_buf()))
            .expect("the path of a program")
    });
    directory.join(format!("{name}{}", env::consts::EXE_SUFFIX))
}

/// A service as a process of its own; killed when dropped.
#[derive(Debug)]
pub struct Service {
    child: Child,
    address: String,
}

impl Service {
    /// `learner serve` on a free port over a directory.
    pub fn learner(data: &Path) -> Self {
        let mut command = Command::new(program("learner"));
        command.args(["serve", "--listen", "127.0.0.1:0", "--data"]).arg(data);
        Self::start(command)
    }

    /// `server` on a free port.
    pub fn server() -> Self {
        Self::server_at("127.0.0.1:0")
    }

    /// `server` at an address: `unix:PATH` for a Unix socket.
    pub fn server_at(address: &str) -> Self {
        let mut command = Command::new(program("server"));
        command.args(["--listen", address]);
        Self::start(command)
    }

    /// Runs a command that says where it listens.
    ///
    /// # Panics
    /// It does not.
    pub fn start(mut command: Command) -> Self {
        let mut child = command.stdin(Stdio::null()).stdout(Stdio::piped()).spawn().expect("a process");
        let stdout = child.stdout.take().expect("a pipe");
        let mut line = String::new();
        BufReader::new(stdout).read_line(&mut line).expect("a line");
        let address = line.trim().strip_prefix("listening on ").unwrap_or_default().to_owned();
        assert!(!address.is_empty(), "{command:?}: expected its address, got {line:?}");
        Self { child, address }
    }

    /// Its process id.
    pub fn pid(&self) -> u32 {
        self.child.id()
    }

    /// Where it listens.
    pub fn address(&self) -> &str {
        &self.address
    }

    /// Its process.
    pub fn id(&self) -> u32 {
        self.child.id()
    }

    /// Ends it as a power cut would: SIGKILL, no chance to tidy up.
    ///
    /// # Panics
    /// It is no more.
    pub fn kill(mut self) {
        self.child.kill().expect("a process to kill");
        self.child.wait().expect("a process to wait for");
    }
}

impl Drop for Service {
    fn drop(&mut self) {
        // It may be dead already.
        let _ = self.child.kill();
        let _ = self.child.wait();
    }
}
