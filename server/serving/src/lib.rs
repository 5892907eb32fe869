//! What the services of Mazeway share at their door, whatever they serve: where they listen, how many connections they
//! take, who calls, what a caller may do, and how long anything may last.
//!
//! It knows no environment and no learner, so either may stand on it, and it is never part of their cores.

pub mod caller;
pub mod config;
pub mod connections;
pub mod door;
pub mod fair;
pub mod grant;
pub mod keyring;
pub mod listen;
pub mod rules;
pub mod running;
pub mod settings;
pub mod socket;
pub mod spin;
pub mod telemetry;
pub mod tls;
pub mod token_command;
pub mod tokens;
pub mod transport;
pub mod watch;

pub use caller::Caller;
pub use config::{DoorConfig, DoorError};
pub use listen::{ListenAddress, Listener};
pub use telemetry::{Telemetry, TelemetryConfig};

/// A number for something that went wrong inside: the log has it beside what happened, the caller is told no more.
pub fn incident() -> String {
    let mut bytes = [0; 4];
    // Without randomness every incident is number 0; the log has its time all the same.
    let _ = getrandom::fill(&mut bytes);
    format!("{:08x}", u32::from_le_bytes(bytes))
}
