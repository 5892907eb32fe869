//! Small random processes with demonstrations, for tests of what is private to the methods.

use super::{Basis, FitOptions, Problem};
use crate::mdp::{Features, TabularMdp};
use crate::statistics::Statistics;
use crate::trajectory::Trajectory;
use rand_core::Rng;
use rand_pcg::Pcg64;

/// A process of two or three next states a pair, and twelve walks of random actions.
pub(super) struct Case {
    pub(super) mdp: TabularMdp,
    pub(super) statistics: Statistics,
    features: Features,
}

fn uniform(random: &mut Pcg64) -> f64 {
    (random.next_u64() >> 11) as f64 / (1_u64 << 53) as f64
}

impl Case {
    /// Walks of unequal length; the last state is terminal.
    pub(super) fn new(seed: u64, n: usize, n_actions: usize) -> Self {
        Self::with_lengths(seed, n, n_actions, &[1, 4, 7])
    }

    pub(super) fn with_lengths(seed: u64, n: usize, n_actions: usize, lengths: &[usize]) -> Self {
        let mut random = Pcg64::new(u128::from(seed), 77);
        let (mut offsets, mut next, mut probabilities) = (vec![0], Vec::new(), Vec::new());
        for pair in 0..n * n_actions {
            let state = pair / n_actions;
            let mut row: Vec<u32> = if state == n - 1 {
                vec![state as u32]
            } else {
                (0..3).map(|_| (random.next_u64() % n as u64) as u32).collect()
            };
            row.sort_unstable();
            row.dedup();
            let weights: Vec<f64> = row.iter().map(|_| 0.1 + uniform(&mut random)).collect();
            let sum: f64 = weights.iter().sum();
            probabilities.extend(weights.iter().map(|w| w / sum));
            next.extend(row);
            offsets.push(next.len());
        }
        let mdp = TabularMdp::new(n, n_actions, offsets, next, probabilities, None).expect("a model");
        let mut builder = Statistics::builder(n, n_actions, None);
        for walk in 0..12 {
            let mut state = (random.next_u64() % n as u64) as usize;
            let (mut states, mut actions) = (Vec::new(), Vec::new());
            for _ in 0..lengths[walk % lengths.len()] {
                let action = (random.next_u64() % n_actions as u64) as usize;
                states.push(state as u32);
                actions.push(action as u32);
                let (next, p) = mdp.row(mdp.pair(state, action));
                let mut left = uniform(&mut random);
                state = next[p
                    .iter()
                    .position(|p| {
                        left -= p;
                        left < 0.0
                    })
                    .unwrap_or(p.len() - 1)] as usize;
            }
            let walk = Trajectory::new(states, actions, None, n as u32, n_actions as u32).expect("a trajectory");
            builder.add(&walk).expect("within the process");
        }
        let values: Vec<f64> = (0..2 * n * n_actions).map(|_| uniform(&mut random) - 0.5).collect();
        let names = vec!["x".to_owned(), "y".to_owned()];
        let features = Features::of_pairs(n * n_actions, names, &values).expect("features");
        Self { statistics: builder.finish().expect("counts"), mdp, features }
    }

    pub(super) fn problem<'a>(&'a self, options: &'a FitOptions) -> Problem<'a> {
        let features = Some(&self.features);
        Problem { mdp: &self.mdp, options, statistics: &self.statistics, demonstrations: None, features }
    }

    pub(super) fn bases(&self) -> [Basis; 3] {
        [Basis::state(&self.mdp), Basis::state_action(&self.mdp), Basis::features(&self.features)]
    }
}

/// Largest difference of a gradient from central differences at a random point, relative to the gradient's size.
pub(super) fn gradient_error(n: usize, seed: u64, mut f: impl FnMut(&[f64]) -> (f64, Vec<f64>)) -> f64 {
    let mut random = Pcg64::new(u128::from(seed), 78);
    let weights: Vec<f64> = (0..n).map(|_| 4.0 * uniform(&mut random) - 2.0).collect();
    let (_, gradient) = f(&weights);
    let size = 1.0 + gradient.iter().fold(0.0, |m: f64, g| m.max(g.abs()));
    let step = 1e-4;
    let mut worst = 0.0_f64;
    for b in 0..n {
        let mut moved = weights.clone();
        moved[b] += step;
        let above = f(&moved).0;
        moved[b] -= 2.0 * step;
        let below = f(&moved).0;
        worst = worst.max(((above - below) / (2.0 * step) - gradient[b]).abs() / size);
    }
    worst
}
