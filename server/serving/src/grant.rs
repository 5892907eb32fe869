//! What a caller may do, and how much of it.

use std::{
    fmt,
    str::FromStr,
    sync::atomic::{AtomicBool, Ordering},
    time::SystemTime,
};

/// A kind of call that a token may be good for. None contains another.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash, PartialOrd, Ord)]
pub enum Scope {
    /// Acting in environments.
    Act,
    /// Recording demonstrations and models.
    Record,
    /// Fitting, and reading what is recorded and fitted.
    Fit,
    /// Deleting.
    Admin,
}

impl Scope {
    /// All of them.
    pub const ALL: [Self; 4] = [Self::Act, Self::Record, Self::Fit, Self::Admin];

    /// Its name in files, flags and messages.
    pub fn name(self) -> &'static str {
        match self {
            Self::Act => "act",
            Self::Record => "record",
            Self::Fit => "fit",
            Self::Admin => "admin",
        }
    }
}

impl fmt::Display for Scope {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(self.name())
    }
}

impl FromStr for Scope {
    type Err = String;

    fn from_str(text: &str) -> Result<Self, String> {
        Self::ALL
            .into_iter()
            .find(|scope| scope.name() == text)
            .ok_or_else(|| format!("expected act, record, fit or admin, got {text:?}"))
    }
}

/// How much of a service one caller may take; `None`: as much as the service has.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq)]
pub struct Quotas {
    /// Sessions at a time.
    pub max_sessions: Option<usize>,
    /// Environments of all its sessions together.
    pub max_envs: Option<usize>,
    /// Bytes of demonstrations and models that it may record in all; deleting gives none back.
    pub max_recorded_bytes: Option<u64>,
    /// Fits that wait or run at a time.
    pub max_fits: Option<usize>,
}

/// What a token, or a certificate, entitles to.
#[derive(Debug)]
pub struct Grant {
    /// Whose it is: in logs, spans, queues and for what it owns.
    pub name: String,
    /// What it is good for.
    pub scopes: Vec<Scope>,
    /// How much of it.
    pub quotas: Quotas,
    /// When it ends.
    pub expires: Option<SystemTime>,
    revoked: AtomicBool,
}

impl Grant {
    /// A grant that holds until `expires`.
    pub fn new(name: String, scopes: Vec<Scope>, quotas: Quotas, expires: Option<SystemTime>) -> Self {
        Self { name, scopes, quotas, expires, revoked: AtomicBool::new(false) }
    }

    /// Everything, for ever.
    pub fn unlimited(name: String) -> Self {
        Self::new(name, Scope::ALL.to_vec(), Quotas::default(), None)
    }

    /// Ends it now, also for the calls that it began.
    pub fn revoke(&self) {
        self.revoked.store(true, Ordering::Relaxed);
    }

    /// True until it expires or is revoked.
    pub fn holds(&self, now: SystemTime) -> bool {
        !self.revoked.load(Ordering::Relaxed) && self.expires.is_none_or(|expires| now < expires)
    }
}
