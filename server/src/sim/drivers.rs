//! Scripted drivers that suit every simulator.
//!
//! Deliberately absent: drivers that know a road or a maze; they live with their simulator.

use super::{Driver, Rng, rng::below};

/// Draws every action uniformly, without looking.
#[derive(Debug, Clone, Copy)]
pub(crate) struct RandomDriver {
    /// Number of actions; at least 1.
    pub(crate) n_actions: u32,
}

impl<S> Driver<S> for RandomDriver {
    fn act(&mut self, _simulator: &S, rng: &mut Rng) -> u32 {
        below(rng, self.n_actions)
    }
}
