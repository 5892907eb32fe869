//! The client that behaves well: it acts now and then, as a person or a slow robot does, and times every step.

use mazeway_client::{Connection, Env, SessionOptions};
use std::time::{Duration, Instant};
use tokio::time::{MissedTickBehavior, interval};

/// Time between two steps.
const PERIOD: Duration = Duration::from_millis(5);

/// How long steps took, in microseconds.
#[derive(Debug, Clone, Copy)]
pub struct Waits {
    pub steps: usize,
    pub median: f64,
    pub p99: f64,
    pub p999: f64,
    pub most: f64,
}

/// Acts for a while; `meanwhile` is called every now and then.
pub async fn act(address: &str, time: Duration, mut meanwhile: impl FnMut()) -> Waits {
    let connection = Connection::open(address).await.expect("a connection");
    let options = SessionOptions { max_episode_steps: Some(0), ..SessionOptions::default() };
    let mut env = Env::create(&connection, "Maze-v0", options).await.expect("a session");
    env.reset(Some(1)).await.expect("resets");
    let (begun, mut took, mut ticks) = (Instant::now(), Vec::new(), interval(PERIOD));
    ticks.set_missed_tick_behavior(MissedTickBehavior::Delay);
    while begun.elapsed() < time {
        ticks.tick().await;
        let sent = Instant::now();
        env.step((took.len() % 4) as u32).await.expect("a step");
        took.push(sent.elapsed().as_secs_f64() * 1e6);
        if took.len() % 200 == 0 {
            meanwhile();
        }
    }
    env.close().await.expect("closes");
    took.sort_by(f64::total_cmp);
    let at = |share: f64| took[((took.len() - 1) as f64 * share).round() as usize];
    Waits { steps: took.len(), median: at(0.5), p99: at(0.99), p999: at(0.999), most: at(1.0) }
}
