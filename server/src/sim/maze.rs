//! `Maze-v0`: the grid world of Hahn & Zoubir (2015), §5 and Fig. 1, with any layout.
//!
//! Free cells are the states, numbered row-major. Actions: 0 north, 1 south, 2 east, 3 west. With probability 1 − `slip` the
//! chosen direction is taken, otherwise one of the four drawn uniformly; a move into a wall or off the grid stays. The step's
//! reward is the reward of the state *entered*; the model's table is R(s,a) = R(s), the reward of the state itself, so that
//! Q(s,a) = R(s) + γ Σ P V(s') as in the paper. Episodes start uniformly over the states and never terminate.
//!
//! Invariants: every table is made once, in [`configure`]; a step is two look-ups and one random word.

mod layout;
mod planner;
mod render;

use std::sync::{Arc, OnceLock};

use rand_core::Rng as _;
use serde_json::{Map, Value, json};

use self::layout::Layout;
use super::{
    Configured, DType, Driver, EnvSpec, InfoColumn, OptionError, OptionSpec, Outcome, Rng, Simulator, Space,
    TabularModel,
    drivers::RandomDriver,
    model::{Rows, model_id},
    options,
    rng::below,
};

/// Identifier of this environment.
pub const ENV_ID: &str = "Maze-v0";
/// Number of actions.
pub const N_ACTIONS: u32 = 4;
/// Name of each action, by its index.
pub const ACTION_LABELS: [&str; 4] = ["north", "south", "east", "west"];

/// Maze of the paper's Fig. 1.
const DEFAULT_LAYOUT: [&str; 9] = [
    ".........",
    ".###.###.",
    ".#.....#.",
    ".#.#.#.#.",
    ".........",
    ".#.#.#.#.",
    ".#.....#.",
    ".###.###.",
    ".........",
];
const DEFAULT_SLIP: f64 = 0.3;
const MAX_EPISODE_STEPS: u32 = 100;
/// Values of one uniform draw: the 53 high bits of a word, of which a step takes both whether it slips and where to.
const DRAWS: f64 = 9_007_199_254_740_992.0;

/// Everything that never changes, shared by the environments of a batch.
#[derive(Debug)]
struct Tables {
    layout: Layout,
    /// Chance that the direction is drawn.
    slip: f64,
    /// Draws below this slip.
    slip_below: u64,
    /// Direction of a slipping draw is `draw * direction_scale`.
    direction_scale: f64,
    /// State entered, shape `(n_states, 4)`.
    next: Vec<u32>,
    /// Row and column of each state, packed as the info columns are.
    positions: Vec<[[u8; 4]; 2]>,
    /// The optimal actions of each state as a bit mask, made when first asked for.
    optimal: OnceLock<Vec<u8>>,
}

/// One maze. See the module's documentation.
#[derive(Debug, Clone)]
pub struct Maze {
    tables: Arc<Tables>,
    state: u32,
}

/// Describes and makes a maze under `given` options: `layout`, `rewards` and `slip`, all optional.
///
/// An unknown or malformed option is an [`OptionError`] that names it.
pub fn configure(given: &Map<String, Value>) -> Result<Configured<Maze>, OptionError> {
    let options = option_specs();
    options::refuse_unknown(given, &options)?;
    let layout = Layout::from_options(given, &DEFAULT_LAYOUT)?;
    let slip = options::number(given, "slip", DEFAULT_SLIP, 0.0, 1.0)?;
    let n_states = layout.n_states();
    let spec = EnvSpec {
        env_id: ENV_ID,
        description: "a grid world with walls, rewarded cells and slippery moves (Hahn & Zoubir 2015, Fig. 1)",
        observation_space: Space::Discrete { n: n_states },
        n_actions: N_ACTIONS,
        n_states,
        info_columns: vec![
            column("row", "row of the present cell, counted from 0 at the top"),
            column("col", "column of the present cell, counted from 0 at the left"),
        ],
        max_episode_steps: MAX_EPISODE_STEPS,
        options,
        drivers: vec![
            ("optimal", "the optimal policy under the true reward with discount 0.9, ties split evenly"),
            ("random", "every action equally likely"),
        ],
        styles: vec!["optimal"],
        render_fps: 4,
    };
    let slip_below = (slip * DRAWS) as u64;
    let tables = Tables {
        next: layout.moves(),
        positions: layout.positions().map(|(row, column)| [row, column].map(|at| (at as i32).to_le_bytes())).collect(),
        layout,
        slip,
        slip_below,
        direction_scale: if slip_below == 0 { 0.0 } else { 4.0 / slip_below as f64 },
        optimal: OnceLock::new(),
    };
    Ok(Configured { spec: Arc::new(spec), prototype: Maze { tables: Arc::new(tables), state: 0 } })
}

fn column(name: &'static str, description: &'static str) -> InfoColumn {
    InfoColumn { name, dtype: DType::Int32, shape: Vec::new(), unit: "1", description, summed: false }
}

fn option_specs() -> Vec<OptionSpec> {
    vec![
        OptionSpec {
            name: "layout",
            default: json!(DEFAULT_LAYOUT),
            description: "the grid: a list of rows, or one string with line breaks; '.' is free, '#' is a wall; rows of equal \
                          length, at most 65536 cells in all, at least one free",
        },
        OptionSpec {
            name: "rewards",
            default: Value::Null,
            description: "rewarded cells as [row, column] (reward 1) or [row, column, reward], or one number for each state; \
                          null means 1 in those of the upper-left, upper-right and lower-right corner and the centre that are free",
        },
        OptionSpec {
            name: "slip",
            default: json!(DEFAULT_SLIP),
            description: "probability, 0 to 1, that a step goes in one of the four directions drawn uniformly instead of the chosen one",
        },
    ]
}

impl Configured<Maze> {
    /// The exact model: rows of P(s'|s,a), and R(s,a) = R(s) as the reward table `"optimal"`.
    pub fn model(&self) -> TabularModel {
        let tables = &*self.prototype.tables;
        let n_states = tables.layout.n_states();
        let mut rows = Rows::new();
        for state in 0..n_states {
            let next = tables.moves(state);
            for action in 0..N_ACTIONS as usize {
                let mut entries = [(0, 0.0); 5];
                for direction in 0..4 {
                    entries[direction] = (next[direction], tables.slip / 4.0);
                }
                entries[4] = (next[action], 1.0 - tables.slip);
                rows.push(&mut entries);
            }
        }
        let layout = &tables.layout;
        TabularModel {
            env_id: ENV_ID.to_owned(),
            model_id: model_id(n_states, N_ACTIONS, &rows.offsets, &rows.next_states, &rows.probabilities),
            n_states,
            n_actions: N_ACTIONS,
            state_labels: layout.positions().map(|(row, column)| format!("row {row}, col {column}")).collect(),
            action_labels: ACTION_LABELS.map(str::to_owned).to_vec(),
            initial_distribution: vec![1.0 / f64::from(n_states); n_states as usize],
            row_offsets: rows.offsets,
            next_states: rows.next_states,
            probabilities: rows.probabilities,
            visit_counts: None,
            rewards: vec![("optimal".to_owned(), layout.rewards.iter().flat_map(|&reward| [reward; 4]).collect())],
            grid: Some((layout.rows, layout.columns, layout.cells.clone())),
        }
    }
}

impl Tables {
    /// State entered from `state` by each direction.
    fn moves(&self, state: u32) -> [u32; 4] {
        let at = state as usize * 4;
        [self.next[at], self.next[at + 1], self.next[at + 2], self.next[at + 3]]
    }

    fn optimal(&self) -> &[u8] {
        self.optimal.get_or_init(|| planner::optimal_actions(&self.next, self.slip, &self.layout.rewards))
    }
}

impl Simulator for Maze {
    /// The state: there are at most 65,536.
    type Stored = u16;
    const STEP_NANOS: usize = 9;

    fn stored(&self) -> u16 {
        self.state as u16
    }

    #[inline]
    fn load<'a>(scratch: &'a mut Self, stored: &'a mut u16) -> &'a mut Self {
        scratch.state = u32::from(*stored);
        scratch
    }

    #[inline]
    fn save(scratch: &Self, stored: &mut u16) {
        *stored = scratch.stored();
    }

    fn reset(&mut self, rng: &mut Rng) {
        self.state = below(rng, self.tables.layout.n_states());
    }

    #[inline]
    fn step(&mut self, action: u32, rng: &mut Rng) -> Outcome {
        let tables = &*self.tables;
        let draw = rng.next_u64() >> 11;
        // Nobody can foretell whether it slips: both directions are at hand, and none is jumped to.
        let slipping = ((draw as f64 * tables.direction_scale) as u32).min(3);
        let direction = std::hint::select_unpredictable(draw < tables.slip_below, slipping, action) as usize;
        self.state = tables.next[self.state as usize * 4 + direction];
        Outcome { reward: tables.layout.rewards[self.state as usize], terminated: false }
    }

    fn tabular_state(&self) -> u32 {
        self.state
    }

    #[inline]
    fn write_observation(&self, out: &mut [u8]) {
        out.copy_from_slice(&(self.state as i32).to_le_bytes());
    }

    fn write_info(&self, column: usize, out: &mut [u8]) {
        out.copy_from_slice(&self.tables.positions[self.state as usize][column]);
    }

    fn write_rows(
        scratch: &mut Self,
        stored: &mut [u16],
        first: usize,
        observations: &mut [u8],
        _observation_len: usize,
        infos: &mut [&mut [u8]],
        _info_lens: &[usize],
    ) {
        for (out, state) in observations.as_chunks_mut().0[first..].iter_mut().zip(&*stored) {
            *out = u32::from(*state).to_le_bytes();
        }
        if let [rows, columns] = infos {
            let rows = rows.as_chunks_mut().0[first..].iter_mut();
            let columns = columns.as_chunks_mut().0[first..].iter_mut();
            for ((row, column), &state) in rows.zip(columns).zip(&*stored) {
                [*row, *column] = scratch.tables.positions[state as usize];
            }
        }
    }

    fn info_value(&self, column: usize) -> f64 {
        let (row, col) = self.tables.layout.position(self.state);
        f64::from(if column == 0 { row } else { col })
    }

    fn write_action_mask(&self, out: &mut [u8]) {
        for (flag, next) in out.iter_mut().zip(self.tables.moves(self.state)) {
            *flag = u8::from(next != self.state);
        }
    }

    fn render_text(&self) -> String {
        render::text(&self.tables.layout, self.state)
    }

    fn render_svg(&self) -> String {
        render::svg(&self.tables.layout, self.state)
    }

    fn driver(&self, name: &str) -> Option<Box<dyn Driver<Self>>> {
        match name {
            "optimal" => {
                self.tables.optimal();
                Some(Box::new(OptimalDriver))
            }
            "random" => Some(Box::new(RandomDriver { n_actions: N_ACTIONS })),
            _ => None,
        }
    }
}

/// Draws evenly among the optimal actions.
struct OptimalDriver;

impl Driver<Maze> for OptimalDriver {
    fn act(&mut self, simulator: &Maze, rng: &mut Rng) -> u32 {
        let mask = simulator.tables.optimal()[simulator.state as usize];
        let rank = below(rng, mask.count_ones());
        (0..N_ACTIONS).filter(|action| mask >> action & 1 == 1).nth(rank as usize).unwrap_or(0)
    }
}

#[cfg(test)]
mod tests;
