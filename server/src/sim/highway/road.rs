//! The road: positions and speeds of the traffic relative to the host, and one second of their motion.
//!
//! Invariants: vehicles are sorted front to back; two vehicles of a lane, and the host and the vehicle behind it, keep at least
//! [`MIN_GAP_M`] between their bumpers; only `+ − × ÷` and comparisons, so that every platform computes the same bits.
//! Deliberately absent: rewards and observations, which are made from what the road shows.

use rand_core::Rng as _;

use crate::sim::{Rng, rng};

/// Number of lanes; 0 is the right (slow) one.
pub(super) const LANES: usize = 3;
/// Number of speed levels of the host.
pub(super) const LEVELS: usize = 4;
/// Speed of each level of the host in m/s.
pub(super) const LEVEL_SPEED_MPS: [f64; LEVELS] = [20.0, 25.0, 30.0, 35.0];
/// Speed of each lane's traffic in m/s, before a vehicle's own offset.
pub(super) const LANE_SPEED_MPS: [f64; LANES] = [18.0, 22.0, 26.0];
/// Largest offset of a vehicle's speed from its lane's.
pub(super) const MAX_OFFSET_MPS: f64 = 1.5;
/// Most vehicles on the road.
pub(super) const MAX_VEHICLES: usize = 24;
/// Length of every vehicle.
pub(super) const LENGTH_M: f64 = 5.0;
/// Where the window ends behind the host; a vehicle that leaves in front re-enters here.
pub(super) const REAR_M: f64 = -100.0;
/// Where the window ends ahead of the host; a vehicle that leaves behind re-enters here.
pub(super) const FRONT_M: f64 = 250.0;
/// How far beyond the window a vehicle goes before it has left.
pub(super) const MARGIN_M: f64 = 5.0;
/// How far the host looks ahead for a free lane, from its centre to the other vehicle's.
pub(super) const LOOK_AHEAD_M: f64 = 45.0;
/// Least distance between the bumpers of two vehicles, and alongside the host for it to change lanes.
pub(super) const MIN_GAP_M: f64 = 2.0;

/// Distance between bumpers that traffic likes to keep.
const FOLLOWING_GAP_M: f64 = 5.0;
/// How fast a vehicle falls back after somebody cut in.
const FALL_BACK_MPS: f64 = 1.0;
/// Probability per vehicle and second of wishing to change lanes, as a fraction of 2³¹.
const CHANGE_BELOW: u32 = (0.05 * 2_147_483_648.0) as u32;
/// Seconds of closing speed that a vehicle leaves the host when it cuts in ahead of it.
const CUT_IN_SECS: f64 = 1.5;

/// Everything that moves.
#[derive(Debug, Clone, Copy)]
pub(super) struct Road {
    /// Number of vehicles.
    n: usize,
    /// Centre of each vehicle relative to the host's, metres ahead; falling.
    x_m: [f64; MAX_VEHICLES],
    /// Present speed of each vehicle.
    speed_mps: [f64; MAX_VEHICLES],
    /// Each vehicle's own offset from its lane's speed.
    offset_mps: [f64; MAX_VEHICLES],
    /// Lane of each vehicle.
    lane: [u8; MAX_VEHICLES],
    /// Lane of the host.
    pub(super) host_lane: usize,
    /// Speed level of the host.
    pub(super) host_level: usize,
    /// Way that the host has driven since the reset, so that pictures show it moving.
    pub(super) driven_m: f64,
}

/// What happened in one second.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq)]
pub(super) struct Events {
    /// Vehicles hit: 0 or 1.
    pub(super) collisions: u32,
    /// Vehicles passed in the lane to the right.
    pub(super) overtakes_left: u32,
    /// Vehicles passed in the lane to the left, which is illegal.
    pub(super) overtakes_right: u32,
}

/// One vehicle, for whoever looks.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(super) struct Vehicle {
    /// Centre relative to the host's, metres ahead.
    pub(super) x_m: f64,
    /// Lane.
    pub(super) lane: usize,
    /// Present speed.
    pub(super) speed_mps: f64,
}

/// The nearest vehicles ahead of and behind the host in each lane.
#[derive(Debug, Clone, Copy)]
pub(super) struct View {
    /// Distance to the bumper of the nearest vehicle ahead; infinite where there is none, negative alongside.
    pub(super) ahead_m: [f64; LANES],
    /// Speed of that vehicle.
    pub(super) ahead_mps: [f64; LANES],
    /// Distance to the bumper of the nearest vehicle behind; infinite where there is none, negative alongside.
    pub(super) behind_m: [f64; LANES],
}

impl View {
    /// No vehicle ahead within the look-ahead.
    pub(super) fn clear(&self, lane: usize) -> bool {
        self.ahead_m[lane] > LOOK_AHEAD_M - LENGTH_M
    }

    /// Room alongside: the host can change to this lane.
    pub(super) fn room(&self, lane: usize) -> bool {
        self.ahead_m[lane] >= MIN_GAP_M && self.behind_m[lane] >= MIN_GAP_M
    }

    /// Room alongside and a clear look-ahead.
    pub(super) fn free(&self, lane: usize) -> bool {
        self.room(lane) && self.clear(lane)
    }
}

/// The lane that a lane change leads to: 0 keeps, 1 goes left, 2 goes right. `None` beyond the road.
pub(super) fn target_lane(lane: usize, change: usize) -> Option<usize> {
    match change {
        0 => Some(lane),
        1 => Some(lane + 1).filter(|&lane| lane < LANES),
        _ => lane.checked_sub(1),
    }
}

impl Road {
    /// A road with `n` vehicles, to be [`reset`](Self::reset).
    pub(super) fn new(n: usize) -> Self {
        let (none, n) = ([0.0; MAX_VEHICLES], n.min(MAX_VEHICLES));
        Self {
            n,
            x_m: none,
            speed_mps: none,
            offset_mps: none,
            lane: [0; MAX_VEHICLES],
            host_lane: 0,
            host_level: 0,
            driven_m: 0.0,
        }
    }

    /// Speed of the host.
    pub(super) fn host_speed_mps(&self) -> f64 {
        LEVEL_SPEED_MPS[self.host_level]
    }

    /// The vehicles, front to back.
    pub(super) fn vehicles(&self) -> impl DoubleEndedIterator<Item = Vehicle> + '_ {
        (0..self.n).map(|i| Vehicle { x_m: self.x_m[i], lane: self.lane[i] as usize, speed_mps: self.speed_mps[i] })
    }

    /// Number of vehicles.
    pub(super) fn n_vehicles(&self) -> usize {
        self.n
    }

    /// Spreads the vehicles evenly over lanes and window with some jitter, and draws the host's lane and level.
    pub(super) fn reset(&mut self, rng: &mut Rng) {
        self.host_lane = rng::below(rng, LANES as u32) as usize;
        self.host_level = rng::below(rng, LEVELS as u32) as usize;
        self.driven_m = 0.0;
        let mut placed = 0;
        for (lane, lane_speed_mps) in LANE_SPEED_MPS.into_iter().enumerate() {
            let count = (self.n + LANES - 1 - lane) / LANES;
            // In its own lane the host needs room: three quarters of the vehicles lie ahead of it, the others behind.
            let ahead = if lane == self.host_lane { (count * 3).div_ceil(4) } else { count };
            let behind = count - ahead;
            let rear = if lane == self.host_lane { 30.0 } else { REAR_M };
            for (start, end, count) in [(rear, FRONT_M, ahead), (REAR_M, -30.0, behind)] {
                for slot in 0..count {
                    let width = (end - start) / count as f64;
                    let place = slot as f64 + 0.5 + 0.6 * (rng::uniform(rng) - 0.5);
                    self.x_m[placed] = start + place * width;
                    self.lane[placed] = lane as u8;
                    self.offset_mps[placed] = draw_offset(rng);
                    self.speed_mps[placed] = lane_speed_mps + self.offset_mps[placed];
                    placed += 1;
                }
            }
        }
        self.sort();
    }

    /// The nearest vehicles of each lane.
    #[inline]
    pub(super) fn view(&self) -> View {
        let mut view =
            View { ahead_m: [f64::INFINITY; LANES], ahead_mps: [0.0; LANES], behind_m: [f64::INFINITY; LANES] };
        for i in 0..self.n.min(MAX_VEHICLES) {
            let lane = self.lane[i] as usize;
            if self.x_m[i] > 0.0 {
                view.ahead_m[lane] = self.x_m[i] - LENGTH_M;
                view.ahead_mps[lane] = self.speed_mps[i];
            } else if view.behind_m[lane] == f64::INFINITY {
                view.behind_m[lane] = -self.x_m[i] - LENGTH_M;
            }
        }
        view
    }

    /// One second: the host changes lane and speed, then some vehicles change lanes, then all move. `view` is
    /// [`Self::view`].
    pub(super) fn advance(&mut self, view: &View, change: usize, level: usize, rng: &mut Rng) -> Events {
        self.host_level = level;
        if change != 0
            && let Some(lane) = target_lane(self.host_lane, change)
            && view.room(lane)
        {
            self.host_lane = lane;
        }
        self.change_lanes(rng);
        let (events, hit) = self.move_all();
        if let Some(hit) = hit {
            self.enter_ahead(hit, rng);
        }
        for i in 0..self.n {
            if self.x_m[i] < REAR_M - MARGIN_M {
                self.enter_ahead(i, rng);
            } else if self.x_m[i] > FRONT_M + MARGIN_M && hit != Some(i) {
                self.enter_behind(i, rng);
            }
        }
        self.sort();
        events
    }

    /// Vehicles that wish to change lanes do so where the gap allows.
    fn change_lanes(&mut self, rng: &mut Rng) {
        let n = self.n.min(MAX_VEHICLES);
        let mut word = 0;
        for i in 0..n {
            // Half a word a vehicle: the low bit for the side, the others for the wish.
            word = if i % 2 == 0 { rng.next_u64() } else { word >> 32 };
            let half = word as u32;
            if half >> 1 < CHANGE_BELOW
                && let Some(lane) = target_lane(self.lane[i] as usize, 1 + (half & 1) as usize)
                && self.gap_allows(i, lane)
            {
                self.lane[i] = lane as u8;
            }
        }
    }

    /// True where vehicle `i` has its liked gap on both sides in `lane`, and does not cut the host off.
    fn gap_allows(&self, i: usize, lane: usize) -> bool {
        let x_m = self.x_m[i];
        let among_traffic = (0..self.n).all(|j| {
            j == i || self.lane[j] as usize != lane || (self.x_m[j] - x_m).abs() >= LENGTH_M + FOLLOWING_GAP_M
        });
        if !among_traffic || lane != self.host_lane {
            return among_traffic;
        }
        let closing_mps = self.host_speed_mps() - (LANE_SPEED_MPS[lane] + self.offset_mps[i]);
        let wanted_m = if x_m > 0.0 { CUT_IN_SECS * closing_mps.max(0.0) + FOLLOWING_GAP_M } else { FOLLOWING_GAP_M };
        x_m.abs() >= LENGTH_M + wanted_m
    }

    /// Moves everything one second on, front to back. Returns the vehicle that the host hit.
    ///
    /// Traffic follows as in Newell's (2002) simplified car-following model: at the vehicle's own speed where the road is
    /// free, else at the leader's, keeping a distance. The host does as it is told, which is what makes it collide.
    fn move_all(&mut self) -> (Events, Option<usize>) {
        let mut leader_before = [f64::INFINITY; LANES];
        let mut leader_after = [f64::INFINITY; LANES];
        let mut leader = [usize::MAX; LANES];
        let mut hit = None;
        let mut host_after = None;
        let mut after = [0.0; MAX_VEHICLES];
        let host_lane = self.host_lane;
        let n = self.n.min(MAX_VEHICLES);
        let mut i = 0;
        loop {
            if host_after.is_none() && (i == n || self.x_m[i] <= 0.0) {
                let mut moved = LEVEL_SPEED_MPS[self.host_level];
                if leader_after[host_lane] - moved <= LENGTH_M {
                    // Contact: the host gets as far as that vehicle's bumper.
                    moved = leader_after[host_lane] - LENGTH_M;
                    hit = Some(leader[host_lane]);
                }
                host_after = Some(moved);
                leader_before[host_lane] = 0.0;
                leader_after[host_lane] = moved;
            }
            if i == n {
                break;
            }
            let (x_m, lane) = (self.x_m[i], self.lane[i] as usize);
            let free = x_m + LANE_SPEED_MPS[lane] + self.offset_mps[i];
            let gap_m = leader_before[lane] - x_m - LENGTH_M;
            let limit = leader_after[lane] - LENGTH_M - (gap_m + FALL_BACK_MPS).min(FOLLOWING_GAP_M);
            after[i] = free.min(limit).max(x_m);
            (leader_before[lane], leader_after[lane], leader[lane]) = (x_m, after[i], i);
            i += 1;
        }
        let host_after = host_after.unwrap_or(0.0);
        self.driven_m += host_after;
        let mut events = Events::default();
        for (i, after) in after.iter().enumerate().take(n) {
            let (before, x_m, lane) = (self.x_m[i], after - host_after, self.lane[i] as usize);
            let passed = u32::from(before > 0.0 && x_m <= 0.0);
            events.overtakes_left += passed & u32::from(lane + 1 == host_lane);
            events.overtakes_right += passed & u32::from(lane == host_lane + 1);
            self.speed_mps[i] = after - before;
            self.x_m[i] = x_m;
        }
        if hit.is_some() {
            events.collisions = 1;
            self.host_level = 0;
        }
        (events, hit)
    }

    /// Vehicle `i` re-enters ahead, as another vehicle.
    fn enter_ahead(&mut self, i: usize, rng: &mut Rng) {
        let occupied = self.others(i).fold(f64::NEG_INFINITY, f64::max);
        self.enter(i, FRONT_M.max(occupied + LENGTH_M + FOLLOWING_GAP_M), rng);
    }

    /// Vehicle `i` re-enters behind, as another vehicle.
    fn enter_behind(&mut self, i: usize, rng: &mut Rng) {
        let occupied = self.others(i).fold(f64::INFINITY, f64::min);
        self.enter(i, REAR_M.min(occupied - LENGTH_M - FOLLOWING_GAP_M), rng);
    }

    /// Positions of the other vehicles in the lane of vehicle `i`.
    fn others(&self, i: usize) -> impl Iterator<Item = f64> + '_ {
        (0..self.n).filter(move |&j| j != i && self.lane[j] == self.lane[i]).map(|j| self.x_m[j])
    }

    fn enter(&mut self, i: usize, x_m: f64, rng: &mut Rng) {
        self.x_m[i] = x_m;
        self.offset_mps[i] = draw_offset(rng);
        self.speed_mps[i] = LANE_SPEED_MPS[self.lane[i] as usize] + self.offset_mps[i];
    }

    /// Insertion sort, front to back: the order changes little from one second to the next.
    fn sort(&mut self) {
        for end in 1..self.n.min(MAX_VEHICLES) {
            let mut at = end;
            while at > 0 && self.x_m[at - 1] < self.x_m[at] {
                self.x_m.swap(at - 1, at);
                self.speed_mps.swap(at - 1, at);
                self.offset_mps.swap(at - 1, at);
                self.lane.swap(at - 1, at);
                at -= 1;
            }
        }
    }
}

fn draw_offset(rng: &mut Rng) -> f64 {
    MAX_OFFSET_MPS * (2.0 * rng::uniform(rng) - 1.0)
}
