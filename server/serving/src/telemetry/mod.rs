//! What a service shows of itself: numbers for Prometheus, whether it serves, logs, and spans for OpenTelemetry.
//!
//! Invariants: a step costs no lock and no allocation more for being counted; what a client sends makes no label, so that
//! numbers stay few; neither tokens nor demonstrations are ever written. Deliberately absent: what a service counts of its
//! own, which it registers here.

pub mod calls;
pub mod endpoint;
mod life;
pub mod logs;
mod methods;
pub mod numbers;
mod request_id;

use crate::listen::ListenAddress;
use calls::Calls;
pub(crate) use life::Life;
use numbers::{Counter, Growing, Reading};
use prometheus_client::{
    encoding::prometheus_text,
    registry::{Metric, Registry},
};
use std::{
    net::SocketAddr,
    sync::{Arc, LazyLock, Mutex, PoisonError},
};

/// What is shown, and where. The same flags for every service.
#[derive(Debug, Clone, PartialEq, Eq, Default, clap::Args)]
#[command(next_help_heading = "Telemetry")]
pub struct TelemetryConfig {
    /// Address of the numbers for Prometheus, at /metrics, and of /healthz; port 0 takes a free one [default: none]
    #[arg(long, value_name = "IP:PORT")]
    pub metrics_listen: Option<SocketAddr>,
    /// OpenTelemetry collector that takes spans over gRPC, such as http://127.0.0.1:4317 [default: none]
    #[arg(long, value_name = "URL", value_parser = logs::endpoint)]
    pub otlp_endpoint: Option<String>,
    /// How the log on standard error is written
    #[arg(long, value_enum, default_value_t, value_name = "FORMAT")]
    pub log_format: logs::LogFormat,
    /// What is logged: a level, or levels of modules, such as info or warn,mazeway_server=debug [default: warn]
    #[arg(long, value_name = "FILTER", value_parser = logs::filter)]
    pub log: Option<String>,
}

impl TelemetryConfig {
    /// True where no other machine reads the numbers.
    pub fn is_local(&self) -> bool {
        self.metrics_listen.is_none_or(|address| ListenAddress::Tcp(address).is_local())
    }
}

/// Counts of connections.
#[derive(Debug, Clone, Default)]
pub struct Connections {
    /// Taken so far.
    pub accepted: Counter,
    /// Closed at once, beyond the limit.
    pub refused: Counter,
    /// Bytes that came.
    pub received: Counter,
    /// Bytes that went.
    pub sent: Counter,
}

impl Connections {
    /// Numbers that nobody reads.
    pub(crate) fn nobodys() -> Self {
        static NOBODYS: LazyLock<Connections> = LazyLock::new(Connections::default);
        NOBODYS.clone()
    }
}

/// The numbers of one service, and whether it serves.
#[derive(Debug)]
pub struct Telemetry {
    registry: Mutex<Registry>,
    /// Of calls.
    pub calls: Calls,
    /// Of connections.
    pub connections: Connections,
    pub(crate) life: Arc<Life>,
}

impl Telemetry {
    /// Names begin with `prefix`.
    pub fn new(prefix: &str) -> Self {
        let telemetry = Self {
            registry: Mutex::new(Registry::with_prefix(prefix)),
            calls: Calls::default(),
            connections: Connections::default(),
            life: Arc::default(),
        };
        telemetry.calls.register(&telemetry);
        let connections = telemetry.connections.clone();
        telemetry.add("connections_accepted", "Connections taken", connections.accepted.clone());
        telemetry.add(
            "connections_refused",
            "Connections closed at once, beyond the limit",
            connections.refused.clone(),
        );
        telemetry.add("received_bytes", "Bytes that came, encryption included", connections.received.clone());
        telemetry.add("sent_bytes", "Bytes that went, encryption included", connections.sent.clone());
        telemetry
    }

    /// Shows a number under a name, which for a counter goes without its `_total`.
    pub fn add(&self, name: &str, help: &str, metric: impl Metric) {
        self.registry.lock().unwrap_or_else(PoisonError::into_inner).register(name, help, metric);
    }

    /// Shows what `read` says at the time.
    pub fn read(&self, name: &str, help: &str, read: impl Fn() -> i64 + Send + Sync + 'static) {
        self.add(name, help, Reading(read));
    }

    /// Shows a number that only grows, as `read` says it at the time.
    pub fn count(&self, name: &str, help: &str, read: impl Fn() -> u64 + Send + Sync + 'static) {
        self.add(name, help, Growing(read));
    }

    /// Whether the service takes calls. It is told, and says so at `/healthz` and in the log; it never begins twice.
    pub fn set_serving(&self, serving: bool) {
        self.life.serves(serving);
    }

    /// Whether the service takes calls.
    pub fn is_serving(&self) -> bool {
        self.life.is_serving()
    }

    /// All numbers, in the text format of Prometheus.
    ///
    /// # Errors
    /// None that a string gives.
    pub fn text(&self) -> Result<String, std::fmt::Error> {
        let mut text = String::new();
        prometheus_text::encode(&mut text, &self.registry.lock().unwrap_or_else(PoisonError::into_inner))?;
        Ok(text)
    }
}
