//! Fair turns between the connections of one worker, so that a caller who asks little is answered at once, however much
//! others ask.
//!
//! A worker serves its connections on one thread, in the order in which their bytes came. Where a hundred send as fast as
//! they can, whoever sends a single request waits for a hundred others. So each connection is charged for what it sends,
//! against a virtual time that grows by half an even share of all that is sent to the worker (start-time fair queueing:
//! Goyal, Vin and Cheng, 1996). One that has asked for no more than that reads its bytes as they come: half, so that where
//! all but one ask as much as they can, these do not count as asking little. One that is ahead of it waits in the worker's
//! lane, which lets them read one at a time, those first that have asked least, and each time only after the worker has
//! nothing else to do and has asked the operating system for what came meanwhile.
//!
//! Invariants: a connection that has the worker to itself never waits and takes no lock; one with bytes to read that waits is
//! in the lane exactly once; what one may save up or owe is bounded, so that nobody waits for ever; nothing here is shared
//! between workers, and nothing asks a clock.

use std::{
    cell::RefCell,
    collections::BTreeMap,
    sync::{
        Arc, Mutex, MutexGuard, PoisonError,
        atomic::{AtomicBool, AtomicU64, AtomicUsize, Ordering::Relaxed},
    },
    task::{Context, Poll, Waker},
};
use tokio::sync::Notify;

/// Virtual time that a byte takes.
const BYTE: u64 = 1024;
/// What a read is charged beyond its bytes, in bytes: about a request.
const READ_BYTES: u64 = 16;
/// What a connection saves up while it is quiet.
const SAVED: u64 = BYTE << 10;
/// What a connection owes at most: beyond it, those that ask much take turns.
const OWED: u64 = BYTE << 14;

thread_local! {
    static LANE: RefCell<Option<Arc<Lane>>> = const { RefCell::new(None) };
}

/// One that waits for its turn.
#[derive(Debug)]
struct Waiting {
    granted: Arc<AtomicBool>,
    waker: Waker,
}

/// What a place in the lane is ordered by: what has been asked for, then who came first.
type Place = (u64, u64);

/// Where the connections of a worker wait that have asked much. The atomics are read and written by the worker alone.
#[derive(Debug, Default)]
pub struct Lane {
    now: AtomicU64,
    connections: AtomicU64,
    /// Who had the last turn.
    last: AtomicU64,
    waits: AtomicUsize,
    arrivals: AtomicU64,
    waiting: Mutex<BTreeMap<Place, Waiting>>,
    came: Notify,
}

impl Lane {
    /// Makes a lane for the connections that this thread serves from now on. What is returned gives out the turns; it is to
    /// be run on this thread.
    pub fn open() -> impl Future<Output = ()> {
        let lane = Arc::<Self>::default();
        // Nobody has saved anything at the beginning of time.
        lane.now.store(SAVED, Relaxed);
        LANE.with(|present| present.replace(Some(Arc::clone(&lane))));
        async move {
            loop {
                let next = lane.change(BTreeMap::pop_first);
                match next {
                    Some((_, Waiting { granted, waker })) => {
                        granted.store(true, Relaxed);
                        waker.wake();
                        // Comes back when all that was ready has run and new bytes have been asked for.
                        tokio::task::yield_now().await;
                    }
                    None => lane.came.notified().await,
                }
            }
        }
    }

    fn change<T>(&self, change: impl FnOnce(&mut BTreeMap<Place, Waiting>) -> T) -> T {
        let mut waiting: MutexGuard<'_, _> = self.waiting.lock().unwrap_or_else(PoisonError::into_inner);
        let outcome = change(&mut waiting);
        self.waits.store(waiting.len(), Relaxed);
        outcome
    }

    fn enter(&self, place: Place, waiting: Waiting) {
        self.change(|all| all.insert(place, waiting));
        self.came.notify_one();
    }
}

/// A connection's right to read.
#[derive(Debug)]
pub struct Pass {
    lane: Arc<Lane>,
    id: u64,
    /// The virtual time until which it has had its share.
    until: u64,
    granted: Arc<AtomicBool>,
    place: Option<Place>,
}

impl Pass {
    /// For a connection that the present thread serves; none where the thread has no lane.
    pub fn of_thread() -> Option<Self> {
        static NEXT: AtomicU64 = AtomicU64::new(1);
        let lane = LANE.with(|present| present.borrow().clone())?;
        lane.connections.fetch_add(1, Relaxed);
        let (id, until) = (NEXT.fetch_add(1, Relaxed), lane.now.load(Relaxed) - SAVED);
        Some(Self { lane, id, until, granted: Arc::default(), place: None })
    }

    /// Whether the connection may read now. Asked anew when its waker is woken. `has_bytes` says whether there is anything
    /// to read, and arranges for a wake-up where there is not.
    pub fn poll_turn(
        &mut self,
        cx: &mut Context<'_>,
        has_bytes: impl FnOnce(&mut Context<'_>) -> Poll<()>,
    ) -> Poll<()> {
        let lane = &self.lane;
        let nobody_since = || lane.waits.load(Relaxed) == 0 && lane.last.load(Relaxed) == self.id;
        if self.until <= lane.now.load(Relaxed) || self.granted.load(Relaxed) || nobody_since() {
            return Poll::Ready(());
        }
        if has_bytes(cx).is_pending() {
            return Poll::Pending;
        }
        let place = *self.place.get_or_insert_with(|| (self.until, lane.arrivals.fetch_add(1, Relaxed)));
        // A second time it is the same place, with the waker of now.
        lane.enter(place, Waiting { granted: Arc::clone(&self.granted), waker: cx.waker().clone() });
        Poll::Pending
    }

    /// True where it may read since it is its turn, and others may wait for theirs.
    pub fn is_turn(&self) -> bool {
        self.place.is_some()
    }

    /// It has read so many bytes.
    pub fn used(&mut self, bytes: usize) {
        let lane = &self.lane;
        if let Some(place) = self.place.take() {
            // Time may have gone by so far that it needed no turn.
            lane.change(|all| all.remove(&place));
            lane.last.store(self.id, Relaxed);
            self.granted.store(false, Relaxed);
        }
        let cost = (bytes as u64 + READ_BYTES) * BYTE;
        let now = lane.now.load(Relaxed) + cost / (2 * lane.connections.load(Relaxed).max(1));
        lane.now.store(now, Relaxed);
        self.until = self.until.max(now - SAVED).saturating_add(cost).min(now + OWED);
    }
}

impl Drop for Pass {
    fn drop(&mut self) {
        self.lane.connections.fetch_sub(1, Relaxed);
        if let Some(place) = self.place {
            self.lane.change(|all| all.remove(&place));
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::listen::Accepted;
    use std::time::{Duration, Instant};
    use tokio::{
        io::{AsyncReadExt as _, AsyncWriteExt as _},
        net::{TcpListener, TcpStream},
    };

    /// Connections that ask as much as they can.
    const GREEDY: usize = 40;
    /// What the worker does for a request.
    const WORK: Duration = Duration::from_micros(50);

    /// Answers every byte after some work, and counts what it did.
    async fn serve(accepted: Accepted, done: Arc<AtomicU64>) {
        let mut socket = accepted.into_socket().expect("a socket");
        let mut byte = [0];
        while socket.read(&mut byte).await.is_ok_and(|read| read > 0) {
            let begun = Instant::now();
            while begun.elapsed() < WORK {}
            done.fetch_add(1, Relaxed);
            if socket.write_all(&byte).await.is_err() {
                return;
            }
        }
    }

    /// How many requests of others were served while a rare one waited for its answer: in nine of ten cases no more than the
    /// first, in half of them no more than the second.
    fn others_before_a_rare_one(fair: bool) -> (u64, u64) {
        let listener = std::net::TcpListener::bind("127.0.0.1:0").expect("a port");
        let address = listener.local_addr().expect("an address");
        let (done, over) = (Arc::new(AtomicU64::new(0)), Arc::new(AtomicBool::new(false)));
        let worker = std::thread::spawn({
            let (done, over) = (Arc::clone(&done), Arc::clone(&over));
            move || {
                let runtime = tokio::runtime::Builder::new_current_thread().enable_all().build().expect("a runtime");
                runtime.block_on(async move {
                    if fair {
                        tokio::spawn(Lane::open());
                    }
                    listener.set_nonblocking(true).expect("a listener");
                    let listener = TcpListener::from_std(listener).expect("a listener");
                    for _ in 0..=GREEDY {
                        let (stream, _) = listener.accept().await.expect("a connection");
                        stream.set_nodelay(true).expect("an option");
                        tokio::spawn(serve(stream.into_std().expect("a stream").into(), Arc::clone(&done)));
                    }
                    while !over.load(Relaxed) {
                        tokio::time::sleep(Duration::from_millis(10)).await;
                    }
                });
            }
        });
        let runtime = tokio::runtime::Builder::new_current_thread().enable_all().build().expect("a runtime");
        let mut waits = runtime.block_on(async {
            let mut rare = TcpStream::connect(address).await.expect("connects");
            rare.set_nodelay(true).expect("an option");
            for _ in 0..GREEDY {
                let mut greedy = TcpStream::connect(address).await.expect("connects");
                tokio::spawn(async move {
                    // Always several requests ahead.
                    let ahead = [0; 8];
                    let mut answers = [0; 8];
                    while greedy.write_all(&ahead).await.is_ok() && greedy.read_exact(&mut answers).await.is_ok() {}
                });
            }
            tokio::time::sleep(Duration::from_secs(1)).await;
            let mut waits = Vec::new();
            for _ in 0..100 {
                let before = done.load(Relaxed);
                rare.write_all(&[1]).await.expect("sends");
                rare.read_exact(&mut [0]).await.expect("an answer");
                waits.push(done.load(Relaxed) - before);
                tokio::time::sleep(Duration::from_millis(10)).await;
            }
            waits
        });
        over.store(true, Relaxed);
        drop(runtime);
        worker.join().expect("a worker that ends well");
        waits.sort_unstable();
        (waits[waits.len() * 9 / 10], waits[waits.len() / 2])
    }

    #[test]
    fn one_that_asks_little_waits_for_few_of_those_that_ask_much() {
        let ((_, fair), (_, unfair)) = (others_before_a_rare_one(true), others_before_a_rare_one(false));
        assert!(unfair >= GREEDY as u64, "without a lane it waits for its turn among all: {unfair}");
        // An answer may lie for a while before it is read: the test's own threads and others want the processor too.
        assert!(fair <= unfair / 4, "{fair} before it of {GREEDY} that ask much, without a lane {unfair}");
    }
}
