//! The scripted experts of Hahn & Zoubir (2015), §5: aggressive, bad and legal drivers.
//!
//! They see the whole road, not the 36 states. Each asks for an action that says what it wants even where it may not come
//! about: a driver that wants to go left asks for "left" while somebody is alongside, and keeps its lane until there is room.

use super::{
    Highway,
    road::{LANES, LENGTH_M, LEVEL_SPEED_MPS, View, target_lane},
};
use crate::sim::{Driver, Rng};

const KEEP: u32 = 0;
const LEFT: u32 = 1;
const RIGHT: u32 = 2;
/// Fastest speed level.
const FASTEST: u32 = 3;

const fn action(change: u32, level: u32) -> u32 {
    change * 4 + level
}

/// As fast as possible, overtaking on all lanes, avoiding collisions.
///
/// At full speed while the lane is clear; round the vehicle ahead on either side where a lane is free; boxed in, it brakes and
/// makes for the middle lane, from where there are two ways out.
pub(super) struct Aggressive;

impl Driver<Highway> for Aggressive {
    fn act(&mut self, highway: &Highway, _rng: &mut Rng) -> u32 {
        let (view, lane) = (&highway.view, highway.road.host_lane);
        if view.clear(lane) {
            return action(KEEP, FASTEST);
        }
        for change in [RIGHT, LEFT] {
            if target_lane(lane, change as usize).is_some_and(|lane| view.free(lane)) {
                return action(change, FASTEST);
            }
        }
        match lane {
            0 => action(LEFT, 0),
            1 => action(KEEP, 1),
            _ => action(RIGHT, 1),
        }
    }
}

/// Hits as many vehicles as it can.
pub(super) struct Bad;

impl Bad {
    /// Seconds by which another lane's hit must be sooner for a change to be worth it.
    const WORTH_SECS: f64 = 2.0;

    /// Seconds until the host reaches the vehicle ahead in `lane` at its fastest.
    fn hit_secs(view: &View, lane: usize) -> f64 {
        view.ahead_m[lane] / (LEVEL_SPEED_MPS[FASTEST as usize] - view.ahead_mps[lane])
    }
}

impl Driver<Highway> for Bad {
    fn act(&mut self, highway: &Highway, _rng: &mut Rng) -> u32 {
        let (view, lane) = (&highway.view, highway.road.host_lane);
        let mut best = (KEEP, Self::hit_secs(view, lane) - Self::WORTH_SECS);
        for change in [LEFT, RIGHT] {
            if let Some(lane) = target_lane(lane, change as usize)
                && view.room(lane)
            {
                let secs = Self::hit_secs(view, lane);
                if secs < best.1 {
                    best = (change, secs);
                }
            }
        }
        action(best.0, FASTEST)
    }
}

/// Avoids collisions and never overtakes from the right: slowly to the left lane, where it stays.
pub(super) struct Legal;

impl Legal {
    /// Below this distance to the vehicle ahead it falls back.
    const CLOSE_M: f64 = 2.0 * LENGTH_M;
}

impl Driver<Highway> for Legal {
    fn act(&mut self, highway: &Highway, _rng: &mut Rng) -> u32 {
        let (view, lane) = (&highway.view, highway.road.host_lane);
        if lane + 1 < LANES {
            // At the slowest level nobody on the left is passed while it waits for room.
            return action(LEFT, 0);
        }
        if view.clear(lane) {
            action(KEEP, FASTEST)
        } else if view.ahead_m[lane] < Self::CLOSE_M {
            action(KEEP, 0)
        } else {
            action(KEEP, 1)
        }
    }
}
