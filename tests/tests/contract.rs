//! One contract that every environment keeps behind every face: in process, unary, interactive.

use mazeway_client::{Autoreset, Code, Seeds};
use mazeway_server::{registry::Registry, sim::Space};
use mazeway_tests::{
    EnvServer, config,
    faces::{FACES, Face, Make, Reply, Subject},
};
use serde_json::{Map, Value, json};

/// Environments under options that matter to the contract: those of other spaces and of episodes that end.
fn environments() -> Vec<(&'static str, Map<String, Value>)> {
    let object = |value: Value| value.as_object().expect("an object").clone();
    vec![
        ("Highway-v0", Map::new()),
        ("Highway-v0", object(json!({"observation": "kinematics"}))),
        ("Highway-v0", object(json!({"terminate_on_collision": true, "density": 8, "style": "bad"}))),
        ("Maze-v0", Map::new()),
        ("Maze-v0", object(json!({"layout": ["..#", "#.."], "slip": 0}))),
    ]
}

/// Every face with every environment, those of the wire over TCP and over a Unix socket.
async fn for_all<F: Future<Output = ()>>(check: impl Fn(Face, String, Make) -> F) {
    let directory = tempfile::tempdir().expect("a directory");
    let servers = [EnvServer::start(), EnvServer::unix(&directory.path().join("env.sock"), config())];
    for (face, server) in FACES.iter().flat_map(|face| servers.iter().map(move |server| (*face, server))) {
        for (env_id, options) in environments() {
            println!("{face:?} {} {env_id} {options:?}", server.address());
            let make = Make { options, ..Make::new(env_id, 1, Autoreset::NextStep) };
            check(face, server.address(), make).await;
        }
    }
}

fn n_actions(make: &Make) -> u32 {
    Registry::new().configure(make.env_id, &make.options).expect("an environment").spec().n_actions
}

/// Actions of a batch at a step: arbitrary, and the same for everyone.
fn actions(step: usize, num_envs: usize, n_actions: u32) -> Vec<u32> {
    (0..num_envs).map(|env| ((step * 7 + env * 3 + step * step / 5) as u32) % n_actions).collect()
}

#[tokio::test]
async fn observations_lie_in_their_space() {
    for_all(async |face, address, make| {
        let make = Make { num_envs: 4, ..make };
        let spec = Registry::new().configure(make.env_id, &make.options).expect("an environment").spec().clone();
        let check = |reply: &Reply| match &spec.observation_space {
            Space::Discrete { n } => {
                let states = reply.observations.as_chunks::<4>().0.iter().map(|bits| i32::from_le_bytes(*bits));
                assert_eq!(states.inspect(|state| assert!((0..*n as i32).contains(state))).count(), 4);
            }
            Space::Box { low, high, .. } => {
                let values = reply.observations.as_chunks::<4>().0.iter().map(|bits| f32::from_le_bytes(*bits));
                let bounds = low.iter().zip(high).cycle();
                let count =
                    values.zip(bounds).map(|(v, (low, high))| assert!((low..=high).contains(&&v), "{v}")).count();
                assert_eq!(count, 4 * low.len());
            }
        };
        let mut subject = Subject::make(face, &address, &make).await;
        let first = subject.reset(Seeds::From(3), None).await.expect("resets");
        check(&first);
        for step in 0..60 {
            let reply = subject.step(&actions(step, 4, spec.n_actions)).await.expect("steps");
            check(&reply);
            assert!(reply.rewards.iter().all(|reward| reward.is_finite()));
            assert!(reply.terminated.iter().chain(&reply.truncated).all(|flag| *flag <= 1));
            let sizes = spec.info_columns.iter().map(|column| 4 * column.packed_len());
            let sizes: Vec<_> = sizes.chain([4 * spec.n_actions as usize]).collect();
            assert_eq!(reply.infos.iter().map(Vec::len).collect::<Vec<_>>(), sizes);
            assert!(reply.infos.last().is_some_and(|mask| mask.iter().all(|flag| *flag <= 1)));
        }
    })
    .await;
}

#[tokio::test]
async fn a_seed_is_a_trajectory_and_a_batch_is_its_singles() {
    for_all(async |face, address, make| {
        let n_actions = n_actions(&make);
        let make = Make { num_envs: 3, max_episode_steps: Some(9), ..make };
        let single = Make { num_envs: 1, ..make.clone() };
        let mut whole = Subject::make(face, &address, &make).await;
        let mut singles = Vec::new();
        for _ in 0..3 {
            singles.push(Subject::make(face, &address, &single).await);
        }
        // The second time from whatever state the first has left.
        for seeds in [Seeds::From(u64::MAX - 1), Seeds::Each(vec![u64::MAX - 1, u64::MAX, 0])] {
            let reply = whole.reset(seeds, None).await.expect("resets");
            for (env, single) in singles.iter_mut().enumerate() {
                let seed = (u64::MAX - 1).wrapping_add(env as u64);
                assert_eq!(single.reset(Seeds::From(seed), None).await.expect("resets"), reply.row(env));
            }
            for step in 0..25 {
                let actions = actions(step, 3, n_actions);
                let reply = whole.step(&actions).await.expect("steps");
                for (env, single) in singles.iter_mut().enumerate() {
                    assert_eq!(single.step(&actions[env..=env]).await.expect("steps"), reply.row(env));
                }
            }
        }
    })
    .await;
}

#[tokio::test]
async fn the_autoreset_modes_tell_one_story() {
    for_all(async |face, address, make| {
        let n_actions = n_actions(&make);
        let modes = [Autoreset::Disabled, Autoreset::SameStep, Autoreset::NextStep];
        let [disabled, same, next] =
            modes.map(|autoreset| Make { autoreset, max_episode_steps: Some(7), ..make.clone() });
        let mut disabled = Subject::make(face, &address, &disabled).await;
        let mut same = Subject::make(face, &address, &same).await;
        let mut next = Subject::make(face, &address, &next).await;
        for subject in [&mut disabled, &mut same, &mut next] {
            subject.reset(Seeds::From(11), None).await.expect("resets");
        }
        let mut episodes = 0;
        for step in 0..40 {
            let actions = actions(step, 1, n_actions);
            let shown = disabled.step(&actions).await.expect("steps");
            assert_eq!(next.step(&actions).await.expect("steps"), shown);
            let reset_at_once = same.step(&actions).await.expect("steps");
            assert_eq!(reset_at_once.rewards, shown.rewards);
            assert_eq!((&reset_at_once.terminated, &reset_at_once.truncated), (&shown.terminated, &shown.truncated));
            if shown.ended(0) {
                episodes += 1;
                assert_eq!(
                    (&reset_at_once.final_observations, &reset_at_once.final_infos),
                    (&shown.observations, &shown.infos)
                );
                let refused = disabled.step(&actions).await.expect_err("the episode has ended");
                assert_eq!(refused.code, Code::FailedPrecondition);
                let first = disabled.reset(Seeds::Continue, Some(&[true])).await.expect("resets");
                assert_eq!(next.step(&actions).await.expect("resets"), first);
                assert_eq!((&first.observations, &first.infos), (&reset_at_once.observations, &reset_at_once.infos));
            } else {
                assert_eq!(reset_at_once, shown);
            }
        }
        assert!(episodes >= 5, "{episodes} episodes of at most 7 steps");
    })
    .await;
}

#[tokio::test]
async fn wrong_calls_are_refused_by_name_and_change_nothing() {
    for_all(async |face, address, make| {
        let n_actions = n_actions(&make);
        let make = Make { num_envs: 2, ..make };
        let mut tried = Subject::make(face, &address, &make).await;
        let mut spared = Subject::make(face, &address, &make).await;
        let refusal = tried.step(&[0, 0]).await.expect_err("no reset yet");
        assert_eq!(refusal.code, Code::FailedPrecondition);
        let refusal = tried.reset(Seeds::From(1), Some(&[true, false])).await.expect_err("leaves one out");
        assert_eq!((refusal.code, refusal.field.as_deref()), (Code::FailedPrecondition, Some("reset_mask[1]")));
        for subject in [&mut tried, &mut spared] {
            subject.reset(Seeds::From(1), None).await.expect("resets");
            subject.step(&[0, 1]).await.expect("steps");
        }
        let refusals = [
            (tried.step(&[0, n_actions]).await, "actions[1]"),
            (tried.step(&[u32::MAX, 0]).await, "actions[0]"),
            (tried.step(&[0]).await, "actions"),
            (tried.step(&[0, 0, 0]).await, "actions"),
            (tried.reset(Seeds::Each(vec![1]), None).await, "seeds"),
            (tried.reset(Seeds::From(5), Some(&[true])).await, "reset_mask"),
        ];
        for (outcome, field) in refusals {
            let refusal = outcome.expect_err(field);
            assert_eq!((refusal.code, refusal.field.as_deref()), (Code::InvalidArgument, Some(field)));
        }
        for step in 0..10 {
            let actions = actions(step, 2, n_actions);
            assert_eq!(tried.step(&actions).await, spared.step(&actions).await);
        }
    })
    .await;
}
