//! What viewers see of a session, without being in its way.
//!
//! A viewer leaves a wish with the session, and whoever has the session grants it with a copy of the environment's state: its
//! owner between two steps, or [`super::Sessions::look`] itself where nobody has it. What has not changed since the viewer's
//! last look is not shown again: such a wish waits for the next step or reset.
//!
//! Invariants: where nobody looks, all this costs a step is one look at a flag; what is drawn is drawn elsewhere, from the
//! copy; a wish whose viewer has gone is forgotten. Deliberately absent: pictures, frames a second, limits on viewers.

use crate::batch::{Batch, BatchError, Moment, Picture};
use std::{
    fmt, mem,
    sync::{
        Mutex, MutexGuard, PoisonError,
        atomic::{AtomicBool, Ordering},
    },
    task::Waker,
};

/// An environment as it stands, and how far it has come.
pub struct Glance {
    /// When this is.
    pub moment: Moment,
    /// What there is to see.
    pub picture: Box<dyn Picture>,
}

impl fmt::Debug for Glance {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.debug_struct("Glance").field("moment", &self.moment).finish_non_exhaustive()
    }
}

/// Somebody who looks, once.
pub trait Viewer: Send {
    /// True where nobody waits any more.
    fn has_gone(&self) -> bool;
    /// Takes what was wished for, or learns that there is no such environment.
    fn see(self: Box<Self>, glance: Result<Glance, BatchError>);
}

/// A wish for a look. Dropped where the session ends before it could be granted.
pub struct Wish {
    /// At which environment.
    pub index: usize,
    /// [`Moment::changes`] of what the viewer has seen already.
    pub seen: Option<u64>,
    /// Who looks.
    pub viewer: Box<dyn Viewer>,
}

impl Wish {
    /// What there is for the viewer; `None` as long as it has to wait.
    fn glance(&self, batch: &dyn Batch) -> Option<Result<Glance, BatchError>> {
        let moment = match batch.moment(self.index) {
            Ok(moment) if self.seen == Some(moment.changes) => return None,
            Ok(moment) => moment,
            Err(BatchError::NeverReset) => return None,
            Err(error) => return Some(Err(error)),
        };
        Some(batch.picture(self.index).map(|picture| Glance { moment, picture }))
    }
}

/// The side of a session that viewers see.
#[derive(Default)]
pub(super) struct Sight {
    /// True while there are wishes: all that a step looks at.
    wanted: AtomicBool,
    state: Mutex<State>,
}

#[derive(Default)]
struct State {
    wishes: Vec<Wish>,
    /// Wakes whoever has the session and may be waiting for something else.
    owner: Option<Waker>,
}

impl Sight {
    fn lock(&self) -> MutexGuard<'_, State> {
        self.state.lock().unwrap_or_else(PoisonError::into_inner)
    }

    /// Leaves a wish, and wakes the owner so that it looks for it.
    pub fn wish(&self, wish: Wish) {
        let mut state = self.lock();
        state.wishes.retain(|wish| !wish.viewer.has_gone());
        state.wishes.push(wish);
        self.wanted.store(true, Ordering::Release);
        let owner = state.owner.clone();
        drop(state);
        if let Some(owner) = owner {
            owner.wake();
        }
    }

    /// Grants what can be granted.
    #[inline]
    pub fn show(&self, batch: &dyn Batch) {
        if self.wanted.load(Ordering::Acquire) {
            self.grant(batch);
        }
    }

    #[cold]
    fn grant(&self, batch: &dyn Batch) {
        let mut granted = Vec::new();
        let mut state = self.lock();
        for wish in mem::take(&mut state.wishes) {
            match wish.glance(batch) {
                Some(glance) => granted.push((wish.viewer, glance)),
                None => state.wishes.push(wish),
            }
        }
        self.wanted.store(!state.wishes.is_empty(), Ordering::Release);
        drop(state);
        for (viewer, glance) in granted {
            viewer.see(glance);
        }
    }

    /// Says how the present owner is woken.
    pub fn set_owner(&self, owner: Option<Waker>) {
        self.lock().owner = owner;
    }

    /// The session is over: nobody will see anything any more.
    pub fn end(&self) {
        let mut state = self.lock();
        let wishes = mem::take(&mut state.wishes);
        self.wanted.store(false, Ordering::Release);
        drop(state);
        drop(wishes);
    }
}
