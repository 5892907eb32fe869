//! A connection without a network: whatever bytes come, each frame is answered with a frame, and a step's answer is the
//! very message that the generated code would have written.

use super::{process::Process, specs::Specs, world::World};
use crate::{
    batch::{Autoreset, Batch as _, BatchOptions},
    config::Config,
    grpc::host::Host,
    registry::{Options, Registry},
};
use bytes::{Bytes, BytesMut};
use mazeway_proto::dm_env::{
    self as pb, EnvironmentStateType,
    environment_request::Payload as Request,
    environment_response::Payload as Response,
    tensor::{self, Payload},
};
use proptest::prelude::*;
use prost::Message as _;
use std::sync::Arc;
use tokio_util::sync::CancellationToken;

fn process() -> Process {
    let telemetry = mazeway_serving::Telemetry::new("test");
    let config = Config { max_total_envs: 64, ..Config::default() };
    let host = Host::new(config, &telemetry, CancellationToken::new());
    Process::new(Arc::new(host), mazeway_serving::Caller::anybody())
}

fn runtime() -> tokio::runtime::Runtime {
    tokio::runtime::Builder::new_current_thread().enable_all().build().expect("a runtime")
}

fn frame(payload: Request) -> Bytes {
    pb::EnvironmentRequest { payload: Some(payload) }.encode_to_vec().into()
}

async fn ask(process: &mut Process, request: Bytes) -> Response {
    let answer = process.answer(request).await;
    pb::EnvironmentResponse::decode(answer).expect("a response").payload.expect("a payload")
}

fn text(text: &str) -> pb::Tensor {
    pb::Tensor { payload: Some(Payload::Strings(tensor::StringArray { array: vec![text.into()] })), shape: vec![] }
}

/// A connection in a world of one highway, seeded.
async fn joined() -> Process {
    let mut process = process();
    let seed =
        pb::Tensor { payload: Some(Payload::Uint8s(tensor::Uint8Array { array: vec![9].into() })), shape: vec![] };
    let settings = [("env_id".to_owned(), text("Highway-v0")), ("seed".to_owned(), seed)].into();
    let created = ask(&mut process, frame(Request::CreateWorld(pb::CreateWorldRequest { settings }))).await;
    let Response::CreateWorld(pb::CreateWorldResponse { world_name }) = created else { panic!("{created:?}") };
    let join = pb::JoinWorldRequest { world_name, settings: [].into() };
    let answer = ask(&mut process, frame(Request::JoinWorld(join))).await;
    assert!(matches!(answer, Response::JoinWorld(_)), "{answer:?}");
    process
}

fn step(action: i32, observations: Vec<u64>) -> Bytes {
    let array = vec![action];
    let action = pb::Tensor { payload: Some(Payload::Int32s(tensor::Int32Array { array })), shape: vec![] };
    frame(Request::Step(pb::StepRequest { actions: [(1, action)].into(), requested_observations: observations }))
}

#[test]
fn a_step_is_written_as_the_generated_code_writes_it() {
    for (env_id, options) in [("Maze-v0", "{}"), ("Highway-v0", "{\"observation\": \"kinematics\"}")] {
        for (num_envs, batched) in [(1, false), (1, true), (3, true), (200, true)] {
            let options: Options = serde_json::from_str(options).expect("options");
            let environment = Registry::new().configure(env_id, &options).expect("an environment");
            let made =
                BatchOptions { num_envs, autoreset: Autoreset::NextStep, max_episode_steps: 2, action_masks: true };
            let mut world = World::new(environment.batch(made), batched, options, Some(u64::MAX));
            world.begin().expect("begins");
            world.step(&vec![0; 4 * num_envs]).expect("steps");
            world.step(&vec![0; 4 * num_envs]).expect("steps");
            let specs = Specs::of(&world);
            let wire = specs.to_proto();
            let all: Vec<u64> = wire.observations.keys().copied().collect();
            for asked in [vec![], vec![2], vec![3, 1, 3], all] {
                let requested = specs.requested(&asked).expect("known");
                let (mut bytes, mut lengths) = (BytesMut::new(), Vec::new());
                let state = EnvironmentStateType::Interrupted;
                specs.write_step(world.buffers(), state, requested, &mut lengths, &mut bytes);
                let decoded = pb::EnvironmentResponse::decode(&bytes[..]).expect("a response");
                assert_eq!(decoded.encode_to_vec(), bytes, "{env_id} {num_envs} {asked:?}");
                let Some(Response::Step(answer)) = decoded.payload else { panic!("{decoded:?}") };
                let mut numbers = asked.clone();
                numbers.sort_unstable();
                numbers.dedup();
                assert_eq!(answer.observations.keys().copied().collect::<Vec<_>>(), numbers);
                assert_eq!(answer.state(), state);
                for (number, tensor) in answer.observations {
                    assert_eq!(tensor.shape, wire.observations[&number].shape);
                    assert!(tensor.shape.first().is_none_or(|&first| !batched || first == num_envs as i32));
                }
            }
        }
    }
}

#[test]
fn a_step_needs_no_memory_beyond_its_request() {
    runtime().block_on(async {
        let mut process = joined().await;
        process.answer(step(4, vec![1])).await;
        // The same request, of one observation and of all: what decoding takes, and the handle of the answer's frame.
        for request in [step(4, vec![1]), step(4, (1..=9).collect())] {
            let answers = process.answer(request.clone());
            let future = std::cell::RefCell::new(Some(Box::pin(answers)));
            let counted = allocation_counter::measure(|| {
                let mut answers = future.borrow_mut().take().expect("once");
                let waker = std::task::Waker::noop();
                let poll = answers.as_mut().poll(&mut std::task::Context::from_waker(waker));
                assert!(poll.is_ready());
            });
            assert!(counted.count_total <= 12, "{counted:?}");
        }
    });
}

proptest! {
    #![proptest_config(ProptestConfig { cases: 400, ..ProptestConfig::default() })]

    #[test]
    fn any_bytes_are_answered(requests in proptest::collection::vec(proptest::collection::vec(any::<u8>(), 0..60), 1..6)) {
        runtime().block_on(async {
            let mut process = joined().await;
            for request in requests {
                ask(&mut process, request.into()).await;
            }
        });
    }

    /// A request that is right but for one byte: what comes of it is an answer, and the world is still there.
    #[test]
    fn a_damaged_request_is_answered(place in any::<prop::sample::Index>(), value in any::<u8>(), cut in any::<prop::sample::Index>()) {
        runtime().block_on(async {
            let mut process = joined().await;
            for whole in [step(3, vec![1, 2, 3]), step(3, (1..=9).collect())] {
                let mut damaged = whole.to_vec();
                let place = place.index(damaged.len());
                damaged[place] = value;
                ask(&mut process, damaged.clone().into()).await;
                damaged.truncate(cut.index(damaged.len()));
                ask(&mut process, damaged.into()).await;
                let answer = ask(&mut process, whole).await;
                // Damage may have made it a request to leave.
                prop_assert!(matches!(answer, Response::Step(_) | Response::Error(_)), "{answer:?}");
            }
            Ok(())
        })?;
    }
}
