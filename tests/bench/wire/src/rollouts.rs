//! Steps a second of roll-outs: the server drives, a Rust client takes every step in and looks at it.

use crate::{
    Setting,
    figures::{Report, Subject, in_rounds, mode_name},
    process::Process,
    round_trips::current_thread,
};
use mazeway_client::{Connection, Controller, Episodes, Rollout};
use serde_json::json;

/// Steps of an episode.
const STEPS: u32 = 200;

/// Environment, controller, episodes of one roll-out and the steps a second that are promised.
const CASES: [(&str, &str, u32, Option<f64>); 5] = [
    ("Maze-v0", "policy", 20_000, Some(10e6)),
    ("Maze-v0", "random", 20_000, Some(10e6)),
    ("Highway-v0", "policy", 2_000, Some(1e6)),
    ("Highway-v0", "random", 2_000, Some(1e6)),
    ("Highway-v0", "aggressive", 2_000, Some(1e6)),
];

async fn rollout(connection: &Connection, env_id: &str, controller: &str, episodes: u32) -> Rollout {
    let controller = if controller == "policy" {
        // The same chance for every action: nothing can be foretold.
        let specs = connection.list_environments().await.expect("a catalogue");
        let spec = specs.iter().find(|spec| spec.env_id == env_id).expect("a known environment");
        let (states, actions) = (spec.n_states as usize, spec.n_actions as usize);
        Controller::Policy(vec![1.0 / actions as f64; states * actions])
    } else {
        Controller::driver(controller)
    };
    Rollout::new(env_id, controller, episodes, STEPS)
}

/// Takes every step in, and says how many they were.
async fn read(connection: &Connection, rollout: &Rollout) -> u64 {
    let mut stream = connection.rollout_stream(rollout.clone()).await.expect("runs");
    let (mut episodes, mut steps) = (Episodes::default(), 0);
    while stream.next_into(&mut episodes).await.expect("comes") {
        steps += episodes.states.len() as u64;
    }
    steps
}

pub fn measure(setting: &Setting, report: &mut Report) {
    let (server, runtime) = (Process::server(setting, "127.0.0.1:0"), current_thread());
    let connection = runtime.block_on(Connection::open(server.address())).expect("connects");
    let shrunk = if setting.quick { 10 } else { 1 };
    let plans: Vec<_> = CASES
        .map(|(env_id, controller, episodes, _)| {
            runtime.block_on(rollout(&connection, env_id, controller, episodes / shrunk))
        })
        .into();
    let mut subjects: Vec<_> = plans
        .iter()
        .zip(CASES)
        .map(|(plan, (_, controller, ..))| {
            let (connection, runtime) = (&connection, &runtime);
            Subject::new(controller, move |times| {
                for _ in 0..times {
                    let steps = runtime.block_on(read(connection, plan));
                    assert_eq!(steps, u64::from(plan.episodes) * u64::from(plan.steps), "all that were asked for");
                }
            })
        })
        .collect();
    let spreads = in_rounds(&mut subjects, setting.rounds, setting.slice);
    for ((plan, spread), (env_id, controller, _, promised)) in plans.iter().zip(spreads).zip(CASES) {
        let spread = spread.rate(plan.episodes * plan.steps);
        let met = promised.map(|promised| spread.median() >= promised);
        let mode = mode_name(setting.mode);
        let record = json!({"mode": mode, "env": env_id, "controller": controller, "promised": promised, "met": met});
        report.push("rollouts", record, spread);
    }
}
