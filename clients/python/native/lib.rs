//! `mazeway._native`: the Rust client behind Python's environments.
//!
//! Two layers. `Channel` carries any call as bytes, for Python has the messages; `Interaction` is the fast path, which
//! decodes into numpy arrays itself. The caller's thread drives the I/O with the interpreter released, so that a step
//! costs no hop to another thread; in between, a `Keeper` answers the server's pings.
//!
//! Invariants: every wait ends within its timeout and heeds signals; an object belongs to the process that made it, is
//! refused in a forked child and dropped there without touching what the parent still uses. Deliberately absent: sessions'
//! states, spaces and error types, which Python has once for both clients.

mod arrays;
mod channel;
mod driver;
mod errors;
mod interaction;

/// The module itself.
#[pyo3::pymodule(name = "_native")]
mod native {
    #[pymodule_export]
    use crate::{
        channel::{Answers, Channel, Exchange},
        driver::Keeper,
        errors::{CallError, ForeignProcessError, LateError},
        interaction::Interaction,
    };
}
