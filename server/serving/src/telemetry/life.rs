//! When a service began, was told to stop and stopped, in its log.

use crate::config::DoorConfig;
use std::{
    sync::{
        OnceLock,
        atomic::{AtomicU8, Ordering::Relaxed},
    },
    time::Instant,
};

const NEW: u8 = 0;
const SERVING: u8 = 1;
const STOPPING: u8 = 2;
const STOPPED: u8 = 3;

/// How far a service is, and what is told of it.
#[derive(Debug, Default)]
pub(crate) struct Life {
    stage: AtomicU8,
    address: OnceLock<String>,
    access: OnceLock<(bool, &'static str)>,
    begun: OnceLock<Instant>,
}

impl Life {
    /// Where it listens.
    pub fn listens(&self, address: impl ToString) {
        let _ = self.address.set(address.to_string());
    }

    /// Whom it lets in.
    pub fn asks(&self, config: &DoorConfig) {
        let auth = match (config.tokens.is_some(), config.tls_client_ca.is_some()) {
            (true, true) => "tokens and client certificates",
            (true, false) => "tokens",
            (false, true) => "client certificates",
            (false, false) => "nobody is asked",
        };
        let _ = self.access.set((config.tls_cert.is_some(), auth));
    }

    /// It takes calls from now on, or no more.
    pub fn serves(&self, serving: bool) {
        let (from, to) = if serving { (NEW, SERVING) } else { (SERVING, STOPPING) };
        if self.stage.compare_exchange(from, to, Relaxed, Relaxed).is_err() {
            return;
        }
        if serving {
            let _ = self.begun.set(Instant::now());
            let address = self.address.get().map_or("", String::as_str);
            let (tls, auth) = self.access.get().copied().unwrap_or_default();
            tracing::info!(address, tls, auth, version = env!("CARGO_PKG_VERSION"), "the service takes calls");
        } else {
            tracing::info!("the service was told to stop: nobody is let in, and calls under way may end");
        }
    }

    /// Whether it takes calls.
    pub fn is_serving(&self) -> bool {
        self.stage.load(Relaxed) == SERVING
    }

    /// Nobody is inside any more.
    pub fn ended(&self) {
        let stage = self.stage.swap(STOPPED, Relaxed);
        if stage == SERVING || stage == STOPPING {
            let served_secs = self.begun.get().map_or(0, |begun| begun.elapsed().as_secs());
            tracing::info!(served_secs, "the service has stopped");
        }
    }
}
