//! Settings of a server: limits and times, each a flag, a variable and a key of the binary's file of settings.

use crate::sessions::Limits;
use mazeway_serving::{
    DoorConfig, ListenAddress, TelemetryConfig,
    config::{ENOUGH, count, seconds},
    token_command::TokenArgs,
};
use std::{path::PathBuf, time::Duration};

/// Everything that a server can be told. [`Config::default`] has the defaults of the flags.
#[derive(Debug, Clone, PartialEq, clap::Args)]
pub struct Config {
    /// Sessions at a time; a further one is refused with `RESOURCE_EXHAUSTED`.
    #[arg(long, default_value_t = 1024, value_parser = count(1..=ENOUGH), value_name = "N")]
    pub max_sessions: usize,
    /// Environments in one session.
    #[arg(long, default_value_t = 16_384, value_parser = count(1..=ENOUGH), value_name = "N")]
    pub max_envs_per_session: usize,
    /// Environments in all sessions together.
    #[arg(long, default_value_t = 65_536, value_parser = count(1..=ENOUGH), value_name = "N")]
    pub max_total_envs: usize,
    /// Lease of a session that asks for none, in seconds.
    #[arg(long = "default-lease-secs", default_value = "300", value_parser = seconds, value_name = "SECS")]
    pub default_lease: Duration,
    /// Longest lease that a session may ask for, in seconds.
    #[arg(long = "max-lease-secs", default_value = "3600", value_parser = seconds, value_name = "SECS")]
    pub max_lease: Duration,
    /// Largest message accepted or sent, in bytes.
    #[arg(long, default_value_t = 16 << 20, value_parser = count(1024..=i32::MAX as u64), value_name = "BYTES")]
    pub max_message_bytes: usize,
    /// Roll-outs that run at a time; a further one is refused with `RESOURCE_EXHAUSTED`.
    #[arg(long, default_value_t = 8, value_parser = count(0..=1024), value_name = "N")]
    pub max_concurrent_rollouts: usize,
    /// Steps of one roll-out in all, burn-in included.
    #[arg(long, default_value_t = 1_000_000_000, value_parser = clap::value_parser!(u64).range(1..), value_name = "N")]
    pub max_rollout_steps: u64,
    /// Viewers of one session at a time; a further one is refused with `RESOURCE_EXHAUSTED`.
    #[arg(long, default_value_t = 64, value_parser = count(0..=ENOUGH), value_name = "N")]
    pub max_viewers_per_session: usize,
    /// Viewers of all sessions together.
    #[arg(long, default_value_t = 256, value_parser = count(0..=ENOUGH), value_name = "N")]
    pub max_viewers: usize,
    /// Models that are computed at a time; further callers wait.
    #[arg(long, default_value_t = 2, value_parser = count(1..=1024), value_name = "N")]
    pub max_concurrent_models: usize,
    /// Calls and streams of one connection at a time; a further one waits, so leave room for more than its sessions.
    #[arg(long, default_value_t = 2048, value_parser = clap::value_parser!(u32).range(1..), value_name = "N")]
    pub max_streams_per_connection: u32,
    /// Threads that serve connections, each connection on one of them; 0: as many as there are cores.
    #[arg(long, default_value_t = 0, value_parser = count(0..=1024), value_name = "N")]
    pub threads: usize,
    /// Microseconds for which a thread that has read something looks for more before it sleeps, where that has paid before;
    /// 0: it sleeps at once.
    #[arg(long, default_value_t = 100, value_parser = clap::value_parser!(u64).range(..=10_000), value_name = "N")]
    pub spin_micros: u64,
    /// Time between HTTP/2 pings that find out whether a silent peer is still there, in seconds.
    #[arg(long = "keepalive-secs", default_value = "10", value_parser = seconds, value_name = "SECS")]
    pub keepalive: Duration,
    /// Time that running calls have to end once the server is told to stop, in seconds.
    #[arg(long = "shutdown-grace-secs", default_value = "5", value_parser = seconds, value_name = "SECS")]
    pub shutdown_grace: Duration,
    /// Who is let in, and what a peer may take of the transport.
    #[command(flatten)]
    pub door: DoorConfig,
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
            max_streams_per_connection: 2048,
            threads: 0,
            spin_micros: 100,
            keepalive: Duration::from_secs(10),
            shutdown_grace: Duration::from_secs(5),
            door: DoorConfig::default(),
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

    /// Longest time for which a thread looks for more before it sleeps.
    pub fn spin(&self) -> Duration {
        Duration::from_micros(self.spin_micros)
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

/// What begins the name of every variable: `MAZEWAY_SERVER_MAX_SESSIONS` is `--max-sessions`.
pub const VARIABLES: &str = "MAZEWAY_SERVER_";

/// Where the settings are among the commands of the binary `server`.
pub const PLACES: [Option<&str>; 2] = [None, Some("config")];

/// The command line of the binary `server`.
#[derive(Debug, Clone, PartialEq, clap::Parser)]
#[command(name = "server", version, about = "Serves Mazeway's environments over gRPC")]
#[command(args_conflicts_with_subcommands = true, disable_help_subcommand = true)]
#[command(
    after_help = "Every flag is also a variable, MAZEWAY_SERVER_ and its name in capitals, and a key of the file of \
    --config: a flag wins over the variable, the variable over the file."
)]
pub struct Cli {
    /// What to do instead of serving.
    #[command(subcommand)]
    pub command: Option<Command>,
    /// Everything that can be set.
    #[command(flatten)]
    pub settings: Settings,
}

/// What the binary does beside serving.
#[derive(Debug, Clone, PartialEq, clap::Subcommand)]
pub enum Command {
    /// Print the configuration as a file, with where each value comes from; takes the flags of the server
    Config(Box<Settings>),
    /// Make a token for --tokens, and show its secret once
    Token(TokenArgs),
}

/// Everything that can be set.
#[derive(Debug, Clone, PartialEq, clap::Args)]
pub struct Settings {
    /// File of settings, in TOML, each under the name of its flag.
    #[arg(long, value_name = "FILE")]
    pub config: Option<PathBuf>,
    /// Address to listen on, or unix:PATH for a Unix socket that its owner alone may use; port 0 takes a free one. One
    /// line with the address goes to standard output.
    #[arg(long, default_value = "127.0.0.1:50051", value_name = "ADDR")]
    pub listen: ListenAddress,
    /// Listen on an address that other machines reach, although not everything is encrypted and everybody asked who they
    /// are.
    #[arg(long)]
    pub insecure: bool,
    /// Limits and times.
    #[command(flatten)]
    pub limits: Config,
    /// What is shown.
    #[command(flatten)]
    pub telemetry: TelemetryConfig,
}

#[cfg(test)]
mod tests {
    use super::*;
    use clap::Parser as _;

    #[test]
    fn flags_default_to_the_default() {
        assert_eq!(Cli::parse_from(["server"]).settings.limits, Config::default());
    }
}
