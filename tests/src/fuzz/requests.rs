//! Requests to both services, mutated after their encoding, over real sockets: what the wire lets through must end in an
//! answer or in a status that blames the caller.
//!
//! The first byte of an input chooses the method, the rest is the message. Where a message belongs into a stream, it comes
//! after what makes it sensible: a reset before a step, a world joined before anything is done in it.

use crate::{EnvServer, config, learner::LearnerServer, learner::trajectory, memory};
use bytes::Bytes;
use mazeway_client::packed::pack;
use mazeway_learner::config::Limits;
use mazeway_proto::{
    dm_env::{self, environment_request::Payload},
    env::{self, interact_request},
    learner as pb,
    raw::Raw,
};
use mazeway_server::Config;
use prost::Message;
use std::{cell::RefCell, time::Duration};
use tokio::{runtime::Runtime, time::timeout};
use tonic::{Code, Request, Status, client::Grpc, codegen::http::uri::PathAndQuery, transport::Channel};

/// Stands in inputs for the id of the session and the name of the world that are there.
const SESSION: &[u8; 32] = b"session-session-session-session-";
/// Calls after which services begin anew, so that what was let in does not pile up.
const CALLS: u32 = 200_000;
/// Calls after which there is a new connection: a server ends one on which what comes too late for a call that it has refused, since
/// they follow each other so fast, amounts to some hundred frames.
const CALLS_OF_A_CONNECTION: u32 = 100;
/// Messages of an answer that are read; of those who watch one, as they wait for the next.
const READ: usize = 4;
/// Time that an answer may take, on a machine that is busy.
const PATIENCE: Duration = Duration::from_secs(20);

const ENVIRONMENTS: &str = "/mazeway.env.v1.EnvironmentService/";
const LEARNER: &str = "/mazeway.learner.v1.LearnerService/";
const WORLDS: &str = "/dm_env_rpc.v1.Environment/Process";

/// Services that live as long as their thread.
struct Peers {
    runtime: Runtime,
    environments: Channel,
    learner: Channel,
    session: String,
    world: String,
    calls: u32,
    server: EnvServer,
    learner_server: LearnerServer,
    _data: tempfile::TempDir,
}

impl Peers {
    fn start() -> Self {
        let data = memory();
        let runtime = tokio::runtime::Builder::new_current_thread().enable_all().build().expect("a runtime");
        let limits = Config {
            max_envs_per_session: 64,
            max_sessions: 100_000,
            max_total_envs: 1_000_000,
            max_rollout_steps: 1_000_000,
            ..config()
        };
        let server = EnvServer::with(Config { threads: 1, ..limits });
        let learner = LearnerServer::with(data.path(), Limits { max_fit_iterations: 100, ..Limits::default() });
        let (environments, of_learner) = connect(&runtime, &server, &learner);
        let mut peers = Self {
            runtime,
            environments,
            learner: of_learner,
            session: String::new(),
            world: String::new(),
            calls: 0,
            server,
            learner_server: learner,
            _data: data,
        };
        let lease = Some(prost_types::Duration { seconds: 3600, nanos: 0 });
        let create = env::CreateSessionRequest { env_id: "Maze-v0".into(), num_envs: 2, lease, ..Default::default() };
        let made = peers.ask(&format!("{ENVIRONMENTS}CreateSession"), vec![create.encode_to_vec()]).expect("a session");
        peers.session = env::CreateSessionResponse::decode(made[0].clone()).expect("a session").session_id;
        // Who watches one that has not begun waits for it.
        let reset = env::ResetRequest { session_id: peers.session.clone(), ..Default::default() };
        peers.ask(&format!("{ENVIRONMENTS}Reset"), vec![reset.encode_to_vec()]).expect("it begins");
        let text = |text: &str| dm_env::Tensor {
            payload: Some(dm_env::tensor::Payload::Strings(dm_env::tensor::StringArray { array: vec![text.into()] })),
            ..Default::default()
        };
        let number = |number: f64| dm_env::Tensor {
            payload: Some(dm_env::tensor::Payload::Doubles(dm_env::tensor::DoubleArray { array: vec![number] })),
            ..Default::default()
        };
        let settings = [("env_id".into(), text("Maze-v0")), ("lease_secs".into(), number(3600.0))].into();
        let create = Payload::CreateWorld(dm_env::CreateWorldRequest { settings });
        let made = peers.ask(WORLDS, vec![worlds(create)]).expect("a world");
        let made = dm_env::EnvironmentResponse::decode(made[0].clone()).expect("a world");
        let Some(dm_env::environment_response::Payload::CreateWorld(made)) = made.payload else { panic!("{made:?}") };
        peers.world = made.world_name;
        peers
    }

    fn connect(&mut self) {
        (self.environments, self.learner) = connect(&self.runtime, &self.server, &self.learner_server);
    }

    /// The messages of the answer.
    fn ask(&self, path: &str, messages: Vec<Vec<u8>>) -> Result<Vec<Bytes>, Status> {
        let channel = if path.starts_with(LEARNER) { &self.learner } else { &self.environments };
        let mut grpc = Grpc::new(channel.clone());
        let wanted = if path.ends_with("/Watch") { 1 } else { READ };
        let path: PathAndQuery = path.parse().expect("a path");
        let messages = tokio_stream::iter(messages.into_iter().map(Bytes::from).collect::<Vec<_>>());
        self.runtime.block_on(async {
            let answer = async {
                grpc.ready().await.map_err(|error| Status::unavailable(error.to_string()))?;
                let mut answers = grpc.streaming(Request::new(messages), path, Raw).await?.into_inner();
                let mut read = Vec::new();
                while read.len() < wanted
                    && let Some(message) = answers.message().await?
                {
                    read.push(message);
                }
                Ok(read)
            };
            timeout(PATIENCE, answer).await.expect("an answer in time")
        })
    }
}

fn connect(runtime: &Runtime, server: &EnvServer, learner: &LearnerServer) -> (Channel, Channel) {
    runtime.block_on(async {
        let channel = async |address: String| mazeway_client::channel(&address).await.expect("a channel");
        (channel(server.address()).await, channel(learner.address()).await)
    })
}

thread_local! {
    static PEERS: RefCell<Option<Peers>> = const { RefCell::new(None) };
}

fn worlds(payload: Payload) -> Vec<u8> {
    dm_env::EnvironmentRequest { payload: Some(payload) }.encode_to_vec()
}

fn replaced(message: &[u8], by: &str) -> Vec<u8> {
    let mut message = message.to_vec();
    if by.len() == SESSION.len() {
        while let Some(at) = message.windows(SESSION.len()).position(|window| window == SESSION) {
            message[at..at + SESSION.len()].copy_from_slice(by.as_bytes());
        }
    }
    message
}

fn tried(paths: &[(&str, &str)], bytes: &[u8]) -> Result<String, String> {
    let (method, message) = bytes.split_first().ok_or("no method")?;
    let (service, method) = paths[usize::from(*method) % paths.len()];
    let path = format!("{service}{method}");
    PEERS.with_borrow_mut(|peers| {
        if peers.as_ref().is_some_and(|peers| peers.calls == CALLS) {
            *peers = None;
        }
        let peers = peers.get_or_insert_with(Peers::start);
        peers.calls += 1;
        if peers.calls.is_multiple_of(CALLS_OF_A_CONNECTION) {
            peers.connect();
        }
        let message = replaced(message, if service == WORLDS { &peers.world } else { &peers.session });
        let messages = match (service, method) {
            (_, "Interact") => {
                let reset = env::ResetRequest { session_id: peers.session.clone(), ..Default::default() };
                let reset = env::InteractRequest { request: Some(interact_request::Request::Reset(reset)) };
                vec![reset.encode_to_vec(), message]
            }
            (WORLDS, _) => {
                let world_name = peers.world.clone();
                let join = Payload::JoinWorld(dm_env::JoinWorldRequest { world_name, ..Default::default() });
                vec![worlds(join), message, worlds(Payload::Step(dm_env::StepRequest::default()))]
            }
            _ => vec![message],
        };
        let answered = peers.ask(&path, messages);
        // Whoever asks may end what is there; then there is another one.
        if let Err(status) = &answered {
            let ours = [Code::Internal, Code::Unknown, Code::Cancelled, Code::Unavailable, Code::DataLoss];
            let blames_caller = !ours.contains(&status.code());
            assert!(blames_caller, "{path}: {status:?}");
        }
        let ends = matches!(method, "CloseSession" | "Interact") || service == WORLDS;
        let renew = match &answered {
            Ok(_) => ends,
            Err(status) => status.code() == Code::NotFound,
        };
        let answer = match answered {
            Ok(messages) => Ok(format!("{method}: {} messages", messages.len())),
            Err(status) => Err(format!("{method}: {:?}: {}", status.code(), status.message())),
        };
        if renew && !peers.lives() {
            *peers = Peers::start();
        }
        answer
    })
}

impl Peers {
    /// Whether session and world are still there.
    fn lives(&self) -> bool {
        let reset = env::ResetRequest { session_id: self.session.clone(), ..Default::default() };
        let session = self.ask(&format!("{ENVIRONMENTS}Reset"), vec![reset.encode_to_vec()]);
        let join = dm_env::JoinWorldRequest { world_name: self.world.clone(), ..Default::default() };
        let world = self.ask(WORLDS, vec![worlds(Payload::JoinWorld(join))]);
        let joined = world.is_ok_and(|answers| {
            answers.first().is_some_and(|answer| {
                let answer = dm_env::EnvironmentResponse::decode(answer.clone()).ok().and_then(|answer| answer.payload);
                !matches!(answer, Some(dm_env::environment_response::Payload::Error(error)) if error.code == Code::NotFound as i32)
            })
        });
        session.is_ok() && joined
    }
}

const ENVIRONMENT_METHODS: [(&str, &str); 11] = [
    (ENVIRONMENTS, "CreateSession"),
    (ENVIRONMENTS, "Reset"),
    (ENVIRONMENTS, "Step"),
    (ENVIRONMENTS, "Interact"),
    (ENVIRONMENTS, "Rollout"),
    (ENVIRONMENTS, "Render"),
    (ENVIRONMENTS, "CloseSession"),
    (ENVIRONMENTS, "GetModel"),
    (WORLDS, ""),
    (ENVIRONMENTS, "ListEnvironments"),
    (ENVIRONMENTS, "Watch"),
];

const LEARNER_METHODS: [(&str, &str); 12] = [
    (LEARNER, "RecordTrajectories"),
    (LEARNER, "PutModel"),
    (LEARNER, "GetModel"),
    (LEARNER, "ListModels"),
    (LEARNER, "ListTrajectories"),
    (LEARNER, "DeleteTrajectories"),
    (LEARNER, "ExportTrajectories"),
    (LEARNER, "Fit"),
    (LEARNER, "GetFit"),
    (LEARNER, "ListFits"),
    (LEARNER, "ListFitTrajectories"),
    (LEARNER, "DeleteFit"),
];

/// A request to the environment server.
pub fn environment(bytes: &[u8]) -> Result<String, String> {
    tried(&ENVIRONMENT_METHODS, bytes)
}

/// A request to the learner service.
pub fn learner(bytes: &[u8]) -> Result<String, String> {
    tried(&LEARNER_METHODS, bytes)
}

fn inputs(messages: Vec<(u8, Vec<u8>)>) -> Vec<Vec<u8>> {
    messages.into_iter().map(|(method, message)| [vec![method], message].concat()).collect()
}

/// One good request of each method.
pub fn environment_seeds() -> Vec<Vec<u8>> {
    let session_id = || String::from_utf8(SESSION.to_vec()).expect("text");
    let slip = prost_types::Value { kind: Some(prost_types::value::Kind::NumberValue(0.25)) };
    let options = || Some(prost_types::Struct { fields: [("slip".to_owned(), slip.clone())].into() });
    let step = env::StepRequest { session_id: session_id(), actions: pack([0_i32, 3]) };
    let reset = env::ResetRequest { session_id: session_id(), seed: Some(7), ..Default::default() };
    let rollout = env::RolloutRequest {
        env_id: "Maze-v0".into(),
        controller: Some(env::rollout_request::Controller::Driver("random".into())),
        episodes: 3,
        steps: 5,
        ..Default::default()
    };
    let create = env::CreateSessionRequest {
        env_id: "Maze-v0".into(),
        options: options(),
        num_envs: 2,
        lease: Some(prost_types::Duration { seconds: 1, nanos: 5 }),
        ..Default::default()
    };
    let actions = dm_env::Tensor {
        payload: Some(dm_env::tensor::Payload::Int32s(dm_env::tensor::Int32Array { array: vec![2] })),
        ..Default::default()
    };
    let act = dm_env::StepRequest { actions: [(1, actions)].into(), requested_observations: vec![1, 2, 3] };
    inputs(vec![
        (0, create.encode_to_vec()),
        (1, reset.encode_to_vec()),
        (2, step.encode_to_vec()),
        (3, env::InteractRequest { request: Some(interact_request::Request::Step(step)) }.encode_to_vec()),
        (4, rollout.encode_to_vec()),
        (5, env::RenderRequest { session_id: session_id(), ..Default::default() }.encode_to_vec()),
        (6, env::CloseSessionRequest { session_id: session_id() }.encode_to_vec()),
        (7, env::GetModelRequest { env_id: "Maze-v0".into(), options: options() }.encode_to_vec()),
        (8, worlds(Payload::Step(act))),
        (8, worlds(Payload::Reset(dm_env::ResetRequest::default()))),
        (8, worlds(Payload::DestroyWorld(dm_env::DestroyWorldRequest { world_name: session_id() }))),
        (9, env::ListEnvironmentsRequest::default().encode_to_vec()),
        (10, env::WatchRequest { session_id: session_id(), max_width: 50, ..Default::default() }.encode_to_vec()),
    ])
}

/// One good request of each method.
pub fn learner_seeds() -> Vec<Vec<u8>> {
    let filter = || Some(pb::TrajectoryFilter { env_id: "Test-v0".into(), ..Default::default() });
    let record = |n: u128| pb::RecordTrajectoriesRequest { trajectories: vec![trajectory(n), trajectory(n + 1)] };
    inputs(vec![
        (0, record(2).encode_to_vec()),
        (0, record(5).encode_to_vec()),
        (1, pb::PutModelRequest::default().encode_to_vec()),
        (2, pb::GetModelRequest { model_id: "0".repeat(64) }.encode_to_vec()),
        (3, pb::ListModelsRequest { env_id: "Test-v0".into() }.encode_to_vec()),
        (4, pb::ListTrajectoriesRequest { filter: filter(), page_size: 3, ..Default::default() }.encode_to_vec()),
        (5, pb::DeleteTrajectoriesRequest { filter: filter() }.encode_to_vec()),
        (6, pb::ExportTrajectoriesRequest { filter: filter(), ..Default::default() }.encode_to_vec()),
        (7, pb::FitRequest { filter: filter(), method: "bc".into(), ..Default::default() }.encode_to_vec()),
        (8, pb::GetFitRequest { fit_id: "0123abcd".into() }.encode_to_vec()),
        (9, pb::ListFitsRequest { page_size: 5, ..Default::default() }.encode_to_vec()),
        (10, pb::ListFitTrajectoriesRequest { fit_id: "0123abcd".into(), ..Default::default() }.encode_to_vec()),
        (11, pb::DeleteFitRequest { fit_id: "0123abcd".into() }.encode_to_vec()),
    ])
}
