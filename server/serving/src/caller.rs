//! Who makes a call, as far as the service was told.

use std::sync::Arc;

/// The holder of a token, or anybody where none are asked for. It travels among the extensions of a request.
#[derive(Debug, Clone, PartialEq, Eq, Hash, PartialOrd, Ord)]
pub struct Caller {
    name: Arc<str>,
}

impl Caller {
    /// The holder of the token of that name.
    pub fn named(name: &str) -> Self {
        Self { name: name.into() }
    }

    /// Anybody: the only caller of a service that asks for no tokens.
    pub fn anybody() -> Self {
        Self::named("")
    }

    /// The caller of a request: who was found out before, or anybody.
    pub fn of<T>(request: &tonic::Request<T>) -> Self {
        request.extensions().get::<Self>().cloned().unwrap_or_else(Self::anybody)
    }

    /// Its name in logs, metrics and queues; empty for anybody.
    pub fn name(&self) -> &str {
        &self.name
    }
}
