//! The gRPC face: decoding, calling, encoding, and nothing that computes.

mod from_proto;
mod host;
mod interact;
mod picture;
mod serve;
mod service;
mod status;
mod to_proto;

pub use serve::{ServeError, serve};
pub use status::CallError;
