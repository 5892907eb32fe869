//! How fast environments step over the wire: a real server on the loopback interface, the Rust client on one task.
//!
//! `cargo run --release -p mazeway-tests --example throughput`

use mazeway_client::{Autoreset, Connection, Controller, Rollout, SessionOptions, VectorEnv};
use mazeway_tests::EnvServer;
use std::time::{Duration, Instant};

/// Time that each measurement takes at least.
const LONG_ENOUGH: Duration = Duration::from_secs(1);
/// Steps that are under way at a time where they are pipelined.
const DEPTH: usize = 32;

#[tokio::main]
async fn main() -> Result<(), mazeway_client::ClientError> {
    let server = EnvServer::start();
    let connection = Connection::open(&server.address()).await?;
    println!("{:<12} {:>6} {:>20} {:>20}", "environment", "batch", "steps/s, in turn", "steps/s, pipelined");
    for env_id in ["Maze-v0", "Highway-v0"] {
        for num_envs in [1, 64, 256, 1024, 4096] {
            let make = SessionOptions::default();
            let mut envs = VectorEnv::create(&connection, env_id, num_envs, Autoreset::NextStep, make).await?;
            let actions: Vec<u32> = (0..num_envs).map(|env| env % 4).collect();
            envs.reset(1).await?;
            let (begun, mut steps) = (Instant::now(), 0);
            while begun.elapsed() < LONG_ENOUGH {
                envs.step(&actions).await?;
                steps += num_envs;
            }
            let in_turn = f64::from(steps) / begun.elapsed().as_secs_f64();
            for _ in 0..DEPTH {
                envs.send_step(&actions).await?;
            }
            let (begun, mut steps) = (Instant::now(), 0);
            while begun.elapsed() < LONG_ENOUGH {
                envs.receive_step().await?;
                envs.send_step(&actions).await?;
                steps += num_envs;
            }
            let pipelined = f64::from(steps) / begun.elapsed().as_secs_f64();
            println!("{env_id:<12} {num_envs:>6} {in_turn:>20.0} {pipelined:>20.0}");
            for _ in 0..DEPTH {
                envs.receive_step().await?;
            }
            envs.close().await?;
        }
        let begun = Instant::now();
        let rollout = Rollout { totals_only: true, ..Rollout::new(env_id, Controller::driver("random"), 1000, 1000) };
        let steps = connection.rollout(rollout).await?.total_steps();
        println!("{env_id:<12} roll-out of 1,000 x 1,000: {:.0} steps/s", steps as f64 / begun.elapsed().as_secs_f64());
    }
    Ok(())
}
