//! The reference maze: model and demonstrations computed independently, under `tests/data`.
#![allow(dead_code, reason = "every test file uses its own part")]

use mazeway_learner::mdp::{PlanOptions, PlannerKind, TabularMdp, plan};
use mazeway_learner::statistics::Statistics;
use mazeway_learner::trajectory::{Demonstrations, Trajectory};
use rand_core::Rng;
use rand_pcg::Pcg64;
use serde_json::Value;

pub const DISCOUNT: f64 = 0.9;
pub const N_STATES: usize = 57;
pub const N_ACTIONS: usize = 4;

fn read(name: &str) -> Value {
    let path = std::path::Path::new(env!("CARGO_MANIFEST_DIR")).join("../tests/data").join(name);
    let text = std::fs::read_to_string(&path).unwrap_or_else(|error| panic!("{}: {error}", path.display()));
    serde_json::from_str(&text).expect("reference data are JSON")
}

pub fn floats(value: &Value) -> Vec<f64> {
    value.as_array().expect("an array").iter().map(|v| v.as_f64().expect("a number")).collect()
}

fn indices(value: &Value) -> Vec<u32> {
    value.as_array().expect("an array").iter().map(|v| v.as_u64().expect("an index") as u32).collect()
}

pub struct Maze {
    pub mdp: TabularMdp,
    /// R(s,a) = R(s).
    pub reward: Vec<f64>,
    pub state_values: Vec<f64>,
    pub optimal_actions: Vec<Vec<u32>>,
}

impl Maze {
    /// 1 / (number of optimal actions) on each optimal action.
    pub fn optimal_policy(&self) -> Vec<f64> {
        let mut policy = vec![0.0; self.mdp.n_pairs()];
        for (state, actions) in self.optimal_actions.iter().enumerate() {
            for &action in actions {
                policy[state * N_ACTIONS + action as usize] = 1.0 / actions.len() as f64;
            }
        }
        policy
    }
}

pub fn maze() -> Maze {
    let model = read("maze_model.json");
    let mut rows = vec![Vec::new(); N_STATES * N_ACTIONS];
    for entry in model["transition"].as_array().expect("rows") {
        let entry = floats(entry);
        rows[entry[0] as usize * N_ACTIONS + entry[1] as usize].push((entry[2] as u32, entry[3]));
    }
    let (mut offsets, mut next, mut probabilities) = (vec![0], Vec::new(), Vec::new());
    for row in rows {
        for (state, p) in row {
            next.push(state);
            probabilities.push(p);
        }
        offsets.push(next.len());
    }
    let mdp = TabularMdp::new(N_STATES, N_ACTIONS, offsets, next, probabilities, None).expect("a checked model");
    let mut reward = vec![0.0; N_STATES * N_ACTIONS];
    for state in indices(&model["rewarded_states"]) {
        reward[state as usize * N_ACTIONS..(state as usize + 1) * N_ACTIONS].fill(1.0);
    }
    Maze {
        mdp,
        reward,
        state_values: floats(&model["state_values"]),
        optimal_actions: model["optimal_actions"].as_array().expect("rows").iter().map(indices).collect(),
    }
}

/// Layouts under `tests/data/layouts` and their slips, for tests over several mazes: the paper's, one given with independent
/// figures, and random ones of several sizes.
pub const LAYOUTS: [(&str, f64); 7] =
    [("maze-v0", 0.3), ("given", 0.3), ("small", 0.3), ("wide", 0.1), ("tree", 0.3), ("open", 0.5), ("large", 0.2)];

/// The model of a layout, as the simulator makes it, and its optimal policy at [`DISCOUNT`].
pub fn layout(name: &str, slip: f64) -> Maze {
    let path =
        std::path::Path::new(env!("CARGO_MANIFEST_DIR")).join("../tests/data/layouts").join(name).with_extension("txt");
    let text = std::fs::read_to_string(&path).unwrap_or_else(|error| panic!("{}: {error}", path.display()));
    let options = [("layout".to_owned(), Value::from(text)), ("slip".to_owned(), Value::from(slip))];
    let configured = mazeway_server::sim::maze::configure(&options.into_iter().collect())
        .expect("a layout that the simulator takes");
    let model = configured.model();
    let (n_states, n_actions) = (model.n_states as usize, model.n_actions as usize);
    let mdp = TabularMdp::new(
        n_states,
        n_actions,
        model.row_offsets,
        model.next_states,
        model.probabilities,
        Some(model.initial_distribution),
    )
    .expect("a checked model");
    let reward = model.rewards.into_iter().next().expect("a reward").1;
    let options = PlanOptions { discount: DISCOUNT, ..PlanOptions::default() };
    let optimal = plan(PlannerKind::PolicyIteration, &mdp, &reward, &options).expect("a plan");
    let greedy = optimal.greedy_policy();
    let best = |state: &[f64]| (0..n_actions as u32).filter(|&a| state[a as usize] > 0.0).collect();
    let optimal_actions = greedy.probabilities().chunks_exact(n_actions).map(best).collect();
    Maze { mdp, reward, state_values: optimal.state_values, optimal_actions }
}

pub fn demonstrations() -> Demonstrations {
    let data = read("maze_demonstrations.json");
    let states = data["states"].as_array().expect("rows");
    let actions = data["actions"].as_array().expect("rows");
    states
        .iter()
        .zip(actions)
        .map(|(s, a)| {
            Trajectory::new(indices(s), indices(a), None, N_STATES as u32, N_ACTIONS as u32).expect("a trajectory")
        })
        .collect()
}

pub fn statistics(demonstrations: &Demonstrations) -> Statistics {
    statistics_in(N_STATES, demonstrations)
}

pub fn statistics_in(n_states: usize, demonstrations: &Demonstrations) -> Statistics {
    let mut builder = Statistics::builder(n_states, N_ACTIONS, None);
    builder.extend(demonstrations).expect("within the maze");
    builder.finish().expect("at least one trajectory")
}

pub fn cases() -> Vec<Value> {
    read("maze_fits.json")["cases"].as_array().expect("cases").clone()
}

/// Share of states whose greedy action is optimal, ties split evenly.
pub fn agreement(greedy: &[f64], optimal: &[f64]) -> f64 {
    let agreed: f64 = greedy.iter().zip(optimal).filter(|&(_, o)| *o > 0.0).map(|(g, _)| g).sum();
    agreed * N_ACTIONS as f64 / optimal.len() as f64
}

/// Episodes of the optimal policy, ties split evenly, from uniform starts; the same for a seed on every platform.
pub fn simulate(maze: &Maze, episodes: usize, steps: usize, seed: u64) -> Demonstrations {
    let policy = maze.optimal_policy();
    let mut random = Pcg64::new(u128::from(seed), 0xa02_bdbf_7bb3_c0a7);
    (0..episodes)
        .map(|_| {
            let mut state = draw(maze.mdp.initial_distribution(), &mut random);
            let (mut states, mut actions) = (Vec::new(), Vec::new());
            for _ in 0..steps {
                let action = draw(&policy[state * N_ACTIONS..(state + 1) * N_ACTIONS], &mut random);
                states.push(state as u32);
                actions.push(action as u32);
                let (next, probabilities) = maze.mdp.row(maze.mdp.pair(state, action));
                state = next[draw(probabilities, &mut random)] as usize;
            }
            let n_states = maze.mdp.n_states() as u32;
            Trajectory::new(states, actions, Some(state as u32), n_states, N_ACTIONS as u32).expect("a trajectory")
        })
        .collect()
}

/// Index drawn from a distribution.
pub fn draw(distribution: &[f64], random: &mut Pcg64) -> usize {
    let mut left = (random.next_u64() >> 11) as f64 / (1_u64 << 53) as f64;
    for (index, p) in distribution.iter().enumerate() {
        left -= p;
        if left < 0.0 {
            return index;
        }
    }
    distribution.iter().rposition(|p| *p > 0.0).expect("a distribution")
}
