//! A run of neighbouring environments of a batch with the parts of the reply that are theirs: what one core works on.
//!
//! Invariants: what an environment does depends on its own state, generator and action alone, so that neither the number
//! of blocks nor who works on them changes a number; nothing here allocates or locks. Deliberately absent: checks, which
//! come before anything changes.

use super::{Autoreset, Seeds, buffers::Parts};
use crate::sim::{
    Rng, Simulator,
    rng::{Purpose, stream},
};

/// Bit of a clock that says that the episode is over and a reset is due; the others count its steps.
const ENDED: u32 = 1 << 31;

/// Environments that are stepped before what they show is packed: few enough to stay in the nearest cache.
const AT_A_TIME: usize = 32;

/// Steps of an episode and whether it has ended, in one word.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub(super) struct Clock(u32);

impl Clock {
    pub fn ended(self) -> bool {
        self.0 & ENDED != 0
    }

    /// Steps of the episode.
    pub fn steps(self) -> u32 {
        self.0 & !ENDED
    }

    /// One step more, up to the most that can be told.
    fn tick(&mut self) -> u32 {
        self.0 = (self.0 + 1).min(ENDED - 1);
        self.0
    }

    fn end(&mut self) {
        self.0 |= ENDED;
    }
}

/// What every environment of a batch shares.
#[derive(Debug, Clone, Copy)]
pub(super) struct Rules<'a> {
    pub autoreset: Autoreset,
    /// 0 means never.
    pub max_episode_steps: u32,
    /// Bytes of each info column of the spec; a further column is the action mask.
    pub info_lens: &'a [usize],
}

/// What is to be done with every environment.
#[derive(Debug, Clone, Copy)]
pub(super) enum Work<'a> {
    /// Begin episodes; all seeds and the mask are those of the whole batch.
    Reset { seeds: Seeds<'a>, mask: Option<&'a [u8]>, fresh: Option<u64> },
    /// Step; the packed actions are those of the whole batch.
    Step { actions: &'a [[u8; 4]] },
}

/// Some neighbouring environments.
pub(super) struct Block<'a, S: Simulator> {
    /// Rank of the first in its batch.
    pub first: usize,
    pub states: &'a mut [S::Stored],
    pub rngs: &'a mut [Rng],
    pub clocks: &'a mut [Clock],
    pub parts: Parts<'a>,
}

impl<S: Simulator> Block<'_, S> {
    pub fn len(&self) -> usize {
        self.clocks.len()
    }

    /// The first `len` environments and the others.
    pub fn split(self, len: usize) -> (Self, Self) {
        let (states, states_after) = self.states.split_at_mut(len);
        let (rngs, rngs_after) = self.rngs.split_at_mut(len);
        let (clocks, clocks_after) = self.clocks.split_at_mut(len);
        let (parts, parts_after) = self.parts.split(len);
        (
            Self { first: self.first, states, rngs, clocks, parts },
            Self {
                first: self.first + len,
                states: states_after,
                rngs: rngs_after,
                clocks: clocks_after,
                parts: parts_after,
            },
        )
    }

    /// Works on every environment of the block; true where an episode ended whose last observation is told apart.
    pub fn run(&mut self, rules: Rules<'_>, work: Work<'_>, scratch: &mut S) -> bool {
        match work {
            Work::Reset { seeds, mask, fresh } => {
                self.reset(rules, seeds, mask, fresh, scratch);
                false
            }
            Work::Step { actions } => {
                let actions = &actions[self.first..][..self.len()];
                // A loop for each mode: what never happens in one costs it nothing.
                match rules.autoreset {
                    Autoreset::SameStep => self.step::<true>(rules, actions, scratch),
                    Autoreset::NextStep | Autoreset::Disabled => self.step::<false>(rules, actions, scratch),
                }
            }
        }
    }

    fn reset(&mut self, rules: Rules<'_>, seeds: Seeds<'_>, mask: Option<&[u8]>, fresh: Option<u64>, scratch: &mut S) {
        for i in 0..self.len() {
            let rank = self.first + i;
            if mask.is_some_and(|mask| mask[rank] == 0) {
                continue;
            }
            let seed = match seeds {
                Seeds::Continue => fresh.map(|seed| seed.wrapping_add(rank as u64)),
                Seeds::From(seed) => Some(seed.wrapping_add(rank as u64)),
                Seeds::Each(seeds) => Some(u64::from_le_bytes(seeds.as_chunks::<8>().0[rank])),
            };
            if let Some(seed) = seed {
                self.rngs[i] = stream(seed, Purpose::Dynamics);
            }
            S::load(scratch, &mut self.states[i]).reset(&mut self.rngs[i]);
            S::save(scratch, &mut self.states[i]);
            self.clocks[i] = Clock::default();
        }
        self.parts.clear_outcomes();
        self.parts.present.write(scratch, self.states, 0, rules.info_lens);
    }

    fn step<const SAME_STEP: bool>(&mut self, rules: Rules<'_>, actions: &[[u8; 4]], scratch: &mut S) -> bool {
        let limit = if rules.max_episode_steps == 0 { u32::MAX } else { rules.max_episode_steps };
        let mut any_final = false;
        for first in (0..self.len()).step_by(AT_A_TIME) {
            let some = first..self.len().min(first + AT_A_TIME);
            let Self { states, rngs, clocks, parts, .. } = self;
            let outcomes = parts.rewards[some.clone()]
                .iter_mut()
                .zip(&mut parts.terminated[some.clone()])
                .zip(&mut parts.truncated[some.clone()]);
            let envs = states[some.clone()]
                .iter_mut()
                .zip(&mut rngs[some.clone()])
                .zip(&mut clocks[some.clone()])
                .zip(&actions[some.clone()])
                .zip(outcomes);
            for (i, ((((stored, rng), clock), action), ((reward, terminated), truncated))) in envs.enumerate() {
                let simulator = S::load(scratch, stored);
                if clock.ended() {
                    simulator.reset(rng);
                    (*clock, *reward, *terminated, *truncated) = (Clock::default(), [0; 8], 0, 0);
                } else {
                    let outcome = simulator.step(u32::from_le_bytes(*action), rng);
                    let cut_off = clock.tick() >= limit;
                    *reward = outcome.reward.to_le_bytes();
                    (*terminated, *truncated) = (u8::from(outcome.terminated), u8::from(cut_off));
                    if outcome.terminated | cut_off {
                        if SAME_STEP {
                            parts.last.write_one(simulator, first + i, rules.info_lens);
                            any_final = true;
                            simulator.reset(rng);
                            *clock = Clock::default();
                        } else {
                            clock.end();
                        }
                    }
                }
                S::save(scratch, stored);
            }
            self.parts.present.write(scratch, &mut self.states[some], first, rules.info_lens);
        }
        any_final
    }
}
