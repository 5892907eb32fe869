//! A server under load: two thousand sessions from two hundred connections, of which half are idle, some step as fast as they
//! can, some never read their streams and some vanish without a word; and beside them one client that behaves well.
//!
//! What is asked: how long the well-behaved client waits for a step, beside what it waited before the load came; how much
//! memory a session takes; whether the sessions are there all the time; whether, once the load has gone, every lease has run out
//! and memory and files are as before. And how long steps take beside fits ([`fits`]).
//!
//! The load runs in processes of its own under the idle policy of the scheduler, for it stands for other machines.

mod acting;
pub mod fits;
pub mod load;
pub mod probe;
pub mod report;
pub mod run;
mod server;
