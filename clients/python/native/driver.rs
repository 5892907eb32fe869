//! Who drives the I/O: the thread that waits for an answer, and the keeper while nobody does.
//!
//! A runtime of the current thread makes progress only while someone is in it, and a server takes a peer that answers no
//! pings for dead. So the keeper, one thread a process, looks into every connection that was silent for a while. It needs
//! neither the interpreter nor a lock that a call could hold, and it never outlives its process.

use crate::errors::ForeignProcessError;
use pyo3::prelude::*;
use std::{
    future::{Future, poll_fn},
    io,
    pin::{Pin, pin},
    process,
    sync::{
        Arc, Mutex, MutexGuard, PoisonError, Weak,
        atomic::{AtomicU64, Ordering},
    },
    task::Poll,
    thread,
    time::{Duration, Instant},
};
use tokio::{
    runtime::{Builder, Runtime},
    task::yield_now,
    time::{Sleep, sleep_until},
};

/// How often a wait asks Python whether a signal came.
const SIGNALS: Duration = Duration::from_millis(100);
/// How often the keeper looks around; far below any sensible time for a ping's answer.
const ROUND: Duration = Duration::from_secs(2);
/// Silence after which it looks into a connection.
const SILENCE: Duration = Duration::from_secs(1);
/// Silence after which something may have happened that a step should know.
const ASIDE: Duration = Duration::from_millis(20);
/// Times that a connection's tasks are run to take in and send out what is there.
const TURNS: usize = 8;
/// Longest wait: beyond it nobody can tell.
const LONGEST: Duration = Duration::from_hours(365 * 24);

/// Why a wait ended without a result.
#[derive(Debug)]
pub enum Stopped {
    /// The time was up.
    Late,
    /// A signal's handler raised this.
    Raised(PyErr),
}

/// A runtime that runs where its caller is.
#[derive(Debug)]
pub struct Driver {
    /// Always there but while dropped.
    runtime: Option<Runtime>,
    began: Instant,
    /// Milliseconds from then to its last use.
    used_ms: AtomicU64,
    /// Ends a wait now and then, whichever comes next: to set a timer for each costs more than a step has to spare.
    alarm: Mutex<Option<Pin<Box<Sleep>>>>,
}

impl Driver {
    pub fn new() -> io::Result<Self> {
        let runtime = Some(Builder::new_current_thread().enable_io().enable_time().build()?);
        Ok(Self { runtime, began: Instant::now(), used_ms: AtomicU64::new(0), alarm: Mutex::default() })
    }

    pub fn runtime(&self) -> &Runtime {
        self.runtime.as_ref().expect("a driver that lives")
    }

    /// Runs a future to its end, with the interpreter released; looks after signals now and then.
    pub fn wait<F>(&self, py: Python<'_>, patience: Duration, future: F) -> Result<F::Output, Stopped>
    where
        F: Future + Send,
        F::Output: Send,
    {
        let outcome = self.wait_for(py, patience, future);
        if outcome.is_err() {
            self.settle(py); // the other side learns that nobody waits
        }
        outcome
    }

    fn wait_for<F>(&self, py: Python<'_>, patience: Duration, future: F) -> Result<F::Output, Stopped>
    where
        F: Future + Send,
        F::Output: Send,
    {
        let mut future = pin!(future);
        let deadline = Instant::now() + patience.min(LONGEST);
        // Another thread that waits meanwhile makes one of its own.
        let mut alarm = self.alarm().take();
        let outcome = loop {
            let done = py.detach(|| {
                self.runtime().block_on(async {
                    let soon = || deadline.min(Instant::now() + SIGNALS).into();
                    let alarm = alarm.get_or_insert_with(|| Box::pin(sleep_until(soon())));
                    if alarm.is_elapsed() || alarm.deadline() > deadline.into() {
                        alarm.as_mut().reset(soon());
                    }
                    poll_fn(|cx| match future.as_mut().poll(cx) {
                        Poll::Ready(output) => Poll::Ready(Some(output)),
                        Poll::Pending => alarm.as_mut().poll(cx).map(|()| None),
                    })
                    .await
                })
            });
            self.touch();
            if let Some(output) = done {
                break Ok(output);
            }
            if let Err(error) = py.check_signals() {
                break Err(Stopped::Raised(error));
            }
            if Instant::now() >= deadline {
                break Err(Stopped::Late);
            }
        };
        *self.alarm() = alarm;
        outcome
    }

    fn alarm(&self) -> MutexGuard<'_, Option<Pin<Box<Sleep>>>> {
        self.alarm.lock().unwrap_or_else(PoisonError::into_inner)
    }

    /// [`Self::turn`] with the interpreter released.
    pub fn settle(&self, py: Python<'_>) {
        py.detach(|| self.turn());
    }

    /// Takes in and sends out what is there, without waiting for more.
    fn turn(&self) {
        self.runtime().block_on(async {
            for _ in 0..TURNS {
                yield_now().await;
            }
        });
    }

    fn touch(&self) {
        self.used_ms.store(self.began.elapsed().as_millis() as u64, Ordering::Relaxed);
    }

    /// Learns what happened while nobody was in here, such as that the connection broke: what is sent into a broken one may
    /// or may not have arrived.
    pub fn catch_up(&self, py: Python<'_>) {
        if self.silent_for() >= ASIDE {
            self.settle(py);
        }
    }

    fn silent_for(&self) -> Duration {
        self.began.elapsed().saturating_sub(Duration::from_millis(self.used_ms.load(Ordering::Relaxed)))
    }
}

impl Drop for Driver {
    /// Waits for nobody, not even for a name that is being looked up.
    fn drop(&mut self) {
        if let Some(runtime) = self.runtime.take() {
            runtime.shutdown_background();
        }
    }
}

/// Something of the process that made it. A forked child shares its sockets and its epoll with the parent, so that even
/// dropping it there would harm the parent: it is refused and forgotten instead.
#[derive(Debug)]
pub struct Local<T> {
    pid: u32,
    /// Always there but while dropped.
    value: Option<T>,
}

impl<T> Local<T> {
    pub fn new(value: T) -> Self {
        Self { pid: process::id(), value: Some(value) }
    }

    pub fn get(&self) -> PyResult<&T> {
        let ours = self.value.as_ref().filter(|_| self.pid == process::id());
        ours.ok_or_else(|| ForeignProcessError::new_err("made by the process that this one was forked from"))
    }
}

impl<T> Drop for Local<T> {
    fn drop(&mut self) {
        if self.pid != process::id() {
            std::mem::forget(self.value.take());
        }
    }
}

/// Answers the pings of silent connections. One serves a process; Python makes another after a fork.
#[pyclass(frozen, module = "mazeway._native")]
#[derive(Debug)]
pub struct Keeper(Local<Arc<Mutex<Kept>>>);

#[derive(Debug, Default)]
struct Kept {
    drivers: Vec<Weak<Driver>>,
    /// Whether a thread looks after them.
    running: bool,
}

#[pymethods]
impl Keeper {
    #[new]
    fn new() -> Self {
        Self(Local::new(Arc::default()))
    }
}

impl Keeper {
    /// Looks after a driver until it is dropped.
    pub fn watch(&self, driver: &Arc<Driver>) -> PyResult<()> {
        let kept = self.0.get()?;
        let mut state = kept.lock().unwrap_or_else(PoisonError::into_inner);
        state.drivers.push(Arc::downgrade(driver));
        if !state.running {
            let kept = Arc::clone(kept);
            thread::Builder::new().name("mazeway-keeper".into()).spawn(move || keep(&kept))?;
            state.running = true;
        }
        Ok(())
    }
}

fn keep(kept: &Mutex<Kept>) {
    loop {
        thread::sleep(ROUND);
        let drivers: Vec<_> = {
            let mut state = kept.lock().unwrap_or_else(PoisonError::into_inner);
            state.drivers.retain(|driver| driver.strong_count() > 0);
            if state.drivers.is_empty() {
                state.running = false;
                return;
            }
            state.drivers.iter().filter_map(Weak::upgrade).collect()
        };
        for driver in drivers {
            if driver.silent_for() >= SILENCE {
                driver.turn();
            }
        }
    }
}
