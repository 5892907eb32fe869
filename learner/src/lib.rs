//! Mazeway's learner: watches experts act and works out what they want.
//!
//! Learning flows one way: trajectory → store → statistics → fit → policy → report. The core ([`mdp`], [`trajectory`],
//! [`transitions`], [`statistics`], [`irl`], [`eval`]) knows no storage and no transport and compiles without the feature `service`.

#[cfg(feature = "service")]
pub mod config;
pub mod eval;
#[cfg(feature = "service")]
pub mod files;
#[cfg(feature = "service")]
mod grpc;
pub mod irl;
pub mod mdp;
#[cfg(feature = "service")]
pub mod report;
pub mod statistics;
#[cfg(feature = "service")]
pub mod store;
pub mod trajectory;
pub mod transitions;

#[cfg(feature = "service")]
pub use config::Config;
#[cfg(feature = "service")]
pub use grpc::{CallError, ServeError, fit_options, serve, serve_observed, stopped, telemetry, yield_to_others};
