//! The other end: a process that says where it listens, killed when it is no longer needed.

use crate::Setting;
use std::{
    io::{BufRead as _, BufReader},
    process::{Child, Command, Stdio},
};

/// A running process.
#[derive(Debug)]
pub struct Process {
    child: Child,
    address: String,
}

impl Process {
    /// Runs a command until it has said where it listens.
    pub fn start(command: &mut Command) -> Self {
        let mut child = command.stdin(Stdio::null()).stdout(Stdio::piped()).spawn().expect("a process");
        let mut line = String::new();
        BufReader::new(child.stdout.take().expect("a pipe")).read_line(&mut line).expect("a line");
        let address = line.trim().strip_prefix("listening on ").unwrap_or_default().to_owned();
        assert!(!address.is_empty(), "{command:?}: expected its address, got {line:?}");
        Self { child, address }
    }

    /// The binary `server`, without limits that would get in the way.
    pub fn server(setting: &Setting, listen: &str) -> Self {
        let mut command = Command::new(&setting.server);
        command.args(["--listen", listen, "--max-envs-per-session", "65536", "--max-total-envs", "1000000"]);
        command.args(["--max-sessions", "20000", "--max-connections", "20000", "--default-lease-secs", "3000"]);
        command.args(["--spin-micros", &setting.spin_micros.to_string()]);
        for (name, _) in std::env::vars().filter(|(name, _)| name.starts_with("MAZEWAY_")) {
            command.env_remove(name);
        }
        Self::start(&mut command)
    }

    /// What it said.
    pub fn address(&self) -> &str {
        &self.address
    }

    /// Resident bytes.
    pub fn resident(&self) -> f64 {
        let status = std::fs::read_to_string(format!("/proc/{}/status", self.child.id())).expect("a running process");
        let line = status.lines().find_map(|line| line.strip_prefix("VmRSS:")).expect("its size");
        line.trim().trim_end_matches(" kB").parse::<f64>().expect("a number") * 1024.0
    }
}

impl Drop for Process {
    fn drop(&mut self) {
        // It may be dead already.
        let _ = self.child.kill();
        let _ = self.child.wait();
    }
}
