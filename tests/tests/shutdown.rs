//! SIGTERM to the real programs under load: nobody new is let in, whoever is inside is told, what was acknowledged is there,
//! and the end comes in time.

#![cfg(unix)]

use mazeway_client::{Code, Connection, Env, Learner, SessionOptions};
use mazeway_proto::{
    env::{self as pb, environment_service_client::EnvironmentServiceClient, interact_request::Request},
    learner::TrajectoryFilter,
};
use mazeway_tests::{
    learner::{LearnerServer, export, trajectory},
    programs::program,
};
use std::{
    collections::HashSet,
    io::{BufRead as _, BufReader},
    path::Path,
    process::{Child, Command, ExitStatus, Stdio},
    time::{Duration, Instant},
};
use tokio::time::timeout;
use tonic::transport::Channel;
use tonic_health::pb::{HealthCheckRequest, health_check_response::ServingStatus, health_client::HealthClient};

/// Longest that any end may take beyond the time given to running calls.
const SLACK: Duration = Duration::from_secs(5);

struct Program {
    child: Child,
    address: String,
}

impl Program {
    fn start(command: &mut Command) -> Self {
        let mut child = command.stdout(Stdio::piped()).spawn().expect("a process");
        let mut line = String::new();
        BufReader::new(child.stdout.take().expect("a pipe")).read_line(&mut line).expect("a line");
        let address = line.trim().strip_prefix("listening on ").expect("an address").to_owned();
        Self { child, address }
    }

    fn server(grace_secs: &str) -> Self {
        let arguments = ["--listen", "127.0.0.1:0", "--shutdown-grace-secs", grace_secs];
        Self::start(Command::new(program("server")).args(arguments))
    }

    fn learner(data: &Path, listen: &str) -> Self {
        Self::start(Command::new(program("learner")).args(["serve", "--listen", listen, "--data"]).arg(data))
    }

    fn terminate(&self) {
        let status = Command::new("kill").args(["-TERM", &self.child.id().to_string()]).status().expect("kill");
        assert!(status.success());
    }

    /// Waits for its end, for so long at most.
    async fn ended(&mut self, most: Duration) -> ExitStatus {
        let begun = Instant::now();
        loop {
            if let Some(status) = self.child.try_wait().expect("a process") {
                return status;
            }
            assert!(begun.elapsed() < most, "it still runs after {most:?}");
            tokio::time::sleep(Duration::from_millis(10)).await;
        }
    }

    async fn channel(&self) -> Channel {
        mazeway_client::channel(&self.address).await.expect("connects")
    }
}

impl Drop for Program {
    fn drop(&mut self) {
        let _ = self.child.kill();
        let _ = self.child.wait();
    }
}

fn options() -> SessionOptions {
    // A client that is told that the server stops would wait for it to come back.
    SessionOptions { max_episode_steps: Some(0), resume_within: Some(Duration::ZERO), ..SessionOptions::default() }
}

#[tokio::test(flavor = "multi_thread")]
async fn a_server_tells_its_streams_and_ends_although_some_never_read() {
    let mut server = Program::server("1");
    let connection = Connection::open(&server.address).await.expect("connects");
    let mut steppers = tokio::task::JoinSet::new();
    for _ in 0..20 {
        let mut env = Env::create(&connection, "Maze-v0", options()).await.expect("a session");
        env.reset(Some(1)).await.expect("resets");
        steppers.spawn(async move {
            let mut steps = 0_u64;
            loop {
                match env.step(1).await {
                    Ok(_) => steps += 1,
                    Err(error) => return (steps, error),
                }
            }
        });
    }
    // One that sends for ever and reads nothing.
    let env = Env::create(&connection, "Maze-v0", options()).await.expect("a session");
    let session_id = env.session_id().to_owned();
    let step = pb::StepRequest { actions: 1_u32.to_le_bytes().to_vec().into(), ..Default::default() };
    let reset = pb::ResetRequest { session_id, ..Default::default() };
    let requests =
        std::iter::once(Request::Reset(reset)).chain(std::iter::repeat_with(move || Request::Step(step.clone())));
    let requests = tokio_stream::iter(requests.map(|request| pb::InteractRequest { request: Some(request) }));
    let mut silent = EnvironmentServiceClient::new(server.channel().await);
    let unread = silent.interact(requests).await.expect("a stream");
    // And a stream of health that hears of it.
    let mut health = HealthClient::new(server.channel().await);
    let mut watched = health.watch(HealthCheckRequest::default()).await.expect("health").into_inner();
    let serving = |answer: tonic_health::pb::HealthCheckResponse| answer.status();
    assert_eq!(watched.message().await.expect("health").map(serving), Some(ServingStatus::Serving));
    tokio::time::sleep(Duration::from_millis(300)).await;

    server.terminate();
    assert_eq!(watched.message().await.expect("health").map(serving), Some(ServingStatus::NotServing));
    while let Some(outcome) = timeout(SLACK, steppers.join_next()).await.expect("an end in time") {
        let (steps, error) = outcome.expect("a task that ends well");
        assert!(steps > 0);
        assert_eq!(error.code(), Code::Unavailable, "{error}");
        assert!(error.to_string().contains("shutting down"), "{error}");
    }
    // A client waits for a server that may come back, longer than this one is there.
    let asked = Env::create(&connection, "Maze-v0", options());
    let (refused, status) = tokio::join!(asked, server.ended(Duration::from_secs(1) + SLACK));
    let refused = refused.expect_err("nobody is let in");
    assert_eq!(refused.code(), Code::Unavailable, "{refused}");
    assert!(status.success(), "{status}");
    drop((unread, env));
}

#[tokio::test(flavor = "multi_thread")]
async fn a_roll_out_under_way_is_ended_when_its_time_is_over() {
    let mut server = Program::server("0.5");
    let rollout = mazeway_client::Rollout {
        totals_only: true,
        ..mazeway_client::Rollout::new("Highway-v0", mazeway_client::Controller::Driver("random".into()), 100_000, 200)
    };
    let connection = Connection::open(&server.address).await.expect("connects");
    let mut stream = connection.rollout_stream(rollout).await.expect("a roll-out");
    stream.next().await.expect("episodes");
    let told = Instant::now();
    server.terminate();
    let status = server.ended(Duration::from_millis(500) + SLACK).await;
    assert!(status.success(), "{status}");
    assert!(told.elapsed() >= Duration::from_millis(400), "it has its time");
}

#[tokio::test(flavor = "multi_thread")]
async fn recorders_go_on_with_a_learner_that_was_restarted_and_lose_and_double_nothing() {
    let data = tempfile::tempdir().expect("a directory");
    let mut learner = Program::learner(data.path(), "127.0.0.1:0");
    let address = learner.address.clone();
    let mut recorders = tokio::task::JoinSet::new();
    for recorder in 0..4_u128 {
        let address = address.clone();
        recorders.spawn(async move {
            let learner = Learner::connect(&address).await.expect("connects");
            let mut recording = learner.recorder().retry_for(Duration::from_mins(1));
            for number in 0..3_000 {
                recording.record(trajectory(recorder * 1_000_000 + number)).await.expect("a learner that comes back");
                if number % 50 == 0 {
                    tokio::time::sleep(Duration::from_millis(5)).await;
                }
            }
            recording.finish().await.expect("everything stored")
        });
    }
    for _ in 0..3 {
        tokio::time::sleep(Duration::from_millis(150)).await;
        learner.terminate();
        let status = learner.ended(Duration::from_secs(10) + SLACK).await;
        assert!(status.success(), "{status}");
        learner = Program::learner(data.path(), &address);
    }
    let mut acknowledged = 0;
    while let Some(receipt) = recorders.join_next().await {
        acknowledged += receipt.expect("a recorder that ends well").acknowledged();
    }
    assert_eq!(acknowledged, 12_000);
    learner.terminate();
    assert!(learner.ended(SLACK + Duration::from_secs(10)).await.success());
    let server = LearnerServer::start(data.path());
    let stored = export(&server.client().await, &TrajectoryFilter::default()).await;
    assert_eq!(stored.len(), 12_000);
    let expected: HashSet<String> =
        (0..4_u128).flat_map(|r| (0..3_000).map(move |n| trajectory(r * 1_000_000 + n).trajectory_id)).collect();
    assert_eq!(stored.into_iter().map(|t| t.trajectory_id).collect::<HashSet<_>>(), expected);
}
