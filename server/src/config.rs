//! Settings of a server: limits and times, each a flag and an environment variable of the binary.

use crate::sessions::Limits;
use mazeway_serving::ListenAddress;
use std::time::Duration;

/// Everything that a server can be told. [`Config::default`] has the defaults of the flags.
#[derive(Debug, Clone, PartialEq, clap::Args)]
pub struct Config {
    /// Sessions at a time; a further one is refused with `RESOURCE_EXHAUSTED`.
    #[arg(long, env = "MAZEWAY_MAX_SESSIONS", default_value_t = 1024, value_name = "N")]
    pub max_sessions: usize,
    /// Environments in one session.
    #[arg(long, env = "MAZEWAY_MAX_ENVS_PER_SESSION", default_value_t = 16_384, value_name = "N")]
    pub max_envs_per_session: usize,
    /// Environments in all sessions together.
    #[arg(long, env = "MAZEWAY_MAX_TOTAL_ENVS", default_value_t = 65_536, value_name = "N")]
    pub max_total_envs: usize,
    /// Lease of a session that asks for none, in seconds.
    #[arg(long = "default-lease-secs", env = "MAZEWAY_DEFAULT_LEASE_SECS", default_value = "300", value_parser = seconds, value_name = "SECS")]
    pub default_lease: Duration,
    /// Longest lease that a session may ask for, in seconds.
    #[arg(long = "max-lease-secs", env = "MAZEWAY_MAX_LEASE_SECS", default_value = "3600", value_parser = seconds, value_name = "SECS")]
    pub max_lease: Duration,
    /// Largest message accepted or sent, in bytes.
    #[arg(long, env = "MAZEWAY_MAX_MESSAGE_BYTES", default_value_t = 16 << 20, value_name = "BYTES")]
    pub max_message_bytes: usize,
    /// Roll-outs that run at a time; a further one is refused with `RESOURCE_EXHAUSTED`.
    #[arg(long, env = "MAZEWAY_MAX_CONCURRENT_ROLLOUTS", default_value_t = 8, value_name = "N")]
    pub max_concurrent_rollouts: usize,
    /// Steps of one roll-out in all, burn-in included.
    #[arg(long, env = "MAZEWAY_MAX_ROLLOUT_STEPS", default_value_t = 1_000_000_000, value_name = "N")]
    pub max_rollout_steps: u64,
    /// Viewers of one session at a time; a further one is refused with `RESOURCE_EXHAUSTED`.
    #[arg(long, env = "MAZEWAY_MAX_VIEWERS_PER_SESSION", default_value_t = 64, value_name = "N")]
    pub max_viewers_per_session: usize,
    /// Viewers of all sessions together.
    #[arg(long, env = "MAZEWAY_MAX_VIEWERS", default_value_t = 256, value_name = "N")]
    pub max_viewers: usize,
    /// Models that are computed at a time; further callers wait.
    #[arg(long, env = "MAZEWAY_MAX_CONCURRENT_MODELS", default_value_t = 2, value_name = "N")]
    pub max_concurrent_models: usize,
    /// Connections at a time; a further one is closed at once.
    #[arg(long, env = "MAZEWAY_MAX_CONNECTIONS", default_value_t = 1024, value_name = "N")]
    pub max_connections: usize,
    /// Calls and streams of one connection at a time; a further one waits, so leave room for more than its sessions.
    #[arg(long, env = "MAZEWAY_MAX_STREAMS_PER_CONNECTION", default_value_t = 2048, value_name = "N")]
    pub max_streams_per_connection: u32,
    /// Threads that serve connections, each connection on one of them; 0: as many as there are cores.
    #[arg(long, env = "MAZEWAY_THREADS", default_value_t = 0, value_name = "N")]
    pub threads: usize,
    /// Time between HTTP/2 pings that find out whether a silent peer is still there, in seconds.
    #[arg(long = "keepalive-secs", env = "MAZEWAY_KEEPALIVE_SECS", default_value = "10", value_parser = seconds, value_name = "SECS")]
    pub keepalive: Duration,
    /// Time that running calls have to end once the server is told to stop, in seconds.
    #[arg(long = "shutdown-grace-secs", env = "MAZEWAY_SHUTDOWN_GRACE_SECS", default_value = "5", value_parser = seconds, value_name = "SECS")]
    pub shutdown_grace: Duration,
}

impl Default for Config {
    fn default() -> Self {
        Self {
            max_sessions: 1024,
            max_envs_per_session: 16_384,
            max_total_envs: 65_536,
            default_lease: Duration::from_mins(5),
            max_lease: Duration::from_hours(1),
            max_message_bytes: 16 << 20,
            max_concurrent_rollouts: 8,
            max_rollout_steps: 1_000_000_000,
            max_viewers_per_session: 64,
            max_viewers: 256,
            max_concurrent_models: 2,
            max_connections: 1024,
            max_streams_per_connection: 2048,
            threads: 0,
            keepalive: Duration::from_secs(10),
            shutdown_grace: Duration::from_secs(5),
        }
    }
}

impl Config {
    /// Threads that serve connections.
    pub fn threads(&self) -> usize {
        match self.threads {
            0 => std::thread::available_parallelism().map_or(1, usize::from),
            threads => threads,
        }
    }

    /// What sessions may take.
    pub fn limits(&self) -> Limits {
        Limits {
            max_sessions: self.max_sessions,
            max_envs_per_session: self.max_envs_per_session,
            max_total_envs: self.max_total_envs,
            default_lease: self.default_lease.min(self.max_lease),
            max_lease: self.max_lease,
        }
    }
}

/// The command line of the binary `server`.
#[derive(Debug, Clone, PartialEq, clap::Parser)]
#[command(name = "server", version, about = "Serves Mazeway's environments over gRPC")]
pub struct Cli {
    /// Address to listen on, or unix:PATH for a Unix socket that its owner alone may use; port 0 takes a free one. One
    /// line with the address goes to standard output.
    #[arg(long, env = "MAZEWAY_LISTEN", default_value = "127.0.0.1:50051", value_name = "ADDR")]
    pub listen: ListenAddress,
    /// Listen on an address that other machines reach, although nothing is encrypted and nobody is asked who they are.
    #[arg(long, env = "MAZEWAY_INSECURE")]
    pub insecure: bool,
    /// Limits and times.
    #[command(flatten)]
    pub config: Config,
}

/// Longest time that any setting may be.
const LONGEST: Duration = Duration::from_hours(365 * 24);

fn seconds(text: &str) -> Result<Duration, String> {
    let secs = text.parse().ok().and_then(|secs| Duration::try_from_secs_f64(secs).ok());
    let within = secs.filter(|duration| !duration.is_zero() && *duration <= LONGEST);
    within.ok_or_else(|| "expected a positive number of seconds, at most a year".into())
}

#[cfg(test)]
mod tests {
    use super::*;
    use clap::Parser as _;

    #[test]
    fn flags_default_to_the_default() {
        assert_eq!(Cli::parse_from(["server"]).config, Config::default());
    }

    #[test]
    fn seconds_are_positive() {
        assert_eq!(seconds("0.25"), Ok(Duration::from_millis(250)));
        for wrong in ["0", "-1", "nan", "inf", "1e12", "soon", ""] {
            assert!(seconds(wrong).is_err(), "{wrong}");
        }
    }
}
