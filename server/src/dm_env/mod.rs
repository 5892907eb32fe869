//! The second face of the server: `dm_env_rpc.v1.Environment`, DeepMind's protocol, over the same catalogue, sessions and
//! limits as the first. `docs/DM_ENV_RPC.md` says what a world, a setting and an observation are.
//!
//! Invariants: a request that fails is answered in the stream and changes nothing; a world is a session whose batch is a
//! [`world::World`], so that every limit and lease holds for both faces; nothing is allocated by the shape that a tensor
//! claims to have. Deliberately absent: worlds of several agents.

mod changes;
mod error;
mod frames;
mod process;
mod properties;
mod seat;
mod settings;
mod specs;
mod tensor;
mod world;

pub use frames::EnvironmentServer;

#[cfg(test)]
mod tests;
