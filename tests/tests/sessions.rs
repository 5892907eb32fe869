//! Sessions over the wire: leases, limits, ownership, wrong calls, and taking a session up again.

use mazeway_client::{
    Autoreset, ClientError, Code, Connection, Controller, Env, Observation, Rollout, Seeds, SessionOptions, VectorEnv,
    channel, packed::pack,
};
use mazeway_proto::env::{self as pb, environment_service_client::EnvironmentServiceClient, interact_request::Request};
use mazeway_server::Config;
use mazeway_serving::DoorConfig;
use mazeway_tests::{EnvServer, config, proxy::Proxy};
use std::time::Duration;
use tokio::{sync::mpsc, time::sleep};
use tokio_stream::wrappers::ReceiverStream;
use tonic::{Status, Streaming, transport::Channel};

type Service = EnvironmentServiceClient<Channel>;

async fn service(server: &EnvServer) -> Service {
    EnvironmentServiceClient::new(channel(&server.address()).await.expect("a channel"))
}

fn maze() -> pb::CreateSessionRequest {
    pb::CreateSessionRequest { env_id: "Maze-v0".into(), ..Default::default() }
}

async fn create(service: &mut Service, request: pb::CreateSessionRequest) -> String {
    service.create_session(request).await.expect("a session").into_inner().session_id
}

fn duration(duration: Duration) -> prost_types::Duration {
    duration.try_into().expect("a duration")
}

fn step(session_id: &str, actions: &[i32]) -> pb::StepRequest {
    pb::StepRequest { session_id: session_id.into(), actions: pack(actions.iter().copied()) }
}

fn reset(session_id: &str, seed: u64) -> pb::ResetRequest {
    pb::ResetRequest { session_id: session_id.into(), seed: Some(seed), ..Default::default() }
}

/// Opens an interactive stream.
async fn interact(service: &mut Service) -> (mpsc::Sender<pb::InteractRequest>, Streaming<pb::InteractResponse>) {
    let (requests, body) = mpsc::channel(16);
    (requests, service.interact(ReceiverStream::new(body)).await.expect("a stream").into_inner())
}

async fn send(requests: &mpsc::Sender<pb::InteractRequest>, request: Request) {
    requests.send(pb::InteractRequest { request: Some(request) }).await.expect("the stream lives");
}

/// Checks the code and the field of a refusal.
#[track_caller]
fn refused<T: std::fmt::Debug>(outcome: Result<T, Status>, code: Code, field: &str) -> String {
    let error = ClientError::from(outcome.expect_err("it is refused"));
    assert_eq!((error.code(), error.field()), (code, Some(field)), "{error}");
    error.to_string()
}

fn option(name: &str, kind: prost_types::value::Kind) -> prost_types::Struct {
    prost_types::Struct { fields: [(name.to_owned(), prost_types::Value { kind: Some(kind) })].into() }
}

#[tokio::test]
async fn every_wrong_call_names_its_field() {
    use prost_types::value::Kind;
    let server = EnvServer::start();
    let mut service = service(&server).await;

    let wrong = pb::CreateSessionRequest { env_id: "Maze-v7".into(), ..maze() };
    let message = refused(service.create_session(wrong).await, Code::NotFound, "env_id");
    assert_eq!(message, "no environment \"Maze-v7\"; there are Highway-v0, Maze-v0");
    let wrong = pb::CreateSessionRequest { options: Some(option("slip", Kind::NumberValue(1.5))), ..maze() };
    refused(service.create_session(wrong).await, Code::InvalidArgument, "options.slip");
    let wrong = pb::CreateSessionRequest { options: Some(option("slip", Kind::NumberValue(f64::NAN))), ..maze() };
    refused(service.create_session(wrong).await, Code::InvalidArgument, "options.slip");
    let wrong = pb::CreateSessionRequest { options: Some(option("slippery", Kind::BoolValue(true))), ..maze() };
    refused(service.create_session(wrong).await, Code::InvalidArgument, "options.slippery");
    let wrong = pb::CreateSessionRequest { autoreset_mode: 9, ..maze() };
    refused(service.create_session(wrong).await, Code::InvalidArgument, "autoreset_mode");
    let negative = prost_types::Duration { seconds: -1, nanos: 0 };
    let wrong = pb::CreateSessionRequest { lease: Some(negative), ..maze() };
    refused(service.create_session(wrong).await, Code::InvalidArgument, "lease");
    let wrong = pb::CreateSessionRequest { lease: Some(duration(Duration::from_hours(100))), ..maze() };
    refused(service.create_session(wrong).await, Code::InvalidArgument, "lease");

    let id = create(&mut service, pb::CreateSessionRequest { num_envs: 2, ..maze() }).await;
    let unknown = "0123456789abcdef0123456789abcdef";
    for (id, code) in [(unknown, Code::NotFound), ("nonsense", Code::NotFound), ("", Code::InvalidArgument)] {
        refused(service.reset(reset(id, 1)).await, code, "session_id");
        refused(service.step(step(id, &[0])).await, code, "session_id");
        let render = pb::RenderRequest { session_id: id.into(), ..Default::default() };
        refused(service.render(render).await, code, "session_id");
        refused(service.close_session(pb::CloseSessionRequest { session_id: id.into() }).await, code, "session_id");
    }

    let early = service.step(step(&id, &[0, 0])).await.expect_err("no reset yet");
    assert_eq!(early.code(), Code::FailedPrecondition);
    let picture = |index, mode| pb::RenderRequest { session_id: id.clone(), index, mode };
    let early = service.render(picture(0, 1)).await.expect_err("no reset yet");
    assert_eq!(early.code(), Code::FailedPrecondition);
    let both = pb::ResetRequest { seeds: pack([1_u64, 2]), ..reset(&id, 1) };
    refused(service.reset(both).await, Code::InvalidArgument, "seeds");
    let torn = pb::ResetRequest { seeds: vec![0; 15].into(), seed: None, ..reset(&id, 1) };
    let message = refused(service.reset(torn).await, Code::InvalidArgument, "seeds");
    assert_eq!(message, "expected 16 bytes of uint64 seeds for 2 environments, got 15");
    service.reset(reset(&id, 1)).await.expect("resets");
    let torn = pb::StepRequest { actions: vec![0; 7].into(), ..step(&id, &[]) };
    let message = refused(service.step(torn).await, Code::InvalidArgument, "actions");
    assert_eq!(message, "expected 8 bytes of int32 actions for 2 environments, got 7");
    let message = refused(service.step(step(&id, &[0, 4])).await, Code::InvalidArgument, "actions[1]");
    assert_eq!(message, "expected an action from 0 to 3 for environment 1, got 4");
    refused(service.step(step(&id, &[-1, 0])).await, Code::InvalidArgument, "actions[0]");
    refused(service.render(picture(2, 1)).await, Code::InvalidArgument, "index");
    refused(service.render(picture(0, 77)).await, Code::InvalidArgument, "mode");
    service.close_session(pb::CloseSessionRequest { session_id: id.clone() }).await.expect("closes");
    refused(service.step(step(&id, &[0, 0])).await, Code::NotFound, "session_id");
}

#[tokio::test]
async fn wrong_rollouts_and_models_name_their_field() {
    use pb::rollout_request::Controller as Who;
    let server = EnvServer::with(Config { max_rollout_steps: 10_000, ..config() });
    let mut service = service(&server).await;
    let policy = |values: Vec<f64>| Some(Who::Policy(pb::TabularPolicy { probabilities: pack(values) }));
    let right = pb::RolloutRequest {
        env_id: "Maze-v0".into(),
        controller: Some(Who::Driver("random".into())),
        episodes: 2,
        steps: 3,
        ..Default::default()
    };
    let mut broken_row = vec![0.25; 57 * 4];
    broken_row[5] = 0.5;
    let cases = [
        (pb::RolloutRequest { env_id: "Maze".into(), ..right.clone() }, Code::NotFound, "env_id"),
        (pb::RolloutRequest { controller: None, ..right.clone() }, Code::InvalidArgument, "controller"),
        (
            pb::RolloutRequest { controller: Some(Who::Driver("legal".into())), ..right.clone() },
            Code::InvalidArgument,
            "driver",
        ),
        (pb::RolloutRequest { episodes: 0, ..right.clone() }, Code::InvalidArgument, "episodes"),
        (pb::RolloutRequest { steps: 0, ..right.clone() }, Code::InvalidArgument, "steps"),
        (pb::RolloutRequest { episodes: 4000, ..right.clone() }, Code::ResourceExhausted, "steps"),
        (
            pb::RolloutRequest { episodes: u32::MAX, burn_in_steps: u32::MAX, ..right.clone() },
            Code::ResourceExhausted,
            "steps",
        ),
        (
            pb::RolloutRequest { controller: policy(vec![1.0; 3]), ..right.clone() },
            Code::InvalidArgument,
            "policy.probabilities",
        ),
        (
            pb::RolloutRequest { controller: policy(broken_row), ..right.clone() },
            Code::InvalidArgument,
            "policy.probabilities[1]",
        ),
        (
            pb::RolloutRequest { controller: policy(vec![f64::INFINITY; 57 * 4]), ..right.clone() },
            Code::InvalidArgument,
            "policy.probabilities[0][0]",
        ),
    ];
    for (request, code, field) in cases {
        refused(service.rollout(request).await, code, field);
    }
    let model = pb::GetModelRequest { env_id: "Highway-v9".into(), ..Default::default() };
    refused(service.get_model(model).await, Code::NotFound, "env_id");
    let options = option("density", prost_types::value::Kind::StringValue("dense".into()));
    let model = pb::GetModelRequest { env_id: "Highway-v0".into(), options: Some(options) };
    refused(service.get_model(model).await, Code::InvalidArgument, "options.density");
}

#[tokio::test]
async fn limits_are_kept() {
    let server = EnvServer::with(Config {
        max_sessions: 2,
        max_envs_per_session: 50,
        max_total_envs: 60,
        max_message_bytes: 64 << 10,
        ..config()
    });
    let mut service = service(&server).await;
    let of = |num_envs| pb::CreateSessionRequest { num_envs, ..maze() };
    refused(service.create_session(of(51)).await, Code::ResourceExhausted, "num_envs");
    refused(service.create_session(of(u32::MAX)).await, Code::ResourceExhausted, "num_envs");
    let first = create(&mut service, of(50)).await;
    refused(service.create_session(of(11)).await, Code::ResourceExhausted, "num_envs");
    create(&mut service, of(10)).await;
    refused(service.create_session(of(0)).await, Code::ResourceExhausted, "sessions");
    service.close_session(pb::CloseSessionRequest { session_id: first }).await.expect("closes");
    let id = create(&mut service, of(50)).await;
    let huge = pb::StepRequest { session_id: id, actions: vec![0; 100 << 10].into() };
    let code = service.step(huge).await.expect_err("too large a message").code();
    assert!(matches!(code, Code::OutOfRange | Code::ResourceExhausted), "{code:?}");
}

#[tokio::test]
async fn connections_are_limited_and_come_free() {
    let server =
        EnvServer::with(Config { door: DoorConfig { max_connections: 2, ..DoorConfig::default() }, ..config() });
    let (first, second) = (service(&server).await, service(&server).await);
    for mut service in [first.clone(), second.clone()] {
        service.list_environments(pb::ListEnvironmentsRequest {}).await.expect("answers");
    }
    // The third is closed in its handshake, or at its first call.
    let third = async || {
        let mut service = EnvironmentServiceClient::new(channel(&server.address()).await?);
        service.list_environments(pb::ListEnvironmentsRequest {}).await.map_err(ClientError::from)
    };
    assert!(third().await.is_err());
    drop(first);
    for _ in 0..500 {
        if third().await.is_ok() {
            return;
        }
        sleep(Duration::from_millis(10)).await;
    }
    panic!("the place of a connection that has gone stays taken");
}

#[tokio::test]
async fn a_reply_beyond_the_message_limit_is_refused_at_the_start() {
    let server = EnvServer::with(Config { max_message_bytes: 1000, ..config() });
    let of = |num_envs| pb::CreateSessionRequest { num_envs, ..maze() };
    let mut service = service(&server).await;
    refused(service.create_session(of(100)).await, Code::ResourceExhausted, "num_envs");
    create(&mut service, of(10)).await;
}

#[tokio::test]
async fn rollouts_are_limited_and_end_with_their_caller() {
    let server = EnvServer::with(Config { max_concurrent_rollouts: 1, ..config() });
    let connection = Connection::open(&server.address()).await.expect("connects");
    let long =
        || Rollout { totals_only: true, ..Rollout::new("Maze-v0", Controller::driver("random"), 900, 1_000_000) };
    let mut running = connection.rollout_stream(long()).await.expect("runs");
    running.next().await.expect("comes").expect("episodes");
    let error = connection.rollout_stream(long()).await.expect_err("one is running");
    assert_eq!((error.code(), error.field()), (Code::ResourceExhausted, Some("rollouts")));
    drop(running);
    let mut short = long();
    (short.episodes, short.steps) = (3, 3);
    for _ in 0..500 {
        match connection.rollout(short.clone()).await {
            Ok(episodes) => return assert_eq!(episodes.lengths, [3, 3, 3]),
            Err(error) => assert_eq!(error.code(), Code::ResourceExhausted),
        }
        sleep(Duration::from_millis(10)).await;
    }
    panic!("the roll-out outlives its caller");
}

#[tokio::test]
async fn an_idle_session_expires() {
    let server = EnvServer::with(Config { max_sessions: 1, ..config() });
    let mut service = service(&server).await;
    let short = || pb::CreateSessionRequest { lease: Some(duration(Duration::from_millis(300))), ..maze() };
    let id = create(&mut service, short()).await;
    // Each use begins the lease anew.
    for seed in 0..4 {
        sleep(Duration::from_millis(120)).await;
        service.reset(reset(&id, seed)).await.expect("alive");
    }
    sleep(Duration::from_millis(400)).await;
    refused(service.reset(reset(&id, 1)).await, Code::DeadlineExceeded, "session_id");
    // The reaper frees its place although nobody asks for it.
    create(&mut service, short()).await;
    sleep(Duration::from_millis(1600)).await;
    create(&mut service, short()).await;
}

#[tokio::test]
async fn an_idle_stream_ends_with_its_session() {
    let server = EnvServer::start();
    let mut service = service(&server).await;
    let id =
        create(&mut service, pb::CreateSessionRequest { lease: Some(duration(Duration::from_millis(300))), ..maze() })
            .await;
    let (requests, mut answers) = interact(&mut service).await;
    for seed in 0..4 {
        send(&requests, Request::Reset(reset(&id, seed))).await;
        answers.message().await.expect("answers").expect("an answer");
        sleep(Duration::from_millis(120)).await;
    }
    refused(answers.message().await, Code::DeadlineExceeded, "session_id");
    refused(service.reset(reset(&id, 1)).await, Code::DeadlineExceeded, "session_id");
}

#[tokio::test]
async fn a_stream_owns_its_session() {
    let server = EnvServer::start();
    let mut service = service(&server).await;
    let id = create(&mut service, maze()).await;
    let (requests, mut answers) = interact(&mut service).await;
    send(&requests, Request::Reset(reset(&id, 1))).await;
    answers.message().await.expect("answers").expect("an answer");
    refused(service.reset(reset(&id, 1)).await, Code::FailedPrecondition, "session_id");
    refused(service.step(step(&id, &[0])).await, Code::FailedPrecondition, "session_id");
    let close = pb::CloseSessionRequest { session_id: id.clone() };
    refused(service.close_session(close.clone()).await, Code::FailedPrecondition, "session_id");
    let (other_requests, mut other_answers) = interact(&mut service).await;
    send(&other_requests, Request::Reset(reset(&id, 1))).await;
    refused(other_answers.message().await, Code::FailedPrecondition, "session_id");
    // A picture is drawn by the stream itself, between its steps.
    let picture = pb::RenderRequest { session_id: id.clone(), index: 0, mode: 1 };
    let text = service.render(picture).await.expect("draws").into_inner().content;
    assert!(String::from_utf8_lossy(&text).contains('@'), "{text:?}");
    // Another session is none of this stream's business.
    let other = create(&mut service, maze()).await;
    send(&requests, Request::Reset(reset(&other, 1))).await;
    refused(answers.message().await, Code::InvalidArgument, "session_id");
    // Its failure has put the session back, as it was.
    service.step(step(&id, &[0])).await.expect("steps");
    let (requests, mut answers) = interact(&mut service).await;
    send(&requests, Request::Step(step(&id, &[0]))).await;
    answers.message().await.expect("answers").expect("an answer");
    send(&requests, Request::Close(pb::CloseSessionRequest::default())).await;
    answers.message().await.expect("answers").expect("an answer");
    assert!(answers.message().await.expect("ends well").is_none());
    refused(service.close_session(close).await, Code::NotFound, "session_id");
}

#[tokio::test]
async fn a_stream_that_goes_puts_its_session_back() {
    let server = EnvServer::start();
    let mut service = service(&server).await;
    let id = create(&mut service, maze()).await;
    for seed in 0..20 {
        let (requests, mut answers) = interact(&mut service).await;
        send(&requests, Request::Reset(reset(&id, seed))).await;
        answers.message().await.expect("answers").expect("an answer");
        if seed % 2 == 0 {
            // The caller ends its half and sees the other end.
            drop(requests);
            assert!(answers.message().await.expect("ends well").is_none());
            service.step(step(&id, &[0])).await.expect("back in its place");
        } else {
            drop((requests, answers));
            // The server learns of it soon.
            let mut tries = 0;
            while let Err(status) = service.step(step(&id, &[0])).await {
                assert_eq!(status.code(), Code::FailedPrecondition);
                tries += 1;
                assert!(tries < 500, "it never comes back");
                sleep(Duration::from_millis(10)).await;
            }
        }
    }
}

#[tokio::test]
async fn pipelined_requests_are_answered_in_order_and_the_first_failure_ends_the_stream() {
    let server = EnvServer::start();
    let mut service = service(&server).await;
    // Beyond the size up to which batches are stepped where the request is read.
    for num_envs in [1, 400] {
        let id = create(&mut service, pb::CreateSessionRequest { num_envs, ..maze() }).await;
        let wrong = step(&id, &vec![9; num_envs as usize]);
        let (requests, mut answers) = interact(&mut service).await;
        send(&requests, Request::Reset(reset(&id, 5))).await;
        for action in 0..4 {
            send(&requests, Request::Step(step("", &vec![action; num_envs as usize]))).await;
        }
        send(&requests, Request::Step(wrong)).await;
        send(&requests, Request::Step(step("", &vec![0; num_envs as usize]))).await;
        let twin = create(&mut service, pb::CreateSessionRequest { num_envs, ..maze() }).await;
        let first = service.reset(reset(&twin, 5)).await.expect("resets").into_inner();
        let answer = answers.message().await.expect("answers").expect("an answer").response;
        assert_eq!(answer, Some(pb::interact_response::Response::Reset(first)));
        for action in 0..4 {
            let expected =
                service.step(step(&twin, &vec![action; num_envs as usize])).await.expect("steps").into_inner();
            let answer = answers.message().await.expect("answers").expect("an answer").response;
            assert_eq!(answer, Some(pb::interact_response::Response::Step(expected)));
        }
        refused(answers.message().await, Code::InvalidArgument, "actions[0]");
        // What came after the failure was not carried out.
        let after = vec![1; num_envs as usize];
        let lives_on = service.step(step(&id, &after)).await.expect("steps").into_inner();
        assert_eq!(lives_on, service.step(step(&twin, &after)).await.expect("steps").into_inner());
    }
}

#[tokio::test]
async fn an_empty_request_ends_the_stream() {
    let server = EnvServer::start();
    let mut service = service(&server).await;
    let (requests, mut answers) = interact(&mut service).await;
    requests.send(pb::InteractRequest { request: None }).await.expect("the stream lives");
    refused(answers.message().await, Code::InvalidArgument, "request");
}

#[tokio::test]
async fn a_client_takes_its_session_up_again_when_the_connection_breaks() {
    let server = EnvServer::start();
    let proxy = Proxy::start(server.socket());
    let mut env = Env::connect(&proxy.address(), "Maze-v0", SessionOptions::default()).await.expect("connects");
    let mut twin = Env::connect(&server.address(), "Maze-v0", SessionOptions::default()).await.expect("connects");
    let id = env.session_id().to_owned();
    env.reset(Some(3)).await.expect("resets");
    twin.reset(Some(3)).await.expect("resets");
    let mut cut = 0;
    for round in 0..60 {
        if round % 7 == 3 {
            proxy.cut();
            cut += 1;
            // The client's side hears of it before the next call, so that nothing is under way.
            sleep(Duration::from_millis(50)).await;
        }
        let action = round % 4;
        assert_eq!(env.step(action).await.expect("steps"), twin.step(action).await.expect("steps"));
    }
    assert!(cut > 5);
    assert_eq!(env.session_id(), id);
    // A seeded reset is repeated even where the break comes in its midst.
    proxy.cut();
    let (first, _) = env.reset(Some(9)).await.expect("resets");
    assert_eq!(first, twin.reset(Some(9)).await.expect("resets").0);
    env.close().await.expect("closes");
}

#[tokio::test]
async fn a_dropped_call_does_not_shift_the_answers() {
    let server = EnvServer::start();
    let connection = Connection::open(&server.address()).await.expect("connects");
    let make = || VectorEnv::create(&connection, "Maze-v0", 2, Autoreset::NextStep, SessionOptions::default());
    let (mut envs, mut twin) = (make().await.expect("makes"), make().await.expect("makes"));
    envs.reset(1).await.expect("resets");
    twin.reset(1).await.expect("resets");
    for i in 0..20 {
        // Polled once: the request is sent, its answer is not awaited.
        let dropped = tokio::time::timeout(Duration::ZERO, envs.step(&[i % 4, 1])).await;
        let _ = dropped;
    }
    // A reset says where both are, whatever was carried out.
    let first = envs.reset(Seeds::Each(vec![7, 8])).await.expect("resets");
    assert_eq!(first, twin.reset(7).await.expect("resets"));
    for i in 0..20 {
        let actions = [i % 4, (i + 1) % 4];
        assert_eq!(envs.step(&actions).await.expect("steps"), twin.step(&actions).await.expect("steps"));
    }
}

#[tokio::test]
async fn many_steps_under_way_never_block_for_good() {
    let server = EnvServer::start();
    let connection = Connection::open(&server.address()).await.expect("connects");
    let options = SessionOptions { max_episode_steps: Some(0), ..SessionOptions::default() };
    let make = || VectorEnv::create(&connection, "Highway-v0", 1000, Autoreset::NextStep, options.clone());
    let (mut envs, mut twin) = (make().await.expect("makes"), make().await.expect("makes"));
    envs.reset(1).await.expect("resets");
    twin.reset(1).await.expect("resets");
    // Answers of 34 kB: far more than may be on the wire.
    for i in 0..600 {
        envs.send_step(&[i % 12; 1000]).await.expect("sends");
    }
    for i in 0..600 {
        let expected = twin.step(&[i % 12; 1000]).await.expect("steps");
        assert_eq!(envs.receive_step().await.expect("receives"), expected);
    }
    let error = envs.receive_step().await.expect_err("nothing is under way");
    assert_eq!(error.field(), Some("request"), "{error}");
    // Without a reader, the answers of a failed stream come first and its failure last.
    for action in [0, 1, 99, 2] {
        envs.send_step(&[action; 1000]).await.expect("sends");
    }
    for action in [0, 1] {
        let expected = twin.step(&[action; 1000]).await.expect("steps");
        assert_eq!(envs.receive_step().await.expect("receives"), expected);
    }
    let error = envs.receive_step().await.expect_err("no such action");
    assert_eq!((error.code(), error.field()), (Code::InvalidArgument, Some("actions[0]")));
    for _ in 0..4096 {
        envs.send_step(&[0; 1000]).await.expect("sends");
    }
    let error = envs.send_step(&[0; 1000]).await.expect_err("too many");
    assert_eq!(error.field(), Some("request"), "{error}");
}

#[tokio::test]
async fn a_client_that_reads_nothing_is_held_back_and_loses_nothing() {
    const MANY: usize = 20_000;
    let server = EnvServer::start();
    let mut service = service(&server).await;
    // Stepped where the request is read, and on another thread.
    for num_envs in [200, 2000] {
        let request = || pb::CreateSessionRequest { num_envs, max_episode_steps: Some(0), ..maze() };
        let (id, twin) = (create(&mut service, request()).await, create(&mut service, request()).await);
        let (requests, mut answers) = interact(&mut service).await;
        send(&requests, Request::Reset(reset(&id, 1))).await;
        let (mut sent, actions) = (0, |step: usize| vec![(step % 4) as i32; num_envs as usize]);
        while sent < MANY {
            let one = send(&requests, Request::Step(step("", &actions(sent))));
            if tokio::time::timeout(Duration::from_secs(1), one).await.is_err() {
                break;
            }
            sent += 1;
        }
        assert!(sent < MANY, "{sent} answers of {} bytes wait somewhere", num_envs * 22);
        service.reset(reset(&twin, 1)).await.expect("resets");
        answers.message().await.expect("answers").expect("an answer");
        for i in 0..sent {
            let answer = answers.message().await.expect("answers").expect("an answer").response;
            let expected = service.step(step(&twin, &actions(i))).await.expect("steps").into_inner();
            assert!(answer == Some(pb::interact_response::Response::Step(expected)), "answer {i}");
        }
    }
}

#[tokio::test]
async fn a_client_that_is_dropped_frees_its_session() {
    let server = EnvServer::with(Config { max_sessions: 1, ..config() });
    let connection = Connection::open(&server.address()).await.expect("connects");
    for _ in 0..10 {
        let mut tries = 0;
        let mut env = loop {
            match Env::create(&connection, "Maze-v0", SessionOptions::default()).await {
                Ok(env) => break env,
                Err(error) => assert_eq!(error.code(), Code::ResourceExhausted),
            }
            tries += 1;
            assert!(tries < 500, "the session stays");
            sleep(Duration::from_millis(10)).await;
        };
        let (observation, _) = env.reset(Some(1)).await.expect("resets");
        assert!(matches!(observation, Observation::Discrete(_)));
    }
}

#[tokio::test]
async fn a_closed_environment_says_so() {
    let server = EnvServer::start();
    let mut env = Env::connect(&server.address(), "Maze-v0", SessionOptions::default()).await.expect("connects");
    env.reset(Some(1)).await.expect("resets");
    env.close().await.expect("closes");
    env.close().await.expect("a second time does nothing");
    let error = env.step(0).await.expect_err("it is closed");
    assert_eq!(error.field(), Some("session_id"), "{error}");
}

#[tokio::test]
async fn nobody_there_is_an_error_with_the_address() {
    let address = {
        let server = EnvServer::start();
        server.address()
    };
    let error = Connection::open(&address).await.expect_err("nobody is there");
    assert!(matches!(error, ClientError::Connect { .. }) && error.to_string().contains(&address), "{error}");
    let error = Connection::open("not an address").await.expect_err("no address");
    assert!(matches!(error, ClientError::Address { .. }), "{error}");
}
