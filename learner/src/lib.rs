//! Mazeway's learner: watches experts act and works out what they want.
//!
//! Learning flows one way: trajectory → store → statistics → fit → policy → report. The core ([`mdp`], [`trajectory`],
//! [`statistics`], [`irl`], [`eval`]) knows no storage and no transport and compiles without the feature `service`.

pub mod eval;
pub mod irl;
pub mod mdp;
#[cfg(feature = "service")]
pub mod report;
pub mod statistics;
pub mod trajectory;

#[cfg(feature = "service")]
pub mod store;
