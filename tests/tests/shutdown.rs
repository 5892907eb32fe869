//! SIGTERM to the real programs under load: nobody new is let in, whoever is inside is told, what was acknowledged is there,
//! and the end comes in time.

#![cfg(unix)]

use mazeway_client::{Code, Connection, Demonstration, Env, Learner, SessionOptions, packed::pack};
use mazeway_proto::{
    env::{
        self as pb, ModelPart, environment_service_client::EnvironmentServiceClient, interact_request::Request,
        model_part::Part,
    },
    learner::{
        self as learner_pb, TrajectoryFilter, fit_response::Event, learner_service_client::LearnerServiceClient,
    },
};
use mazeway_tests::{
    learner::{LearnerServer, export, trajectory},
    programs::program,
    worlds::{Worlds, settings, text},
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
    let error = loop {
        match timeout(SLACK, stream.next()).await.expect("it hears of the end") {
            Ok(episodes) => assert!(episodes.is_some(), "a roll-out that takes longer"),
            Err(error) => break error,
        }
    };
    // A quarter of the grace is left for the last words.
    assert!(told.elapsed() >= Duration::from_millis(300), "it has its time");
    assert!(error.code() == Code::Unavailable && error.to_string().contains("shutting down"), "{error}");
    let status = server.ended(Duration::from_millis(500) + SLACK).await;
    assert!(status.success(), "{status}");
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

/// A model in which every action leads anywhere, and a fit in it that never ends by itself.
async fn endless(learner: &Learner) -> (String, learner_pb::FitRequest) {
    let (n_states, n_actions) = (400_u32, 4);
    let header = pb::ModelHeader { env_id: "Anywhere-v0".into(), n_states, n_actions, ..Default::default() };
    let rows = |state: u32| pb::RowBlock {
        first_row: state * n_actions,
        row_lengths: pack(vec![n_states; n_actions as usize]),
        next_states: pack((0..n_actions).flat_map(|_| 0..n_states)),
        probabilities: pack(vec![1.0 / f64::from(n_states); (n_states * n_actions) as usize]),
        ..Default::default()
    };
    let parts = std::iter::once(Part::Header(header)).chain((0..n_states).map(|state| Part::Rows(rows(state))));
    let parts = parts.map(|part| ModelPart { part: Some(part) }).collect();
    let model_id = learner.put_model_parts(parts).await.expect("a model").model_id;
    let mut recorder = learner.recorder();
    let demonstration = Demonstration {
        env_id: "Anywhere-v0".into(),
        style: "wandering".into(),
        model_id: model_id.clone(),
        n_states,
        n_actions,
        states: (0..200).map(|step| step * 7 % n_states).collect(),
        actions: (0..200).map(|step| step * step % 4).collect(),
        ..Demonstration::default()
    };
    recorder.record(demonstration).await.expect("a demonstration");
    recorder.finish().await.expect("stored");
    let request = learner_pb::FitRequest {
        method: "em-tied".into(),
        filter: Some(TrajectoryFilter { style: "wandering".into(), ..Default::default() }),
        options: Some(learner_pb::FitOptions {
            basis: learner_pb::Basis::StateAction as i32,
            penalty: learner_pb::Penalty::None as i32,
            tolerance: Some(0.0),
            max_iterations: Some(1_000_000),
            ..Default::default()
        }),
        ..Default::default()
    };
    (model_id, request)
}

#[tokio::test(flavor = "multi_thread")]
async fn whoever_waits_for_a_learner_that_stops_hears_of_it() {
    let data = tempfile::tempdir().expect("a directory");
    let mut command = Command::new(program("learner"));
    command.args(["serve", "--listen", "127.0.0.1:0", "--shutdown-grace-secs", "4", "--max-concurrent-fits", "1"]);
    let mut service = Program::start(command.arg("--data").arg(data.path()));
    let learner = Learner::connect(&service.address).await.expect("connects");
    let (model_id, fit) = endless(&learner).await;
    // 64 MiB of demonstrations, of which the reader takes 10 a second.
    let mut recorder = learner.recorder();
    for number in 0..64 {
        let large = learner_pb::Trajectory {
            states: pack(vec![7_u32; 1 << 16]),
            actions: pack(vec![1_u32; 1 << 16]),
            rewards: pack(vec![0.5; 1 << 16]),
            ..trajectory(number)
        };
        recorder.record(large).await.expect("a demonstration");
    }
    recorder.finish().await.expect("stored");
    let mut running = learner.fit_stream(fit.clone()).await.expect("a stream");
    assert!(matches!(running.next().await.expect("it runs"), Some(Event::Progress(_))));
    let mut queued = learner.fit_stream(fit).await.expect("a place");
    assert!(matches!(queued.next().await.expect("it waits"), Some(Event::Queued(_))));
    let raw = || async { LearnerServiceClient::new(service.channel().await) };
    let all = learner_pb::ExportTrajectoriesRequest {
        filter: Some(TrajectoryFilter { env_id: "Test-v0".into(), ..Default::default() }),
        ..Default::default()
    };
    let mut exported = raw().await.export_trajectories(all).await.expect("an export").into_inner();
    exported.message().await.expect("a page");
    let exporting = tokio::spawn(async move {
        loop {
            match exported.message().await {
                Ok(Some(_)) => tokio::time::sleep(Duration::from_millis(100)).await,
                Ok(None) => panic!("it ends as if it were whole"),
                Err(status) => return status,
            }
        }
    });
    // One that reads nothing of a model until it must, and one that sends little of another.
    let mut read = raw().await.get_model(learner_pb::GetModelRequest { model_id }).await.expect("a model").into_inner();
    let (hurry, hurried) = tokio::sync::oneshot::channel::<()>();
    let reading = tokio::spawn(async move {
        hurried.await.expect("a test that goes on");
        loop {
            match read.message().await {
                Ok(Some(_)) => {}
                Ok(None) => panic!("it ends as if it were whole"),
                Err(status) => return status,
            }
        }
    });
    let (parts, stream) = tokio::sync::mpsc::channel(1);
    let header = pb::ModelHeader { env_id: "Half-v0".into(), n_states: 1, n_actions: 1, ..Default::default() };
    let part = Some(ModelPart { part: Some(Part::Header(header)) });
    parts.send(learner_pb::PutModelRequest { part, replace: false }).await.expect("a stream");
    let mut client = raw().await;
    let putting = tokio::spawn(async move {
        let stream = tokio_stream::wrappers::ReceiverStream::new(stream);
        client.put_model(stream).await.expect_err("it never came")
    });
    tokio::time::sleep(Duration::from_millis(300)).await;

    service.terminate();
    let told = Instant::now();
    let error = timeout(SLACK, queued.next()).await.expect("at once").expect_err("it will not begin");
    assert!(error.code() == Code::Unavailable && error.to_string().contains("shutting down"), "{error}");
    assert!(told.elapsed() < Duration::from_secs(2), "whoever waits for nothing is told at once");
    let error = loop {
        match timeout(SLACK, running.next()).await.expect("in time") {
            Ok(Some(_)) => {}
            Ok(None) => panic!("the stream of a fit ended without a fit"),
            Err(error) => break error,
        }
    };
    assert!(error.code() == Code::Unavailable && error.to_string().contains("shutting down"), "{error}");
    assert!(told.elapsed() > Duration::from_secs(2), "it has its time");
    hurry.send(()).expect("a reader");
    for (what, task) in [("export", exporting), ("read", reading), ("put", putting)] {
        let status = timeout(SLACK, task).await.expect("in time").expect("a status");
        assert_eq!(status.code(), Code::Unavailable, "{what}: {status}");
        assert!(status.message().contains("shutting down"), "{what}: {status}");
    }
    let status = service.ended(Duration::from_secs(4) + SLACK).await;
    assert!(status.success(), "{status}");
    drop(parts);
}

#[tokio::test(flavor = "multi_thread")]
async fn a_dm_env_rpc_stream_hears_that_the_server_stops() {
    let mut server = Program::server("1");
    let mut worlds = Worlds::connect(&server.address).await;
    let world = worlds.create(settings([("env_id", text("Maze-v0"))])).await.expect("creates");
    worlds.join(&world).await.expect("joins");
    server.terminate();
    assert_eq!(timeout(SLACK, worlds.end()).await.expect("in time"), Some(Code::Unavailable));
    assert!(server.ended(Duration::from_secs(1) + SLACK).await.success());
}
