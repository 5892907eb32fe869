//! The highway's tabular model, estimated from simulated transitions.
//!
//! P(s'|s,a) is the share of the visits to (s,a) that led to s'; R(s,a) of a style is the mean step reward. The drives mix all
//! scripted drivers with exploration of the least visited actions, so that every row has many visits. Invariants: fixed seeds;
//! chunks are counted in integers and summed, so that the result does not depend on the number of threads.
//! Deliberately absent: smoothing; a row without visits would be a defect, and a test says so.

use rayon::prelude::*;

use super::{ENV_ID, Highway, N_ACTIONS, N_STATES, STYLES, Style, action_label, state_label};
use crate::sim::{
    Configured, Simulator as _, TabularModel,
    model::{Rows, model_id},
    rng::{Purpose, below, stream},
};

/// Chunks that are simulated independently, each with its own streams.
const CHUNKS: u64 = 64;
/// Steps of a chunk: 2.56 million in all.
const CHUNK_STEPS: u32 = 40_000;
/// Steps of an episode within a chunk.
const EPISODE_STEPS: u32 = 200;
/// Longest phase of one way of driving.
const MAX_PHASE_STEPS: u32 = 20;
/// Resets from which the initial distribution is estimated, in each chunk.
const CHUNK_RESETS: u32 = 2_000;

const STATES: usize = N_STATES as usize;
const ACTIONS: usize = N_ACTIONS as usize;
const ROWS: usize = STATES * ACTIONS;

/// Integer totals of some drives.
struct Counts {
    initial: Vec<u64>,
    /// Shape (rows, states).
    next: Vec<u64>,
    /// Visits, metres driven, collisions and overtakes from the right of each row. Speeds are whole m/s.
    totals: Vec<[u64; 4]>,
}

impl Counts {
    fn new() -> Self {
        Self { initial: vec![0; STATES], next: vec![0; ROWS * STATES], totals: vec![[0; 4]; ROWS] }
    }

    fn add(mut self, other: Self) -> Self {
        let sum = |into: &mut [u64], from: &[u64]| into.iter_mut().zip(from).for_each(|(into, from)| *into += from);
        sum(&mut self.initial, &other.initial);
        sum(&mut self.next, &other.next);
        sum(self.totals.as_flattened_mut(), other.totals.as_flattened());
        self
    }
}

impl Configured<Highway> {
    /// Estimates the model under this density; about a second of computation. The styles' reward tables are all in it.
    pub fn model(&self) -> TabularModel {
        let counts =
            (0..CHUNKS).into_par_iter().map(|chunk| drive(&self.prototype, chunk)).reduce(Counts::new, Counts::add);
        let mut rows = Rows::new();
        for (next, totals) in counts.next.chunks_exact(STATES).zip(&counts.totals) {
            let visits = totals[0].max(1) as f64;
            let mut entries: Vec<(u32, f64)> =
                next.iter().enumerate().map(|(state, &count)| (state as u32, count as f64 / visits)).collect();
            rows.push(&mut entries);
        }
        let rewards = STYLES.iter().zip(Style::ALL).map(|(name, style)| {
            let table = counts.totals.iter().map(|&[visits, metres, collisions, overtakes_right]| {
                let mean = |total: u64| total as f64 / visits.max(1) as f64;
                style.reward(mean(metres), mean(collisions), mean(overtakes_right))
            });
            ((*name).to_owned(), table.collect())
        });
        let resets = counts.initial.iter().sum::<u64>() as f64;
        TabularModel {
            env_id: ENV_ID.to_owned(),
            model_id: model_id(N_STATES, N_ACTIONS, &rows.offsets, &rows.next_states, &rows.probabilities),
            n_states: N_STATES,
            n_actions: N_ACTIONS,
            state_labels: (0..N_STATES).map(state_label).collect(),
            action_labels: (0..N_ACTIONS).map(action_label).collect(),
            initial_distribution: counts.initial.iter().map(|&count| count as f64 / resets).collect(),
            rewards: rewards.collect(),
            row_offsets: rows.offsets,
            next_states: rows.next_states,
            probabilities: rows.probabilities,
            visit_counts: Some(counts.totals.iter().map(|totals| totals[0]).collect()),
            grid: None,
        }
    }
}

/// Drives one chunk: phases of a scripted driver, of one action held, and of least visited actions.
fn drive(prototype: &Highway, chunk: u64) -> Counts {
    let mut counts = Counts::new();
    let mut rng = stream(chunk, Purpose::Model);
    let mut highway = prototype.clone();
    for _ in 0..CHUNK_RESETS {
        highway.reset(&mut rng);
        counts.initial[highway.tabular_state() as usize] += 1;
    }
    let mut drivers: Vec<_> = STYLES.iter().filter_map(|style| highway.driver(style)).collect();
    let (mut phase, mut phase_steps, mut held) = (0, 0, 0);
    for step in 0..CHUNK_STEPS {
        if step % EPISODE_STEPS == 0 {
            highway.reset(&mut rng);
        }
        if phase_steps == 0 {
            phase = below(&mut rng, 6) as usize;
            phase_steps = 1 + below(&mut rng, MAX_PHASE_STEPS);
            held = below(&mut rng, N_ACTIONS);
        }
        phase_steps -= 1;
        let state = highway.tabular_state() as usize;
        let action = match (phase, drivers.get_mut(phase)) {
            (_, Some(driver)) => driver.act(&highway, &mut rng),
            (3, None) => held,
            _ => least_visited(&counts.totals[state * ACTIONS..][..ACTIONS]),
        };
        highway.step(action, &mut rng);
        let row = state * ACTIONS + action as usize;
        counts.next[row * STATES + highway.tabular_state() as usize] += 1;
        let seen = [
            1,
            highway.road.host_speed_mps() as u64,
            highway.events.collisions.into(),
            highway.events.overtakes_right.into(),
        ];
        for (total, seen) in counts.totals[row].iter_mut().zip(seen) {
            *total += seen;
        }
    }
    counts
}

/// The first of the least visited actions.
fn least_visited(totals: &[[u64; 4]]) -> u32 {
    (0..totals.len()).min_by_key(|&action| totals[action][0]).unwrap_or(0) as u32
}
