//! A worker that has just been asked something looks for more for a moment before it sleeps.
//!
//! To wake a thread on a halted core takes several times as long as a step does (docs/PERFORMANCE.md). Where one request
//! follows another within that moment, nobody needs to be woken. Where it was looked in vain, or another thread wanted the
//! core, the next requests are slept for, ever more of them, so that what comes rarely, or from a client on the worker's own
//! core, costs next to nothing.
//!
//! Invariants: a worker looks only after bytes have come, no longer than it was told to, and only when none of its tasks and
//! no other thread of the core is ready; nothing here is shared between threads.

use std::{
    cell::{Cell, RefCell},
    future::poll_fn,
    task::{Poll, Waker},
    thread,
    time::{Duration, Instant},
};
use tokio::task::yield_now;

/// However often it was looked in vain, it is looked again after two to this power of reads.
const MOST_IN_VAIN: u32 = 10;
/// Where giving way takes longer, somebody else was there.
const SOMEBODY: Duration = Duration::from_micros(3);

/// Reads of a thread that brought something.
struct Reads {
    count: Cell<u64>,
    /// The read that somebody waits for.
    awaited: Cell<u64>,
    waker: RefCell<Option<Waker>>,
}

thread_local! {
    static READS: Reads =
        const { Reads { count: Cell::new(0), awaited: Cell::new(u64::MAX), waker: RefCell::new(None) } };
}

/// Bytes have come in on this thread.
pub(crate) fn read() {
    READS.with(|reads| {
        let count = reads.count.get() + 1;
        reads.count.set(count);
        if count >= reads.awaited.get() {
            reads.awaited.set(u64::MAX);
            if let Some(waker) = reads.waker.take() {
                waker.wake();
            }
        }
    });
}

fn count() -> u64 {
    READS.with(|reads| reads.count.get())
}

/// Waits for so many further reads.
async fn further(reads: u64) {
    let last = count() + reads;
    poll_fn(|cx| {
        READS.with(|reads| {
            if reads.count.get() >= last {
                return Poll::Ready(());
            }
            reads.awaited.set(last);
            reads.waker.replace(Some(cx.waker().clone()));
            Poll::Pending
        })
    })
    .await;
}

/// Lets whoever is ready on this core go first; false where there was somebody, such as the one who is to send the bytes.
fn is_alone() -> bool {
    let begun = Instant::now();
    thread::yield_now();
    begun.elapsed() < SOMEBODY
}

/// Looks for bytes again and again; false where none came in time, or somebody else wants the core.
async fn look(most: Duration, is_alone: fn() -> bool) -> bool {
    let (seen, begun) = (count(), Instant::now());
    loop {
        if !is_alone() {
            return false;
        }
        // Comes back when all that was ready has run and the operating system was asked for what came meanwhile.
        yield_now().await;
        if count() != seen {
            return true;
        }
        if begun.elapsed() >= most {
            return false;
        }
    }
}

/// Keeps the present thread awake for `most` after it has read something, where that pays. To be run on this thread, as a
/// task of its single-threaded runtime; never ends, unless `most` is zero.
pub async fn spin(most: Duration) {
    if !most.is_zero() {
        spin_while(most, is_alone).await;
    }
}

async fn spin_while(most: Duration, is_alone: fn() -> bool) {
    let mut in_vain = 0;
    loop {
        further(1 << in_vain).await;
        while look(most, is_alone).await {
            in_vain = 0;
        }
        in_vain = (in_vain + 1).min(MOST_IN_VAIN);
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const MINUTE: Duration = Duration::from_mins(1);

    thread_local! {
        static ALONE: Cell<bool> = const { Cell::new(true) };
    }

    fn is_asleep() -> bool {
        READS.with(|reads| reads.awaited.get() != u64::MAX)
    }

    /// How many reads the spinner sleeps for, once it does.
    async fn slept() -> u64 {
        while !is_asleep() {
            yield_now().await;
        }
        READS.with(|reads| reads.awaited.get()) - count()
    }

    #[tokio::test]
    async fn looks_until_something_comes_or_the_time_is_up() {
        assert!(!look(Duration::from_millis(1), || true).await);
        let looking = tokio::spawn(look(MINUTE, || true));
        yield_now().await;
        assert!(!looking.is_finished());
        read();
        assert!(looking.await.expect("an end"));
    }

    #[tokio::test]
    async fn looks_ever_more_rarely_in_vain_and_at_once_again_where_it_pays() {
        tokio::spawn(spin_while(MINUTE, || ALONE.get()));
        ALONE.set(false);
        for reads in (0..=MOST_IN_VAIN).chain([MOST_IN_VAIN]).map(|in_vain| 1 << in_vain) {
            assert_eq!(slept().await, reads);
            (0..reads).for_each(|_| read());
        }
        // It looks now, and what it sees makes up for all that was in vain.
        ALONE.set(true);
        for _ in 0..10 {
            yield_now().await;
            assert!(!is_asleep());
        }
        read();
        yield_now().await;
        yield_now().await;
        ALONE.set(false);
        assert_eq!(slept().await, 2);
    }

    #[tokio::test]
    async fn leaves_the_core_to_others_and_never_looks_where_it_shall_not() {
        assert!(!look(MINUTE, || false).await);
        spin(Duration::ZERO).await;
    }
}
