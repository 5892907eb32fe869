//! Who makes a call, as far as the service was told.

use crate::grant::{Grant, Quotas, Scope};
use std::{
    cmp::Ordering,
    hash::{Hash, Hasher},
    sync::{Arc, LazyLock},
    time::SystemTime,
};

/// The holder of a token or a certificate, or anybody where neither is asked for. It travels among the extensions of a
/// request. Two are equal if their names are.
#[derive(Debug, Clone)]
pub struct Caller(Arc<Grant>);

impl Caller {
    /// Somebody of that name who may do everything.
    pub fn named(name: &str) -> Self {
        Self(Arc::new(Grant::unlimited(name.into())))
    }

    /// Anybody: the only caller of a service that asks for neither tokens nor certificates.
    pub fn anybody() -> Self {
        static ANYBODY: LazyLock<Caller> = LazyLock::new(|| Caller::named(""));
        ANYBODY.clone()
    }

    /// The caller of a request: who was found out before, or anybody.
    pub fn of<T>(request: &tonic::Request<T>) -> Self {
        request.extensions().get::<Self>().cloned().unwrap_or_else(Self::anybody)
    }

    /// The caller of a request of HTTP.
    pub fn of_http<T>(request: &http::Request<T>) -> Self {
        request.extensions().get::<Self>().cloned().unwrap_or_else(Self::anybody)
    }

    /// Its name in logs, spans and queues; empty for anybody.
    pub fn name(&self) -> &str {
        &self.0.name
    }

    /// Whether it may make calls of that kind.
    pub fn may(&self, scope: Scope) -> bool {
        self.0.scopes.contains(&scope)
    }

    /// How much it may take.
    pub fn quotas(&self) -> &Quotas {
        &self.0.quotas
    }

    /// False once its token has expired or was revoked.
    pub fn holds(&self, now: SystemTime) -> bool {
        self.0.holds(now)
    }
}

impl From<Arc<Grant>> for Caller {
    fn from(grant: Arc<Grant>) -> Self {
        Self(grant)
    }
}

impl PartialEq for Caller {
    fn eq(&self, other: &Self) -> bool {
        self.name() == other.name()
    }
}

impl Eq for Caller {}

impl Hash for Caller {
    fn hash<H: Hasher>(&self, state: &mut H) {
        self.name().hash(state);
    }
}

impl PartialOrd for Caller {
    fn partial_cmp(&self, other: &Self) -> Option<Ordering> {
        Some(self.cmp(other))
    }
}

impl Ord for Caller {
    fn cmp(&self, other: &Self) -> Ordering {
        self.name().cmp(other.name())
    }
}
