//! Fair turns between the connections of one worker, so that a caller who asks little is answered at once, however much
//! others ask.
//!
//! A worker serves its connections on one thread, in the order in which their bytes came. Where a hundred send as fast as
//! they can, whoever sends a single request waits for a hundred others. So each connection has an allowance of reads that
//! grows with time ([`READS_A_SECOND`], up to [`SAVED_READS`]). Within it, bytes are read as they come. Beyond it, a
//! connection waits in the worker's lane, which lets them read in turn, one at a time, and each time only after the worker
//! has nothing else to do and has asked the operating system for what came meanwhile.
//!
//! Invariants: a connection that has the worker to itself never waits; one with bytes to read that waits is in the lane
//! exactly once, and gets its turn after one of each other at most; nothing here is shared between workers.

use std::{
    cell::RefCell,
    collections::VecDeque,
    sync::{
        Arc, Mutex, MutexGuard, PoisonError,
        atomic::{AtomicBool, AtomicU64, Ordering::Relaxed},
    },
    task::{Context, Poll, Waker},
    time::Instant,
};
use tokio::sync::Notify;

/// Reads that a connection may do at any time, on the average.
const READS_A_SECOND: f64 = 1000.0;
/// Reads that a connection saves up while it is quiet.
const SAVED_READS: u32 = 100;

thread_local! {
    static LANE: RefCell<Option<Arc<Lane>>> = const { RefCell::new(None) };
}

/// One that waits for its turn.
#[derive(Debug)]
struct Waiting {
    id: u64,
    granted: Arc<AtomicBool>,
    waker: Waker,
}

#[derive(Debug, Default)]
struct State {
    waiting: VecDeque<Waiting>,
    /// Who had the last turn.
    last: u64,
}

/// Where the connections of a worker wait that have asked much.
#[derive(Debug, Default)]
pub struct Lane {
    state: Mutex<State>,
    came: Notify,
}

impl Lane {
    fn lock(&self) -> MutexGuard<'_, State> {
        self.state.lock().unwrap_or_else(PoisonError::into_inner)
    }

    /// Makes a lane for the connections that this thread serves from now on. What is returned gives out the turns; it is to
    /// be run on this thread.
    pub fn open() -> impl Future<Output = ()> {
        let lane = Arc::<Self>::default();
        LANE.with(|present| present.replace(Some(Arc::clone(&lane))));
        async move {
            loop {
                let next = lane.lock().waiting.pop_front();
                match next {
                    Some(Waiting { id, granted, waker }) => {
                        lane.lock().last = id;
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
}

/// A connection's right to read.
#[derive(Debug)]
pub struct Pass {
    lane: Arc<Lane>,
    id: u64,
    reads: u32,
    since: Instant,
    granted: Arc<AtomicBool>,
    waits: bool,
}

impl Pass {
    /// For a connection that the present thread serves; none where the thread has no lane.
    pub fn of_thread() -> Option<Self> {
        static NEXT: AtomicU64 = AtomicU64::new(1);
        let lane = LANE.with(|present| present.borrow().clone())?;
        Some(Self {
            lane,
            id: NEXT.fetch_add(1, Relaxed),
            reads: SAVED_READS,
            since: Instant::now(),
            granted: Arc::default(),
            waits: false,
        })
    }

    /// Whether the connection may read now. Asked anew when its waker is woken. `has_bytes` says whether there is anything
    /// to read, and arranges for a wake-up where there is not.
    pub fn poll_turn(
        &mut self,
        cx: &mut Context<'_>,
        has_bytes: impl FnOnce(&mut Context<'_>) -> Poll<()>,
    ) -> Poll<()> {
        if self.reads > 0 || self.granted.load(Relaxed) {
            return Poll::Ready(());
        }
        let saved = (self.since.elapsed().as_secs_f64() * READS_A_SECOND) as u32;
        if saved > 0 {
            self.reads = saved.min(SAVED_READS);
            self.since = Instant::now();
            return Poll::Ready(());
        }
        if has_bytes(cx).is_pending() {
            return Poll::Pending;
        }
        let mut state = self.lane.lock();
        if self.waits {
            if let Some(place) = state.waiting.iter_mut().find(|waiting| waiting.id == self.id) {
                place.waker.clone_from(cx.waker());
                return Poll::Pending;
            }
        } else if state.waiting.is_empty() && state.last == self.id {
            // Nobody has had a turn since.
            return Poll::Ready(());
        }
        self.waits = true;
        let (granted, waker) = (Arc::clone(&self.granted), cx.waker().clone());
        state.waiting.push_back(Waiting { id: self.id, granted, waker });
        drop(state);
        self.lane.came.notify_one();
        Poll::Pending
    }

    /// It has read.
    pub fn used(&mut self) {
        if self.reads > 0 {
            self.reads -= 1;
            if self.reads == 0 {
                self.since = Instant::now();
            }
        } else {
            self.waits = false;
            self.granted.store(false, Relaxed);
        }
    }
}

impl Drop for Pass {
    fn drop(&mut self) {
        if self.waits {
            self.lane.lock().waiting.retain(|waiting| waiting.id != self.id);
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::listen::Accepted;
    use std::time::Duration;
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

    /// How many requests of others were served while a rare one waited for its answer, most of all and in the middle.
    fn others_before_a_rare_one(fair: bool) -> (u64, u64) {
        let listener = std::net::TcpListener::bind("127.0.0.1:0").expect("a port");
        let address = listener.local_addr().expect("an address");
        let done = Arc::new(AtomicU64::new(0));
        let worker = std::thread::spawn({
            let done = Arc::clone(&done);
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
                    // Told to end by the last connection that goes.
                    tokio::time::sleep(Duration::from_secs(3)).await;
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
            tokio::time::sleep(Duration::from_millis(500)).await;
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
        drop(runtime);
        worker.join().expect("a worker that ends well");
        waits.sort_unstable();
        (waits[waits.len() * 9 / 10], waits[waits.len() / 2])
    }

    #[test]
    fn one_that_asks_little_waits_for_few_of_those_that_ask_much() {
        let ((most, middle), (unfair, _)) = (others_before_a_rare_one(true), others_before_a_rare_one(false));
        assert!(unfair >= GREEDY as u64 / 2, "without a lane it waits for its turn among all: {unfair}");
        // The test's own threads share the processor with the worker, so an answer may lie for a while before it is read.
        assert!(middle <= GREEDY as u64 / 4, "{middle} of {GREEDY}, in nine of ten cases {most}; unfair {unfair}");
    }
}
