//! `Highway-v0`: three lanes among traffic, after Hahn & Zoubir (2015), §5 and Fig. 3.
//!
//! Lane 0 is the right (slow) lane, 2 the left (fast) one; one decision a second. Action = 4 × lane change + speed level, lane
//! change 0 keep, 1 left, 2 right; levels 0..3 are 20, 25, 30 and 35 m/s. A change needs a free gap alongside, else the host
//! keeps its lane and takes the speed. Tabular state = (lane × 4 + level) × 3 + traffic, traffic 0 *clear* (own lane free for
//! 45 m, from centre to centre), 1 *passable* (own lane blocked, an adjacent lane free), 2 *boxed in* (own lane blocked, no
//! adjacent lane free).
//!
//! Step rewards, from the speed v after the step, the collisions c and the overtakes from the right o of the step:
//! `aggressive` (v − 20) / 15 − 5 c; `bad` c; `legal` (v − 20) / 15 − 5 c − 5 o.
//!
//! Overtakes count vehicles of the lane next to the host's: passed from the left in the lane to its right, from the right in
//! the lane to its left. Invariants: a step does not allocate; style and observation never change what happens on the road.

mod drivers;
mod estimate;
mod render;
mod road;

use std::sync::Arc;

use serde_json::{Map, Value, json};

use self::road::{Events, FRONT_M, LANES, LEVEL_SPEED_MPS, LEVELS, MAX_VEHICLES, Road, View, target_lane};
use super::{
    Configured, DType, Driver, EnvSpec, InfoColumn, OptionError, OptionSpec, Outcome, Rng, Simulator, Space,
    drivers::RandomDriver, options,
};

/// Identifier of this environment.
pub const ENV_ID: &str = "Highway-v0";
/// Number of actions.
pub const N_ACTIONS: u32 = 12;
/// Number of tabular states.
pub const N_STATES: u32 = 36;
/// Styles of driving: the names of the experts and of the rewards.
pub const STYLES: [&str; 3] = ["aggressive", "bad", "legal"];

const MAX_EPISODE_STEPS: u32 = 200;
const DEFAULT_DENSITY: f64 = 4.0;
const MAX_DENSITY: f64 = (MAX_VEHICLES / LANES) as f64;
/// What a collision or an overtake from the right costs, in units of the reward of the greatest speed.
const PENALTY: f64 = 5.0;
/// Features of a vehicle in the kinematic observation: position, lane, speed.
const FEATURES: usize = 3;
/// How far the vehicles may be from the host: beyond the window while re-entering vehicles queue.
const MAX_DISTANCE_M: f64 = 1000.0;
/// Rank of each info column.
const COLLISIONS: usize = 0;
const OVERTAKES_LEFT: usize = 1;
const OVERTAKES_RIGHT: usize = 2;
const SPEED: usize = 3;
const LANE: usize = 4;
const GAP: usize = 5;

/// The step reward.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum Style {
    Aggressive,
    Bad,
    Legal,
}

impl Style {
    /// In the order of [`STYLES`].
    const ALL: [Self; 3] = [Self::Aggressive, Self::Bad, Self::Legal];

    /// Reward of (mean) speed and events; see the module's documentation.
    fn reward(self, speed_mps: f64, collisions: f64, overtakes_right: f64) -> f64 {
        let speed = (speed_mps - LEVEL_SPEED_MPS[0]) / (LEVEL_SPEED_MPS[LEVELS - 1] - LEVEL_SPEED_MPS[0]);
        match self {
            Self::Aggressive => speed - PENALTY * collisions,
            Self::Bad => collisions,
            Self::Legal => speed - PENALTY * (collisions + overtakes_right),
        }
    }
}

/// One highway. See the module's documentation.
#[derive(Debug, Clone)]
pub struct Highway {
    road: Road,
    /// What the host sees of the road as it is: the observation, the infos, the mask and the next step all ask for it.
    view: View,
    /// What the last step brought; nothing after a reset.
    events: Events,
    style: Style,
    kinematics: bool,
    terminate_on_collision: bool,
}

/// Describes and makes a highway under `given` options: `style`, `density`, `observation`, `terminate_on_collision`.
///
/// An unknown or malformed option is an [`OptionError`] that names it.
pub fn configure(given: &Map<String, Value>) -> Result<Configured<Highway>, OptionError> {
    let specs = option_specs();
    options::refuse_unknown(given, &specs)?;
    let style = Style::ALL[options::choice(given, "style", &STYLES, 0)?];
    let density = options::number(given, "density", DEFAULT_DENSITY, 0.0, MAX_DENSITY)?;
    let kinematics = options::choice(given, "observation", &["discrete", "kinematics"], 0)? == 1;
    let terminate_on_collision = options::flag(given, "terminate_on_collision", false)?;
    let road = Road::new((density * LANES as f64).round() as usize);
    let spec = EnvSpec {
        env_id: ENV_ID,
        description: "a three-lane motorway with traffic, driven one decision a second (Hahn & Zoubir 2015, Fig. 3)",
        observation_space: if kinematics {
            kinematics_space(road.n_vehicles())
        } else {
            Space::Discrete { n: N_STATES }
        },
        n_actions: N_ACTIONS,
        n_states: N_STATES,
        info_columns: info_columns(),
        max_episode_steps: MAX_EPISODE_STEPS,
        options: specs,
        drivers: vec![
            ("aggressive", "as fast as possible, overtaking on all lanes, avoiding collisions"),
            ("bad", "hits as many vehicles as it can"),
            ("legal", "avoids collisions, never overtakes from the right"),
            ("random", "every action equally likely"),
        ],
        styles: STYLES.to_vec(),
        render_fps: 2,
    };
    let prototype =
        Highway { view: road.view(), road, events: Events::default(), style, kinematics, terminate_on_collision };
    Ok(Configured { spec: Arc::new(spec), prototype })
}

fn option_specs() -> Vec<OptionSpec> {
    vec![
        OptionSpec {
            name: "style",
            default: json!(STYLES[0]),
            description: "step reward: \"aggressive\" (speed_mps - 20) / 15 - 5 collisions, \"bad\" collisions, \
                          \"legal\" (speed_mps - 20) / 15 - 5 collisions - 5 overtakes_right",
        },
        OptionSpec {
            name: "density",
            default: json!(DEFAULT_DENSITY),
            description: "vehicles a lane in the window of 350 m, 0 to 8; the total is rounded",
        },
        OptionSpec {
            name: "observation",
            default: json!("discrete"),
            description: "\"discrete\": the tabular state; \"kinematics\": rows of position ahead of the host (m), lane and \
                          speed (m/s), the host first, then the vehicles from the nearest on",
        },
        OptionSpec {
            name: "terminate_on_collision",
            default: json!(false),
            description: "true to end the episode at the first collision",
        },
    ]
}

fn info_columns() -> Vec<InfoColumn> {
    let column = |name, dtype, unit, summed, description| InfoColumn {
        name,
        dtype,
        shape: Vec::new(),
        unit,
        description,
        summed,
    };
    vec![
        column("collisions", DType::Int32, "1", true, "vehicles hit in this step"),
        column("overtakes_left", DType::Int32, "1", true, "vehicles passed in the lane to the right: from the left"),
        column(
            "overtakes_right",
            DType::Int32,
            "1",
            true,
            "vehicles passed in the lane to the left: from the right, illegal",
        ),
        column("speed_mps", DType::Float32, "m/s", true, "speed of the host after this step; its sum is metres driven"),
        column("lane", DType::Int32, "1", false, "lane of the host: 0 right, 1 middle, 2 left"),
        column(
            "gap_m",
            DType::Float32,
            "m",
            false,
            "distance to the bumper of the vehicle ahead in the host's lane, at most 250",
        ),
    ]
}

fn kinematics_space(n_vehicles: usize) -> Space {
    let rows = n_vehicles + 1;
    let bounds = |row: [f64; FEATURES]| std::iter::repeat_n(row.map(|x| x as f32), rows).flatten().collect();
    Space::Box {
        shape: vec![rows as u32, FEATURES as u32],
        low: bounds([-MAX_DISTANCE_M, 0.0, 0.0]),
        high: bounds([MAX_DISTANCE_M, (LANES - 1) as f64, LEVEL_SPEED_MPS[LEVELS - 1]]),
    }
}

/// Label of a tabular state, such as `"lane 0, 25 m/s, clear"`.
pub fn state_label(state: u32) -> String {
    let (lane, level, traffic) = (state / 12, state / 3 % 4, state % 3);
    let traffic = ["clear", "passable", "boxed in"][traffic as usize];
    format!("lane {lane}, {} m/s, {traffic}", LEVEL_SPEED_MPS[level as usize])
}

/// Label of an action, such as `"left, 30 m/s"`.
pub fn action_label(action: u32) -> String {
    let change = ["keep", "left", "right"][(action / 4) as usize];
    format!("{change}, {} m/s", LEVEL_SPEED_MPS[(action % 4) as usize])
}

impl Highway {
    /// 0 clear, 1 passable, 2 boxed in.
    fn traffic(&self) -> usize {
        let (view, lane) = (&self.view, self.road.host_lane);
        if view.clear(lane) {
            0
        } else if [1, 2].into_iter().any(|change| target_lane(lane, change).is_some_and(|lane| view.free(lane))) {
            1
        } else {
            2
        }
    }

    /// Packs the host and the vehicles, from the nearest on.
    fn write_kinematics(&self, out: &mut [u8]) {
        let mut rows = [[0.0; FEATURES]; MAX_VEHICLES + 1];
        rows[0] = [0.0, self.road.host_lane as f64, self.road.host_speed_mps()];
        let n = self.road.n_vehicles();
        for (at, vehicle) in self.road.vehicles().enumerate() {
            let row = [vehicle.x_m.clamp(-MAX_DISTANCE_M, MAX_DISTANCE_M), vehicle.lane as f64, vehicle.speed_mps];
            let mut at = at + 1;
            while at > 1 && rows[at - 1][0].abs() > row[0].abs() {
                rows[at] = rows[at - 1];
                at -= 1;
            }
            rows[at] = row;
        }
        for (bytes, value) in out.chunks_exact_mut(4).zip(rows[..=n].iter().flatten()) {
            bytes.copy_from_slice(&(*value as f32).to_le_bytes());
        }
    }
}

impl Simulator for Highway {
    type Stored = Self;
    const STEP_NANOS: usize = 210;

    fn stored(&self) -> Self {
        self.clone()
    }

    #[inline]
    fn load<'a>(_scratch: &'a mut Self, stored: &'a mut Self) -> &'a mut Self {
        stored
    }

    #[inline]
    fn save(_scratch: &Self, _stored: &mut Self) {}

    fn reset(&mut self, rng: &mut Rng) {
        self.road.reset(rng);
        self.view = self.road.view();
        self.events = Events::default();
    }

    fn step(&mut self, action: u32, rng: &mut Rng) -> Outcome {
        self.events = self.road.advance(&self.view, action as usize / LEVELS, action as usize % LEVELS, rng);
        self.view = self.road.view();
        let Events { collisions, overtakes_right, .. } = self.events;
        let reward = self.style.reward(self.road.host_speed_mps(), f64::from(collisions), f64::from(overtakes_right));
        Outcome { reward, terminated: self.terminate_on_collision && collisions > 0 }
    }

    fn tabular_state(&self) -> u32 {
        ((self.road.host_lane * LEVELS + self.road.host_level) * 3 + self.traffic()) as u32
    }

    fn write_observation(&self, out: &mut [u8]) {
        if self.kinematics {
            self.write_kinematics(out);
        } else {
            out.copy_from_slice(&(self.tabular_state() as i32).to_le_bytes());
        }
    }

    fn write_info(&self, column: usize, out: &mut [u8]) {
        let value = self.info_value(column);
        match column {
            SPEED | GAP => out.copy_from_slice(&(value as f32).to_le_bytes()),
            _ => out.copy_from_slice(&(value as i32).to_le_bytes()),
        }
    }

    fn info_value(&self, column: usize) -> f64 {
        match column {
            COLLISIONS => f64::from(self.events.collisions),
            OVERTAKES_LEFT => f64::from(self.events.overtakes_left),
            OVERTAKES_RIGHT => f64::from(self.events.overtakes_right),
            SPEED => self.road.host_speed_mps(),
            LANE => self.road.host_lane as f64,
            GAP => self.view.ahead_m[self.road.host_lane].min(FRONT_M),
            _ => f64::NAN,
        }
    }

    fn write_action_mask(&self, out: &mut [u8]) {
        let (view, lane) = (&self.view, self.road.host_lane);
        for (change, flags) in out.chunks_exact_mut(LEVELS).enumerate() {
            let possible = change == 0 || target_lane(lane, change).is_some_and(|lane| view.room(lane));
            flags.fill(u8::from(possible));
        }
    }

    fn render_text(&self) -> String {
        render::text(self)
    }

    fn render_svg(&self) -> String {
        render::svg(self)
    }

    fn driver(&self, name: &str) -> Option<Box<dyn Driver<Self>>> {
        match name {
            "aggressive" => Some(Box::new(drivers::Aggressive)),
            "bad" => Some(Box::new(drivers::Bad)),
            "legal" => Some(Box::new(drivers::Legal)),
            "random" => Some(Box::new(RandomDriver { n_actions: N_ACTIONS })),
            _ => None,
        }
    }
}

#[cfg(test)]
mod tests;
