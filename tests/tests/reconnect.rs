//! Connections that break, servers that come back, and answers that never come.

use mazeway_client::{
    Autoreset, ClientError, Code, ConnectOptions, Connection, Controller, Demonstration, Env, Learner, Rollout,
    SessionOptions, VectorEnv, WatchOptions,
};
use mazeway_proto::learner as pb;
use mazeway_tests::{
    EnvServer, config,
    learner::LearnerServer,
    programs::{Service, program},
    proxy::Proxy,
};
use std::{
    io::{BufRead as _, BufReader, Read as _, Write as _},
    net::TcpStream,
    process::{Command, Stdio},
    thread,
    time::{Duration, Instant},
};
use tokio::{net::TcpListener, time::sleep};

#[tokio::test]
async fn what_reads_or_creates_is_asked_again_over_another_connection() {
    let server = EnvServer::start();
    let proxy = Proxy::start(server.socket());
    let connection = Connection::open(&proxy.address()).await.expect("a server");
    let catalogue = connection.list_environments().await.expect("lists");
    for _ in 0..5 {
        proxy.cut();
        assert_eq!(connection.list_environments().await.expect("lists again"), catalogue);
        proxy.cut();
        let mut env = Env::create(&connection, "Maze-v0", SessionOptions::default()).await.expect("a session");
        env.reset(Some(1)).await.expect("resets");
        proxy.cut();
        assert!(env.render_text().await.expect("a picture").contains('@'));
        env.close().await.expect("closes");
    }
    proxy.cut();
    let model = connection.model("Maze-v0", &mazeway_client::Options::default()).await.expect("a model");
    assert_eq!(model.n_states, 57);
}

#[tokio::test]
async fn a_learner_is_read_and_given_models_over_another_connection() {
    let data = tempfile::tempdir().expect("a directory");
    let learner = LearnerServer::start(data.path());
    let proxy = Proxy::start(learner.socket());
    let client = Learner::connect(&proxy.address()).await.expect("a learner");
    let server = EnvServer::start();
    let connection = Connection::open(&server.address()).await.expect("a server");
    let model = connection.model("Maze-v0", &mazeway_client::Options::default()).await.expect("a model");
    for round in 0..5 {
        proxy.cut();
        assert_eq!(client.put_model(&model).await.expect("stored").already_stored, round > 0);
        proxy.cut();
        assert_eq!(client.list_models("").await.expect("lists").len(), 1);
        proxy.cut();
        assert_eq!(client.count_trajectories(&pb::TrajectoryFilter::default()).await.expect("counts"), 0);
    }
}

#[tokio::test]
async fn a_server_that_comes_back_is_waited_for_and_one_that_does_not_is_an_error() {
    let server = EnvServer::start();
    let address = server.socket();
    let connection = Connection::open(&address.to_string()).await.expect("a server");
    server.stop();
    let again = thread::spawn(move || {
        thread::sleep(Duration::from_millis(700));
        EnvServer::at(address, config())
    });
    assert!(!connection.list_environments().await.expect("lists").is_empty());
    again.join().expect("a server").stop();
    let begun = Instant::now();
    let error = connection.list_environments().await.expect_err("nobody is there");
    assert_eq!(error.code(), Code::Unavailable, "{error}");
    assert!(begun.elapsed() < Duration::from_secs(30), "{:?}", begun.elapsed());
}

/// Takes connections and never says a word.
async fn silent() -> String {
    let listener = TcpListener::bind("127.0.0.1:0").await.expect("a port");
    let address = listener.local_addr().expect("an address").to_string();
    tokio::spawn(async move {
        let mut kept = Vec::new();
        while let Ok((stream, _)) = listener.accept().await {
            kept.push(stream);
        }
    });
    address
}

/// A process that stands still until it is dropped: its connections stay, and nobody is there.
struct Frozen<'a>(&'a Service);

impl<'a> Frozen<'a> {
    fn new(service: &'a Service) -> Self {
        signal(service, "-STOP");
        // The signal is on its way when it has been sent; where the system does not say when it is there, it has time.
        let stat = format!("/proc/{}/stat", service.pid());
        while std::fs::read_to_string(&stat).is_ok_and(|stat| !stat.contains(") T ")) {
            thread::sleep(Duration::from_millis(1));
        }
        thread::sleep(Duration::from_millis(50));
        Self(service)
    }
}

impl Drop for Frozen<'_> {
    fn drop(&mut self) {
        signal(self.0, "-CONT");
    }
}

fn signal(service: &Service, name: &str) {
    let status = Command::new("kill").args([name, &service.pid().to_string()]).status();
    assert!(status.expect("kill").success());
}

/// Waits so short for any answer.
fn impatient() -> ConnectOptions {
    let deadline = Duration::from_millis(300);
    ConnectOptions { deadline, work_deadline: deadline, ..ConnectOptions::default() }
}

#[track_caller]
fn late<T: std::fmt::Debug>(outcome: Result<T, ClientError>) {
    assert_eq!(outcome.expect_err("no answer"), ClientError::Late { secs: 0.3 });
}

#[tokio::test]
async fn no_call_waits_without_an_end() {
    let begun = Instant::now();
    let address = silent().await;
    let connection = Connection::connect(&address, &impatient()).await.expect("a connection");
    late(connection.list_environments().await);
    late(connection.model("Maze-v0", &mazeway_client::Options::default()).await);
    late(connection.rollout(Rollout::new("Maze-v0", Controller::driver("random"), 1, 1)).await);
    late(Env::create(&connection, "Maze-v0", SessionOptions::default()).await);
    late(connection.watch("0", WatchOptions::default()).await);

    let learner = Learner::connect_with(&address, &impatient()).await.expect("a connection");
    let none = pb::TrajectoryFilter::default();
    late(learner.list_models("").await);
    late(learner.model("0").await);
    late(learner.put_model_parts(Vec::new()).await);
    late(learner.export_trajectories(&none).await);
    late(learner.export_fit_trajectories("0", &none).await);
    late(learner.fit_trajectories("0").await);
    late(learner.count_trajectories(&none).await);
    late(learner.delete_trajectories(&none).await);
    late(learner.fit(pb::FitRequest::default(), |_| {}).await);
    late(learner.get_fit("0").await);
    late(learner.list_fits("", "").await);
    late(learner.delete_fit("0").await);

    // What is recorded may go out again, and so a learner that says nothing is one that is away.
    let mut recorder = learner.recorder().retry_for(Duration::from_millis(300));
    recorder.record(demonstration()).await.expect("taken");
    for _ in 0..2 {
        let error = recorder.flush().await.expect_err("no answer");
        assert_eq!((error.code(), recorder.unacknowledged()), (Code::Unavailable, 1), "{error}");
    }
    assert!(recorder.finish().await.is_err());
    assert!(begun.elapsed() < Duration::from_secs(30), "{:?}", begun.elapsed());
}

fn demonstration() -> Demonstration {
    let (states, actions) = (vec![0, 1], vec![1, 0]);
    Demonstration {
        env_id: "Toy-v0".into(),
        style: "s".into(),
        n_states: 2,
        n_actions: 2,
        states,
        actions,
        ..Default::default()
    }
}

/// A batch of two whose episodes have begun.
async fn begun(connection: &Connection) -> VectorEnv {
    let options = SessionOptions::default();
    let mut envs = VectorEnv::create(connection, "Maze-v0", 2, Autoreset::default(), options).await.expect("a session");
    envs.reset(1).await.expect("resets");
    envs.step(&[0, 1]).await.expect("steps");
    envs
}

#[tokio::test]
async fn a_server_that_stands_still_between_two_calls_ends_them_in_time() {
    let server = Service::server();
    let connection = Connection::connect(server.address(), &impatient()).await.expect("a connection");
    let (mut stepped, mut reset) = (begun(&connection).await, begun(&connection).await);
    let (mut drawn, mut closed) = (begun(&connection).await, begun(&connection).await);
    let frozen = Frozen::new(&server);
    let start = Instant::now();
    late(stepped.step(&[0, 1]).await);
    // Over another stream, which nobody opens.
    late(stepped.step(&[0, 1]).await);
    late(stepped.close().await);
    late(reset.reset(1).await);
    late(reset.send_step(&[0, 1]).await);
    late(drawn.render_text(0).await);
    late(closed.close().await);
    assert!(start.elapsed() < Duration::from_secs(5), "{:?}", start.elapsed());
    drop(frozen);
    sleep(Duration::from_millis(100)).await;
    reset.reset(1).await.expect("the session lives on");
    reset.step(&[0, 1]).await.expect("steps");
}

#[tokio::test]
async fn a_session_that_is_dropped_leaves_nothing_behind_where_nobody_answers() {
    let server = Service::server();
    let connection = Connection::connect(server.address(), &impatient()).await.expect("a connection");
    let tasks = || tokio::runtime::Handle::current().metrics().num_alive_tasks();
    let before = tasks();
    let dropped = [begun(&connection).await, begun(&connection).await];
    let frozen = Frozen::new(&server);
    drop(dropped);
    assert!(tasks() > before, "somebody says good-bye");
    let start = Instant::now();
    while tasks() > before {
        assert!(start.elapsed() < Duration::from_secs(5), "{} tasks are left of {before}", tasks());
        sleep(Duration::from_millis(20)).await;
    }
    drop(frozen);
}

#[tokio::test]
async fn a_viewer_waits_for_an_environment_at_rest_and_for_no_server_that_stands_still() {
    let server = Service::server();
    let connection = Connection::open(server.address()).await.expect("a connection");
    let mut env = Env::create(&connection, "Maze-v0", SessionOptions::default()).await.expect("a session");
    let viewer = Connection::connect(server.address(), &impatient()).await.expect("a connection");
    let mut frames = viewer.watch(env.session_id(), WatchOptions::default()).await.expect("a watch");
    // Far longer than the viewer waits for any answer: before the first episode, and within one.
    let rest = Duration::from_millis(1500);
    let (frame, _) = tokio::join!(frames.next(), async {
        sleep(rest).await;
        env.reset(Some(1)).await.expect("resets")
    });
    assert_eq!(frame.expect("alive").expect("a picture").step, 0);
    let (frame, _) = tokio::join!(frames.next(), async {
        sleep(rest).await;
        env.step(0).await.expect("steps")
    });
    assert_eq!(frame.expect("alive").expect("a picture").step, 1);
    let frozen = Frozen::new(&server);
    let begun = Instant::now();
    late(frames.next().await);
    assert!(begun.elapsed() < Duration::from_secs(5), "{:?}", begun.elapsed());
    drop(frozen);
}

#[tokio::test]
async fn a_recording_that_is_finished_is_no_call_whose_caller_went() {
    let data = tempfile::tempdir().expect("a directory");
    let mut command = Command::new(program("learner"));
    command.args(["serve", "--listen", "127.0.0.1:0", "--metrics-listen", "127.0.0.1:0", "--data"]).arg(data.path());
    let mut process = command.stdout(Stdio::piped()).spawn().expect("a process");
    let mut lines = BufReader::new(process.stdout.take().expect("a pipe")).lines();
    let mut said = |what: &str| {
        let line = lines.next().expect("a line").expect("a line");
        line.strip_prefix(what).unwrap_or_else(|| panic!("expected {what:?}, got {line:?}")).to_owned()
    };
    let (address, metrics) = (said("listening on "), said("metrics on http://"));
    let learner = Learner::connect(&address).await.expect("a learner");
    for _ in 0..3 {
        let mut recorder = learner.recorder();
        recorder.record(demonstration()).await.expect("taken");
        assert_eq!(recorder.finish().await.expect("stored").stored, 1);
    }
    let calls = |code: &str| {
        let mut stream = TcpStream::connect(metrics.trim_end_matches("/metrics")).expect("connects");
        write!(stream, "GET /metrics HTTP/1.0\r\nHost: test\r\n\r\n").expect("asks");
        let mut answer = String::new();
        stream.read_to_string(&mut answer).expect("an answer");
        let name = format!("/RecordTrajectories\",code=\"{code}\"}} ");
        answer.lines().find_map(|line| Some(line.split_once(&name)?.1.to_owned())).unwrap_or_else(|| "0".into())
    };
    let begun = Instant::now();
    while calls("OK") != "3" && begun.elapsed() < Duration::from_secs(10) {
        sleep(Duration::from_millis(20)).await;
    }
    assert_eq!((calls("OK"), calls("CANCELLED")), ("3".into(), "0".into()));
    process.kill().expect("a process to kill");
    process.wait().expect("a process to wait for");
}
