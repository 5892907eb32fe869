//! Random processes and demonstrations, a function of the seed alone.
#![allow(dead_code, reason = "every test file uses its own part")]

use mazeway_learner::mdp::{Policy, TabularMdp};
use mazeway_learner::statistics::Statistics;
use mazeway_learner::trajectory::{Demonstrations, Trajectory};
use rand_core::Rng;
use rand_pcg::Pcg64;

pub fn generator(seed: u64) -> Pcg64 {
    Pcg64::new(u128::from(seed), 0x5eed)
}

/// Uniform in [0, 1).
pub fn uniform(random: &mut Pcg64) -> f64 {
    (random.next_u64() >> 11) as f64 / (1_u64 << 53) as f64
}

pub fn below(n: usize, random: &mut Pcg64) -> usize {
    (random.next_u64() % n as u64) as usize
}

pub fn vector(n: usize, random: &mut Pcg64) -> Vec<f64> {
    (0..n).map(|_| uniform(random)).collect()
}

/// Sparse rows of up to `branching` next states; about a fifth of the states are absorbing.
pub fn mdp(n_states: usize, n_actions: usize, branching: usize, random: &mut Pcg64) -> TabularMdp {
    let (mut offsets, mut next, mut probabilities) = (vec![0], Vec::new(), Vec::new());
    for state in 0..n_states {
        let absorbing = n_states > 1 && below(5, random) == 0;
        for _ in 0..n_actions {
            let mut columns: Vec<usize> = if absorbing {
                vec![state]
            } else {
                (0..=below(branching, random)).map(|_| below(n_states, random)).collect()
            };
            columns.sort_unstable();
            columns.dedup();
            let weights: Vec<f64> = columns.iter().map(|_| 0.05 + uniform(random)).collect();
            let sum: f64 = weights.iter().sum();
            next.extend(columns.iter().map(|&s| s as u32));
            probabilities.extend(weights.iter().map(|w| w / sum));
            offsets.push(next.len());
        }
    }
    let initial = vector(n_states, random);
    let sum: f64 = initial.iter().sum();
    let initial = initial.iter().map(|p| p / sum).collect();
    TabularMdp::new(n_states, n_actions, offsets, next, probabilities, Some(initial)).expect("a checked model")
}

pub fn policy(n_states: usize, n_actions: usize, random: &mut Pcg64) -> Policy {
    let mut probabilities = Vec::new();
    for _ in 0..n_states {
        let row = vector(n_actions, random);
        let sum: f64 = row.iter().sum();
        probabilities.extend(row.iter().map(|p| p / sum));
    }
    Policy::new(n_actions, probabilities).expect("a policy")
}

fn draw(distribution: impl Iterator<Item = f64>, random: &mut Pcg64) -> usize {
    let mut left = uniform(random);
    let mut last = 0;
    for (index, p) in distribution.enumerate() {
        if p > 0.0 {
            last = index;
        }
        left -= p;
        if left < 0.0 {
            return index;
        }
    }
    last
}

/// Episodes of `policy` of 1 to `longest` steps each.
pub fn episodes(mdp: &TabularMdp, policy: &Policy, n: usize, longest: usize, random: &mut Pcg64) -> Demonstrations {
    (0..n)
        .map(|_| {
            let mut state = draw(mdp.initial_distribution().iter().copied(), random);
            let (mut states, mut actions) = (Vec::new(), Vec::new());
            for _ in 0..=below(longest, random) {
                let action = draw(policy.row(state).iter().copied(), random);
                states.push(state as u32);
                actions.push(action as u32);
                let (next, probabilities) = mdp.row(mdp.pair(state, action));
                state = next[draw(probabilities.iter().copied(), random)] as usize;
            }
            let (n_states, n_actions) = (mdp.n_states() as u32, mdp.n_actions() as u32);
            Trajectory::new(states, actions, Some(state as u32), n_states, n_actions).expect("a trajectory")
        })
        .collect()
}

pub fn statistics(mdp: &TabularMdp, demonstrations: &Demonstrations) -> Statistics {
    let mut builder = Statistics::builder(mdp.n_states(), mdp.n_actions(), None);
    builder.extend(demonstrations).expect("within the process");
    builder.finish().expect("at least one trajectory")
}

/// Order of `n` things at random.
pub fn permutation(n: usize, random: &mut Pcg64) -> Vec<usize> {
    let mut order: Vec<usize> = (0..n).collect();
    for i in (1..n).rev() {
        order.swap(i, below(i + 1, random));
    }
    order
}

/// The same process with state s renamed `order[s]`.
pub fn permuted(mdp: &TabularMdp, order: &[usize]) -> TabularMdp {
    let (n, n_actions) = (mdp.n_states(), mdp.n_actions());
    let mut old = vec![0; n];
    for (s, &to) in order.iter().enumerate() {
        old[to] = s;
    }
    let (mut offsets, mut next, mut probabilities) = (vec![0], Vec::new(), Vec::new());
    for &from in &old {
        for action in 0..n_actions {
            let (states, p) = mdp.row(mdp.pair(from, action));
            let mut row: Vec<(u32, f64)> = states.iter().zip(p).map(|(&s, &p)| (order[s as usize] as u32, p)).collect();
            row.sort_unstable_by_key(|entry| entry.0);
            next.extend(row.iter().map(|entry| entry.0));
            probabilities.extend(row.iter().map(|entry| entry.1));
            offsets.push(next.len());
        }
    }
    let initial = old.iter().map(|&s| mdp.initial_distribution()[s]).collect();
    TabularMdp::new(n, n_actions, offsets, next, probabilities, Some(initial)).expect("a checked model")
}
