//! A real learner service in this process, and demonstrations to send it.

use mazeway_client::{Learner, packed::pack};
use mazeway_learner::{Config, config::Limits};
use mazeway_proto::learner as pb;
use mazeway_server::{ListenAddress, Listener};
use std::{net::SocketAddr, path::Path, thread::JoinHandle, time::Duration};
use tokio::sync::oneshot;
use uuid::Uuid;

/// A learner service on a thread and a runtime of its own, over a directory that outlives it.
#[derive(Debug)]
pub struct LearnerServer {
    address: ListenAddress,
    stop: Option<oneshot::Sender<()>>,
    thread: Option<JoinHandle<()>>,
}

impl LearnerServer {
    /// Starts a service with default limits.
    pub fn start(data: &Path) -> Self {
        Self::with(data, Limits::default())
    }

    /// Starts a service on a free port.
    pub fn with(data: &Path, limits: Limits) -> Self {
        Self::at("127.0.0.1:0".parse().expect("an address"), data, limits)
    }

    /// Starts a service on an address.
    ///
    /// # Panics
    /// The port cannot be bound.
    pub fn at(address: SocketAddr, data: &Path, limits: Limits) -> Self {
        let limits = Limits { shutdown_grace: limits.shutdown_grace.min(Duration::from_secs(2)), ..limits };
        Self::configured(address.into(), Config { limits, ..Config::new(data) })
    }

    /// Starts a service on an address with all its settings.
    ///
    /// # Panics
    /// The port cannot be bound.
    pub fn configured(address: ListenAddress, config: Config) -> Self {
        let (stop, stopped) = oneshot::channel();
        let (bound, is_bound) = std::sync::mpsc::channel();
        let thread = std::thread::spawn(move || {
            let runtime = tokio::runtime::Builder::new_multi_thread().worker_threads(2).enable_all().build();
            runtime.expect("a runtime").block_on(async move {
                let listener = Listener::bind(&address).await.expect("a port");
                bound.send(listener.address().expect("an address")).expect("the test waits");
                let shutdown = async {
                    let _ = stopped.await;
                };
                mazeway_learner::serve(config, listener, shutdown).await.expect("a service that ends well");
            });
        });
        let address = is_bound.recv().expect("a service that starts");
        Self { address, stop: Some(stop), thread: Some(thread) }
    }

    /// Where it listens.
    ///
    /// # Panics
    /// On a Unix socket.
    pub fn socket(&self) -> SocketAddr {
        match self.address {
            ListenAddress::Tcp(address) => address,
            ListenAddress::Unix(_) => panic!("expected a service on TCP"),
        }
    }

    /// Where it listens, for clients.
    pub fn address(&self) -> String {
        self.address.to_string()
    }

    /// A client of it.
    ///
    /// # Panics
    /// It does not answer.
    pub async fn client(&self) -> Learner {
        Learner::connect(&self.address()).await.expect("a learner that answers")
    }

    /// Stops it and waits until it is down.
    pub fn stop(mut self) {
        self.shut_down();
    }

    fn shut_down(&mut self) {
        drop(self.stop.take());
        if let Some(thread) = self.thread.take() {
            let outcome = thread.join();
            // A second panic while a test fails would hide the first.
            assert!(outcome.is_ok() || std::thread::panicking(), "the learner panicked");
        }
    }
}

impl Drop for LearnerServer {
    fn drop(&mut self) {
        self.shut_down();
    }
}

/// A trajectory whose content follows from a number: the same number, the same bytes.
pub fn trajectory(number: u128) -> pb::Trajectory {
    let steps = 3 + (number % 40) as u32;
    let cell = |step: u32| (number as u32).wrapping_mul(31).wrapping_add(step * 7);
    pb::Trajectory {
        trajectory_id: Uuid::from_u128(number).to_string(),
        env_id: "Test-v0".into(),
        model_id: String::new(),
        style: if number.is_multiple_of(3) { "calm" } else { "brisk" }.into(),
        source: "test".into(),
        seed: number.is_multiple_of(2).then_some(number as u64),
        n_states: 57,
        n_actions: 4,
        states: pack((0..steps).map(|step| cell(step) % 57)),
        actions: pack((0..steps).map(|step| cell(step) % 4)),
        rewards: pack((0..steps).map(|step| f64::from(cell(step)) / 7.0)),
        final_state: number.is_multiple_of(5).then_some(56),
        terminated: number.is_multiple_of(7),
        truncated: number.is_multiple_of(11),
    }
}

/// Everything a filter selects, exported.
///
/// # Panics
/// The learner fails.
pub async fn export(learner: &Learner, filter: &pb::TrajectoryFilter) -> Vec<pb::Trajectory> {
    let mut stream = learner.export_trajectories(filter).await.expect("an export");
    let mut all = Vec::new();
    while let Some(page) = stream.next().await.expect("a page") {
        all.extend(page);
    }
    all
}
