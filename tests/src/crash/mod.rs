//! Power cuts: the store on a disk that forgets what it did not promise, against a model of what it must remember.
//!
//! [`disk`] keeps a log of everything that SQLite writes and syncs, and makes of it what a disk may hold after a cut at
//! any moment; [`vfs`] lets SQLite write there; [`history`] is what is done to a store; [`check`] does it, cuts the power
//! many times, opens what is left and compares.

pub mod check;
pub mod disk;
pub mod history;
mod subject;
pub mod vfs;
