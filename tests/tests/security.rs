//! Who is let in: TLS, certificates of clients, tokens and their scopes, over real sockets.

use mazeway_client::{ClientError, Code, channel};
use mazeway_learner::Config as LearnerConfig;
use mazeway_proto::{
    dm_env::{self, environment_client::EnvironmentClient, environment_request, environment_response},
    env::{self as pb, environment_service_client::EnvironmentServiceClient},
    learner::{self as learner_pb, learner_service_client::LearnerServiceClient},
};
use mazeway_server::Config;
use mazeway_serving::{
    DoorConfig,
    grant::{Quotas, Scope},
};
use mazeway_tests::{
    EnvServer,
    authority::{Authority, bearing, secure_channel},
    config,
    learner::{LearnerServer, trajectory},
};
use std::{fmt::Debug, fs, time::Duration};
use tokio::time::{Instant, sleep};
use tonic::{
    Response, Status,
    transport::{Certificate, Channel, ClientTlsConfig},
};
use tonic_health::pb::{HealthCheckRequest, health_client::HealthClient};
use tonic_types::StatusExt as _;

fn behind(door: DoorConfig) -> Config {
    Config { door, ..config() }
}

#[track_caller]
fn refused<T: Debug>(outcome: Result<T, Status>, code: Code) -> Status {
    let status = outcome.expect_err("it is refused");
    assert_eq!(status.code(), code, "{status}");
    status
}

async fn list(channel: Channel) -> Result<usize, Status> {
    let mut service = EnvironmentServiceClient::new(channel);
    service.list_environments(pb::ListEnvironmentsRequest {}).await.map(|r| r.into_inner().environments.len())
}

async fn list_with(channel: Channel, secret: &str) -> Result<Response<pb::ListEnvironmentsResponse>, Status> {
    EnvironmentServiceClient::new(bearing(channel, secret)).list_environments(pb::ListEnvironmentsRequest {}).await
}

#[tokio::test]
async fn tls_serves_those_who_trust_it_and_nobody_in_the_clear() {
    let authority = Authority::new();
    let server = EnvServer::with(behind(authority.tls()));
    let known = secure_channel(&server.address(), authority.trusting()).await.expect("a handshake");
    assert!(list(known).await.expect("lists") > 0);
    // Others do not trust it, and it does not talk to those who do not ask for TLS.
    let stranger = ClientTlsConfig::new()
        .ca_certificate(Certificate::from_pem(fs::read(Authority::new().root_file()).unwrap_or_default()));
    secure_channel(&server.address(), stranger.domain_name("localhost")).await.expect_err("an unknown authority");
    let wrong_name = authority.trusting().domain_name("elsewhere.example");
    secure_channel(&server.address(), wrong_name).await.expect_err("another name");
    if let Ok(plain) = channel(&server.address()).await {
        list(plain).await.expect_err("no call gets through");
    }
}

#[tokio::test]
async fn a_handshake_that_does_not_end_holds_up_nobody_and_is_cut_off() {
    let authority = Authority::new();
    let door = DoorConfig { handshake_timeout: Duration::from_millis(300), ..authority.tls() };
    let server = EnvServer::with(Config { threads: 1, ..behind(door) });
    let mut silent = Vec::new();
    for _ in 0..20 {
        silent.push(tokio::net::TcpStream::connect(server.socket()).await.expect("connects"));
    }
    let known = secure_channel(&server.address(), authority.trusting()).await.expect("a handshake");
    assert!(list(known).await.expect("lists") > 0);
    for stream in silent {
        stream.readable().await.expect("an end");
        assert_eq!(stream.try_read(&mut [0; 64]).unwrap_or(0), 0, "it is closed without a word");
    }
}

#[tokio::test]
async fn mutual_tls_lets_those_in_whose_certificate_is_signed() {
    let authority = Authority::new();
    let door = DoorConfig { tls_client_ca: Some(authority.root_file()), ..authority.tls() };
    let server = EnvServer::with(behind(door));
    let known = secure_channel(&server.address(), authority.known_as("alice")).await.expect("a handshake");
    assert!(list(known).await.expect("lists") > 0);
    // With TLS 1.3 a client learns with its first call that its certificate was not taken.
    let other = Authority::new();
    let forged = authority.trusting().identity({
        let (cert, key) = other.sign("alice");
        tonic::transport::Identity::from_pem(cert, key)
    });
    for tls in [authority.trusting(), forged] {
        if let Ok(channel) = secure_channel(&server.address(), tls).await {
            list(channel).await.expect_err("no call gets through");
        }
    }
}

#[tokio::test]
async fn without_a_good_token_only_health_is_answered() {
    let authority = Authority::new();
    let secret = authority.token("alice", &[Scope::Act], &Quotas::default());
    let server = EnvServer::with(behind(authority.tokens()));
    let channel = channel(&server.address()).await.expect("a channel");
    list_with(channel.clone(), &secret).await.expect("lists");
    HealthClient::new(channel.clone()).check(HealthCheckRequest::default()).await.expect("health is open");
    refused(list(channel.clone()).await, Code::Unauthenticated);
    for wrong in ["", "mzw_", &secret[..46], &format!("{secret}x")] {
        let status = refused(list_with(channel.clone(), wrong).await, Code::Unauthenticated);
        assert!(!status.message().contains(wrong) || wrong.len() < 5, "{status}");
    }
    // The stream, the other face and reflection ask as well.
    let mut stream = EnvironmentServiceClient::new(channel.clone());
    refused(stream.interact(tokio_stream::pending()).await, Code::Unauthenticated);
    let mut worlds = mazeway_proto::dm_env::environment_client::EnvironmentClient::new(channel.clone());
    refused(worlds.process(tokio_stream::pending()).await, Code::Unauthenticated);
    let mut reflection = tonic_reflection::pb::v1::server_reflection_client::ServerReflectionClient::new(channel);
    refused(reflection.server_reflection_info(tokio_stream::pending()).await, Code::Unauthenticated);
}

#[tokio::test]
async fn those_who_show_no_token_take_a_share_of_the_connections_alone() {
    let authority = Authority::new();
    let secret = authority.token("alice", &[Scope::Act], &Quotas::default());
    let door = DoorConfig {
        max_connections: 8,
        handshake_timeout: Duration::from_millis(300),
        idle_timeout: Duration::from_mins(10),
        ..authority.tokens()
    };
    let server = EnvServer::with(behind(door));
    let known = channel(&server.address()).await.expect("a channel");
    list_with(known.clone(), &secret).await.expect("lists");
    let watch = async |channel: Channel| {
        let mut watched = HealthClient::new(channel).watch(HealthCheckRequest::default()).await?.into_inner();
        watched.message().await?;
        Ok::<_, Status>(watched)
    };
    let mut of_alice = watch(known.clone()).await.expect("health");
    let mut strangers = Vec::new();
    for _ in 0..7 {
        let stranger = channel(&server.address()).await.expect("a channel");
        strangers.push(watch(stranger).await.expect("health is open"));
    }
    // The oldest go first; so many as may stay do.
    let stay = strangers.split_off(5);
    for mut stranger in strangers {
        let ended = tokio::time::timeout(Duration::from_secs(10), stranger.message()).await.expect("it is told to go");
        refused(ended, Code::Unavailable);
    }
    let another = async {
        loop {
            if let Ok(another) = channel(&server.address()).await
                && list_with(another, &secret).await.is_ok()
            {
                return;
            }
            sleep(Duration::from_millis(50)).await;
        }
    };
    tokio::time::timeout(Duration::from_secs(10), another).await.expect("there is room for who has a token");
    for mut stays in stay {
        tokio::time::timeout(Duration::from_millis(100), stays.message()).await.expect_err("it goes on");
    }
    tokio::time::timeout(Duration::from_millis(100), of_alice.message()).await.expect_err("it goes on");
    list_with(known, &secret).await.expect("lists");
}

#[tokio::test]
async fn a_token_that_is_taken_out_is_refused_and_its_streams_end() {
    let authority = Authority::new();
    let alice = authority.token("alice", &[Scope::Act], &Quotas::default());
    let file = fs::read_to_string(authority.path("tokens.toml")).expect("a file");
    let bob = authority.token("bob", &[Scope::Act], &Quotas::default());
    let server = EnvServer::with(behind(authority.tokens()));
    let channel = channel(&server.address()).await.expect("a channel");
    let mut streams = Vec::new();
    for secret in [&alice, &bob] {
        let mut service = EnvironmentServiceClient::new(bearing(channel.clone(), secret));
        streams.push(service.interact(tokio_stream::pending()).await.expect("a stream").into_inner());
    }
    fs::write(authority.path("tokens.toml"), file).expect("writes");
    let (mut of_bob, mut of_alice) = (streams.pop().expect("two"), streams.pop().expect("two"));
    of_bob.message().await.expect_err("it ends");
    refused(list_with(channel.clone(), &bob).await, Code::Unauthenticated);
    list_with(channel, &alice).await.expect("lists");
    tokio::time::timeout(Duration::from_millis(200), of_alice.message()).await.expect_err("it goes on");
}

#[tokio::test]
async fn a_token_that_expires_is_refused_from_then_on() {
    let authority = Authority::new();
    let secret = authority.token("alice", &[Scope::Act], &Quotas::default());
    let path = authority.path("tokens.toml");
    let text = fs::read_to_string(&path).expect("a file");
    let soon = std::time::SystemTime::now() + Duration::from_secs(2);
    // To the whole second, as a file says it.
    let at = soon.duration_since(std::time::UNIX_EPOCH).expect("after 1970").as_secs();
    let date = prost_types::Timestamp { seconds: at as i64, nanos: 0 };
    fs::write(&path, format!("{text}expires = {date}\n")).expect("writes");
    let server = EnvServer::with(behind(authority.tokens()));
    let channel = channel(&server.address()).await.expect("a channel");
    list_with(channel.clone(), &secret).await.expect("still good");
    let begun = Instant::now();
    while list_with(channel.clone(), &secret).await.is_ok() {
        assert!(begun.elapsed() < Duration::from_secs(10), "it never expires");
        sleep(Duration::from_millis(50)).await;
    }
    refused(list_with(channel, &secret).await, Code::Unauthenticated);
}

#[tokio::test]
async fn each_scope_is_good_for_its_own_calls_alone() {
    let authority = Authority::new();
    let secrets = Scope::ALL.map(|scope| authority.token(scope.name(), &[scope], &Quotas::default()));
    let server = EnvServer::with(behind(authority.tokens()));
    let data = tempfile::tempdir().expect("a directory");
    let config = LearnerConfig { door: authority.tokens(), ..LearnerConfig::new(data.path()) };
    let learner = LearnerServer::configured("127.0.0.1:0".parse().expect("an address"), config);
    let environments = channel(&server.address()).await.expect("a channel");
    let learner = channel(&learner.address()).await.expect("a channel");
    for (scope, secret) in Scope::ALL.into_iter().zip(&secrets) {
        let mut service = LearnerServiceClient::new(bearing(learner.clone(), secret));
        let none = Code::Ok;
        let outcomes = [
            ("act", list_with(environments.clone(), secret).await.err(), none),
            ("record", service.record_trajectories(tokio_stream::empty()).await.err(), none),
            ("record", service.put_model(tokio_stream::empty()).await.err(), Code::InvalidArgument),
            ("fit", service.fit(learner_pb::FitRequest::default()).await.err(), Code::InvalidArgument),
            ("fit", service.list_trajectories(learner_pb::ListTrajectoriesRequest::default()).await.err(), none),
            ("fit", service.export_trajectories(learner_pb::ExportTrajectoriesRequest::default()).await.err(), none),
            ("fit", service.get_fit(learner_pb::GetFitRequest { fit_id: "0".repeat(8) }).await.err(), Code::NotFound),
            ("record or fit", service.list_models(learner_pb::ListModelsRequest::default()).await.err(), none),
            (
                "admin",
                service.delete_trajectories(learner_pb::DeleteTrajectoriesRequest::default()).await.err(),
                Code::InvalidArgument,
            ),
            ("admin", service.delete_fit(learner_pb::DeleteFitRequest::default()).await.err(), Code::InvalidArgument),
        ];
        for (index, (needed, outcome, otherwise)) in outcomes.into_iter().enumerate() {
            let code = outcome.as_ref().map_or(Code::Ok, Status::code);
            if needed.split(" or ").any(|needed| needed == scope.name()) {
                assert_eq!(code, otherwise, "{index} with {scope}: {outcome:?}");
            } else {
                assert_eq!(code, Code::PermissionDenied, "{index} with {scope}: {outcome:?}");
                let message = outcome.expect("a status").message().to_owned();
                assert!(message.contains(&format!("needs the scope {needed}, which token \"{scope}\"")), "{message}");
            }
        }
    }
}

/// Everything that one can try with the id of a session.
async fn tried(channel: &Channel, secret: &str, session_id: &str) -> Vec<Status> {
    let id = || session_id.to_owned();
    let mut service = EnvironmentServiceClient::new(bearing(channel.clone(), secret));
    let interact = pb::InteractRequest {
        request: Some(pb::interact_request::Request::Reset(pb::ResetRequest {
            session_id: id(),
            ..Default::default()
        })),
    };
    let mut stream = service.interact(tokio_stream::iter([interact])).await.expect("a stream").into_inner();
    let mut worlds = EnvironmentClient::new(bearing(channel.clone(), secret));
    let join = dm_env::JoinWorldRequest { world_name: id(), ..Default::default() };
    let destroy = dm_env::DestroyWorldRequest { world_name: id() };
    let requests = [environment_request::Payload::JoinWorld(join), environment_request::Payload::DestroyWorld(destroy)];
    let requests = requests.map(|payload| dm_env::EnvironmentRequest { payload: Some(payload) });
    let mut answers = worlds.process(tokio_stream::iter(requests)).await.expect("a stream").into_inner();
    let watched = service.watch(pb::WatchRequest { session_id: id(), ..Default::default() }).await;
    let mut statuses = vec![
        watched.map(|_| ()).expect_err("watch"),
        service.reset(pb::ResetRequest { session_id: id(), ..Default::default() }).await.expect_err("reset"),
        service.step(pb::StepRequest { session_id: id(), ..Default::default() }).await.expect_err("step"),
        service.render(pb::RenderRequest { session_id: id(), ..Default::default() }).await.expect_err("render"),
        service.close_session(pb::CloseSessionRequest { session_id: id() }).await.expect_err("close"),
        stream.message().await.expect_err("interact"),
    ];
    while let Some(answer) = answers.message().await.expect("an answer") {
        let Some(environment_response::Payload::Error(error)) = answer.payload else { panic!("{answer:?}") };
        statuses.push(Status::new(error.code.into(), error.message));
    }
    statuses
}

#[tokio::test]
async fn the_session_of_another_is_as_one_that_never_was() {
    let authority = Authority::new();
    let [alice, bob] = ["alice", "bob"].map(|name| authority.token(name, &[Scope::Act], &Quotas::default()));
    let server = EnvServer::with(behind(authority.tokens()));
    let channel = channel(&server.address()).await.expect("a channel");
    let mut service = EnvironmentServiceClient::new(bearing(channel.clone(), &alice));
    let request = pb::CreateSessionRequest { env_id: "Maze-v0".into(), ..Default::default() };
    let session_id = service.create_session(request).await.expect("a session").into_inner().session_id;
    let (stolen, invented) =
        (tried(&channel, &bob, &session_id).await, tried(&channel, &bob, "0123456789abcdef0123456789abcdef").await);
    assert_eq!(stolen.len(), 8);
    let told = |status: &Status| {
        let mut details = status.get_error_details();
        // The name of the call differs by right, where there is one.
        details.set_request_info("", "");
        (status.code(), status.message().to_owned(), format!("{details:?}"))
    };
    for (stolen, invented) in stolen.iter().zip(&invented) {
        assert_eq!(stolen.code(), Code::NotFound, "{stolen}");
        assert_eq!(told(stolen), told(invented));
    }
    service.reset(pb::ResetRequest { session_id, ..Default::default() }).await.expect("alice still has it");
}

#[tokio::test]
async fn a_token_has_its_quota_of_sessions_and_environments() {
    let authority = Authority::new();
    let quotas = Quotas { max_sessions: Some(2), max_envs: Some(10), ..Quotas::default() };
    let alice = authority.token("alice", &[Scope::Act], &quotas);
    let bob = authority.token("bob", &[Scope::Act], &Quotas::default());
    let server = EnvServer::with(behind(authority.tokens()));
    let channel = channel(&server.address()).await.expect("a channel");
    let create = |secret: &str, num_envs: u32| {
        let mut service = EnvironmentServiceClient::new(bearing(channel.clone(), secret));
        let request = pb::CreateSessionRequest { env_id: "Maze-v0".into(), num_envs, ..Default::default() };
        async move { service.create_session(request).await.map(Response::into_inner) }
    };
    let quota = |status: Status, field: &str| {
        let error = ClientError::from(status);
        assert_eq!((error.code(), error.field()), (Code::ResourceExhausted, Some(field)), "{error}");
        assert!(error.to_string().contains("of this caller"), "{error}");
    };
    quota(create(&alice, 11).await.expect_err("too many"), "num_envs");
    create(&alice, 6).await.expect("a session");
    quota(create(&alice, 5).await.expect_err("too many"), "num_envs");
    let last = create(&alice, 4).await.expect("a session").session_id;
    quota(create(&alice, 1).await.expect_err("too many"), "sessions");
    for _ in 0..3 {
        create(&bob, 20).await.expect("another's quota is another's");
    }
    let mut service = EnvironmentServiceClient::new(bearing(channel.clone(), &alice));
    service.close_session(pb::CloseSessionRequest { session_id: last }).await.expect("closes");
    create(&alice, 4).await.expect("there is room again");
}

#[tokio::test]
async fn a_token_has_its_quota_of_recorded_bytes_for_ever() {
    let authority = Authority::new();
    let bytes = |number: u128| {
        let t = trajectory(number);
        (t.states.len() + t.actions.len() + t.rewards.len()) as u64
    };
    let quotas = Quotas { max_recorded_bytes: Some(bytes(1) + bytes(2) + 10), ..Quotas::default() };
    let alice = authority.token("alice", &[Scope::Record], &quotas);
    let bob = authority.token("bob", &[Scope::Record], &Quotas::default());
    let data = tempfile::tempdir().expect("a directory");
    let start = || {
        let config = LearnerConfig { door: authority.tokens(), ..LearnerConfig::new(data.path()) };
        LearnerServer::configured("127.0.0.1:0".parse().expect("an address"), config)
    };
    let record = async |learner: &LearnerServer, secret: &str, number: u128| {
        let channel = channel(&learner.address()).await.expect("a channel");
        let request = learner_pb::RecordTrajectoriesRequest { trajectories: vec![trajectory(number)] };
        let mut service = LearnerServiceClient::new(bearing(channel, secret));
        let answers = service.record_trajectories(tokio_stream::iter([request])).await.expect("a stream");
        answers.into_inner().message().await.map(|answer| answer.expect("an answer").stored)
    };
    let learner = start();
    for (number, stored) in [(1, 1), (2, 1), (1, 0)] {
        assert_eq!(record(&learner, &alice, number).await.expect("it is stored"), stored);
    }
    let spent = |status: Status| {
        let error = ClientError::from(status);
        assert_eq!((error.code(), error.field()), (Code::ResourceExhausted, Some("max_recorded_bytes")), "{error}");
    };
    spent(record(&learner, &alice, 3).await.expect_err("too much"));
    learner.stop();
    // A restart forgets nothing, and what was refused was not charged.
    let learner = start();
    assert_eq!(record(&learner, &alice, 2).await.expect("it is stored"), 0);
    spent(record(&learner, &alice, 3).await.expect_err("too much"));
    assert_eq!(record(&learner, &bob, 3).await.expect("another has room"), 1);
}
