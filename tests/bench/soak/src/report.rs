//! What was seen of a run, and what it should have been.

use crate::{probe::Waits, server::Taken};
use serde_json::{Value, json};
use std::fmt::{self, Write as _};

/// Most that the p99 of a step may be under load, in medians of one without, on a machine that does nothing else.
pub const MOST_MEDIANS: f64 = 5.0;
/// Fewest sessions that are there while the load is: 2,000 are wanted, of which a few may have been lost at any moment and
/// not have come back yet.
const FEWEST_SESSIONS: f64 = 1950.0;
/// Most that a session may take, its part of a connection and of what is unread included.
const SESSION_BYTES: f64 = 96.0 * 1024.0;
/// Heap and stacks that loads may leave beyond what a fresh server has. Of the 4 to 8 MiB that they do leave more than a half
/// are the caches that the allocator keeps for every thread and the pages that their pieces hold on to. Without them
/// (`_RJEM_MALLOC_CONF=tcache:false`) 3 MiB are left, of tables that grew to the size of the load and keep it, and these are
/// the same to 0.03 MiB after each of several loads.
const LEFT_BYTES: f64 = 12.0 * 1024.0 * 1024.0;
/// Heap and stacks that a further load may leave beyond what the long one left: what leaks would grow with every load, while
/// what those caches hold varies by so much.
const GROWTH_BYTES: f64 = 2.0 * 1024.0 * 1024.0;

/// What is said where the client that is timed may not run before its load.
pub const NOT_AHEAD: &str =
    "this machine gives no real-time priority: steps under load also waited for the load on their core\n";

/// What the server said of the load while it was there.
#[derive(Debug, Clone, Copy, Default)]
pub struct Crowd {
    /// How often it was asked.
    pub samples: usize,
    /// Fewest sessions.
    pub sessions_least: f64,
    /// Sessions on the average.
    pub sessions_mean: f64,
    /// Open calls on the average: of a session that is in use, one.
    pub calls_mean: f64,
    /// Most connections, those of the dead included.
    pub connections_most: f64,
}

impl Crowd {
    /// It said so.
    pub fn add(&mut self, sessions: f64, calls: f64, connections: f64) {
        self.samples += 1;
        let share = 1.0 / self.samples as f64;
        self.sessions_least = if self.samples == 1 { sessions } else { self.sessions_least.min(sessions) };
        self.sessions_mean += (sessions - self.sessions_mean) * share;
        self.calls_mean += (calls - self.calls_mean) * share;
        self.connections_most = self.connections_most.max(connections);
    }
}

/// How sessions ended.
#[derive(Debug, Clone, Copy, Default)]
pub struct Ends {
    /// Sessions made in all.
    pub created: f64,
    /// Those that their owners ended.
    pub closed: f64,
    /// Those that their leases ended.
    pub expired: f64,
}

/// What was seen.
#[derive(Debug, Clone)]
pub struct Report {
    /// Waits for a bare socket.
    pub bare: Waits,
    /// For a step, without load.
    pub unloaded: Waits,
    /// For a step, under load.
    pub loaded: Waits,
    /// What the server took after its first client,
    pub fresh: Taken,
    /// after a load of a few seconds,
    pub first: Taken,
    /// at most,
    pub peak: Taken,
    /// after the long load,
    pub after: Taken,
    /// and after one more of a few seconds.
    pub again: Taken,
    /// Sessions when it took most.
    pub peak_sessions: f64,
    /// Sessions and connections meanwhile.
    pub crowd: Crowd,
    /// How they ended.
    pub ends: Ends,
    /// Steps of the load.
    pub steps_a_second: f64,
    /// Cores that the server used under load.
    pub busy: f64,
    /// How long the load lasted.
    pub load_secs: f64,
    /// The server had a core of its own.
    pub pinned: bool,
    /// The client that was timed ran before the load on the other.
    pub ahead: bool,
}

impl Report {
    /// The p99 of a step under load, in medians of one without.
    pub fn ratio(&self) -> f64 {
        self.loaded.p99 / self.unloaded.median
    }

    /// Bytes that a session of the load takes with its part of a connection.
    pub fn bytes_a_session(&self) -> f64 {
        (self.peak.resident - self.fresh.resident) / self.peak_sessions
    }

    /// Where it is not what it should be. A p99 under load of `most_medians` is what it should be.
    pub fn missed(&self, most_medians: f64) -> Vec<String> {
        let mut missed = Vec::new();
        let mut expect = |is: bool, what: fmt::Arguments<'_>| {
            if !is {
                missed.push(what.to_string());
            }
        };
        let (ratio, Crowd { sessions_least: least, calls_mean, .. }) = (self.ratio(), self.crowd);
        expect(
            ratio <= most_medians,
            format_args!("p99 under load: expected at most {most_medians} medians without, got {ratio:.1}"),
        );
        expect(
            least >= FEWEST_SESSIONS,
            format_args!("sessions: expected never less than {FEWEST_SESSIONS}, got {least}"),
        );
        // Those that vanished are in the server's sessions for longer than in its calls.
        expect(
            calls_mean >= FEWEST_SESSIONS,
            format_args!("sessions in use: expected {FEWEST_SESSIONS} on the average, got {calls_mean:.0}"),
        );
        let kib = |bytes: f64| bytes / 1024.0;
        let (a_session, most) = (kib(self.bytes_a_session()), kib(SESSION_BYTES));
        expect(a_session <= most, format_args!("memory: expected at most {most} KiB a session, got {a_session:.1}"));
        let left = self.again.own.max(self.after.own) - self.fresh.own;
        expect(
            left <= LEFT_BYTES,
            format_args!("memory: expected at most {:.0} KiB left over, got {:.0}", kib(LEFT_BYTES), kib(left)),
        );
        let growth = self.again.own - self.after.own;
        expect(
            growth <= GROWTH_BYTES,
            format_args!("memory: expected at most {:.0} KiB more a load, got {:.0}", kib(GROWTH_BYTES), kib(growth)),
        );
        let (files, fresh) = (self.again.files.max(self.after.files), self.fresh.files);
        expect(files <= fresh, format_args!("open files: expected {fresh} as before the load, got {files}"));
        let Ends { created, closed, expired } = self.ends;
        expect(
            expired == created - closed,
            format_args!("leases: expected {created} made less {closed} closed to run out, got {expired}"),
        );
        missed
    }

    /// One object for programs.
    pub fn to_json(&self) -> Value {
        let taken = |taken: &Taken| json!({"resident_bytes": taken.resident, "heap_and_stacks_bytes": taken.own, "files": taken.files});
        let (Crowd { samples, sessions_least, sessions_mean, calls_mean, connections_most }, ends) =
            (self.crowd, self.ends);
        json!({
            "benchmark": "soak", "pinned": self.pinned, "ahead": self.ahead, "load_secs": self.load_secs,
            "bare": self.bare.to_json(), "unloaded": self.unloaded.to_json(), "loaded": self.loaded.to_json(),
            "ratio": self.ratio(), "steps_a_second": self.steps_a_second, "busy_cores": self.busy,
            "samples": samples, "sessions_least": sessions_least, "sessions_mean": sessions_mean,
            "calls_mean": calls_mean, "connections_most": connections_most,
            "created": ends.created, "closed": ends.closed, "expired": ends.expired,
            "fresh": taken(&self.fresh), "first": taken(&self.first), "peak": taken(&self.peak),
            "after": taken(&self.after), "again": taken(&self.again), "peak_sessions": self.peak_sessions,
            "bytes_a_session": self.bytes_a_session(),
        })
    }

    /// Tables for people.
    pub fn tables(&self) -> String {
        let rows =
            [("bare socket, without load", &self.bare), ("without load", &self.unloaded), ("under load", &self.loaded)];
        let mut text = waits_table(&rows);
        if self.pinned && !self.ahead {
            text.push_str(NOT_AHEAD);
        }
        let (median, p99) = (self.unloaded.median, self.loaded.p99);
        let _ = writeln!(
            text,
            "p99 under load is {p99:.0} µs, {:.1} times the median without of {median:.0} µs",
            self.ratio()
        );
        let (secs, steps, busy) = (self.load_secs, self.steps_a_second, self.busy);
        let _ = writeln!(text, "load: {secs:.0} s, {steps:.0} steps a second, {busy:.2} cores of the server");
        let Crowd { samples, sessions_least, sessions_mean, calls_mean, connections_most } = self.crowd;
        let _ = writeln!(
            text,
            "sessions: at least {sessions_least}, {sessions_mean:.0} on the average of {samples} looks, {calls_mean:.0} \
             of them in use; at most {connections_most} connections"
        );
        let _ = writeln!(text, "{:<28}{:>15}{:>18}{:>7}", "server", "resident, MiB", "heap and stacks", "files");
        let states = [
            ("fresh", self.fresh),
            ("after a first load", self.first),
            ("peak", self.peak),
            ("after the load", self.after),
            ("after another load", self.again),
        ];
        let mib = |bytes: f64| bytes / f64::from(1 << 20);
        for (name, Taken { resident, own, files }) in states {
            let _ = writeln!(text, "{name:<28}{:>15.1}{:>18.1}{files:>7}", mib(resident), mib(own));
        }
        let (a_session, Ends { created, closed, expired }) = (self.bytes_a_session() / 1024.0, self.ends);
        let _ = writeln!(
            text,
            "a session takes {a_session:.1} KiB; of {created} sessions {closed} were closed and {expired} ran out"
        );
        text
    }
}

/// A table of waits by name.
pub fn waits_table(rows: &[(&str, &Waits)]) -> String {
    let mut text =
        format!("{:<28}{:>10}{:>10}{:>10}{:>10}{:>10}\n", "step, µs", "steps", "median", "p99", "p99.9", "most");
    for (name, Waits { steps, median, p99, p999, most }) in rows {
        let _ = writeln!(text, "{name:<28}{steps:>10}{median:>10.0}{p99:>10.0}{p999:>10.0}{most:>10.0}");
    }
    text
}
