//! The whole run, from a server at rest to a server at rest.

use crate::{
    load::{Kind, Process, Share},
    probe::{self, Waits},
    server::{Echo, Server, Taken},
};
use rustix::thread::{CpuSet, sched_setaffinity};
use serde_json::{Value, json};
use std::{
    fmt::Write as _,
    io,
    path::PathBuf,
    time::{Duration, Instant},
};

/// What the load is, by default: 2,000 sessions on 200 connections.
const SHARES: [(Kind, usize); 4] = [(Kind::Idle, 100), (Kind::Stepping, 60), (Kind::Silent, 20), (Kind::Vanishing, 20)];
/// Sessions of a connection.
const SESSIONS: usize = 10;
/// Lease of all sessions of the load.
const LEASE: Duration = Duration::from_secs(15);
/// Longest that those who vanish are there.
const VANISH: Duration = Duration::from_secs(20);
/// Load before the memory is looked at for the first time: the allocator has then what it keeps.
const WARM_UP: Duration = Duration::from_secs(3);
/// Longest that the leases and the connections of the dead may take to end.
const PATIENCE: Duration = Duration::from_mins(1);

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

/// What was seen.
#[derive(Debug, Clone)]
pub struct Report {
    bare: Waits,
    unloaded: Waits,
    loaded: Waits,
    fresh: Taken,
    before: Taken,
    peak: Taken,
    after: Taken,
    sessions: f64,
    steps_a_second: f64,
    busy: f64,
    load_secs: f64,
    expired: f64,
    pinned: bool,
}

impl Report {
    /// The p99 of a step under load, in medians of one without.
    pub fn ratio(&self) -> f64 {
        self.loaded.p99 / self.unloaded.median
    }

    /// Bytes that a session of the load takes with its part of a connection.
    pub fn bytes_a_session(&self) -> f64 {
        (self.peak.resident - self.fresh.resident) / self.sessions
    }

    /// Bytes that the second load left behind beyond what the first did.
    pub fn bytes_left(&self) -> f64 {
        self.after.resident - self.before.resident
    }

    /// Files that were open before the load, and after it.
    pub fn files(&self) -> (usize, usize) {
        (self.before.files, self.after.files)
    }

    /// One object for programs.
    pub fn to_json(&self) -> Value {
        let waits = |waits: &Waits| {
            json!({"steps": waits.steps, "median_us": waits.median, "p99_us": waits.p99, "p999_us": waits.p999,
                   "most_us": waits.most})
        };
        let taken = |taken: &Taken| json!({"resident_bytes": taken.resident, "files": taken.files});
        json!({
            "benchmark": "soak", "pinned": self.pinned, "load_secs": self.load_secs, "sessions": self.sessions,
            "bare": waits(&self.bare), "unloaded": waits(&self.unloaded), "loaded": waits(&self.loaded), "ratio": self.ratio(),
            "steps_a_second": self.steps_a_second, "busy_cores": self.busy, "expired": self.expired,
            "fresh": taken(&self.fresh), "before": taken(&self.before), "peak": taken(&self.peak),
            "after": taken(&self.after), "bytes_a_session": self.bytes_a_session(),
        })
    }

    /// Tables for people.
    pub fn tables(&self) -> String {
        let mut text = String::new();
        let _ = writeln!(
            text,
            "{:<28}{:>10}{:>10}{:>10}{:>10}{:>10}",
            "step, µs", "steps", "median", "p99", "p99.9", "most"
        );
        for (name, waits) in
            [("bare socket, without load", &self.bare), ("without load", &self.unloaded), ("under load", &self.loaded)]
        {
            let Waits { steps, median, p99, p999, most } = waits;
            let _ = writeln!(text, "{name:<28}{steps:>10}{median:>10.0}{p99:>10.0}{p999:>10.0}{most:>10.0}");
        }
        let _ = writeln!(text, "p99 under load is {:.1} times the median without", self.ratio());
        let (sessions, steps, busy) = (self.sessions, self.steps_a_second, self.busy);
        let _ = writeln!(text, "load: {sessions} sessions, {steps:.0} steps a second, {busy:.2} cores of the server");
        let _ = writeln!(text, "{:<28}{:>14}{:>10}", "server", "resident, MiB", "files");
        let states =
            [("fresh", self.fresh), ("after a first load", self.before), ("peak", self.peak), ("after", self.after)];
        for (name, Taken { resident, files }) in states {
            let _ = writeln!(text, "{name:<28}{:>14.1}{files:>10}", resident / f64::from(1 << 20));
        }
        let _ = writeln!(
            text,
            "a session takes {:.1} KiB; {} leases ran out",
            self.bytes_a_session() / 1024.0,
            self.expired
        );
        text
    }
}

/// The load, with what vanishes and comes anew.
struct Load<'a> {
    plan: &'a Plan,
    address: &'a str,
    _steady: Vec<Process>,
    vanishing: Process,
    frozen: Vec<Process>,
    since: Instant,
}

impl<'a> Load<'a> {
    fn start(plan: &'a Plan, address: &'a str) -> io::Result<Self> {
        let start =
            |&(kind, connections): &(Kind, usize)| share(kind, connections).start(&plan.soak, address, plan.pinned);
        let mut all = SHARES.iter().map(start).collect::<io::Result<Vec<_>>>()?;
        for process in &mut all {
            process.ready()?;
        }
        let vanishing = all.pop().ok_or(io::ErrorKind::InvalidInput)?;
        Ok(Self { plan, address, _steady: all, vanishing, frozen: Vec::new(), since: Instant::now() })
    }

    /// Those who vanish do, when it is time, and others come in their place.
    fn turn(&mut self) -> io::Result<()> {
        if self.since.elapsed() < VANISH {
            return Ok(());
        }
        self.since = Instant::now();
        self.vanishing.freeze()?;
        // Those of the turn before are long gone for the server.
        self.frozen.clear();
        let (kind, connections) = SHARES[3];
        let next = share(kind, connections).start(&self.plan.soak, self.address, self.plan.pinned)?;
        self.frozen.push(std::mem::replace(&mut self.vanishing, next));
        Ok(())
    }
}

fn share(kind: Kind, connections: usize) -> Share {
    Share { kind, connections, sessions: SESSIONS, lease: LEASE }
}

/// Waits until nothing of the load is left, and says what the server takes then.
fn settled(server: &Server) -> io::Result<Taken> {
    let begun = Instant::now();
    loop {
        let left = (server.number("mazeway_server_sessions")?, server.number("mazeway_server_connections")?);
        if left == (0.0, 0.0) {
            // Threads for blocking work go after ten idle seconds.
            std::thread::sleep(Duration::from_secs(11));
            return server.taken();
        }
        if begun.elapsed() > PATIENCE {
            return Err(io::Error::other(format!("{left:?} sessions and connections are left after {PATIENCE:?}")));
        }
        std::thread::sleep(Duration::from_millis(200));
    }
}

/// Runs the plan.
///
/// # Errors
/// A program does not run; something is left of the load when its leases have run out.
pub fn run(plan: &Plan) -> io::Result<Report> {
    let runtime = tokio::runtime::Builder::new_current_thread().enable_all().build()?;
    let server = Server::start(&plan.server, plan.pinned)?;
    let quiet = plan.time.clamp(Duration::from_secs(2), Duration::from_secs(20));
    if plan.pinned {
        let mut second = CpuSet::new();
        second.set(1);
        sched_setaffinity(None, &second)?;
    }
    let bare = {
        let echo = Echo::start(&plan.soak, plan.pinned)?;
        runtime.block_on(probe::echo(&echo.address, quiet))?
    };
    let unloaded = runtime.block_on(probe::act(&server.address, quiet, || ()));
    let fresh = settled(&server)?;
    {
        let _load = Load::start(plan, &server.address)?;
        std::thread::sleep(WARM_UP);
    }
    let before = settled(&server)?;
    let mut load = Load::start(plan, &server.address)?;
    let sessions = server.number("mazeway_server_sessions")?;
    let (begun, steps, processor) =
        (Instant::now(), server.number("mazeway_server_steps_total")?, server.processor_secs()?);
    let (mut peak, mut failed) = (server.taken()?, None);
    let loaded = runtime.block_on(probe::act(&server.address, plan.time, || {
        let mut look = || {
            let taken = server.taken()?;
            peak = Taken { resident: peak.resident.max(taken.resident), files: peak.files.max(taken.files) };
            load.turn()
        };
        if let Err(error) = look() {
            failed.get_or_insert(error);
        }
    }));
    if let Some(error) = failed {
        return Err(error);
    }
    let secs = begun.elapsed().as_secs_f64();
    let steps_a_second = (server.number("mazeway_server_steps_total")? - steps) / secs;
    let busy = (server.processor_secs()? - processor) / secs;
    drop(load);
    let after = settled(&server)?;
    let expired = server.number("mazeway_server_sessions_expired_total")?;
    let pinned = plan.pinned;
    Ok(Report {
        bare,
        unloaded,
        loaded,
        fresh,
        before,
        peak,
        after,
        sessions,
        steps_a_second,
        busy,
        load_secs: secs,
        expired,
        pinned,
    })
}
