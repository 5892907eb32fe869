//! Mazeway's environments: pure simulators ([`sim`]), batches and sessions of them, and the gRPC service over them.
//!
//! Acting flows one way: client → session → batch → simulator → observation. All but [`serve`] and what it needs know no
//! transport and compile without the feature `grpc`.

pub mod batch;
#[cfg(feature = "grpc")]
pub mod config;
#[cfg(feature = "grpc")]
mod dm_env;
#[cfg(feature = "grpc")]
mod grpc;
pub mod raster;
pub mod registry;
pub mod rollout;
pub mod sessions;
pub mod sim;

#[cfg(feature = "grpc")]
pub use config::Config;
#[cfg(feature = "grpc")]
pub use grpc::{CallError, ServeError, serve, serve_observed, telemetry};
#[cfg(feature = "grpc")]
pub use mazeway_serving::{DoorConfig, ListenAddress, Listener};
