//! Sessions: batches that live on the server under a lease, by unguessable ids.
//!
//! Invariants: limits are checked before anything is allocated; a batch is owned by one caller at a time, who takes it
//! out of its slot and whose [`Guard`] puts it back, so that no step waits for a lock; a session outlives its last use
//! by its lease and no longer. Deliberately absent: transports, clocks (callers pass the time) and timers (someone calls
//! [`Sessions::reap`]).

mod sight;

pub use sight::{Glance, Viewer, Wish};

use crate::batch::Batch;
use sight::Sight;
use std::{
    collections::{HashMap, VecDeque},
    fmt,
    ops::{Deref, DerefMut},
    sync::{Arc, Mutex, MutexGuard, PoisonError},
    task::Waker,
    time::{Duration, Instant},
};

/// Expired ids remembered, so that their callers learn what happened.
const REMEMBERED_IDS: usize = 1024;

/// What all sessions together may take.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Limits {
    /// Sessions at a time.
    pub max_sessions: usize,
    /// Environments of one session.
    pub max_envs_per_session: usize,
    /// Environments of all sessions.
    pub max_total_envs: usize,
    /// Lease of a session that asks for none.
    pub default_lease: Duration,
    /// Longest lease.
    pub max_lease: Duration,
}

/// Name of a session: 128 random bits, 32 hexadecimal digits.
#[derive(Clone, Copy, PartialEq, Eq, Hash)]
pub struct SessionId(u128);

impl SessionId {
    fn random() -> Result<Self, SessionError> {
        let mut bits = [0; 16];
        getrandom::fill(&mut bits).map_err(|error| SessionError::Entropy(error.to_string()))?;
        Ok(Self(u128::from_le_bytes(bits)))
    }

    /// Reads what [`fmt::Display`] wrote; `None` for anything else.
    pub fn parse(text: &str) -> Option<Self> {
        let plain = text.len() == 32 && text.bytes().all(|b| matches!(b, b'0'..=b'9' | b'a'..=b'f'));
        if plain { u128::from_str_radix(text, 16).ok().map(Self) } else { None }
    }
}

impl fmt::Display for SessionId {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "{:032x}", self.0)
    }
}

impl fmt::Debug for SessionId {
    /// Shows too little to take the session over from a log.
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "SessionId({:08x}…)", self.0 >> 96)
    }
}

/// Who has sessions, and how much of them. Another's session is as unknown to it as one that never was.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Holder {
    /// Its name; nobody else has it.
    pub name: Arc<str>,
    /// Sessions that it may have at a time; `None`: as many as the server has room for.
    pub max_sessions: Option<usize>,
    /// Environments that all its sessions may have.
    pub max_envs: Option<usize>,
}

impl Holder {
    /// Anybody, where nobody is asked who he is.
    pub fn anybody() -> Self {
        Self { name: "".into(), max_sessions: None, max_envs: None }
    }
}

/// Why a session cannot be had.
#[derive(Debug, Clone, PartialEq, thiserror::Error)]
pub enum SessionError {
    /// No such session.
    #[error("no such session")]
    Unknown,
    /// The lease ran out.
    #[error("the session's lease has expired")]
    Expired,
    /// Another call owns it.
    #[error("the session is in use by another call or stream")]
    Busy,
    /// A limit is reached.
    #[error("expected at most {limit} {what}, asked for {asked}{}", if *.shared { " more" } else { "" })]
    Limit {
        /// Field of the request that asks for it.
        field: &'static str,
        /// Of what.
        what: &'static str,
        /// The limit.
        limit: u64,
        /// What was asked for; with what the caller has already, unless the limit is shared.
        asked: u64,
        /// Whether others share the limit. How much of it they have is not told.
        shared: bool,
    },
    /// A lease outside the bounds.
    #[error("expected a lease above 0 and at most {max_secs} s, got {got_secs} s")]
    Lease {
        /// The longest.
        max_secs: f64,
        /// What came.
        got_secs: f64,
    },
    /// The operating system gave no random numbers.
    #[error("no random session id from the operating system: {0}")]
    Entropy(String),
}

/// What lives in a slot.
struct Slot {
    /// `None` while a [`Guard`] owns it.
    batch: Option<Box<dyn Batch>>,
    /// What reaches the owner of a batch that is taken, if it listens.
    owner: Option<OwnerHandle>,
    sight: Arc<Sight>,
    /// Pictures a second at which it looks natural.
    render_fps: u32,
    holder: Arc<str>,
    num_envs: usize,
    lease: Duration,
    expires: Instant,
}

/// Lets others reach the owner of a taken session; whatever the adapter needs.
pub type OwnerHandle = Arc<dyn std::any::Any + Send + Sync>;

/// How many sessions there have been.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub struct Tally {
    /// Made.
    pub created: u64,
    /// Ended by their leases.
    pub expired: u64,
}

#[derive(Default)]
struct Inner {
    slots: HashMap<SessionId, Slot>,
    total_envs: usize,
    tally: Tally,
    /// Sessions and environments of each holder that has any.
    held: HashMap<Arc<str>, (usize, usize)>,
    expired: VecDeque<(SessionId, Arc<str>)>,
}

impl Inner {
    fn remove(&mut self, id: SessionId) -> Option<Arc<str>> {
        let slot = self.slots.remove(&id)?;
        self.total_envs -= slot.num_envs;
        slot.sight.end();
        if let Some((sessions, envs)) = self.held.get_mut(&slot.holder) {
            *sessions -= 1;
            *envs -= slot.num_envs;
            if *sessions == 0 {
                self.held.remove(&slot.holder);
            }
        }
        Some(slot.holder)
    }

    fn expire(&mut self, id: SessionId) {
        let Some(holder) = self.remove(id) else { return };
        self.tally.expired += 1;
        if self.expired.len() == REMEMBERED_IDS {
            self.expired.pop_front();
        }
        self.expired.push_back((id, holder));
    }

    /// The slot of a session, if it is of `holder`; whoever asks for none was let in before.
    fn slot(&mut self, id: SessionId, holder: Option<&str>, now: Instant) -> Result<&mut Slot, SessionError> {
        let is_of = |of: &str| holder.is_none_or(|holder| holder == of);
        // A lease counts from the last use: what is taken is in use.
        if self.slots.get(&id).is_some_and(|slot| slot.batch.is_some() && slot.expires <= now) {
            self.expire(id);
        }
        if self.slots.get(&id).is_some_and(|slot| is_of(&slot.holder)) {
            Ok(self.slots.get_mut(&id).expect("just seen"))
        } else if self.expired.iter().any(|(expired, of)| *expired == id && is_of(of)) {
            Err(SessionError::Expired)
        } else {
            Err(SessionError::Unknown)
        }
    }
}

/// All sessions of a server.
pub struct Sessions {
    limits: Limits,
    inner: Mutex<Inner>,
}

impl fmt::Debug for Sessions {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.debug_struct("Sessions").field("limits", &self.limits).field("len", &self.len()).finish_non_exhaustive()
    }
}

impl Sessions {
    /// No session yet.
    pub fn new(limits: Limits) -> Self {
        Self { limits, inner: Mutex::default() }
    }

    fn lock(&self) -> MutexGuard<'_, Inner> {
        self.inner.lock().unwrap_or_else(PoisonError::into_inner)
    }

    /// Number of sessions.
    pub fn len(&self) -> usize {
        self.lock().slots.len()
    }

    /// Number of environments of all sessions.
    pub fn total_envs(&self) -> usize {
        self.lock().total_envs
    }

    /// How many sessions there have been.
    pub fn tally(&self) -> Tally {
        self.lock().tally
    }

    /// True while the session lives, its lease run out or not.
    pub fn contains(&self, id: SessionId) -> bool {
        self.lock().slots.contains_key(&id)
    }

    /// True where there is none.
    pub fn is_empty(&self) -> bool {
        self.len() == 0
    }

    /// Creates a session of `num_envs` environments for `holder`, made by `make` once the limits allow it.
    ///
    /// # Errors
    /// A limit, a lease out of bounds, no randomness.
    pub fn create(
        &self,
        holder: &Holder,
        num_envs: usize,
        lease: Option<Duration>,
        now: Instant,
        make: impl FnOnce() -> Box<dyn Batch>,
    ) -> Result<(SessionId, Duration), SessionError> {
        let Limits { max_sessions, max_envs_per_session, max_total_envs, default_lease, max_lease } = self.limits;
        let lease = lease.unwrap_or(default_lease);
        if lease.is_zero() || lease > max_lease {
            return Err(SessionError::Lease { max_secs: max_lease.as_secs_f64(), got_secs: lease.as_secs_f64() });
        }
        let limit = |field, what, limit: usize, asked: usize| {
            let error = || SessionError::Limit { field, what, limit: limit as u64, asked: asked as u64, shared: false };
            if asked <= limit { Ok(()) } else { Err(error()) }
        };
        let shared = |field, what, limit: usize, used: usize, more: usize| {
            let error = || SessionError::Limit { field, what, limit: limit as u64, asked: more as u64, shared: true };
            if more <= limit.saturating_sub(used) { Ok(()) } else { Err(error()) }
        };
        limit("num_envs", "environments in a session", max_envs_per_session, num_envs)?;
        let id = SessionId::random()?;
        {
            let mut inner = self.lock();
            shared("sessions", "sessions on this server", max_sessions, inner.slots.len(), 1)?;
            shared("num_envs", "environments on this server", max_total_envs, inner.total_envs, num_envs)?;
            let (sessions, envs) = inner.held.get(&holder.name).copied().unwrap_or_default();
            if let Some(max) = holder.max_sessions {
                limit("sessions", "sessions of this caller", max, sessions + 1)?;
            }
            if let Some(max) = holder.max_envs {
                limit("num_envs", "environments of this caller", max, envs.saturating_add(num_envs))?;
            }
            inner.total_envs += num_envs;
            inner.tally.created += 1;
            inner.held.insert(Arc::clone(&holder.name), (sessions + 1, envs + num_envs));
            let (sight, holder, expires) = (Arc::default(), Arc::clone(&holder.name), now + lease);
            let slot = Slot { batch: None, owner: None, sight, render_fps: 1, holder, num_envs, lease, expires };
            inner.slots.insert(id, slot);
        }
        // The slot is reserved: the batch, which may be large, is made without the lock. Should that panic, the slot goes.
        let reserved = Reserved { sessions: self, id };
        let batch = make();
        std::mem::forget(reserved);
        if let Some(slot) = self.lock().slots.get_mut(&id) {
            slot.render_fps = batch.spec().render_fps;
            slot.batch = Some(batch);
        }
        Ok((id, lease))
    }

    /// Takes the batch of a session of `holder` out of its slot until the guard is dropped. `owner` lets others reach the
    /// taker, through [`Self::owner`].
    ///
    /// # Errors
    /// Unknown to this holder, expired or in use.
    pub fn take(
        self: &Arc<Self>,
        id: SessionId,
        holder: &str,
        now: Instant,
        owner: Option<OwnerHandle>,
    ) -> Result<Guard, SessionError> {
        let mut inner = self.lock();
        let slot = inner.slot(id, Some(holder), now)?;
        let batch = slot.batch.take().ok_or(SessionError::Busy)?;
        slot.owner = owner;
        let (lease, sight) = (slot.lease, Arc::clone(&slot.sight));
        Ok(Guard { sessions: Arc::clone(self), id, lease, sight, batch: Some(batch) })
    }

    /// Leaves a wish to see a session, for somebody who may ([`Self::render_fps`] says so). It is granted at once where nobody
    /// has taken the session, else by its taker. Looking is no use of it: its lease runs on.
    ///
    /// # Errors
    /// Unknown or expired.
    pub fn look(&self, id: SessionId, now: Instant, wish: Wish) -> Result<(), SessionError> {
        let mut inner = self.lock();
        let slot = inner.slot(id, None, now)?;
        slot.sight.wish(wish);
        if let Some(batch) = &slot.batch {
            slot.sight.show(&**batch);
        }
        Ok(())
    }

    /// Pictures a second at which a session of `holder` looks natural.
    ///
    /// # Errors
    /// Unknown to this holder, or expired.
    pub fn render_fps(&self, id: SessionId, holder: &str, now: Instant) -> Result<u32, SessionError> {
        Ok(self.lock().slot(id, Some(holder), now)?.render_fps)
    }

    /// What the present taker of a session left to be reached by; `None` where nobody has taken it or left nothing.
    pub fn owner(&self, id: SessionId) -> Option<OwnerHandle> {
        self.lock().slots.get(&id)?.owner.clone()
    }

    /// Ends the sessions whose lease has run out, and says how many they were.
    pub fn reap(&self, now: Instant) -> usize {
        let mut dropped = Vec::new();
        let mut inner = self.lock();
        let due: Vec<_> = inner
            .slots
            .iter()
            .filter(|(_, slot)| slot.batch.is_some() && slot.expires <= now)
            .map(|(id, _)| *id)
            .collect();
        for &id in &due {
            // Batches are freed after the lock.
            dropped.extend(inner.slots.get_mut(&id).and_then(|slot| slot.batch.take()));
            inner.expire(id);
        }
        drop(inner);
        due.len()
    }

    /// When the next session that nobody uses expires.
    pub fn next_expiry(&self) -> Option<Instant> {
        self.lock().slots.values().filter(|slot| slot.batch.is_some()).map(|slot| slot.expires).min()
    }
}

struct Reserved<'a> {
    sessions: &'a Sessions,
    id: SessionId,
}

impl Drop for Reserved<'_> {
    fn drop(&mut self) {
        self.sessions.lock().remove(self.id);
    }
}

/// A session taken by one caller. Dropping it puts the batch back under a fresh lease.
pub struct Guard {
    sessions: Arc<Sessions>,
    id: SessionId,
    lease: Duration,
    sight: Arc<Sight>,
    batch: Option<Box<dyn Batch>>,
}

impl fmt::Debug for Guard {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.debug_struct("Guard").field("id", &self.id).finish_non_exhaustive()
    }
}

impl Guard {
    /// Its session.
    pub fn id(&self) -> SessionId {
        self.id
    }

    /// How long the session outlives its last use.
    pub fn lease(&self) -> Duration {
        self.lease
    }

    /// Lets viewers see the session as it is now. Whoever keeps a session calls this after every change and when woken by what
    /// [`Self::set_waker`] was given; who takes it for a single call need not.
    pub fn show(&self) {
        self.sight.show(&**self);
    }

    /// Has the owner woken where viewers wish to see the session.
    pub fn set_waker(&self, waker: Waker) {
        self.sight.set_owner(Some(waker));
    }

    /// Ends the session.
    pub fn close(mut self) {
        self.batch = None;
        self.sessions.lock().remove(self.id);
    }

    /// Ends the session and remembers that its lease ran out.
    pub fn expire(mut self) {
        self.batch = None;
        self.sessions.lock().expire(self.id);
    }
}

impl Deref for Guard {
    type Target = dyn Batch;

    fn deref(&self) -> &Self::Target {
        self.batch.as_deref().expect("held until dropped")
    }
}

impl DerefMut for Guard {
    fn deref_mut(&mut self) -> &mut Self::Target {
        self.batch.as_deref_mut().expect("held until dropped")
    }
}

impl Drop for Guard {
    fn drop(&mut self) {
        if let Some(batch) = self.batch.take() {
            let mut inner = self.sessions.lock();
            // A batch whose step panicked may be in any state: its session ends.
            if std::thread::panicking() {
                inner.remove(self.id);
            } else if let Some(slot) = inner.slots.get_mut(&self.id) {
                slot.sight.set_owner(None);
                slot.sight.show(&*batch);
                slot.batch = Some(batch);
                slot.owner = None;
                slot.expires = Instant::now() + slot.lease;
            }
        }
    }
}

#[cfg(test)]
mod tests;
