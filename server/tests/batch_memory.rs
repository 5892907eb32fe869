//! What a batch and a session cost in memory, counted where it is allocated.

use mazeway_server::{
    batch::{Autoreset, BatchOptions},
    registry::Registry,
    sessions::{Holder, Limits, Sessions},
};
use serde_json::{Value, json};
use std::time::{Duration, Instant};

fn options(num_envs: usize, autoreset: Autoreset) -> BatchOptions {
    BatchOptions { num_envs, autoreset, max_episode_steps: 100, action_masks: false }
}

/// Bytes of a session with `num_envs` environments, its description and everything else included.
fn session_bytes(env_id: &str, given: Value, num_envs: usize, autoreset: Autoreset) -> u64 {
    let hour = Duration::from_hours(1);
    let limits = Limits {
        max_sessions: 8,
        max_envs_per_session: 1 << 20,
        max_total_envs: 1 << 20,
        default_lease: hour,
        max_lease: hour,
    };
    let (registry, sessions) = (Registry::new(), Sessions::new(limits));
    let create = || {
        let environment = registry.configure(env_id, given.as_object().expect("an object")).expect("valid options");
        let make = || environment.batch(options(num_envs, autoreset));
        sessions.create(&Holder::anybody(), num_envs, None, Instant::now(), make).expect("a session");
    };
    // The first makes what all share.
    create();
    let measured = allocation_counter::measure(create);
    u64::try_from(measured.bytes_current).expect("more was allocated than freed")
}

/// Bytes of one more environment in a batch.
fn environment_bytes(env_id: &str, given: Value, autoreset: Autoreset) -> u64 {
    let bytes = |num_envs| session_bytes(env_id, given.clone(), num_envs, autoreset);
    (bytes(2048) - bytes(1024)).div_ceil(1024)
}

#[test]
fn a_maze_of_a_batch_takes_less_than_64_bytes() {
    assert_eq!(environment_bytes("Maze-v0", json!({}), Autoreset::NextStep), 60);
    // Its last observation and infos come on top.
    assert_eq!(environment_bytes("Maze-v0", json!({}), Autoreset::SameStep), 72);
}

#[test]
fn a_highway_of_a_batch_takes_less_than_a_kibibyte() {
    let discrete = environment_bytes("Highway-v0", json!({}), Autoreset::NextStep);
    assert!(discrete <= 800, "{discrete} bytes");
    let kinematics = environment_bytes("Highway-v0", json!({"observation": "kinematics"}), Autoreset::NextStep);
    assert!(kinematics < 1024, "{kinematics} bytes");
}

#[test]
fn a_maze_session_takes_less_than_a_kibibyte_whatever_the_size_of_its_maze() {
    let large = vec![".".repeat(200); 200];
    for given in [json!({}), json!({"layout": large})] {
        let bytes = session_bytes("Maze-v0", given, 1, Autoreset::NextStep);
        assert!(bytes < 1024, "{bytes} bytes");
    }
}
