//! Connections that break, servers that come back, and answers that never come.

use mazeway_client::{ClientError, Code, ConnectOptions, Connection, Env, Learner, SessionOptions, VectorEnv};
use mazeway_proto::learner as pb;
use mazeway_tests::{EnvServer, config, learner::LearnerServer, proxy::Proxy};
use std::time::{Duration, Instant};
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
    let again = std::thread::spawn(move || {
        std::thread::sleep(Duration::from_millis(700));
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

#[tokio::test]
async fn no_call_waits_without_an_end() {
    let options = ConnectOptions { deadline: Duration::from_millis(300), ..ConnectOptions::default() };
    let options = ConnectOptions { work_deadline: Duration::from_millis(300), ..options };
    let late = |error: ClientError| assert_eq!(error, ClientError::Late { secs: 0.3 });
    let address = silent().await;
    let connection = Connection::connect(&address, &options).await.expect("a connection");
    late(connection.list_environments().await.expect_err("no answer"));
    late(connection.model("Maze-v0", &mazeway_client::Options::default()).await.expect_err("no answer"));
    late(Env::create(&connection, "Maze-v0", SessionOptions::default()).await.expect_err("no answer"));
    late(connection.watch("0", mazeway_client::WatchOptions::default()).await.expect_err("no answer"));
    let learner = Learner::connect_with(&address, &options).await.expect("a connection");
    late(learner.list_models("").await.expect_err("no answer"));
    late(learner.fit(pb::FitRequest::default(), |_| {}).await.expect_err("no answer"));

    // A server that stands still between two steps.
    let server = mazeway_tests::programs::Service::server();
    let connection = Connection::connect(server.address(), &options).await.expect("a connection");
    let mut envs = VectorEnv::create(&connection, "Maze-v0", 2, Default::default(), SessionOptions::default())
        .await
        .expect("a session");
    envs.reset(1).await.expect("resets");
    envs.step(&[0, 1]).await.expect("steps");
    let signal = |name: &str| {
        let status = std::process::Command::new("kill").args([name, &server.pid().to_string()]).status();
        assert!(status.expect("kill").success());
    };
    signal("-STOP");
    late(envs.step(&[0, 1]).await.expect_err("no answer"));
    signal("-CONT");
    sleep(Duration::from_millis(100)).await;
    envs.reset(1).await.expect("the session lives on");
    envs.step(&[0, 1]).await.expect("steps");
}
