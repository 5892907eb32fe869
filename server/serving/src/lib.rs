//! What the services of Mazeway share at their door, whatever they serve: where they listen, how many connections they
//! take, who calls.
//!
//! It knows no environment and no learner, so either may stand on it, and it is never part of their cores.

pub mod caller;
pub mod connections;
pub mod listen;

pub use caller::Caller;
pub use listen::{ListenAddress, Listener};
