//! The client that behaves well: it acts now and then, as a person or a slow robot does, and times every step.

use mazeway_client::{Connection, Env, SessionOptions};
use serde_json::{Value, json};
use std::{
    io::{self, Write as _},
    time::{Duration, Instant},
};
use tokio::{
    io::{AsyncReadExt as _, AsyncWriteExt as _},
    net::{TcpListener, TcpStream},
    time::{MissedTickBehavior, interval},
};

/// Time between two steps.
const PERIOD: Duration = Duration::from_millis(5);

/// Bytes of a bare message: a step in its frames.
const MESSAGE_BYTES: usize = 23;

/// How long steps took, in microseconds.
#[derive(Debug, Clone, Copy)]
pub struct Waits {
    /// How many.
    pub steps: usize,
    /// Half of them took no longer.
    pub median: f64,
    /// 99 in a hundred.
    pub p99: f64,
    /// 999 in a thousand.
    pub p999: f64,
    /// The slowest.
    pub most: f64,
}

impl Waits {
    /// One object for programs.
    pub fn to_json(&self) -> Value {
        let Self { steps, median, p99, p999, most } = self;
        json!({"steps": steps, "median_us": median, "p99_us": p99, "p999_us": p999, "most_us": most})
    }
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
    waits(took)
}

/// The same over a bare socket, to a process that sends back what it gets: what the machine itself makes one wait.
///
/// # Errors
/// There is no such process, or it ends.
pub async fn echo(address: &str, time: Duration) -> io::Result<Waits> {
    let mut stream = TcpStream::connect(address).await?;
    stream.set_nodelay(true)?;
    let (begun, mut took, mut ticks) = (Instant::now(), Vec::new(), interval(PERIOD));
    ticks.set_missed_tick_behavior(MissedTickBehavior::Delay);
    let mut bytes = [0; MESSAGE_BYTES];
    while begun.elapsed() < time {
        ticks.tick().await;
        let sent = Instant::now();
        stream.write_all(&bytes).await?;
        stream.read_exact(&mut bytes).await?;
        took.push(sent.elapsed().as_secs_f64() * 1e6);
    }
    Ok(waits(took))
}

/// Sends back what comes, for ever.
///
/// # Errors
/// There is no port.
pub async fn echo_back() -> io::Result<()> {
    let listener = TcpListener::bind("127.0.0.1:0").await?;
    println!("{}", listener.local_addr()?);
    io::stdout().flush()?;
    loop {
        let (mut stream, _) = listener.accept().await?;
        stream.set_nodelay(true)?;
        let mut bytes = [0; MESSAGE_BYTES];
        while stream.read_exact(&mut bytes).await.is_ok() && stream.write_all(&bytes).await.is_ok() {}
    }
}

fn waits(mut took: Vec<f64>) -> Waits {
    took.sort_by(f64::total_cmp);
    let at = |share: f64| took[((took.len() - 1) as f64 * share).round() as usize];
    Waits { steps: took.len(), median: at(0.5), p99: at(0.99), p999: at(0.999), most: at(1.0) }
}
