//! The threads that fits run on, as many as fits may run, and the queue before them.
//!
//! Invariants: a fit runs on these threads and no other; one whose [`Place`] is dropped while it waits is gone at once, and its
//! place is free; every change of the queue is told to all that wait. Where the operating system allows it, the threads
//! yield to all others of the machine, so that recordings and steps are served while fits compute.

use super::turns::{Full, Ticket, Turns};
use mazeway_serving::Caller;
use std::{
    any::Any,
    panic::{AssertUnwindSafe, catch_unwind},
    sync::{Arc, Condvar, Mutex, MutexGuard, PoisonError},
    thread,
};
use tokio::sync::watch;

/// Work that computes for a while.
pub type Work = Box<dyn FnOnce() + Send>;

/// Where a fit is in the queue.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Stand {
    /// It waits.
    Waiting {
        /// 1 for the next.
        place: usize,
        /// How many wait.
        length: usize,
    },
    /// It has begun.
    Begun,
}

/// Work that waits, and how its owner hears of its place.
struct Queued {
    work: Work,
    stand: watch::Sender<Stand>,
}

struct State {
    turns: Turns<Queued>,
    threads: usize,
    idle: usize,
    closed: bool,
}

struct Shared {
    state: Mutex<State>,
    work: Condvar,
}

impl Shared {
    fn lock(&self) -> MutexGuard<'_, State> {
        self.state.lock().unwrap_or_else(PoisonError::into_inner)
    }
}

impl State {
    /// Tells all that wait where they are.
    fn tell(&self) {
        // Threads that are idle are about to take the first.
        let length = self.turns.len().saturating_sub(self.idle);
        for (index, queued) in self.turns.iter().skip(self.idle).enumerate() {
            let now = Stand::Waiting { place: index + 1, length };
            queued.stand.send_if_modified(|stand| std::mem::replace(stand, now) != now);
        }
    }
}

/// Threads and their queue. Dropped, it begins nothing more; what runs ends by itself.
pub struct Pool {
    shared: Arc<Shared>,
}

impl std::fmt::Debug for Pool {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.debug_struct("Pool").field("waiting", &self.waiting()).finish_non_exhaustive()
    }
}

impl Pool {
    /// Starts `threads`; at most `limit` wait.
    ///
    /// # Errors
    /// There are no threads to be had.
    pub fn start(threads: usize, limit: usize) -> std::io::Result<Self> {
        let state = State { turns: Turns::new(limit), threads: 0, idle: 0, closed: false };
        let pool = Self { shared: Arc::new(Shared { state: Mutex::new(state), work: Condvar::new() }) };
        for index in 0..threads.max(1) {
            let shared = Arc::clone(&pool.shared);
            thread::Builder::new().name(format!("fit-{index}")).spawn(move || {
                yield_to_others();
                run(&shared);
            })?;
            let mut state = pool.shared.lock();
            state.threads += 1;
            state.idle += 1;
        }
        Ok(pool)
    }

    /// Takes a place in the queue. `quota` is how many the caller may have, waiting and running.
    ///
    /// # Errors
    /// There is none.
    pub fn submit(&self, caller: &Caller, quota: Option<usize>, work: Work) -> Result<Place, Full> {
        let mut state = self.shared.lock();
        let idle = state.idle;
        let at_once = idle > state.turns.len();
        let first = if at_once { Stand::Begun } else { Stand::Waiting { place: 0, length: 0 } };
        let (sender, stand) = watch::channel(first);
        let ticket = state.turns.join(caller, quota, idle, Queued { work, stand: sender })?;
        if !at_once {
            state.tell();
        }
        drop(state);
        self.shared.work.notify_one();
        Ok(Place { shared: Arc::clone(&self.shared), caller: caller.clone(), ticket, stand })
    }

    /// How many run.
    pub fn running(&self) -> usize {
        let state = self.shared.lock();
        state.threads - state.idle
    }

    /// How many wait.
    pub fn waiting(&self) -> usize {
        let state = self.shared.lock();
        state.turns.len().saturating_sub(state.idle)
    }
}

impl Drop for Pool {
    fn drop(&mut self) {
        self.shared.lock().closed = true;
        self.shared.work.notify_all();
    }
}

/// A place in the queue; dropped, it is given up, so it is kept until the work is done. Work that has begun is not stopped
/// by that.
pub struct Place {
    shared: Arc<Shared>,
    caller: Caller,
    ticket: Ticket,
    stand: watch::Receiver<Stand>,
}

impl Place {
    /// Where it is now.
    pub fn stand(&mut self) -> Stand {
        *self.stand.borrow_and_update()
    }

    /// Waits until it has moved, and says where to.
    pub async fn moved(&mut self) -> Stand {
        match self.stand.changed().await {
            Ok(()) => *self.stand.borrow_and_update(),
            // Nobody tells any more once it has begun.
            Err(_) => Stand::Begun,
        }
    }
}

impl Drop for Place {
    fn drop(&mut self) {
        let mut state = self.shared.lock();
        if state.turns.leave(&self.caller, self.ticket) {
            state.tell();
        }
    }
}

/// Takes turns until the pool is no more.
fn run(shared: &Shared) {
    let mut state = shared.lock();
    loop {
        if state.closed {
            return;
        }
        let Some((_, caller, Queued { work, stand })) = state.turns.begin() else {
            state = shared.work.wait(state).unwrap_or_else(PoisonError::into_inner);
            continue;
        };
        state.idle -= 1;
        state.tell();
        drop(state);
        stand.send_replace(Stand::Begun);
        drop(stand);
        // Whoever waits for the outcome learns that there is none.
        if let Err(panic) = catch_unwind(AssertUnwindSafe(work)) {
            tracing::error!(message = reason(&*panic), "a fit panicked");
        }
        state = shared.lock();
        state.idle += 1;
        state.turns.end(&caller);
    }
}

fn reason(panic: &(dyn Any + Send)) -> &str {
    let text = panic.downcast_ref::<&str>().copied();
    text.or_else(|| panic.downcast_ref::<String>().map(String::as_str)).unwrap_or("no message")
}

/// How much the threads of fits yield, as `nice` counts it.
#[cfg(target_os = "linux")]
const NICENESS: i32 = 10;

/// Has the present thread yield to others. Linux keeps this by thread; elsewhere it would be the whole process that yields.
pub fn yield_to_others() {
    #[cfg(target_os = "linux")]
    if let Err(error) = rustix::process::getpriority_process(None)
        .and_then(|nice| rustix::process::setpriority_process(None, nice.max(NICENESS)))
    {
        tracing::debug!(%error, "a thread of fits has the priority of all others");
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use std::{sync::mpsc, time::Duration};
    use tokio::time::timeout;

    const PATIENCE: Duration = Duration::from_secs(10);

    /// A pool of one thread that is busy until the returned is dropped.
    fn busy(limit: usize) -> (Pool, Place, mpsc::Sender<()>) {
        let pool = Pool::start(1, limit).expect("threads");
        let (hold, held) = mpsc::channel::<()>();
        let work = Box::new(move || {
            let _ = held.recv();
        });
        let place = pool.submit(&Caller::named("first"), None, work).expect("an idle thread");
        (pool, place, hold)
    }

    #[tokio::test]
    async fn a_hundred_that_wait_know_their_places_and_begin_in_turn() {
        let (pool, mut first, hold) = busy(100);
        assert_eq!(first.stand(), Stand::Begun);
        let (done, order) = mpsc::channel();
        let mut places = Vec::new();
        for number in 0..100 {
            let (caller, done) = (Caller::named(if number < 90 { "hog" } else { "" }), done.clone());
            // Half of the places are the most that a named caller gets: the hog's other fits are refused.
            match pool.submit(&caller, None, Box::new(move || done.send(number).expect("the test listens"))) {
                Ok(place) => places.push((number, place)),
                Err(full) => assert_eq!((full, number >= 50), (Full::Share { waiting: 50 }, true)),
            }
        }
        assert_eq!(places.len(), 60);
        let mut stand = |index: usize| places[index].1.stand();
        assert_eq!(stand(0), Stand::Waiting { place: 1, length: 60 });
        // The first of whoever came later is the second: the hog has one turn before it.
        assert_eq!(stand(50), Stand::Waiting { place: 2, length: 60 });
        assert_eq!(stand(49), Stand::Waiting { place: 60, length: 60 });
        // One goes: those behind it move up at once.
        places.remove(1);
        assert_eq!(places[49].1.stand(), Stand::Waiting { place: 2, length: 59 });
        assert_eq!(places[1].1.stand(), Stand::Waiting { place: 3, length: 59 });
        drop(hold);
        for (_, place) in &mut places {
            let begun = async { while place.stand() != Stand::Begun && place.moved().await != Stand::Begun {} };
            timeout(PATIENCE, begun).await.expect("its turn");
        }
        let order: Vec<i32> = (0..59).map(|_| order.recv_timeout(PATIENCE).expect("all run")).collect();
        assert_eq!(&order[..6], [0, 90, 2, 91, 3, 92]);
        assert_eq!(&order[20..], (11..50).collect::<Vec<_>>());
    }

    #[tokio::test]
    async fn work_that_panics_costs_no_thread_and_a_pool_that_goes_frees_what_waits() {
        let (pool, _, hold) = busy(10);
        let (alive, gone) = mpsc::channel::<()>();
        let caller = Caller::anybody();
        let _place = pool.submit(&caller, None, Box::new(|| panic!("on purpose"))).expect("a place");
        let (done, ran) = mpsc::channel();
        let _place = pool.submit(&caller, None, Box::new(move || done.send(()).expect("listens"))).expect("a place");
        drop(hold);
        ran.recv_timeout(PATIENCE).expect("the thread goes on");
        let (hold, held) = mpsc::channel::<()>();
        let wait = Box::new(move || {
            let _ = held.recv();
        });
        let _running = pool.submit(&caller, None, wait).expect("a place");
        let kept = pool.submit(&caller, None, Box::new(move || drop(alive))).expect("a place");
        drop((pool, kept));
        assert_eq!(gone.recv_timeout(PATIENCE), Err(mpsc::RecvTimeoutError::Disconnected));
        drop(hold);
    }

    #[cfg(target_os = "linux")]
    #[test]
    fn threads_of_fits_yield_and_others_do_not() {
        let nice = || rustix::process::getpriority_process(None).expect("a priority");
        let before = nice();
        let pool = Pool::start(1, 1).expect("threads");
        let (done, told) = mpsc::channel();
        let _place = pool.submit(&Caller::anybody(), None, Box::new(move || done.send(nice()).expect("listens")));
        assert_eq!(told.recv_timeout(PATIENCE), Ok(NICENESS.max(before)));
        assert_eq!(rustix::process::getpriority_process(None), Ok(before));
    }
}
