//! How fast roll-outs come over the wire: a real server on the loopback interface, the Rust client reading every step.
//!
//! `cargo run --release -p mazeway-tests --example rollout_speed`

use mazeway_client::{Connection, Controller, Episodes, Rollout};
use mazeway_proto::env::{self as pb, environment_service_client::EnvironmentServiceClient};
use mazeway_tests::EnvServer;
use prost::Message as _;
use std::time::Instant;

/// Steps of a measured roll-out.
const MAZE_STEPS: u32 = 40_000_000;
const HIGHWAY_STEPS: u32 = 8_000_000;
/// Steps of an episode.
const EPISODE_STEPS: u32 = 200;
/// Times that each is measured; the median is printed.
const ROUNDS: usize = 5;

/// Bytes a step as the messages carry it.
async fn bytes_a_step(address: &str, env_id: &str, compact: bool) -> f64 {
    let channel = mazeway_client::channel(address).await.expect("a channel");
    let request = pb::RolloutRequest {
        env_id: env_id.into(),
        controller: Some(pb::rollout_request::Controller::Driver("random".into())),
        episodes: 1000,
        steps: EPISODE_STEPS,
        compact,
        ..Default::default()
    };
    let mut answers = EnvironmentServiceClient::new(channel).rollout(request).await.expect("runs").into_inner();
    let mut bytes = 0;
    while let Some(answer) = answers.message().await.expect("answers") {
        bytes += answer.encoded_len();
    }
    bytes as f64 / f64::from(1000 * EPISODE_STEPS)
}

#[tokio::main]
async fn main() -> Result<(), mazeway_client::ClientError> {
    let server = EnvServer::start();
    let connection = Connection::open(&server.address()).await?;
    println!("{:<12} {:<22} {:>18} {:>14}", "environment", "controller", "million steps/s", "bytes a step");
    for (env_id, steps, states, actions) in [("Maze-v0", MAZE_STEPS, 57, 4), ("Highway-v0", HIGHWAY_STEPS, 36, 12)] {
        let uniform = Controller::Policy(vec![1.0 / f64::from(actions); states * actions as usize]);
        let driver = if env_id == "Maze-v0" { "optimal" } else { "aggressive" };
        let cases = [
            ("policy", uniform.clone(), false),
            (driver, Controller::driver(driver), false),
            ("policy, totals only", uniform, true),
        ];
        for (name, controller, totals_only) in cases {
            let mut rates = Vec::new();
            for seed in 0..ROUNDS as u64 {
                let rollout = Rollout {
                    seed,
                    totals_only,
                    ..Rollout::new(env_id, controller.clone(), steps / EPISODE_STEPS, EPISODE_STEPS)
                };
                let begun = Instant::now();
                let mut stream = connection.rollout_stream(rollout).await?;
                let (mut episodes, mut seen, mut rewards) = (Episodes::default(), 0, 0.0);
                while stream.next_into(&mut episodes).await? {
                    seen += episodes.total_steps();
                    rewards += episodes.rewards.iter().sum::<f64>();
                }
                assert!(seen == u64::from(steps) && f64::is_finite(rewards));
                rates.push(seen as f64 / begun.elapsed().as_secs_f64() / 1e6);
            }
            rates.sort_by(f64::total_cmp);
            let size = if totals_only { 0.0 } else { bytes_a_step(&server.address(), env_id, true).await };
            println!("{env_id:<12} {name:<22} {:>18.1} {size:>14.2}", rates[ROUNDS / 2]);
        }
        println!(
            "{env_id:<12} {:<22} {:>18} {:>14.2}",
            "as before, not compact",
            "",
            bytes_a_step(&server.address(), env_id, false).await
        );
    }
    Ok(())
}
