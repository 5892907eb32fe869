//! The gRPC face: decoding, calling, encoding, and nothing that computes.

pub(crate) mod aside;
mod from_proto;
pub(crate) mod host;
pub(crate) mod interact;
mod numbers;
mod reply;
mod rules;
mod serve;
mod service;
mod status;
mod to_proto;
mod watch;
mod workers;

pub use serve::{ServeError, serve, serve_observed, telemetry};
pub use status::CallError;
pub(crate) use status::with_details;
