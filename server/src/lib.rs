//! Mazeway's environments: pure simulators ([`sim`]), batches and sessions of them, and the gRPC service over them.
//!
//! Acting flows one way: client → session → batch → simulator → observation. [`sim`] and the batch know no transport
//! and compile without the feature `grpc`.

pub mod sim;
