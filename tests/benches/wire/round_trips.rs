//! One step of one maze, asked for and waited for.

use crate::{
    Setting,
    figures::{Report, Subject, in_rounds, mode_name},
    peers::{Peers, Raw, Tonic},
};
use mazeway_client::{Autoreset, Connection, Env, SessionOptions, VectorEnv, channel, packed::pack};
use mazeway_proto::env::{
    self as pb, environment_service_client::EnvironmentServiceClient, interact_request, interact_response,
};
use mazeway_server::{
    batch::{self, BatchOptions, Layout},
    registry::Registry,
};
use mazeway_tests::programs::Service;
use prost::Message as _;
use serde_json::{Map, json};
use std::{process::Command, sync::Arc};
use tokio::{runtime::Runtime, sync::Mutex};

/// Episodes that never end by the clock.
pub fn endless() -> SessionOptions {
    SessionOptions { max_episode_steps: Some(0), ..SessionOptions::default() }
}

/// A server without limits that would get in the way.
pub fn server(setting: &Setting, listen: &str) -> Service {
    let mut command = Command::new(&setting.server);
    command.args(["--listen", listen, "--max-envs-per-session", "65536", "--max-total-envs", "1000000"]);
    command.args(["--max-sessions", "20000", "--max-connections", "20000", "--default-lease-secs", "3000"]);
    for (name, _) in std::env::vars().filter(|(name, _)| name.starts_with("MAZEWAY_")) {
        command.env_remove(name);
    }
    Service::start(command)
}

pub fn current_thread() -> Runtime {
    tokio::runtime::Builder::new_current_thread().enable_all().build().expect("a runtime")
}

/// Bytes of a step's request and of its answer, as the messages of the protocol, without gRPC's frame.
pub fn sizes(env_id: &str, num_envs: usize) -> (usize, usize) {
    let environment = Registry::new().configure(env_id, &Map::new()).expect("an environment");
    let autoreset = batch::Autoreset::NextStep;
    let options = BatchOptions { num_envs, autoreset, max_episode_steps: 0, action_masks: false };
    let layout = Layout::of(environment.spec(), options);
    let zeros = |range: &std::ops::Range<usize>| vec![0; range.len()].into();
    let answer = pb::StepResponse {
        observations: zeros(&layout.observations),
        rewards: zeros(&layout.rewards),
        terminated: zeros(&layout.terminated),
        truncated: zeros(&layout.truncated),
        infos: layout.infos.iter().map(zeros).collect(),
        ..Default::default()
    };
    let request = pb::StepRequest { session_id: String::new(), actions: vec![0; 4 * num_envs].into() };
    let request = pb::InteractRequest { request: Some(interact_request::Request::Step(request)) };
    let answer = pb::InteractResponse { response: Some(interact_response::Response::Step(answer)) };
    (request.encoded_len(), answer.encoded_len())
}

async fn open(address: &str) -> Env {
    let mut env = Env::connect(address, "Maze-v0", endless()).await.expect("a session");
    env.reset(Some(1)).await.expect("resets");
    env
}

/// The RPC `Step`.
async fn unary(address: &str) -> (EnvironmentServiceClient<tonic::transport::Channel>, String) {
    let connection = Connection::open(address).await.expect("connects");
    let make = VectorEnv::create(&connection, "Maze-v0", 1, Autoreset::NextStep, endless());
    let made = make.await.expect("a session");
    let id = made.session_id().to_owned();
    // The session must live on without its maker, which would end it.
    std::mem::forget(made);
    let mut service = EnvironmentServiceClient::new(channel(address).await.expect("connects"));
    let reset = pb::ResetRequest { session_id: id.clone(), seed: Some(1), ..Default::default() };
    service.reset(reset).await.expect("resets");
    (service, id)
}

pub fn measure(setting: &Setting, report: &mut Report) {
    let (request, reply) = sizes("Maze-v0", 1);
    let peers = Peers::start();
    let tcp = server(setting, "127.0.0.1:0");
    let runtime = current_thread();
    let multi = tokio::runtime::Builder::new_multi_thread().enable_all().build().expect("a runtime");

    // A gRPC message has five bytes before it; the sockets carry them too.
    let mut raw_tcp = Raw::tcp(&peers.raw_tcp, request + 5, reply + 5);
    let mut raw_unix = Raw::unix(&peers.raw_unix, request + 5, reply + 5);
    let bidi = |address: &str| runtime.block_on(async { Tonic::connect(address, request, reply).await.bidi(1).await });
    let (mut bidi_tcp, mut bidi_unix) = (bidi(&peers.tonic_tcp), bidi(&peers.tonic_unix));
    let mut bidi_multi = bidi(&peers.tonic_multi_thread);
    let mut unary_tcp = runtime.block_on(Tonic::connect(&peers.tonic_tcp, request, reply));
    let mut env_tcp = runtime.block_on(open(tcp.address()));
    let env_multi = Arc::new(Mutex::new(multi.block_on(open(tcp.address()))));
    let (mut service, id) = runtime.block_on(unary(tcp.address()));

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
