//! Throughput of whole batches, replies packed, in steps a second, on one core and on two.
//!
//! `cargo bench -p mazeway-server --no-default-features --bench batches`

use criterion::{BenchmarkId, Criterion, Throughput, criterion_group, criterion_main};
use mazeway_server::{
    batch::{Autoreset, BatchOptions, Seeds},
    registry::{Environment, Registry},
    sim::rng::{Purpose, below, stream},
};
use serde_json::{Value, json};
use std::{sync::Arc, time::Duration};

fn environment(env_id: &str, options: Value) -> Arc<dyn Environment> {
    Registry::new().configure(env_id, options.as_object().expect("an object")).expect("valid options")
}

fn steps(criterion: &mut Criterion, name: &str, env_id: &str, options: Value, autoreset: Autoreset, sizes: &[usize]) {
    let environment = environment(env_id, options);
    let spec = environment.spec();
    let mut group = criterion.benchmark_group(name);
    group.warm_up_time(Duration::from_millis(300)).measurement_time(Duration::from_secs(1)).sample_size(20);
    for &num_envs in sizes {
        let mut rng = stream(1, Purpose::Controller);
        let actions: Vec<u8> = (0..num_envs).flat_map(|_| below(&mut rng, spec.n_actions).to_le_bytes()).collect();
        let options =
            BatchOptions { num_envs, autoreset, max_episode_steps: spec.max_episode_steps, action_masks: false };
        let mut batch = Arc::clone(&environment).batch(options);
        batch.reset(Seeds::From(0), None).expect("resets");
        group.throughput(Throughput::Elements(num_envs as u64));
        for threads in [1, 2] {
            let pool = rayon::ThreadPoolBuilder::new().num_threads(threads).build().expect("threads");
            group.bench_function(BenchmarkId::new(format!("threads_{threads}"), num_envs), |bencher| {
                pool.install(|| bencher.iter(|| batch.step(&actions).expect("steps").reward(0)));
            });
        }
        // As a server steps it: the caller is in no pool, and helpers must be woken up.
        group.bench_function(BenchmarkId::new("own_pool", num_envs), |bencher| {
            bencher.iter(|| batch.step(&actions).expect("steps").reward(0));
        });
    }
    group.finish();
}

fn batches(criterion: &mut Criterion) {
    use Autoreset::{NextStep, SameStep};
    let maze = [1, 64, 1024, 16_384, 65_536];
    steps(criterion, "maze_batch", "Maze-v0", json!({}), NextStep, &maze);
    steps(criterion, "maze_batch_same_step", "Maze-v0", json!({}), SameStep, &[1024]);
    steps(criterion, "highway_batch", "Highway-v0", json!({}), NextStep, &[1, 64, 1024, 16_384]);
    steps(criterion, "highway_batch_kinematics", "Highway-v0", json!({"observation": "kinematics"}), NextStep, &[1024]);
}

criterion_group!(benches, batches);
criterion_main!(benches);
