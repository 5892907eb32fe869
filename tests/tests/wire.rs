//! What a server is beside its environments: health, reflection, a clean end.

use mazeway_client::{Autoreset, Code, Connection, Controller, Env, Rollout, SessionOptions, VectorEnv, channel};
use mazeway_server::Config;
use mazeway_tests::{EnvServer, config};
use std::time::{Duration, Instant};
use tonic_health::pb::{HealthCheckRequest, health_client::HealthClient};
use tonic_reflection::pb::{v1, v1alpha};

#[tokio::test]
async fn health_answers_for_the_server_and_the_service() {
    let server = EnvServer::start();
    let mut health = HealthClient::new(channel(&server.address()).await.expect("connects"));
    for service in ["", "mazeway.env.v1.EnvironmentService"] {
        let answer = health.check(HealthCheckRequest { service: service.into() }).await.expect("answers").into_inner();
        assert_eq!(answer.status(), tonic_health::ServingStatus::Serving.into(), "{service:?}");
    }
    let unknown = health.check(HealthCheckRequest { service: "no.such.Service".into() }).await;
    assert_eq!(unknown.expect_err("unknown").code(), Code::NotFound);
}

#[tokio::test]
async fn reflection_describes_the_services_in_both_versions() {
    let server = EnvServer::start();
    let channel = channel(&server.address()).await.expect("connects");
    let expected = ["grpc.health.v1.Health", "mazeway.env.v1.EnvironmentService"];

    let mut client = v1::server_reflection_client::ServerReflectionClient::new(channel.clone());
    let request =
        |message_request| v1::ServerReflectionRequest { host: String::new(), message_request: Some(message_request) };
    let requests = [
        request(v1::server_reflection_request::MessageRequest::ListServices(String::new())),
        request(v1::server_reflection_request::MessageRequest::FileContainingSymbol(expected[1].into())),
    ];
    let mut answers = client.server_reflection_info(tokio_stream::iter(requests)).await.expect("answers").into_inner();
    let first = answers.message().await.expect("answers").and_then(|answer| answer.message_response);
    let Some(v1::server_reflection_response::MessageResponse::ListServicesResponse(list)) = first else {
        panic!("no list of services: {first:?}");
    };
    let names: Vec<_> = list.service.iter().map(|service| service.name.as_str()).collect();
    assert!(expected.iter().all(|name| names.contains(name)), "{names:?}");
    let second = answers.message().await.expect("answers").and_then(|answer| answer.message_response);
    let Some(v1::server_reflection_response::MessageResponse::FileDescriptorResponse(files)) = second else {
        panic!("no descriptors: {second:?}");
    };
    assert!(!files.file_descriptor_proto.is_empty());

    let mut client = v1alpha::server_reflection_client::ServerReflectionClient::new(channel);
    let list = v1alpha::server_reflection_request::MessageRequest::ListServices(String::new());
    let request = v1alpha::ServerReflectionRequest { host: String::new(), message_request: Some(list) };
    let mut answers = client.server_reflection_info(tokio_stream::iter([request])).await.expect("answers").into_inner();
    let answer = answers.message().await.expect("answers").and_then(|answer| answer.message_response);
    assert!(
        matches!(&answer, Some(v1alpha::server_reflection_response::MessageResponse::ListServicesResponse(list))
            if list.service.iter().any(|service| service.name == expected[1])),
        "{answer:?}"
    );
}

#[tokio::test]
async fn a_server_with_open_streams_stops_in_its_grace() {
    let grace = Duration::from_secs(30);
    let server = EnvServer::with(Config { shutdown_grace: grace, ..Config::default() });
    let options = SessionOptions { resume_within: Some(Duration::from_millis(200)), ..SessionOptions::default() };
    let mut env = Env::connect(&server.address(), "Maze-v0", options).await.expect("connects");
    env.reset(Some(1)).await.expect("resets");
    let begun = Instant::now();
    tokio::task::spawn_blocking(move || server.stop()).await.expect("stops");
    assert!(begun.elapsed() < grace, "the idle stream was waited for");
    let error = env.step(0).await.expect_err("the server is gone");
    assert_eq!(error.code(), Code::Unavailable, "{error}");
}

#[tokio::test]
async fn a_unix_socket_serves_all_that_tcp_does_and_goes_with_its_server() {
    let directory = tempfile::tempdir().expect("a directory");
    let path = directory.path().join("env.sock");
    let (unix, tcp) = (EnvServer::unix(&path, config()), EnvServer::start());
    assert_eq!(unix.address(), format!("unix:{}", path.display()));
    let mut health = HealthClient::new(channel(&unix.address()).await.expect("connects"));
    health.check(HealthCheckRequest::default()).await.expect("answers");
    for address in [unix.address(), format!("unix://{}", path.display())] {
        let make = |address| async move { Env::connect(address, "Highway-v0", SessionOptions::default()).await };
        let (mut env, mut twin) =
            (make(&address).await.expect("connects"), make(&tcp.address()).await.expect("connects"));
        assert_eq!(env.reset(Some(5)).await, twin.reset(Some(5)).await);
        for action in 0..12 {
            assert_eq!(env.step(action).await, twin.step(action).await);
        }
        assert_eq!(env.render_text().await, twin.render_text().await);
        env.close().await.expect("closes");
    }
    let rollout = || Rollout { seed: 1, ..Rollout::new("Maze-v0", Controller::driver("random"), 3, 20) };
    let drive = async |address| mazeway_client::rollout(address, rollout()).await.expect("drives");
    assert_eq!(drive(&unix.address()).await, drive(&tcp.address()).await);
    tokio::task::spawn_blocking(move || unix.stop()).await.expect("stops");
    assert!(!path.exists(), "the socket stays behind");
    let error = Connection::open(&format!("unix:{}", path.display())).await.expect_err("nobody is there");
    assert!(error.to_string().contains("env.sock") && error.code() == Code::Unavailable, "{error}");
}

#[tokio::test]
async fn catalogue_and_session_describe_the_same_environment() {
    let server = EnvServer::start();
    let connection = Connection::open(&server.address()).await.expect("connects");
    let specs = connection.list_environments().await.expect("lists");
    assert_eq!(specs.iter().map(|spec| spec.env_id.as_str()).collect::<Vec<_>>(), ["Highway-v0", "Maze-v0"]);
    for spec in specs {
        assert!(spec.drivers.iter().any(|(name, _)| name == "random"), "{spec:?}");
        assert!(!spec.description.is_empty() && spec.options.iter().all(|option| !option.description.is_empty()));
        let make = SessionOptions::default();
        let env = Env::create(&connection, &spec.env_id, make.clone()).await.expect("creates");
        assert_eq!(*env.spec(), spec);
        assert_eq!(env.max_episode_steps(), spec.max_episode_steps);
        // The defaults, given one by one, change nothing.
        let options = spec.options.iter().map(|option| (option.name.clone(), option.default.clone())).collect();
        let make = SessionOptions { options, action_masks: true, max_episode_steps: Some(0), ..make };
        let envs = VectorEnv::create(&connection, &spec.env_id, 3, Autoreset::SameStep, make).await.expect("creates");
        assert_eq!((envs.num_envs(), envs.max_episode_steps()), (3, 0));
        assert_eq!(envs.spec().info_columns[..spec.info_columns.len()], spec.info_columns);
        assert_eq!(envs.spec().info_columns.last().map(|column| column.name.as_str()), Some("action_mask"));
    }
}

#[tokio::test]
async fn models_arrive_whole_and_are_computed_once() {
    let server = EnvServer::start();
    let connection = Connection::open(&server.address()).await.expect("connects");
    for spec in connection.list_environments().await.expect("lists") {
        let options = mazeway_client::Options::new();
        let (a, b) = tokio::join!(connection.model(&spec.env_id, &options), connection.model(&spec.env_id, &options));
        let model = a.expect("a model");
        assert_eq!(model, b.expect("a model"));
        // The client has verified the id and the sums of the rows.
        assert_eq!((model.n_states, model.n_actions), (spec.n_states, spec.n_actions));
        assert_eq!(model.rewards.iter().map(|(style, _)| style.clone()).collect::<Vec<_>>(), spec.styles);
        assert_eq!(model.estimated, model.visit_counts.is_some());
        let round_trip = model.parts().try_fold(mazeway_client::ModelCollector::default(), |mut collector, part| {
            collector.push(part).map(|()| collector)
        });
        assert_eq!(round_trip.and_then(mazeway_client::ModelCollector::finish), Ok(model));
    }
}

#[tokio::test]
async fn pictures_are_text_pixels_and_png() {
    let server = EnvServer::start();
    let connection = Connection::open(&server.address()).await.expect("connects");
    for spec in connection.list_environments().await.expect("lists") {
        let mut env = Env::create(&connection, &spec.env_id, SessionOptions::default()).await.expect("creates");
        env.reset(Some(1)).await.expect("resets");
        let text = env.render_text().await.expect("draws");
        assert!(text.lines().count() >= 3 && !text.contains('\u{1b}'), "{text}");
        let image = env.render_rgb().await.expect("draws");
        assert!(image.width > 100 && image.height > 100);
        let mut colours: Vec<_> = image.rgb.as_chunks::<3>().0.to_vec();
        colours.sort_unstable();
        colours.dedup();
        assert!(colours.len() > 3, "a picture of {} colours", colours.len());
        let png = env.render_png().await.expect("draws");
        assert_eq!(png[..8], *b"\x89PNG\r\n\x1a\n");
        assert_eq!(png[16..24], [image.width.to_be_bytes(), image.height.to_be_bytes()].concat());
        // Drawing changes nothing: the next step is the one that would have come.
        let mut twin = Env::create(&connection, &spec.env_id, SessionOptions::default()).await.expect("creates");
        twin.reset(Some(1)).await.expect("resets");
        assert_eq!(env.step(1).await, twin.step(1).await);
    }
}

#[tokio::test]
async fn totals_are_the_sums_of_the_steps_infos() {
    let server = EnvServer::start();
    let connection = Connection::open(&server.address()).await.expect("connects");
    let rollout = Rollout { seed: 21, ..Rollout::new("Highway-v0", Controller::driver("bad"), 4, 60) };
    let episodes = connection.rollout(rollout.clone()).await.expect("drives");
    let summed = connection.rollout(Rollout { totals_only: true, ..rollout }).await.expect("drives");
    assert_eq!((&summed.totals, &summed.returns), (&episodes.totals, &episodes.returns));
    let names: Vec<_> = episodes.totals.iter().map(|(name, _)| name.as_str()).collect();
    assert_eq!(names, ["collisions", "overtakes_left", "overtakes_right", "speed_mps"]);
    for episode in episodes.iter() {
        let make = SessionOptions { max_episode_steps: Some(0), ..SessionOptions::default() };
        let mut env = Env::create(&connection, "Highway-v0", make).await.expect("creates");
        env.reset(Some(21 + u64::from(episode.rank))).await.expect("resets");
        let mut sums = vec![0.0; names.len()];
        for (&action, &reward) in episode.actions.iter().zip(episode.rewards) {
            let step = env.step(action).await.expect("steps");
            assert_eq!(step.reward, reward);
            for (sum, name) in sums.iter_mut().zip(&names) {
                *sum += step.info.number(name, 0).expect("a column");
            }
        }
        let totals: Vec<_> = episodes.totals.iter().map(|(_, values)| values[episode.rank as usize]).collect();
        assert_eq!(sums, totals);
    }
}
