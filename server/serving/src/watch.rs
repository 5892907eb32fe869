//! Watches over connections and calls from outside, once a second or so, so that none of them pays for a timer.
//!
//! Ended are: a connection that says nothing, one that has no call for long, one that gives up calls faster than anybody
//! needs; a stream whose reader takes nothing of what is ready for it, and whatever was begun with a token that holds no
//! more. A stream is ended by ending its task, as the transport asks a stalled one for nothing more.
//!
//! A call that needs nothing, health or open reflection, is no use of a connection: it keeps none from being idle, and ends
//! once its connection is told to go. Where tokens are asked for, a connection on which nobody has shown one is a
//! stranger's; of those there are at most a share for longer than a handshake may take, and the oldest go first. So nobody
//! can fill the house who was not let in, and health stays open to everybody.

use crate::{caller::Caller, config::DoorConfig};
use slab::Slab;
use std::{
    sync::{
        Arc, Mutex, OnceLock, PoisonError, Weak,
        atomic::{AtomicBool, AtomicU32, AtomicU64, AtomicUsize, Ordering},
    },
    time::{Duration, Instant, SystemTime},
};
use tokio::task::AbortHandle;
use tokio_util::sync::CancellationToken;
use tracing::Span;

/// Most time between two looks.
const LONGEST_PAUSE: Duration = Duration::from_secs(1);
/// Least time between two looks.
const SHORTEST_PAUSE: Duration = Duration::from_millis(20);
/// Bytes of large answers of one connection that may wait for their reader; beyond, its next call is refused.
const MAX_HELD_BYTES: usize = 64 << 20;
/// Calls of one connection at a time that need nothing: a health stream for each service and more.
const MAX_OPEN_CALLS: usize = 32;
/// One in so many connections may be a stranger's.
const STRANGERS_SHARE: usize = 4;
/// [`Call::owed`] where the transport waits for the service, and not the service for the transport.
const NOTHING_OWED: u64 = u64::MAX;

/// All connections and calls of a service, and the time, which is read from memory.
#[derive(Debug)]
pub struct Watch {
    begun: Instant,
    /// Milliseconds since it began, as of the last look.
    now_ms: AtomicU64,
    handshake_ms: u64,
    idle_ms: u64,
    stall_ms: u64,
    max_resets: u32,
    /// Strangers' connections at a time, beyond those that have just come; all may be where no tokens are asked for.
    max_strangers: usize,
    pause: Duration,
    visits: Mutex<Slab<Weak<Visit>>>,
    calls: Mutex<Slab<Weak<Call>>>,
}

fn lock<T>(mutex: &Mutex<T>) -> std::sync::MutexGuard<'_, T> {
    mutex.lock().unwrap_or_else(PoisonError::into_inner)
}

impl Watch {
    /// Nobody is there yet.
    pub fn new(config: &DoorConfig) -> Arc<Self> {
        let ms = |duration: Duration| u64::try_from(duration.as_millis()).unwrap_or(u64::MAX);
        let shortest = config.handshake_timeout.min(config.idle_timeout).min(config.stall_timeout);
        Arc::new(Self {
            begun: Instant::now(),
            now_ms: AtomicU64::new(0),
            handshake_ms: ms(config.handshake_timeout),
            idle_ms: ms(config.idle_timeout),
            stall_ms: ms(config.stall_timeout),
            max_resets: config.max_resets_per_second,
            max_strangers: match config.tokens {
                Some(_) => (config.max_connections / STRANGERS_SHARE).max(1),
                None => usize::MAX,
            },
            pause: (shortest / 4).clamp(SHORTEST_PAUSE, LONGEST_PAUSE),
            visits: Mutex::default(),
            calls: Mutex::default(),
        })
    }

    /// Time between two looks.
    pub fn pause(&self) -> Duration {
        self.pause
    }

    fn now_ms(&self) -> u64 {
        self.now_ms.load(Ordering::Relaxed)
    }

    /// A connection has come. `leave` is what tells it to go.
    pub fn visit(self: &Arc<Self>, leave: CancellationToken) -> Arc<Visit> {
        let mut visits = lock(&self.visits);
        let entry = visits.vacant_entry();
        let now = self.now_ms();
        let visit = Arc::new(Visit {
            watch: Arc::clone(self),
            key: entry.key(),
            spoken: Arc::default(),
            calls: AtomicUsize::new(0),
            open_calls: AtomicUsize::new(0),
            known: AtomicBool::new(false),
            came_ms: now,
            used_ms: AtomicU64::new(now),
            resets: AtomicU32::new(0),
            held: AtomicUsize::new(0),
            at_once: AtomicBool::new(false),
            leave,
            next_task: Mutex::new(None),
            certified: OnceLock::new(),
        });
        entry.insert(Arc::downgrade(&visit));
        visit
    }

    /// Looks once.
    pub fn look(&self) {
        let now = u64::try_from(self.begun.elapsed().as_millis()).unwrap_or(u64::MAX);
        self.now_ms.store(now, Ordering::Relaxed);
        // Held while they are looked at, and let go outside of the lock, which their end takes.
        let visits: Vec<_> = lock(&self.visits).iter().filter_map(|(_, visit)| visit.upgrade()).collect();
        let mut strangers = Vec::new();
        for visit in &visits {
            visit.resets.store(0, Ordering::Relaxed);
            let unused = now.saturating_sub(visit.used_ms.load(Ordering::Relaxed));
            if !visit.spoken.load(Ordering::Relaxed) && unused > self.handshake_ms {
                tracing::debug!("a connection that said nothing is closed");
                visit.end_at_once();
            } else if visit.calls.load(Ordering::Relaxed) == 0 && unused > self.idle_ms {
                tracing::debug!("a connection without a call is closed");
                visit.leave.cancel();
            } else if visit.is_stranger() && now.saturating_sub(visit.came_ms) > self.handshake_ms {
                strangers.push(visit);
            }
        }
        if strangers.len() > self.max_strangers {
            strangers.sort_unstable_by_key(|visit| visit.came_ms);
            for visit in &strangers[..strangers.len() - self.max_strangers] {
                tracing::debug!("a connection on which nobody has shown a token makes room");
                visit.leave.cancel();
            }
        }
        let wall = SystemTime::now();
        let calls: Vec<_> = lock(&self.calls).iter().filter_map(|(_, call)| call.upgrade()).collect();
        for call in calls {
            let owed = call.owed.load(Ordering::Relaxed);
            if owed != NOTHING_OWED && now.saturating_sub(owed) > self.stall_ms {
                call.span.in_scope(|| tracing::info!("a stream that nobody reads is ended"));
                call.end();
            } else if !call.caller.holds(wall) {
                call.span.in_scope(|| tracing::info!("a call whose token holds no more is ended"));
                call.end();
            }
        }
    }
}

/// One connection.
#[derive(Debug)]
pub struct Visit {
    watch: Arc<Watch>,
    key: usize,
    /// True once its peer has greeted.
    spoken: Arc<AtomicBool>,
    /// Calls that were let in because of who makes them.
    calls: AtomicUsize,
    /// Calls that need nothing.
    open_calls: AtomicUsize,
    /// A call was let in because of who makes it.
    known: AtomicBool,
    came_ms: u64,
    /// When it came, or the last call ended that was let in because of who made it.
    used_ms: AtomicU64,
    /// Calls given up since the last look.
    resets: AtomicU32,
    /// Bytes of large answers that wait for their reader.
    held: AtomicUsize,
    at_once: AtomicBool,
    leave: CancellationToken,
    /// Where the handle of the next task that the transport starts goes: it starts one for every call, right after it.
    next_task: Mutex<Option<Arc<Fate>>>,
    certified: OnceLock<Caller>,
}

impl Visit {
    /// What becomes true once its peer has greeted.
    pub fn spoken(&self) -> Arc<AtomicBool> {
        Arc::clone(&self.spoken)
    }

    /// What tells it to go.
    pub fn leave(&self) -> &CancellationToken {
        &self.leave
    }

    /// Whether it may not even end its calls.
    pub fn is_ended_at_once(&self) -> bool {
        self.at_once.load(Ordering::Relaxed)
    }

    fn end_at_once(&self) {
        self.at_once.store(true, Ordering::Relaxed);
        self.leave.cancel();
    }

    /// A large answer begins to wait for its reader.
    pub fn holds(&self, bytes: usize) {
        self.held.fetch_add(bytes, Ordering::Relaxed);
    }

    /// A part of it waits no more.
    pub fn gives(&self, bytes: usize) {
        self.held.fetch_sub(bytes, Ordering::Relaxed);
    }

    /// Whether so much waits for the peer that it may ask for no more.
    pub fn holds_too_much(&self) -> bool {
        self.held.load(Ordering::Relaxed) > MAX_HELD_BYTES
    }

    /// Its peer has shown a certificate.
    pub fn certify(&self, caller: Caller) {
        let _ = self.certified.set(caller);
    }

    /// Whom the peer's certificate names.
    pub fn certified(&self) -> Option<&Caller> {
        self.certified.get()
    }

    /// Whether nobody on it has shown who they are.
    fn is_stranger(&self) -> bool {
        !self.known.load(Ordering::Relaxed) && self.certified.get().is_none() && !self.leave.is_cancelled()
    }

    /// Whether it has so many calls that need nothing that there may be no more.
    pub fn has_enough_open_calls(&self) -> bool {
        self.open_calls.load(Ordering::Relaxed) >= MAX_OPEN_CALLS
    }

    /// A call begins; the task that the transport starts next is its own. What is told of it belongs to `span`.
    pub fn call(self: &Arc<Self>, caller: Caller, standing: Standing, span: Span) -> Arc<Call> {
        match standing {
            Standing::Admitted => {
                self.calls.fetch_add(1, Ordering::Relaxed);
                self.known.store(true, Ordering::Relaxed);
            }
            Standing::Open => {
                self.open_calls.fetch_add(1, Ordering::Relaxed);
            }
            Standing::Refused => {}
        }
        let fate = Arc::new(Fate::default());
        *lock(&self.next_task) = Some(Arc::clone(&fate));
        let mut calls = lock(&self.watch.calls);
        let entry = calls.vacant_entry();
        let call = Arc::new(Call {
            visit: Arc::clone(self),
            key: entry.key(),
            caller,
            standing,
            span,
            owed: AtomicU64::new(NOTHING_OWED),
            complete: AtomicBool::new(false),
            fate,
        });
        entry.insert(Arc::downgrade(&call));
        call
    }

    /// The transport has started a task.
    pub fn started(&self, task: AbortHandle) {
        if let Some(slot) = lock(&self.next_task).take() {
            let _ = slot.task.set(task);
        }
    }
}

impl Drop for Visit {
    fn drop(&mut self) {
        lock(&self.watch.visits).try_remove(self.key);
    }
}

/// Why a call is inside.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Standing {
    /// Because of who makes it.
    Admitted,
    /// It needs nothing.
    Open,
    /// It is not: its answer says why.
    Refused,
}

/// What becomes of a call, as those know who read its request and write its answer.
#[derive(Debug, Default)]
pub struct Fate {
    task: OnceLock<AbortHandle>,
    gone: AtomicBool,
}

impl Fate {
    /// Its caller has gone in the middle of the request.
    pub fn goes(&self) {
        self.gone.store(true, Ordering::Relaxed);
    }

    /// Whether its caller has gone in the middle of the request.
    pub fn is_gone(&self) -> bool {
        self.gone.load(Ordering::Relaxed)
    }
}

/// One call, from its request to the end of its answer.
#[derive(Debug)]
pub struct Call {
    visit: Arc<Visit>,
    key: usize,
    caller: Caller,
    standing: Standing,
    span: Span,
    /// Since when the transport holds a part of the answer that it could not send on; [`NOTHING_OWED`] where it waits for
    /// one.
    owed: AtomicU64,
    /// The answer is complete, or was ended by the service.
    complete: AtomicBool,
    fate: Arc<Fate>,
}

impl Call {
    /// The connection that it came by.
    pub fn visit(&self) -> &Visit {
        &self.visit
    }

    /// What becomes of it.
    pub fn fate(&self) -> &Arc<Fate> {
        &self.fate
    }

    /// The transport took a part of the answer.
    pub fn took(&self) {
        self.owed.store(self.visit.watch.now_ms(), Ordering::Relaxed);
    }

    /// The transport asked for more and waits for it.
    pub fn waits(&self) {
        self.owed.store(NOTHING_OWED, Ordering::Relaxed);
    }

    /// The answer is complete.
    pub fn completes(&self) {
        self.complete.store(true, Ordering::Relaxed);
    }

    fn end(&self) {
        self.completes();
        if let Some(task) = self.fate.task.get() {
            task.abort();
        }
    }
}

impl Drop for Call {
    fn drop(&mut self) {
        let (visit, watch) = (&self.visit, &self.visit.watch);
        lock(&watch.calls).try_remove(self.key);
        match self.standing {
            Standing::Admitted => {
                visit.used_ms.store(watch.now_ms(), Ordering::Relaxed);
                visit.calls.fetch_sub(1, Ordering::Relaxed);
            }
            Standing::Open => {
                visit.open_calls.fetch_sub(1, Ordering::Relaxed);
            }
            Standing::Refused => {}
        }
        if !self.complete.load(Ordering::Relaxed)
            && visit.resets.fetch_add(1, Ordering::Relaxed) >= watch.max_resets
            && !visit.is_ended_at_once()
        {
            tracing::warn!(caller = self.caller.name(), "a connection that gives up calls without end is closed");
            visit.end_at_once();
        }
    }
}
