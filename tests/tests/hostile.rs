//! `EnvironmentService` against a client that means harm: whatever it sends, it is told the code and the field, in a status
//! small enough to arrive, and the server serves the next one.

use mazeway_client::{ClientError, Code, channel, packed::pack};
use mazeway_proto::env::{
    self as pb, environment_service_client::EnvironmentServiceClient, rollout_request::Controller,
};
use mazeway_server::Config;
use mazeway_tests::{EnvServer, config};
use prost_types::{ListValue, Struct, Value, value::Kind};
use std::fmt::Debug;
use tonic::{Status, transport::Channel};

type Service = EnvironmentServiceClient<Channel>;

async fn service(server: &EnvServer) -> Service {
    EnvironmentServiceClient::new(channel(&server.address()).await.expect("a channel"))
}

#[track_caller]
fn refused<T: Debug>(outcome: Result<T, Status>, code: Code, field: &str) {
    let error = ClientError::from(outcome.expect_err("it is refused"));
    assert_eq!((error.code(), error.field()), (code, Some(field)), "{error}");
    assert!(error.to_string().len() < 1200, "{} bytes", error.to_string().len());
}

fn of(kind: Kind) -> Value {
    Value { kind: Some(kind) }
}

fn object(pairs: &[(&str, Kind)]) -> Struct {
    Struct { fields: pairs.iter().map(|(name, kind)| ((*name).to_owned(), of(kind.clone()))).collect() }
}

fn session(env_id: &str, options: Struct) -> pb::CreateSessionRequest {
    pb::CreateSessionRequest { env_id: env_id.into(), options: Some(options), ..Default::default() }
}

/// One value of each kind, none of which is small or plain.
fn odd_values() -> Vec<Kind> {
    let mut deep = Kind::NumberValue(1.0);
    for _ in 0..30 {
        deep = Kind::ListValue(ListValue { values: vec![of(deep)] });
    }
    vec![
        Kind::NullValue(0),
        Kind::BoolValue(true),
        Kind::NumberValue(-1.0),
        Kind::NumberValue(1e308),
        Kind::NumberValue(0.5),
        Kind::NumberValue(f64::NAN),
        Kind::NumberValue(f64::NEG_INFINITY),
        Kind::StringValue(String::new()),
        Kind::StringValue("ü\n\0".repeat(100_000)),
        Kind::ListValue(ListValue { values: vec![] }),
        Kind::ListValue(ListValue { values: vec![of(Kind::NumberValue(f64::INFINITY)); 1000] }),
        Kind::ListValue(ListValue { values: vec![of(Kind::StringValue("..".into())), of(Kind::NullValue(0))] }),
        Kind::StructValue(object(&[("a", Kind::StringValue("b".repeat(10_000)))])),
        deep,
    ]
}

#[tokio::test]
async fn options_of_every_kind_are_taken_or_refused_by_name() {
    let server = EnvServer::start();
    let mut service = service(&server).await;
    let environments = service.list_environments(pb::ListEnvironmentsRequest {}).await.expect("lists").into_inner();
    let mut refusals = 0;
    for spec in environments.environments {
        for option in &spec.options {
            for value in odd_values() {
                let options = object(&[(option.name.as_str(), value.clone())]);
                let model = pb::GetModelRequest { env_id: spec.env_id.clone(), options: Some(options.clone()) };
                match service.create_session(session(&spec.env_id, options)).await {
                    Ok(made) => {
                        let session_id = made.into_inner().session_id;
                        service.close_session(pb::CloseSessionRequest { session_id }).await.expect("closes");
                    }
                    Err(status) => {
                        let error = ClientError::from(status);
                        let field = error.field().unwrap_or_default().to_owned();
                        assert_eq!(error.code(), Code::InvalidArgument, "{error}");
                        assert!(field.starts_with(&format!("options.{}", option.name)), "{field:?}: {error}");
                        assert!(error.to_string().len() < 1200);
                        // The other call that takes options says the same.
                        refused(service.get_model(model).await.map(|_| ()), Code::InvalidArgument, &field);
                        refusals += 1;
                    }
                }
            }
        }
    }
    assert!(refusals > 60, "{refusals} refusals");
}

#[tokio::test]
async fn what_is_repeated_of_a_large_request_is_short() {
    let server = EnvServer::start();
    let mut service = service(&server).await;
    let long = "ü".repeat(1 << 20);
    let shown = format!("{}… ({} bytes)", "ü".repeat(80), long.len());
    let none = Struct::default();
    refused(service.create_session(session(&long, none)).await, Code::NotFound, "env_id");
    let options = object(&[(long.as_str(), Kind::BoolValue(true))]);
    let field = format!("options.{shown}");
    refused(service.create_session(session("Maze-v0", options)).await, Code::InvalidArgument, &field);
    let options = object(&[(long.as_str(), Kind::NumberValue(f64::NAN))]);
    refused(service.create_session(session("Maze-v0", options)).await, Code::InvalidArgument, &field);
    let rollout = pb::RolloutRequest {
        env_id: "Maze-v0".into(),
        controller: Some(Controller::Driver(long.clone())),
        episodes: 1,
        steps: 1,
        ..Default::default()
    };
    refused(service.rollout(rollout).await.map(|_| ()), Code::InvalidArgument, "driver");
    let close = pb::CloseSessionRequest { session_id: long };
    refused(service.close_session(close).await, Code::NotFound, "session_id");
}

/// Long keys at every level of a deep value: the path to what is wrong is written once, and for the error alone.
#[tokio::test]
async fn deep_values_with_long_keys_cost_no_more_than_themselves() {
    let server = EnvServer::start();
    let mut service = service(&server).await;
    let key = "k".repeat(100_000);
    let mut value = Kind::NumberValue(f64::NAN);
    for _ in 0..25 {
        value = Kind::StructValue(object(&[(key.as_str(), value)]));
    }
    let options = object(&[("layout", value)]);
    let error = ClientError::from(service.create_session(session("Maze-v0", options)).await.expect_err("refused"));
    assert_eq!(error.code(), Code::InvalidArgument);
    let field = error.field().expect("a field");
    assert!(field.starts_with("options.layout.kkk") && field.len() < 400, "{field}");
}

#[tokio::test]
async fn arrays_of_every_length_are_checked_before_they_are_read() {
    let server = EnvServer::start();
    let mut service = service(&server).await;
    let request = pb::CreateSessionRequest { num_envs: 3, ..session("Highway-v0", Struct::default()) };
    let session_id = service.create_session(request).await.expect("a session").into_inner().session_id;
    let reset = |seeds: usize, mask: usize| pb::ResetRequest {
        session_id: session_id.clone(),
        seed: None,
        seeds: vec![0xff; seeds].into(),
        reset_mask: vec![1; mask].into(),
    };
    for wrong in [1, 8, 23, 25, 1 << 20] {
        refused(service.reset(reset(wrong, 0)).await, Code::InvalidArgument, "seeds");
    }
    for wrong in [1, 2, 4, 1 << 20] {
        refused(service.reset(reset(0, wrong)).await, Code::InvalidArgument, "reset_mask");
    }
    service.reset(reset(24, 3)).await.expect("resets");
    let step = |actions: Vec<u8>| pb::StepRequest { session_id: session_id.clone(), actions: actions.into() };
    for wrong in [0, 1, 11, 13, 24, 1 << 20] {
        refused(service.step(step(vec![0; wrong])).await, Code::InvalidArgument, "actions");
    }
    refused(service.step(step(vec![0xff; 12])).await, Code::InvalidArgument, "actions[0]");
    let actions = pack([0_i32, 1, 2]);
    service.step(pb::StepRequest { session_id, actions }).await.expect("steps");
    for num_envs in [u32::MAX, 1 << 31, 1 << 20] {
        let request = pb::CreateSessionRequest { num_envs, ..session("Highway-v0", Struct::default()) };
        refused(service.create_session(request).await, Code::ResourceExhausted, "num_envs");
    }
    for (seconds, nanos) in [(i64::MAX, 999_999_999), (i64::MIN, 0), (-1, 0), (0, -1), (0, 0), (1, i32::MIN)] {
        let lease = Some(prost_types::Duration { seconds, nanos });
        let request = pb::CreateSessionRequest { lease, ..session("Maze-v0", Struct::default()) };
        refused(service.create_session(request).await, Code::InvalidArgument, "lease");
    }
}

#[tokio::test]
async fn limits_beyond_all_numbers_are_as_good_as_none() {
    let most = usize::MAX;
    let config = Config {
        max_sessions: most,
        max_envs_per_session: most,
        max_total_envs: most,
        max_concurrent_rollouts: most,
        max_concurrent_models: most,
        max_viewers: most,
        ..config()
    };
    let server = EnvServer::with(config);
    let mut service = service(&server).await;
    service.create_session(session("Maze-v0", Struct::default())).await.expect("a session");
    let model = pb::GetModelRequest { env_id: "Maze-v0".into(), options: None };
    service.get_model(model).await.expect("a model");
    let rollout = pb::RolloutRequest {
        env_id: "Maze-v0".into(),
        controller: Some(Controller::Driver("random".into())),
        episodes: 1,
        steps: 1,
        ..Default::default()
    };
    service.rollout(rollout).await.expect("a roll-out");
}

#[tokio::test]
async fn a_caller_learns_no_more_of_the_others_than_that_there_is_no_room() {
    let server = EnvServer::with(Config { max_total_envs: 10_000, ..config() });
    let mut service = service(&server).await;
    let of = |num_envs| pb::CreateSessionRequest { num_envs, ..session("Maze-v0", Struct::default()) };
    service.create_session(of(7_654)).await.expect("a session");
    let error = service.create_session(of(3_000)).await.expect_err("no room");
    let (message, details) = (error.message(), String::from_utf8_lossy(error.details()));
    assert!(message.contains("10000") && message.contains("3000 more"), "{message}");
    // Neither what others have, nor what it would make.
    for told in ["7654", "10654"] {
        assert!(!message.contains(told) && !details.contains(told), "{message}");
    }
}
