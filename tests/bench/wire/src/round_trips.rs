//! One step of one maze, asked for and waited for.

use crate::{
    Setting,
    figures::{Report, Subject, in_rounds, mode_name},
    peers::{Peers, Raw, Tonic},
    process::Process,
};
use mazeway_client::{Env, SessionOptions, channel, packed::pack};
use mazeway_proto::env::{
    self as pb, environment_service_client::EnvironmentServiceClient, interact_request, interact_response,
};
use prost::Message as _;
use serde_json::json;
use std::sync::Arc;
use tokio::{runtime::Runtime, sync::Mutex};
use tonic::transport::Channel;

/// Episodes that never end by the clock.
pub fn endless() -> SessionOptions {
    SessionOptions { max_episode_steps: Some(0), ..SessionOptions::default() }
}

pub fn current_thread() -> Runtime {
    tokio::runtime::Builder::new_current_thread().enable_all().build().expect("a runtime")
}

/// Bytes of a step's request and of its answer, as the messages of the protocol, without gRPC's frame.
pub async fn sizes(address: &str, env_id: &str, num_envs: u32) -> (usize, usize) {
    let (mut service, session_id) = unary(address, env_id, num_envs).await;
    let mut step = pb::StepRequest { session_id: session_id.clone(), actions: vec![0; 4 * num_envs as usize].into() };
    let answer = service.step(step.clone()).await.expect("steps").into_inner();
    service.close_session(pb::CloseSessionRequest { session_id }).await.expect("closes");
    // On a stream, all but the first message leave it out.
    step.session_id.clear();
    let request = pb::InteractRequest { request: Some(interact_request::Request::Step(step)) };
    let answer = pb::InteractResponse { response: Some(interact_response::Response::Step(answer)) };
    (request.encoded_len(), answer.encoded_len())
}

async fn open(setting: &Setting, address: &str) -> Env {
    let mut env = Env::create(&setting.connect(address).await, "Maze-v0", endless()).await.expect("a session");
    env.reset(Some(1)).await.expect("resets");
    env
}

/// A session for unary calls, after its reset.
async fn unary(address: &str, env_id: &str, num_envs: u32) -> (EnvironmentServiceClient<Channel>, String) {
    let channel = channel(address).await.expect("connects");
    let mut service = EnvironmentServiceClient::new(channel).max_decoding_message_size(64 << 20);
    let make =
        pb::CreateSessionRequest { env_id: env_id.into(), num_envs, max_episode_steps: Some(0), ..Default::default() };
    let session_id = service.create_session(make).await.expect("a session").into_inner().session_id;
    let reset = pb::ResetRequest { session_id: session_id.clone(), seed: Some(1), ..Default::default() };
    service.reset(reset).await.expect("resets");
    (service, session_id)
}

pub fn measure(setting: &Setting, report: &mut Report) {
    let (peers, tcp) = (Peers::start(), Process::server(setting, "127.0.0.1:0"));
    let directory = tempfile::tempdir().expect("a directory");
    let unix = Process::server(setting, &format!("unix:{}", directory.path().join("server.sock").display()));
    let runtime = current_thread();
    let multi = tokio::runtime::Builder::new_multi_thread().enable_all().build().expect("a runtime");

    let (request, reply) = runtime.block_on(sizes(tcp.address(), "Maze-v0", 1));
    // A gRPC message has five bytes before it; the sockets carry them too.
    let mut raw_tcp = Raw::tcp(&peers.raw_tcp, request + 5, reply + 5);
    let mut raw_unix = Raw::unix(&peers.raw_unix, request + 5, reply + 5);
    let bidi = |address: &str| runtime.block_on(async { Tonic::connect(address, request, reply).await.bidi(1).await });
    let (mut bidi_tcp, mut bidi_unix) = (bidi(&peers.tonic_tcp), bidi(&peers.tonic_unix));
    let mut bidi_multi = bidi(&peers.tonic_multi_thread);
    let mut unary_tcp = runtime.block_on(Tonic::connect(&peers.tonic_tcp, request, reply));
    let mut env_tcp = runtime.block_on(open(setting, tcp.address()));
    let mut env_unix = runtime.block_on(open(setting, unix.address()));
    let env_multi = Arc::new(Mutex::new(multi.block_on(open(setting, tcp.address()))));
    let (mut service, id) = runtime.block_on(unary(tcp.address(), "Maze-v0", 1));

    let mut subjects = [
        Subject::new("raw_tcp", |times| (0..times).for_each(|_| raw_tcp.round_trip())),
        Subject::new("raw_unix", |times| (0..times).for_each(|_| raw_unix.round_trip())),
        Subject::new("tonic_bidi_tcp", |times| runtime.block_on(ping(&mut bidi_tcp, times))),
        Subject::new("tonic_bidi_unix", |times| runtime.block_on(ping(&mut bidi_unix, times))),
        Subject::new("tonic_bidi_tcp_multi_thread", |times| runtime.block_on(ping(&mut bidi_multi, times))),
        Subject::new("tonic_unary_tcp", |times| {
            runtime.block_on(async {
                for _ in 0..times {
                    unary_tcp.unary().await;
                }
            });
        }),
        Subject::new("env_step_tcp", |times| runtime.block_on(steps(&mut env_tcp, times))),
        Subject::new("env_step_unix", |times| runtime.block_on(steps(&mut env_unix, times))),
        // On a task of the runtime, as a program under #[tokio::main] that spawns its work.
        Subject::new("env_step_tcp_multi_thread", |times| {
            let env = Arc::clone(&env_multi);
            let task = multi.spawn(async move { steps(&mut *env.lock().await, times).await });
            multi.block_on(task).expect("steps");
        }),
        Subject::new("unary_step_tcp", |times| {
            runtime.block_on(async {
                for i in 0..times {
                    let step = pb::StepRequest { session_id: id.clone(), actions: pack([(i % 4) as u32]) };
                    service.step(step).await.expect("steps");
                }
            });
        }),
    ];
    let spreads = in_rounds(&mut subjects, setting.rounds, setting.slice);
    for (subject, spread) in subjects.iter().zip(spreads) {
        let record = json!({"mode": mode_name(setting.mode), "name": subject.name});
        report.push("round_trips", record, spread);
    }
}

async fn ping(bidi: &mut crate::peers::Bidi, times: u64) {
    for _ in 0..times {
        bidi.send().await;
        bidi.receive().await;
    }
}

async fn steps(env: &mut Env, times: u64) {
    for i in 0..times {
        env.step((i % 4) as u32).await.expect("steps");
    }
}
