//! Settings of the learner service: where it keeps its data, limits and times.

use mazeway_serving::{
    DoorConfig,
    config::{count, seconds},
};
use std::{ops::RangeInclusive, path::PathBuf, time::Duration};

/// Everything that a learner service can be told.
#[derive(Debug, Clone, PartialEq)]
pub struct Config {
    /// Directory of the recordings, models and fits; made where it is missing.
    pub data: PathBuf,
    /// What it refuses.
    pub limits: Limits,
    /// Who is let in, and what a peer may take of the transport.
    pub door: DoorConfig,
}

impl Config {
    /// The default limits over the data of a directory.
    pub fn new(data: impl Into<PathBuf>) -> Self {
        Self { data: data.into(), limits: Limits::default(), door: DoorConfig::default() }
    }
}

/// Limits, each a flag of `learner serve`. What exceeds one is refused with RESOURCE_EXHAUSTED.
#[derive(Debug, Clone, PartialEq, clap::Args)]
#[command(next_help_heading = "Limits")]
pub struct Limits {
    /// Largest message accepted or sent, in bytes
    #[arg(long, default_value_t = 32 << 20, value_parser = count(MESSAGE_BYTES), value_name = "BYTES")]
    pub max_message_bytes: usize,
    /// Trajectories in one request
    #[arg(long, default_value_t = 10_000, value_parser = count(1..=u32::MAX.into()), value_name = "N")]
    pub max_trajectories_per_request: usize,
    /// Steps of one trajectory
    #[arg(long, default_value_t = 1_000_000, value_parser = count(1..=u32::MAX.into()), value_name = "N")]
    pub max_steps_per_trajectory: usize,
    /// Requests of one recording stream that wait for the disk; further ones wait on the wire
    #[arg(long, default_value_t = 64, value_parser = count(1..=65_536), value_name = "N")]
    pub max_requests_in_flight: usize,
    /// Bytes of the store in use from which recordings and models are refused; deleting, reading and fits go on [default:
    /// as many as the disk has]
    #[arg(long, value_name = "BYTES")]
    pub max_store_bytes: Option<u64>,
    /// State-action pairs of one model
    #[arg(long, default_value_t = 4_000_000, value_parser = clap::value_parser!(u64).range(1..), value_name = "N")]
    pub max_model_rows: u64,
    /// Transitions of one model
    #[arg(long, default_value_t = 20_000_000, value_parser = clap::value_parser!(u64).range(1..), value_name = "N")]
    pub max_model_transitions: u64,
    /// Models that are taken in or given out at a time; further ones wait their turn
    #[arg(long, default_value_t = 2, value_parser = count(1..=1024), value_name = "N")]
    pub max_concurrent_models: usize,
    /// Time for which the other end of a model's stream may do nothing, in seconds; it has to keep up 64 KiB a second in the
    /// long run
    #[arg(long = "model-patience-secs", default_value = "30", value_parser = seconds, value_name = "SECS")]
    pub model_patience: Duration,
    /// Fits that run at a time; further ones wait their turn
    #[arg(long, default_value_t = 2, value_parser = count(1..=1024), value_name = "N")]
    pub max_concurrent_fits: usize,
    /// Fits that wait their turn; callers with tokens take turns, and none of them takes all places
    #[arg(long, default_value_t = 256, value_parser = count(0..=1_000_000), value_name = "N")]
    pub max_queued_fits: usize,
    /// Iterations that a fit may ask for
    #[arg(long, default_value_t = 1_000_000, value_parser = clap::value_parser!(u32).range(1..), value_name = "N")]
    pub max_fit_iterations: u32,
    /// Calls and streams of one connection at a time
    #[arg(long, default_value_t = 256, value_parser = clap::value_parser!(u32).range(1..), value_name = "N")]
    pub max_streams_per_connection: u32,
    /// Time between HTTP/2 pings that find out whether a silent peer is still there, in seconds
    #[arg(long = "keepalive-secs", default_value = "10", value_parser = seconds, value_name = "SECS")]
    pub keepalive: Duration,
    /// Time that running calls have to end once the service is told to stop, in seconds
    #[arg(long = "shutdown-grace-secs", default_value = "10", value_parser = seconds, value_name = "SECS")]
    pub shutdown_grace: Duration,
}

impl Default for Limits {
    /// The defaults of the flags.
    fn default() -> Self {
        Self {
            max_message_bytes: 32 << 20,
            max_trajectories_per_request: 10_000,
            max_steps_per_trajectory: 1_000_000,
            max_requests_in_flight: 64,
            max_store_bytes: None,
            max_model_rows: 4_000_000,
            max_model_transitions: 20_000_000,
            max_concurrent_models: 2,
            model_patience: Duration::from_secs(30),
            max_concurrent_fits: 2,
            max_queued_fits: 256,
            max_fit_iterations: 1_000_000,
            max_streams_per_connection: 256,
            keepalive: Duration::from_secs(10),
            shutdown_grace: Duration::from_secs(10),
        }
    }
}

/// Bytes that a message may have at most: enough for any call without an array, and no more than gRPC can count.
const MESSAGE_BYTES: RangeInclusive<u64> = 1024..=i32::MAX as u64;

#[cfg(test)]
mod tests {
    use super::*;
    use clap::{Args as _, FromArgMatches as _};

    #[test]
    fn the_flags_have_the_defaults_of_the_library() {
        let matches = Limits::augment_args(clap::Command::new("limits")).get_matches_from(["limits"]);
        assert_eq!(Limits::from_arg_matches(&matches).unwrap(), Limits::default());
    }
}
