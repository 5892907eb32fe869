//! What Mazeway's end-to-end tests share: real servers on free ports of the loopback interface, shut down on drop.

pub mod authority;
pub mod crash;
pub mod desk;
pub mod faces;
pub mod fuzz;
pub mod learner;
pub mod programs;
pub mod proxy;
pub mod venv;
pub mod worlds;

use mazeway_server::{Config, ListenAddress, Listener};
use std::{net::SocketAddr, path::Path, thread::JoinHandle, time::Duration};
use tempfile::TempDir;
use tokio::sync::oneshot;

/// A directory in memory where the machine has one, unless the environment names a place for temporary files.
///
/// # Panics
/// None can be made.
pub fn memory() -> TempDir {
    let memory = Path::new("/dev/shm");
    let made = if std::env::var_os("TMPDIR").is_none() && memory.is_dir() {
        tempfile::tempdir_in(memory)
    } else {
        tempfile::tempdir()
    };
    made.expect("a directory")
}

/// Default limits, but calls that still run at the end of a test are cut off soon: its clients no longer answer by then.
pub fn config() -> Config {
    Config { shutdown_grace: Duration::from_millis(100), ..Config::default() }
}

/// A real environment server on a thread and a runtime of its own, so that tests with and without a runtime use it alike.
#[derive(Debug)]
pub struct EnvServer {
    address: ListenAddress,
    stop: Option<oneshot::Sender<()>>,
    thread: Option<JoinHandle<()>>,
}

impl EnvServer {
    /// Starts a server with default limits.
    pub fn start() -> Self {
        Self::with(config())
    }

    /// Starts a server.
    ///
    /// # Panics
    /// No port can be bound.
    pub fn with(config: Config) -> Self {
        Self::at("127.0.0.1:0".parse().expect("an address"), config)
    }

    /// Starts a server on an address.
    ///
    /// # Panics
    /// The port cannot be bound.
    pub fn at(address: SocketAddr, config: Config) -> Self {
        Self::listening(ListenAddress::Tcp(address), config)
    }

    /// Starts a server on a Unix socket.
    ///
    /// # Panics
    /// The path cannot be bound.
    pub fn unix(path: &Path, config: Config) -> Self {
        Self::listening(ListenAddress::Unix(path.into()), config)
    }

    fn listening(address: ListenAddress, config: Config) -> Self {
        let (stop, stopped) = oneshot::channel();
        let (bound, is_bound) = std::sync::mpsc::channel();
        let thread = std::thread::spawn(move || {
            let runtime = tokio::runtime::Builder::new_current_thread().enable_all().build();
            runtime.expect("a runtime").block_on(async move {
                let listener = Listener::bind(&address).await.expect("a free address");
                bound.send(listener.address().expect("an address")).expect("the test waits");
                let shutdown = async {
                    let _ = stopped.await;
                };
                mazeway_server::serve(config, listener, shutdown).await.expect("a server that ends well");
            });
        });
        let address = is_bound.recv().expect("a server that starts");
        Self { address, stop: Some(stop), thread: Some(thread) }
    }

    /// Where it listens.
    ///
    /// # Panics
    /// On a Unix socket.
    pub fn socket(&self) -> SocketAddr {
        match self.address {
            ListenAddress::Tcp(address) => address,
            ListenAddress::Unix(_) => panic!("expected a server on TCP"),
        }
    }

    /// Where it listens, for clients.
    pub fn address(&self) -> String {
        self.address.to_string()
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
            assert!(outcome.is_ok() || std::thread::panicking(), "the server panicked");
        }
    }
}

impl Drop for EnvServer {
    fn drop(&mut self) {
        self.shut_down();
    }
}
