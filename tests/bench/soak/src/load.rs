//! The load, a kind a process. Each makes its sessions, says so on a line, and goes on until it is killed.

use clap::ValueEnum;
use mazeway_client::{Connection, Env, SessionOptions};
use mazeway_proto::env::{self as pb, interact_request::Request};
use std::{
    io::Write as _,
    process::{Child, ChildStdout, Command, Stdio},
    time::Duration,
};
use tokio::{task::JoinSet, time::sleep};

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

fn options(lease: Duration) -> SessionOptions {
    SessionOptions { max_episode_steps: Some(0), lease: Some(lease), ..SessionOptions::default() }
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
        let mut envs = Vec::new();
        for _ in 0..self.connections {
            let connection = Connection::open(&address).await.expect("a connection");
            for _ in 0..self.sessions {
                envs.push(Env::create(&connection, "Maze-v0", options(self.lease)).await.expect("a session"));
            }
        }
        let mut tasks = JoinSet::new();
        for env in envs {
            match self.kind {
                Kind::Idle => tasks.spawn(idle(env, self.lease)),
                Kind::Stepping | Kind::Vanishing => tasks.spawn(stepping(env)),
                Kind::Silent => tasks.spawn(silent(address.clone(), env)),
            };
        }
        // Let all of them reset.
        sleep(Duration::from_millis(500)).await;
        println!("ready");
        let _ = std::io::stdout().flush();
        while let Some(task) = tasks.join_next().await {
            task.expect("load that goes on");
        }
    }
}

async fn idle(mut env: Env, lease: Duration) {
    env.reset(Some(1)).await.expect("resets");
    loop {
        sleep(lease / 3).await;
        // On a machine that is too busy to let it act in time the lease runs out.
        if env.step(0).await.is_err() {
            return;
        }
    }
}

async fn stepping(mut env: Env) {
    env.reset(Some(1)).await.expect("resets");
    for action in (0..4).cycle() {
        // A server that is under load may end what it likes; a session that is lost stays lost.
        if env.step(action).await.is_err() {
            return;
        }
    }
}

/// Sends ahead and never reads: on a connection of its own, whose window the unread answers would take from others.
async fn silent(address: String, env: Env) {
    let (session_id, channel) =
        (env.session_id().to_owned(), mazeway_client::channel(&address).await.expect("connects"));
    let reset = pb::ResetRequest { session_id, ..Default::default() };
    let step = pb::StepRequest { actions: 1_u32.to_le_bytes().to_vec().into(), ..Default::default() };
    let steps = std::iter::repeat_with(move || Request::Step(step.clone()));
    let requests = std::iter::once(Request::Reset(reset)).chain(steps);
    let requests = tokio_stream::iter(requests.map(|request| pb::InteractRequest { request: Some(request) }));
    let mut client = pb::environment_service_client::EnvironmentServiceClient::new(channel);
    let answers = client.interact(requests).await.expect("a stream");
    std::future::pending::<()>().await;
    drop((answers, env));
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
