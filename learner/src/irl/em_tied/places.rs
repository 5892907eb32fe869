//! Where rewards are tried: places by their plausibility, and places near each other.

use crate::irl::BasisKind;
use crate::irl::random::Stream;
use crate::mdp::TabularMdp;

/// Share of places drawn uniformly.
const EVERYWHERE: f64 = 0.3;

/// Where a reward is tried, and its true place may be: a fixed distribution, so that detailed balance is easy to keep.
#[derive(Debug)]
pub(super) struct Places {
    pub(super) probability: Vec<f64>,
    cumulative: Vec<f64>,
}

impl Places {
    /// Most often where a little reward would lower the log posterior least: `slopes` are its derivatives at the optimum with
    /// the sign changed, shape (`n_basis`,), 0 where a weight is free. A reward is tried everywhere now and then.
    pub(super) fn new(slopes: &[f64]) -> Self {
        let plausible: Vec<f64> = slopes.iter().map(|g| (1.0 + g.max(0.0)).powi(-2)).collect();
        let total: f64 = plausible.iter().sum();
        let n = slopes.len() as f64;
        let probability: Vec<f64> = plausible.iter().map(|p| EVERYWHERE / n + (1.0 - EVERYWHERE) * p / total).collect();
        let cumulative = probability
            .iter()
            .scan(0.0, |sum, p| {
                *sum += p;
                Some(*sum)
            })
            .collect();
        Self { probability, cumulative }
    }

    pub(super) fn draw(&self, stream: &mut Stream) -> usize {
        let u = stream.uniform() * self.cumulative[self.cumulative.len() - 1];
        self.cumulative.partition_point(|&c| c <= u).min(self.cumulative.len() - 1)
    }
}

/// Basis functions near each other, both ways: where a reward may have its true place.
#[derive(Debug)]
pub(super) struct Neighbours(pub(super) Vec<Vec<u32>>);

impl Neighbours {
    /// One step apart, for the Dirac bases; none for features.
    pub(super) fn new(mdp: &TabularMdp, kind: BasisKind, n_basis: usize) -> Self {
        let mut near = vec![Vec::new(); n_basis];
        if kind != BasisKind::Features {
            let mut link = |a: usize, b: usize| {
                if a != b {
                    near[a].push(b as u32);
                    near[b].push(a as u32);
                }
            };
            for pair in 0..mdp.n_pairs() {
                let (state, action) = (pair / mdp.n_actions(), pair % mdp.n_actions());
                for &next in mdp.row(pair).0 {
                    match kind {
                        BasisKind::State => link(state, next as usize),
                        _ => link(pair, mdp.pair(next as usize, action)),
                    }
                }
                if kind == BasisKind::StateAction {
                    (0..action).for_each(|other| link(pair, mdp.pair(state, other)));
                }
            }
        }
        for list in &mut near {
            list.sort_unstable();
            list.dedup();
        }
        Self(near)
    }
}
