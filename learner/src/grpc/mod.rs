//! The gRPC face of the learner: decoding, calling, encoding.
//!
//! Invariants: no call blocks an async thread, none holds memory that grows with the data, and every failure is a status
//! that names the field to blame.

mod fit;
mod fit_job;
mod from_proto;
mod models;
mod numbers;
mod options;
mod pace;
mod record;
mod rules;
mod serve;
mod service;
mod status;
mod to_proto;

pub use fit::yield_to_others;
pub use options::{from_proto as fit_options, stopped_from_proto as stopped};
pub use serve::{ServeError, serve, serve_observed, telemetry};
pub use status::CallError;

/// Runs work that takes a while off the async threads.
async fn blocking<T: Send + 'static>(
    work: impl FnOnce() -> Result<T, CallError> + Send + 'static,
) -> Result<T, CallError> {
    tokio::task::spawn_blocking(work).await.map_err(|error| CallError::Internal(error.to_string()))?
}
