//! A batch allocates when it is made and never again.

use mazeway_server::{
    batch::{Autoreset, Batch, BatchOptions, Seeds},
    registry::Registry,
};
use serde_json::json;
use std::sync::Arc;

fn stepping_allocates(batch: &mut dyn Batch) -> u64 {
    let n_actions = batch.spec().n_actions;
    let actions: Vec<Vec<u8>> =
        (0..24_u32).map(|step| (0..5).flat_map(|env| ((step * 7 + env) % n_actions).to_le_bytes()).collect()).collect();
    batch.reset(Seeds::From(1), None).expect("resets");
    let measured = allocation_counter::measure(|| {
        for step in 0..1_000 {
            if batch.options().autoreset == Autoreset::Disabled && step % 7 == 0 {
                batch.reset(Seeds::Continue, Some(&[1; 5])).expect("resets");
            }
            batch.step(&actions[step % actions.len()]).expect("steps");
        }
    });
    measured.count_total
}

#[test]
fn steps_and_resets_do_not_allocate() {
    for (env_id, options) in [
        ("Maze-v0", json!({})),
        ("Highway-v0", json!({})),
        ("Highway-v0", json!({"observation": "kinematics", "density": 8})),
    ] {
        let environment = Registry::new().configure(env_id, options.as_object().expect("an object"));
        let environment = environment.expect("an environment");
        for autoreset in [Autoreset::NextStep, Autoreset::SameStep, Autoreset::Disabled] {
            let options = BatchOptions { num_envs: 5, autoreset, max_episode_steps: 7, action_masks: true };
            let mut batch = Arc::clone(&environment).batch(options);
            assert_eq!(stepping_allocates(&mut *batch), 0, "{env_id} {autoreset:?}");
        }
    }
}

#[test]
fn several_cores_take_a_few_allocations_a_step_and_none_an_environment() {
    const ENVS: usize = 40_000;
    let environment = Registry::new().configure("Maze-v0", &serde_json::Map::new()).expect("an environment");
    let options =
        BatchOptions { num_envs: ENVS, autoreset: Autoreset::NextStep, max_episode_steps: 7, action_masks: true };
    let mut batch = environment.batch(options);
    let actions = vec![0; ENVS * 4];
    batch.reset(Seeds::From(1), None).expect("resets");
    // What a pool makes when it is first used.
    batch.step(&actions).expect("steps");
    let measured = allocation_counter::measure(|| {
        for _ in 0..100 {
            batch.step(&actions).expect("steps");
        }
    });
    // On this thread: a job for each other core, and what the pool queues them in.
    let cores = std::thread::available_parallelism().map_or(1, usize::from) as u64;
    assert!(measured.count_total <= 100 * 4 * cores, "{} allocations", measured.count_total);
}
