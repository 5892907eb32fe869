//! The whole run, from a server at rest to a server at rest.

use crate::{
    load::{Kind, Process, Share},
    probe,
    report::{Crowd, Ends, Report},
    server::{Echo, Server, Taken},
};
use rustix::thread::{CpuSet, sched_setaffinity};
use std::{
    io,
    path::PathBuf,
    process::{Command, Stdio},
    thread::sleep,
    time::{Duration, Instant},
};

/// What the load is: 2,000 sessions on 200 connections.
const SHARES: [(Kind, usize); 4] = [(Kind::Idle, 100), (Kind::Stepping, 60), (Kind::Silent, 20), VANISHING];
const VANISHING: (Kind, usize) = (Kind::Vanishing, 20);
/// Sessions of a connection.
const SESSIONS: usize = 10;
/// Lease of all sessions of the load.
const LEASE: Duration = Duration::from_secs(15);
/// Longest that those who vanish are there.
const VANISH: Duration = Duration::from_secs(20);
/// How long the loads before and after the long one last.
const SHORT: Duration = Duration::from_secs(3);
/// Longest that the load may take to stand, and the leases and the connections of the dead to end.
const PATIENCE: Duration = Duration::from_mins(1);
/// Threads for blocking work go after ten idle seconds, and the allocator gives back what is unused meanwhile.
const REST: Duration = Duration::from_secs(11);

/// What is to be done.
#[derive(Debug, Clone)]
pub struct Plan {
    /// The binary `server`.
    pub server: PathBuf,
    /// The program of this crate.
    pub soak: PathBuf,
    /// How long the load lasts.
    pub time: Duration,
    /// The server on the first core, all else on the second: as if on two machines.
    pub pinned: bool,
}

impl Plan {
    /// How long the probe looks at a server without load.
    pub fn quiet(&self) -> Duration {
        self.time.clamp(Duration::from_secs(2), Duration::from_secs(20))
    }

    /// Has this process, and those that it starts and does not send elsewhere, run on the second core where it is pinned, and
    /// this one before all others there: the client that is timed stands for one on a machine of its own, and would wait for
    /// the load's turn on its core up to the next tick of the scheduler. Returns whether it may.
    pub fn take_place(&self) -> io::Result<bool> {
        if !self.pinned {
            return Ok(false);
        }
        let mut second = CpuSet::new();
        second.set(1);
        sched_setaffinity(None, &second)?;
        let mut chrt = Command::new("chrt");
        chrt.args(["--reset-on-fork", "--fifo", "--pid", "1", &std::process::id().to_string()]).stderr(Stdio::null());
        Ok(chrt.status()?.success())
    }
}

/// The load, with what vanishes and comes anew.
struct Load<'a> {
    plan: &'a Plan,
    server: &'a Server,
    steady: Vec<Process>,
    vanishing: Process,
    frozen: Vec<Process>,
    since: Instant,
}

impl<'a> Load<'a> {
    /// Starts it and waits until it stands: all sessions are in use.
    fn start(plan: &'a Plan, server: &'a Server) -> io::Result<Self> {
        let start = |&kind: &(Kind, usize)| share(kind).start(&plan.soak, &server.address, plan.pinned);
        let mut all = SHARES.iter().map(start).collect::<io::Result<Vec<_>>>()?;
        for process in &mut all {
            process.ready()?;
        }
        let wanted = SHARES.iter().map(|(_, connections)| connections * SESSIONS).sum::<usize>() as f64;
        let begun = Instant::now();
        loop {
            let used = server.numbers()?.get("mazeway_server_calls_open")?;
            if used >= wanted {
                break;
            }
            if begun.elapsed() > PATIENCE {
                let message = format!("expected {wanted} sessions in use after {PATIENCE:?}, got {used}");
                return Err(io::Error::other(message));
            }
            sleep(Duration::from_millis(100));
        }
        let vanishing = all.pop().ok_or(io::ErrorKind::InvalidInput)?;
        Ok(Self { plan, server, steady: all, vanishing, frozen: Vec::new(), since: Instant::now() })
    }

    /// Those who vanish do, when it is time, and others come in their place. All others are to be there.
    fn turn(&mut self) -> io::Result<()> {
        for process in self.steady.iter_mut().chain([&mut self.vanishing]) {
            process.check()?;
        }
        if self.since.elapsed() < VANISH {
            return Ok(());
        }
        self.since = Instant::now();
        self.vanishing.freeze()?;
        // Those of the turn before are long gone for the server.
        self.frozen.clear();
        let next = share(VANISHING).start(&self.plan.soak, &self.server.address, self.plan.pinned)?;
        self.frozen.push(std::mem::replace(&mut self.vanishing, next));
        Ok(())
    }
}

fn share((kind, connections): (Kind, usize)) -> Share {
    Share { kind, connections, sessions: SESSIONS, lease: LEASE }
}

/// Waits until nothing of the load is left, and says what the server takes then.
fn settled(server: &Server) -> io::Result<Taken> {
    let begun = Instant::now();
    loop {
        let numbers = server.numbers()?;
        let left = (numbers.get("mazeway_server_sessions")?, numbers.get("mazeway_server_connections")?);
        if left == (0.0, 0.0) {
            sleep(REST);
            return server.taken();
        }
        if begun.elapsed() > PATIENCE {
            let (sessions, connections) = left;
            let message = format!(
                "expected nothing left over {PATIENCE:?} after the load, got {sessions} sessions and {connections} \
                 connections"
            );
            return Err(io::Error::other(message));
        }
        sleep(Duration::from_millis(200));
    }
}

/// A load of a few seconds, and what the server takes when it has gone.
fn short(plan: &Plan, server: &Server) -> io::Result<Taken> {
    let load = Load::start(plan, server)?;
    sleep(SHORT);
    drop(load);
    settled(server)
}

/// Runs the plan.
///
/// # Errors
/// A program does not run; something is left of the load when its leases have run out.
pub fn run(plan: &Plan) -> io::Result<Report> {
    let runtime = tokio::runtime::Builder::new_current_thread().enable_all().build()?;
    let server = Server::start(&plan.server, plan.pinned)?;
    let ahead = plan.take_place()?;
    let bare = {
        let echo = Echo::start(&plan.soak, plan.pinned)?;
        runtime.block_on(probe::echo(&echo.address, plan.quiet()))?
    };
    let unloaded = runtime.block_on(probe::act(&server.address, plan.quiet(), || ()));
    let fresh = settled(&server)?;
    let first = short(plan, &server)?;

    let mut load = Load::start(plan, &server)?;
    let begun = Instant::now();
    let (steps, processor) = (server.numbers()?.get("mazeway_server_steps_total")?, server.processor_secs()?);
    let (mut peak, mut peak_sessions, mut crowd, mut failed) = (Taken::default(), 0.0, Crowd::default(), None);
    let mut look = || {
        let (numbers, taken) = (server.numbers()?, server.taken()?);
        let sessions = numbers.get("mazeway_server_sessions")?;
        crowd.add(sessions, numbers.get("mazeway_server_calls_open")?, numbers.get("mazeway_server_connections")?);
        if taken.resident > peak.resident {
            peak_sessions = sessions;
        }
        peak = Taken {
            resident: peak.resident.max(taken.resident),
            own: peak.own.max(taken.own),
            files: peak.files.max(taken.files),
        };
        load.turn()
    };
    let loaded = runtime.block_on(probe::act(&server.address, plan.time, || {
        if let Err(error) = look() {
            failed.get_or_insert(error);
        }
    }));
    if let Some(error) = failed {
        return Err(error);
    }
    let load_secs = begun.elapsed().as_secs_f64();
    let steps_a_second = (server.numbers()?.get("mazeway_server_steps_total")? - steps) / load_secs;
    let busy = (server.processor_secs()? - processor) / load_secs;
    drop(load);
    let after = settled(&server)?;
    let again = short(plan, &server)?;

    let numbers = server.numbers()?;
    let ends = Ends {
        created: numbers.get("mazeway_server_sessions_created_total")?,
        // The load closes nothing, and each of the two probes what it made.
        closed: 2.0,
        expired: numbers.get("mazeway_server_sessions_expired_total")?,
    };
    let pinned = plan.pinned;
    Ok(Report {
        bare,
        unloaded,
        loaded,
        fresh,
        first,
        peak,
        after,
        again,
        peak_sessions,
        crowd,
        ends,
        steps_a_second,
        busy,
        load_secs,
        pinned,
        ahead,
    })
}
