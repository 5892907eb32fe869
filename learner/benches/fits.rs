//! How long fits take, without reading the data: 100 demonstrations of 50 steps in the maze; one gradient of the likelihood
//! in grids of 2,500 and 100,000 states; and how fast demonstrations are counted.
//!
//! `cargo bench -p mazeway-learner --no-default-features --bench fits`
#![allow(missing_docs, reason = "criterion's macros make public items")]

mod grid;
#[path = "../tests/maze/mod.rs"]
mod maze;

use criterion::{BatchSize, BenchmarkId, Criterion, Throughput, criterion_group, criterion_main};
use mazeway_learner::irl::em_tied::Likelihood;
use mazeway_learner::irl::{self, Basis, FitOptions, PosteriorKind, Problem};
use mazeway_learner::statistics::{PackedIndices, Statistics};
use rand_core::Rng;
use rand_pcg::Pcg64;
use std::ops::ControlFlow;

fn fits(criterion: &mut Criterion) {
    let maze = maze::maze();
    let demonstrations = maze::simulate(&maze, 100, 50, 0);
    let statistics = maze::statistics(&demonstrations);
    let mut group = criterion.benchmark_group("maze");
    group.sample_size(10);
    let optimum = FitOptions { posterior: PosteriorKind::None, ..FitOptions::default() };
    let whole = FitOptions::default();
    let all = irl::METHODS.iter().map(|method| (method.id().to_owned(), *method, &whole));
    let tied = irl::method("em-tied").expect("a method");
    for (name, method, options) in all.chain([("em-tied optimum".to_owned(), tied, &optimum)]) {
        let problem = Problem {
            mdp: &maze.mdp,
            options,
            statistics: &statistics,
            demonstrations: Some(&demonstrations),
            features: None,
        };
        group.bench_function(name, |bencher| {
            bencher.iter(|| irl::fit(method, &problem, &mut |_| ControlFlow::Continue(())).expect("a fit"));
        });
    }
}

fn gradients(criterion: &mut Criterion) {
    let mut group = criterion.benchmark_group("gradient");
    group.sample_size(10);
    for side in [50, 316] {
        let mut grid = grid::grid(side);
        let steps = grid.steps(16);
        let basis = Basis::state(&grid.mdp);
        for discount in [0.9, 0.99] {
            let name = |start: &str| BenchmarkId::new(format!("{} states, {start}", side * side), discount);
            let new = || Likelihood::new(&grid.mdp, &basis, grid.counts.clone(), discount);
            let mut likelihood = new();
            likelihood.value_and_gradient(&steps[0]);
            let mut turn = 0;
            group.bench_function(name("warm"), |bencher| {
                bencher.iter(|| {
                    turn = (turn + 1) % steps.len();
                    likelihood.value_and_gradient(&steps[turn])
                });
            });
            group.bench_function(name("cold, the model's order included"), |bencher| {
                bencher.iter(|| new().value_and_gradient(&steps[0]));
            });
        }
    }
}

fn counting(criterion: &mut Criterion) {
    let mut group = criterion.benchmark_group("statistics");
    group.sample_size(10);
    let (n_trajectories, steps) = (20_000, 50);
    for (n_states, n_actions) in [(57, 4), (2500, 4)] {
        let mut random = Pcg64::new(1, 2);
        let mut drawn = |below: u64| -> Vec<u16> {
            (0..n_trajectories * steps).map(|_| (random.next_u64() % below) as u16).collect()
        };
        let (states, actions) = (drawn(n_states), drawn(n_actions));
        // as the store keeps them, in the fewest bytes
        let pairs: Vec<[u8; 2]> = states.iter().map(|s| s.to_le_bytes()).collect();
        let bytes = |values: &[u16]| -> Vec<u8> { values.iter().map(|&v| v as u8).collect() };
        let (small, actions) = (bytes(&states), bytes(&actions));
        group.throughput(Throughput::Elements((n_trajectories * steps) as u64));
        group.bench_function(format!("{n_states} states"), |bencher| {
            bencher.iter_batched_ref(
                || Statistics::builder(n_states as usize, n_actions as usize, None),
                |builder| {
                    for (at, a) in actions.chunks_exact(steps).enumerate() {
                        let range = at * steps..(at + 1) * steps;
                        let s = if n_states <= 256 {
                            PackedIndices::U8(&small[range])
                        } else {
                            PackedIndices::U16(&pairs[range])
                        };
                        builder.add_packed(s, PackedIndices::U8(a)).expect("within the model");
                    }
                },
                BatchSize::LargeInput,
            );
        });
    }
}

criterion_group!(benches, fits, gradients, counting);
criterion_main!(benches);
