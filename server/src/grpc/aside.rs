//! What a stream listens to beside its requests, at no cost to them.
//!
//! Asking a timer, a channel and a shutdown whether they are ready takes locks. So they wake a bell instead of the task: as
//! long as it has not rung, none of them is asked.

use futures_util::task::AtomicWaker;
use std::{
    future::poll_fn,
    sync::{
        Arc,
        atomic::{AtomicBool, Ordering},
    },
    task::{Context, Poll, Wake, Waker},
};

/// Wakes the task that listens, and remembers that it did.
#[derive(Default)]
struct Bell {
    rung: AtomicBool,
    task: AtomicWaker,
}

impl Wake for Bell {
    fn wake(self: Arc<Self>) {
        self.wake_by_ref();
    }

    fn wake_by_ref(self: &Arc<Self>) {
        self.rung.store(true, Ordering::Release);
        self.task.wake();
    }
}

/// The bell and the waker that rings it.
pub struct Aside {
    bell: Arc<Bell>,
    waker: Waker,
}

impl Aside {
    /// Has rung, so that everything is asked once.
    pub fn new() -> Self {
        let bell = Arc::new(Bell { rung: AtomicBool::new(true), task: AtomicWaker::new() });
        Self { waker: Waker::from(Arc::clone(&bell)), bell }
    }

    /// Has the task of `cx` woken when the bell rings. True where it has rung: then everything is to be asked, in the
    /// context of [`Self::waker`], until it is pending.
    pub fn has_rung(&self, cx: &Context<'_>) -> bool {
        // First the task, then the question: a bell that rings in between wakes it.
        self.bell.task.register(cx.waker());
        self.bell.rung.swap(false, Ordering::AcqRel)
    }

    /// Waits until it rings.
    pub async fn rung(&self) {
        poll_fn(|cx| if self.has_rung(cx) { Poll::Ready(()) } else { Poll::Pending }).await;
    }

    /// Rings the bell.
    pub fn waker(&self) -> &Waker {
        &self.waker
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use futures_util::task::noop_waker;

    #[test]
    fn it_asks_once_and_again_when_it_has_rung() {
        let aside = Aside::new();
        let task = noop_waker();
        let cx = Context::from_waker(&task);
        assert!(aside.has_rung(&cx));
        assert!(!aside.has_rung(&cx));
        aside.waker().wake_by_ref();
        aside.waker().wake_by_ref();
        assert!(aside.has_rung(&cx));
        assert!(!aside.has_rung(&cx));
    }
}
