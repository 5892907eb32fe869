//! Throughput of the simulators on one core, in steps a second.
//!
//! `cargo bench -p mazeway-server --no-default-features --bench simulators`

use std::hint::black_box;

use criterion::{Criterion, Throughput, criterion_group, criterion_main};
use mazeway_server::sim::{
    Configured, Rng, Simulator, highway, maze,
    rng::{Purpose, below, stream},
};
use serde_json::{Map, json};

/// Steps of one measured iteration.
const STEPS: usize = 10_000;
/// Environments of the batch.
const BATCH: usize = 64;

/// Actions drawn beforehand, so that the driver's time is not the simulator's.
fn actions(n_actions: u32) -> Vec<u32> {
    let mut rng = stream(1, Purpose::Controller);
    (0..STEPS).map(|_| below(&mut rng, n_actions)).collect()
}

fn ready<S: Simulator>(configured: &Configured<S>, seed: u64) -> (S, Rng) {
    let (mut simulator, mut rng) = (configured.prototype.clone(), stream(seed, Purpose::Dynamics));
    simulator.reset(&mut rng);
    (simulator, rng)
}

fn steps<S: Simulator>(criterion: &mut Criterion, name: &str, configured: &Configured<S>) {
    let actions = actions(configured.spec.n_actions);
    let mut group = criterion.benchmark_group(name);
    group.throughput(Throughput::Elements(STEPS as u64));

    let (mut simulator, mut rng) = ready(configured, 0);
    group.bench_function("step", |bencher| {
        bencher.iter(|| actions.iter().map(|&action| simulator.step(action, &mut rng).reward).sum::<f64>());
    });

    let (mut simulator, mut rng) = ready(configured, 0);
    let mut observation = vec![0; configured.spec.observation_space.packed_len()];
    group.bench_function("step_and_observe", |bencher| {
        bencher.iter(|| {
            for &action in &actions {
                black_box(simulator.step(action, &mut rng));
                simulator.write_observation(&mut observation);
                black_box(&observation);
            }
        });
    });

    let mut batch: Vec<_> = (0..BATCH as u64).map(|seed| ready(configured, seed)).collect();
    group.bench_function(format!("batch_of_{BATCH}"), |bencher| {
        bencher.iter(|| {
            let mut reward = 0.0;
            for chunk in actions.chunks(BATCH) {
                for ((simulator, rng), &action) in batch.iter_mut().zip(chunk) {
                    reward += simulator.step(action, rng).reward;
                }
            }
            reward
        });
    });
    group.finish();
}

fn simulators(criterion: &mut Criterion) {
    let defaults = Map::new();
    steps(criterion, "maze", &maze::configure(&defaults).expect("defaults"));
    steps(criterion, "highway", &highway::configure(&defaults).expect("defaults"));
    let kinematics = json!({"observation": "kinematics"});
    let configured = highway::configure(kinematics.as_object().expect("an object")).expect("valid options");
    steps(criterion, "highway_kinematics", &configured);
}

fn model(criterion: &mut Criterion) {
    let configured = highway::configure(&Map::new()).expect("defaults");
    let mut group = criterion.benchmark_group("highway_model");
    group.sample_size(10);
    group.bench_function("estimate", |bencher| bencher.iter(|| configured.model()));
    group.finish();
}

criterion_group!(benches, simulators, model);
criterion_main!(benches);
