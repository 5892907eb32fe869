//! The same seed gives the same numbers through every face, in every batch size, on every number of threads, for ever.

use mazeway_client::{Autoreset, Connection, Controller, Rollout, Seeds, VectorEnv};
use mazeway_server::{
    registry::Registry,
    rollout::{self, EpisodeChunk, RolloutPlan, TabularPolicy},
};
use mazeway_tests::{
    EnvServer,
    faces::{FACES, Face, Make, Reply, Subject},
};
use serde_json::{Map, Value, json};

/// What a seed has given since the first release; the Python client's tests read the same file.
const GOLDEN: &str = include_str!("../data/golden_trajectories.json");

fn golden() -> Vec<Value> {
    serde_json::from_str(GOLDEN).expect("the file is JSON")
}

fn numbers<T: TryFrom<u64>>(value: &Value) -> Vec<T> {
    let number = |n: &Value| n.as_u64().and_then(|n| T::try_from(n).ok()).expect("a number");
    value.as_array().expect("a list").iter().map(number).collect()
}

/// Environment `index`'s discrete observation.
fn state(reply: &Reply, index: usize) -> u32 {
    u32::from_le_bytes(reply.observations[index * 4..][..4].try_into().expect("four bytes"))
}

fn known_id(id: &str) -> &'static str {
    Registry::new().env_ids().find(|known| *known == id).expect("an environment")
}

/// Plays a golden trajectory as environment `index` of a batch of `num_envs`, through a face.
async fn play(face: Face, address: &str, golden: &Value, num_envs: usize, index: usize) -> Value {
    let env_id = known_id(golden["env_id"].as_str().expect("an id"));
    let options = golden["options"].as_object().expect("options").clone();
    let make = Make { options, ..Make::new(env_id, num_envs, Autoreset::NextStep) };
    let mut subject = Subject::make(face, address, &make).await;
    let seed = golden["seed"].as_u64().expect("a seed").wrapping_sub(index as u64);
    let first = subject.reset(Seeds::From(seed), None).await.expect("resets");
    let (mut observations, mut rewards) = (vec![state(&first, index)], Vec::new());
    for action in numbers::<u32>(&golden["actions"]) {
        let reply = subject.step(&vec![action; num_envs]).await.expect("steps");
        observations.push(state(&reply, index));
        rewards.push(reply.rewards[index]);
    }
    let mut played = golden.clone();
    (played["observations"], played["rewards"]) = (json!(observations), json!(rewards));
    played
}

#[tokio::test]
async fn golden_trajectories_through_every_face_and_batch_size() {
    let server = EnvServer::start();
    let address = server.address();
    for golden in golden() {
        for face in FACES {
            // Beyond 256, a batch is stepped on another thread.
            for (num_envs, index) in [(1, 0), (3, 2), (64, 17), (300, 299)] {
                let played = play(face, &address, &golden, num_envs, index).await;
                assert_eq!(played, golden, "{face:?}, environment {index} of {num_envs}; it played\n{played}");
            }
        }
    }
}

#[tokio::test]
async fn pipelined_steps_give_the_same_trajectory() {
    let server = EnvServer::start();
    let connection = Connection::open(&server.address()).await.expect("connects");
    for golden in golden() {
        let options = golden["options"].as_object().expect("options").clone();
        let options = mazeway_client::SessionOptions { options, ..Default::default() };
        let env_id = golden["env_id"].as_str().expect("an id");
        let mut envs = VectorEnv::create(&connection, env_id, 1, Autoreset::NextStep, options).await.expect("creates");
        let first = envs.reset(golden["seed"].as_u64().expect("a seed")).await.expect("resets");
        let mut observations = first.observations.discrete().expect("discrete").to_vec();
        let actions = numbers::<u32>(&golden["actions"]);
        for &action in &actions {
            envs.send_step(&[action]).await.expect("sends");
        }
        for _ in &actions {
            let step = envs.receive_step().await.expect("receives");
            observations.extend(step.observations.discrete().expect("discrete").iter());
        }
        assert_eq!(json!(observations), golden["observations"]);
    }
}

/// Every controller that an environment offers, and a policy.
fn controllers(env_id: &str) -> Vec<Controller> {
    let spec = Registry::new().configure(env_id, &Map::new()).expect("an environment").spec().clone();
    let n_actions = spec.n_actions as usize;
    let rows = (0..spec.n_states as usize * n_actions)
        .map(|i| f64::from(u8::from(i % n_actions == i / n_actions % n_actions)));
    let policy = Controller::Policy(rows.map(|p| 0.5 * p + 0.5 / n_actions as f64).collect());
    spec.drivers.iter().map(|(name, _)| Controller::driver(*name)).chain([policy]).collect()
}

#[tokio::test]
async fn rollouts_over_the_wire_are_those_of_any_number_of_threads() {
    let server = EnvServer::start();
    let connection = Connection::open(&server.address()).await.expect("connects");
    for env_id in Registry::new().env_ids() {
        for controller in controllers(env_id) {
            let rollout = Rollout { seed: 77, burn_in_steps: 5, ..Rollout::new(env_id, controller.clone(), 11, 40) };
            let served = connection.rollout(rollout).await.expect("drives");
            assert_eq!(served.lengths, [40; 11]);
            let environment = Registry::new().configure(env_id, &Map::new()).expect("an environment");
            let plan = RolloutPlan {
                controller: match &controller {
                    Controller::Driver(name) => rollout::Controller::Driver(name.clone()),
                    Controller::Policy(values) => {
                        let spec = environment.spec();
                        let policy = TabularPolicy::new(values, spec.n_states, spec.n_actions);
                        rollout::Controller::Policy(policy.expect("a policy"))
                    }
                },
                seed: 77,
                episodes: 11,
                steps: 40,
                burn_in_steps: 5,
                totals_only: false,
                compact: false,
                chunk_episodes: 11,
            };
            for threads in [1, 3] {
                let pool = rayon::ThreadPoolBuilder::new().num_threads(threads).build().expect("threads");
                let mut chunks: Vec<EpisodeChunk> = Vec::new();
                pool.install(|| {
                    environment.roll_out(&plan, &|| false, &mut |chunk| {
                        chunks.push(chunk);
                        true
                    });
                });
                let [local] = chunks.as_slice() else { panic!("expected one chunk, got {}", chunks.len()) };
                let steps = &local.steps;
                let column = |of: &dyn Fn(usize) -> u32| (0..steps.len()).map(of).collect::<Vec<_>>();
                assert_eq!(served.states, column(&|at| steps.state(at)));
                assert_eq!(served.actions, column(&|at| steps.action(at)));
                assert_eq!(served.rewards, (0..steps.len()).map(|at| steps.reward(at)).collect::<Vec<_>>());
                assert_eq!((&served.final_states, &served.returns), (&local.final_states, &local.returns));
                assert_eq!(served.totals.iter().map(|(_, values)| values.clone()).collect::<Vec<_>>(), local.totals);
            }
        }
    }
}

#[tokio::test]
async fn an_episode_that_is_rolled_out_is_the_one_of_a_session() {
    let server = EnvServer::start();
    let connection = Connection::open(&server.address()).await.expect("connects");
    for env_id in Registry::new().env_ids() {
        for controller in controllers(env_id) {
            let rollout = Rollout { seed: 5, ..Rollout::new(env_id, controller, 4, 50) };
            let episodes = connection.rollout(rollout).await.expect("drives");
            let make = Make { max_episode_steps: Some(0), ..Make::new(known_id(env_id), 4, Autoreset::NextStep) };
            let mut subject = Subject::make(Face::Interact, &server.address(), &make).await;
            let mut reply = subject.reset(Seeds::From(5), None).await.expect("resets");
            for step in 0..50 {
                let at: Vec<_> = episodes.iter().map(|episode| (episode.states[step], episode.actions[step])).collect();
                assert_eq!(
                    (0..4).map(|i| state(&reply, i)).collect::<Vec<_>>(),
                    at.iter().map(|at| at.0).collect::<Vec<_>>()
                );
                reply = subject.step(&at.iter().map(|at| at.1).collect::<Vec<_>>()).await.expect("steps");
                assert_eq!(reply.rewards, episodes.iter().map(|episode| episode.rewards[step]).collect::<Vec<_>>());
            }
        }
    }
}
