//! A square grid with four actions of which 30 % go astray, and weights and counts without structure: for the time of one
//! gradient of the likelihood.

use mazeway_learner::mdp::TabularMdp;
use rand_core::Rng;
use rand_pcg::Pcg64;

pub struct Grid {
    pub mdp: TabularMdp,
    /// N(s,a).
    pub counts: Vec<f64>,
    random: Pcg64,
}

pub fn grid(side: usize) -> Grid {
    let n_states = side * side;
    let (mut offsets, mut next, mut probabilities) = (vec![0], Vec::new(), Vec::new());
    for state in 0..n_states {
        let (row, column) = (state / side, state % side);
        let neighbours = [
            if row > 0 { state - side } else { state },
            if row + 1 < side { state + side } else { state },
            if column + 1 < side { state + 1 } else { state },
            if column > 0 { state - 1 } else { state },
        ];
        for action in 0..4 {
            let mut entries: Vec<(usize, f64)> = Vec::new();
            for (direction, &to) in neighbours.iter().enumerate() {
                let p = if direction == action { 0.775 } else { 0.075 };
                match entries.iter_mut().find(|entry| entry.0 == to) {
                    Some(entry) => entry.1 += p,
                    None => entries.push((to, p)),
                }
            }
            entries.sort_unstable_by_key(|entry| entry.0);
            next.extend(entries.iter().map(|entry| entry.0 as u32));
            probabilities.extend(entries.iter().map(|entry| entry.1));
            offsets.push(next.len());
        }
    }
    let mdp = TabularMdp::new(n_states, 4, offsets, next, probabilities, None).expect("a model");
    let mut random = Pcg64::new(1, 1);
    let counts = (0..mdp.n_pairs()).map(|_| (random.next_u64() % 5) as f64).collect();
    Grid { mdp, counts, random }
}

impl Grid {
    /// Uniform in [0, 1) on every state.
    pub fn weights(&mut self) -> Vec<f64> {
        (0..self.mdp.n_states()).map(|_| (self.random.next_u64() >> 11) as f64 / (1_u64 << 53) as f64).collect()
    }

    /// Some weights, and steps about as long as those of a search from them.
    pub fn steps(&mut self, n: usize) -> Vec<Vec<f64>> {
        let first = self.weights();
        (0..n).map(|_| first.iter().zip(self.weights()).map(|(w, step)| w + 0.05 * (step - 0.5)).collect()).collect()
    }
}
