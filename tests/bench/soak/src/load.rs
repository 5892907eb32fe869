//! The load, a kind a process. Each makes its sessions, says so on a line, and goes on until it is killed.

use crate::acting::{Place, keep};
use clap::ValueEnum;
use std::{
    io::Write as _,
    process::{Child, ChildStdout, Command, Stdio},
    time::Duration,
};
use tokio::{
    task::{JoinSet, LocalSet},
    time::sleep,
};

/// What the sessions of a process do.
#[derive(Debug, Clone, Copy, PartialEq, Eq, ValueEnum)]
pub enum Kind {
    /// A step now and then, before their leases run out.
    Idle,
    /// A step as soon as the last is answered.
    Stepping,
    /// Steps sent ahead for ever, and no answer read.
    Silent,
    /// As stepping, until the process is stopped where it stands.
    Vanishing,
}

/// One process.
#[derive(Debug, Clone, Copy)]
pub struct Share {
    /// What its sessions do.
    pub kind: Kind,
    /// How many connections it has.
    pub connections: usize,
    /// How many sessions each of them has.
    pub sessions: usize,
    /// How long the sessions outlive their last use.
    pub lease: Duration,
}

impl Share {
    /// Starts the process and waits until all its sessions are there. `soak` is the program that is part of this crate.
    ///
    /// # Errors
    /// It does not start, or does not come so far.
    pub fn start(&self, soak: &std::path::Path, address: &str, pinned: bool) -> std::io::Result<Process> {
        let mut command = Command::new("chrt");
        command.args(["--idle", "0"]);
        if pinned {
            command.args(["taskset", "-c", "1"]);
        }
        command.arg(soak).args(["load", "--address", address]);
        let kind = self.kind.to_possible_value().ok_or(std::io::ErrorKind::InvalidInput)?;
        command.args(["--kind", kind.get_name(), "--connections", &self.connections.to_string()]);
        command.args(["--sessions", &self.sessions.to_string(), "--lease-secs", &self.lease.as_secs().to_string()]);
        let mut child = command.stdin(Stdio::null()).stdout(Stdio::piped()).spawn()?;
        let output = child.stdout.take();
        Ok(Process { child, output })
    }

    /// Makes the sessions and uses them, for ever.
    pub async fn run(self, address: String) {
        // All are there before the first acts: it would be in the way of the others.
        let mut all = Vec::new();
        for _ in 0..self.connections {
            let place = Place::open(&address, self.lease).await;
            for _ in 0..self.sessions {
                all.push((place.clone(), place.session().await));
            }
        }
        let going_on = async {
            let mut tasks = JoinSet::new();
            for (place, env) in all {
                tasks.spawn_local(keep(self.kind, place, env));
            }
            // Let all of them reset.
            sleep(Duration::from_millis(500)).await;
            println!("ready");
            let _ = std::io::stdout().flush();
            while let Some(task) = tasks.join_next().await {
                task.expect("load that goes on");
            }
        };
        LocalSet::new().run_until(going_on).await;
    }
}

/// A running process of the load, killed when it is dropped.
#[derive(Debug)]
pub struct Process {
    child: Child,
    output: Option<ChildStdout>,
}

impl Process {
    /// Waits until it has made its sessions.
    ///
    /// # Errors
    /// It ended before.
    pub fn ready(&mut self) -> std::io::Result<()> {
        use std::io::BufRead as _;
        let Some(output) = self.output.take() else { return Ok(()) };
        let mut line = String::new();
        std::io::BufReader::new(output).read_line(&mut line)?;
        if line.trim() == "ready" { Ok(()) } else { Err(std::io::Error::other("the load ended before it began")) }
    }

    /// Looks whether it is still there.
    ///
    /// # Errors
    /// It has ended.
    pub fn check(&mut self) -> std::io::Result<()> {
        match self.child.try_wait()? {
            None => Ok(()),
            Some(status) => Err(std::io::Error::other(format!("a process of the load has ended: {status}"))),
        }
    }

    /// Stops it where it stands: its connections stay open and say nothing any more.
    ///
    /// # Errors
    /// There is no such program as `kill`.
    pub fn freeze(&self) -> std::io::Result<()> {
        let status = Command::new("kill").args(["-STOP", &self.child.id().to_string()]).status()?;
        if status.success() { Ok(()) } else { Err(std::io::Error::other("the load had ended")) }
    }
}

impl Drop for Process {
    fn drop(&mut self) {
        // It may be dead already.
        let _ = self.child.kill();
        let _ = self.child.wait();
    }
}
