//! Settings of the door, the same for every service: who is let in, and what a peer may take of the transport.

use crate::{
    keyring::{Keyring, KeyringError},
    listen::ListenAddress,
    tls::{TlsError, TlsFiles},
};
use clap::builder::RangedU64ValueParser;
use std::{ops::RangeInclusive, path::PathBuf, time::Duration};
use tokio_rustls::TlsAcceptor;

/// Everything that the door can be told. [`DoorConfig::default`] has the defaults of the flags.
#[derive(Debug, Clone, PartialEq, clap::Args)]
#[command(next_help_heading = "Access and transport")]
pub struct DoorConfig {
    /// Certificate chain of this service, in PEM; with --tls-key, everything is encrypted.
    #[arg(long, value_name = "FILE")]
    pub tls_cert: Option<PathBuf>,
    /// Private key of the certificate, in PEM.
    #[arg(long, value_name = "FILE")]
    pub tls_key: Option<PathBuf>,
    /// Certificates, in PEM, of those who sign clients; with it a client must show a certificate, and is called by its
    /// subject's common name.
    #[arg(long, value_name = "FILE")]
    pub tls_client_ca: Option<PathBuf>,
    /// File of tokens: with it, every call but a health check needs one. It is read again when it changes.
    #[arg(long, value_name = "FILE")]
    pub tokens: Option<PathBuf>,
    /// Answer server reflection without a token.
    #[arg(long)]
    pub open_reflection: bool,
    /// Connections at a time; a further one is closed at once.
    #[arg(long, default_value_t = 1024, value_parser = count(1..=ENOUGH), value_name = "N")]
    pub max_connections: usize,
    /// Bytes of all metadata of a call together.
    #[arg(long, default_value_t = 16 << 10, value_parser = clap::value_parser!(u32).range(1024..=1 << 24), value_name = "BYTES")]
    pub max_metadata_bytes: u32,
    /// Calls of one connection that it may give up within a second; with more it is closed.
    #[arg(long, default_value_t = 1000, value_name = "N")]
    pub max_resets_per_second: u32,
    /// Time that a new connection has for its TLS handshake and its first bytes, in seconds.
    #[arg(long = "handshake-timeout-secs", default_value = "10", value_parser = seconds, value_name = "SECS")]
    pub handshake_timeout: Duration,
    /// Time after which a connection without a call is closed, in seconds; clients connect anew by themselves.
    #[arg(long = "idle-timeout-secs", default_value = "900", value_parser = seconds, value_name = "SECS")]
    pub idle_timeout: Duration,
    /// Time after which a stream ends whose reader takes nothing of what is ready for it, in seconds.
    #[arg(long = "stall-timeout-secs", default_value = "300", value_parser = seconds, value_name = "SECS")]
    pub stall_timeout: Duration,
    /// Deadline of a call that is no stream and asks for none, in seconds.
    #[arg(long = "call-deadline-secs", default_value = "60", value_parser = seconds, value_name = "SECS")]
    pub call_deadline: Duration,
    /// Longest deadline of a call that is no stream, in seconds; a longer one is cut to it.
    #[arg(long = "max-call-deadline-secs", default_value = "3600", value_parser = seconds, value_name = "SECS")]
    pub max_call_deadline: Duration,
}

impl Default for DoorConfig {
    fn default() -> Self {
        Self {
            tls_cert: None,
            tls_key: None,
            tls_client_ca: None,
            tokens: None,
            open_reflection: false,
            max_connections: 1024,
            max_metadata_bytes: 16 << 10,
            max_resets_per_second: 1000,
            handshake_timeout: Duration::from_secs(10),
            idle_timeout: Duration::from_mins(15),
            stall_timeout: Duration::from_mins(5),
            call_deadline: Duration::from_mins(1),
            max_call_deadline: Duration::from_hours(1),
        }
    }
}

/// Settings that cannot be followed.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
pub enum DoorError {
    /// Two that do not go together.
    #[error("{0}")]
    Settings(&'static str),
    /// A certificate or a key.
    #[error(transparent)]
    Tls(#[from] TlsError),
    /// The file of tokens.
    #[error(transparent)]
    Tokens(#[from] KeyringError),
}

impl DoorConfig {
    /// The files of TLS, where it is wanted.
    ///
    /// # Errors
    /// One is missing.
    pub fn tls_files(&self) -> Result<Option<TlsFiles>, DoorError> {
        match (&self.tls_cert, &self.tls_key) {
            (Some(cert), Some(key)) => {
                Ok(Some(TlsFiles { cert: cert.clone(), key: key.clone(), client_ca: self.tls_client_ca.clone() }))
            }
            (Some(_), None) => Err(DoorError::Settings("expected --tls-key beside --tls-cert")),
            (None, Some(_)) => Err(DoorError::Settings("expected --tls-cert beside --tls-key")),
            (None, None) if self.tls_client_ca.is_some() => {
                Err(DoorError::Settings("expected --tls-cert and --tls-key beside --tls-client-ca"))
            }
            (None, None) => Ok(None),
        }
    }

    /// What takes connections over TLS, where it is wanted.
    ///
    /// # Errors
    /// A file is missing or does not serve.
    pub fn acceptor(&self) -> Result<Option<TlsAcceptor>, DoorError> {
        Ok(self.tls_files()?.map(|files| files.acceptor()).transpose()?)
    }

    /// The tokens, where they are asked for.
    ///
    /// # Errors
    /// The file does not serve.
    pub fn keyring(&self) -> Result<Option<Keyring>, DoorError> {
        Ok(self.tokens.as_deref().map(Keyring::open).transpose()?)
    }

    /// Reads every file that the settings name, so that what is wrong with one is said before anybody is let in.
    ///
    /// # Errors
    /// A file is missing or does not serve.
    pub fn check(&self) -> Result<(), DoorError> {
        self.acceptor()?;
        self.keyring().map(|_| ())
    }

    /// Whether a service may listen there: other machines reach it only if strangers can neither listen nor call.
    ///
    /// # Errors
    /// What is missing, as a message and a hint.
    pub fn check_exposed(&self, listen: &ListenAddress, insecure: bool) -> Result<(), (String, &'static str)> {
        let encrypted = self.tls_cert.is_some();
        let missing = match (encrypted, self.tokens.is_some() || (encrypted && self.tls_client_ca.is_some())) {
            (true, true) => return Ok(()),
            _ if listen.is_local() || insecure => return Ok(()),
            (false, false) => "nothing on it is encrypted or authenticated",
            (false, true) => "nothing on it is encrypted, the tokens neither",
            (true, false) => "nobody is asked who they are",
        };
        Err((
            format!("{listen} is reached from other machines, and {missing}"),
            "add --tls-cert, --tls-key and --tokens (or --tls-client-ca), listen on 127.0.0.1, or add --insecure where the network is trusted",
        ))
    }
}

/// More than any service has room for, and few enough to be counted everywhere.
pub const ENOUGH: u64 = 1 << 30;

/// A number within bounds.
pub fn count(bounds: RangeInclusive<u64>) -> RangedU64ValueParser<usize> {
    RangedU64ValueParser::new().range(bounds)
}

/// Longest time that any setting may be.
const LONGEST: Duration = Duration::from_hours(365 * 24);

/// A positive number of seconds.
///
/// # Errors
/// It is none, or longer than a year.
pub fn seconds(text: &str) -> Result<Duration, String> {
    let secs = text.parse().ok().and_then(|secs| Duration::try_from_secs_f64(secs).ok());
    let within = secs.filter(|duration| !duration.is_zero() && *duration <= LONGEST);
    within.ok_or_else(|| "expected a positive number of seconds, at most a year".into())
}

#[cfg(test)]
mod tests {
    use super::*;
    use clap::{Args as _, FromArgMatches as _};

    #[test]
    fn flags_default_to_the_default() {
        let matches = DoorConfig::augment_args(clap::Command::new("door")).get_matches_from(["door"]);
        assert_eq!(DoorConfig::from_arg_matches(&matches).expect("parses"), DoorConfig::default());
    }

    #[test]
    fn seconds_are_positive() {
        assert_eq!(seconds("0.25"), Ok(Duration::from_millis(250)));
        for wrong in ["0", "-1", "nan", "inf", "1e12", "soon", ""] {
            assert!(seconds(wrong).is_err(), "{wrong}");
        }
    }

    #[test]
    fn other_machines_are_let_in_under_lock_and_key_alone() {
        let file = || Some(PathBuf::from("file"));
        let (outside, inside) = ("0.0.0.0:1".parse().expect("parses"), "127.0.0.1:1".parse().expect("parses"));
        let plain = DoorConfig::default();
        let tls = DoorConfig { tls_cert: file(), tls_key: file(), ..plain.clone() };
        let tokens = DoorConfig { tokens: file(), ..plain.clone() };
        let both = DoorConfig { tokens: file(), ..tls.clone() };
        let mutual = DoorConfig { tls_client_ca: file(), ..tls.clone() };
        for (config, may) in [(&plain, false), (&tls, false), (&tokens, false), (&both, true), (&mutual, true)] {
            assert_eq!(config.check_exposed(&outside, false).is_ok(), may, "{config:?}");
            assert!(config.check_exposed(&outside, true).is_ok() && config.check_exposed(&inside, false).is_ok());
        }
        let (message, _) = tokens.check_exposed(&outside, false).expect_err("refused");
        assert!(message.contains("the tokens neither"), "{message}");
    }

    #[test]
    fn half_a_pair_is_refused() {
        let file = || Some(PathBuf::from("file"));
        for config in [
            DoorConfig { tls_cert: file(), ..DoorConfig::default() },
            DoorConfig { tls_key: file(), ..DoorConfig::default() },
            DoorConfig { tls_client_ca: file(), ..DoorConfig::default() },
        ] {
            assert!(matches!(config.acceptor(), Err(DoorError::Settings(_))), "{config:?}");
        }
    }
}
