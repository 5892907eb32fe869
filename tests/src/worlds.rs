//! A client of `dm_env_rpc.v1.Environment` for tests: one stream, and what requests are made of.

use mazeway_client::channel;
use mazeway_proto::dm_env::{
    self as pb, environment_client::EnvironmentClient, environment_request::Payload as Request,
    environment_response::Payload as Response, tensor::Payload,
};
use std::collections::BTreeMap;
use tokio::sync::mpsc;
use tokio_stream::wrappers::ReceiverStream;
use tonic::{Code, Streaming};
use tonic_types::Status;

/// Settings by name.
pub type Settings = BTreeMap<String, pb::Tensor>;

/// One connection.
#[derive(Debug)]
pub struct Worlds {
    requests: mpsc::Sender<pb::EnvironmentRequest>,
    answers: Streaming<pb::EnvironmentResponse>,
}

impl Worlds {
    /// Opens a stream on a connection of its own.
    ///
    /// # Panics
    /// There is no server.
    pub async fn connect(address: &str) -> Self {
        let (requests, receiver) = mpsc::channel(64);
        let mut client = EnvironmentClient::new(channel(address).await.expect("connects"));
        let answers = client.process(ReceiverStream::new(receiver)).await.expect("a stream").into_inner();
        Self { requests, answers }
    }

    /// Sends a request without waiting for its answer.
    ///
    /// # Panics
    /// The stream has ended.
    pub async fn send(&self, payload: Option<Request>) {
        self.requests.send(pb::EnvironmentRequest { payload }).await.expect("an open stream");
    }

    /// The next answer.
    ///
    /// # Errors
    /// That of the protocol.
    ///
    /// # Panics
    /// The stream has ended.
    pub async fn receive(&mut self) -> Result<Response, Status> {
        let answer = self.answers.message().await.expect("an open stream").expect("an answer");
        match answer.payload.expect("a payload") {
            Response::Error(status) => Err(status),
            response => Ok(response),
        }
    }

    /// How the stream itself ends.
    ///
    /// # Panics
    /// It sends an answer instead.
    pub async fn end(&mut self) -> Option<Code> {
        match self.answers.message().await {
            Ok(None) => None,
            Ok(Some(answer)) => panic!("an answer instead of the end: {answer:?}"),
            Err(status) => Some(status.code()),
        }
    }

    /// Sends a request and waits for its answer.
    ///
    /// # Errors
    /// That of the protocol.
    pub async fn ask(&mut self, request: Request) -> Result<Response, Status> {
        self.send(Some(request)).await;
        self.receive().await
    }

    /// Creates a world.
    ///
    /// # Errors
    /// That of the protocol.
    pub async fn create(&mut self, settings: Settings) -> Result<String, Status> {
        match self.ask(Request::CreateWorld(pb::CreateWorldRequest { settings })).await? {
            Response::CreateWorld(created) => Ok(created.world_name),
            other => panic!("{other:?}"),
        }
    }

    /// Joins a world.
    ///
    /// # Errors
    /// That of the protocol.
    pub async fn join(&mut self, world_name: &str) -> Result<pb::ActionObservationSpecs, Status> {
        let request = pb::JoinWorldRequest { world_name: world_name.into(), settings: Settings::new() };
        match self.ask(Request::JoinWorld(request)).await? {
            Response::JoinWorld(joined) => Ok(joined.specs.expect("specs")),
            other => panic!("{other:?}"),
        }
    }

    /// Steps with an action for each environment, asking for all of `observations`.
    ///
    /// # Errors
    /// That of the protocol.
    pub async fn step(&mut self, actions: pb::Tensor, observations: Vec<u64>) -> Result<pb::StepResponse, Status> {
        let request = pb::StepRequest { actions: [(1, actions)].into(), requested_observations: observations };
        match self.ask(Request::Step(request)).await? {
            Response::Step(step) => Ok(step),
            other => panic!("{other:?}"),
        }
    }

    /// Resets, with settings.
    ///
    /// # Errors
    /// That of the protocol.
    pub async fn reset(&mut self, settings: Settings) -> Result<pb::ActionObservationSpecs, Status> {
        match self.ask(Request::Reset(pb::ResetRequest { settings })).await? {
            Response::Reset(reset) => Ok(reset.specs.expect("specs")),
            other => panic!("{other:?}"),
        }
    }

    /// Leaves the world, if it is in one.
    ///
    /// # Errors
    /// That of the protocol.
    pub async fn leave(&mut self) -> Result<(), Status> {
        self.ask(Request::LeaveWorld(pb::LeaveWorldRequest {})).await.map(|_| ())
    }

    /// Ends a world.
    ///
    /// # Errors
    /// That of the protocol.
    pub async fn destroy(&mut self, world_name: &str) -> Result<(), Status> {
        self.ask(Request::DestroyWorld(pb::DestroyWorldRequest { world_name: world_name.into() })).await.map(|_| ())
    }
}

/// A tensor of INT32.
pub fn int32s(array: Vec<i32>, shape: Vec<i32>) -> pb::Tensor {
    pb::Tensor { payload: Some(Payload::Int32s(pb::tensor::Int32Array { array })), shape }
}

/// A scalar of INT64.
pub fn integer(value: i64) -> pb::Tensor {
    pb::Tensor { payload: Some(Payload::Int64s(pb::tensor::Int64Array { array: vec![value] })), shape: vec![] }
}

/// A scalar of UINT64.
pub fn unsigned(value: u64) -> pb::Tensor {
    pb::Tensor { payload: Some(Payload::Uint64s(pb::tensor::Uint64Array { array: vec![value] })), shape: vec![] }
}

/// A scalar of DOUBLE.
pub fn number(value: f64) -> pb::Tensor {
    pb::Tensor { payload: Some(Payload::Doubles(pb::tensor::DoubleArray { array: vec![value] })), shape: vec![] }
}

/// A scalar of STRING.
pub fn text(value: &str) -> pb::Tensor {
    pb::Tensor { payload: Some(Payload::Strings(pb::tensor::StringArray { array: vec![value.into()] })), shape: vec![] }
}

/// Settings from pairs.
pub fn settings<const N: usize>(pairs: [(&str, pb::Tensor); N]) -> Settings {
    pairs.into_iter().map(|(name, tensor)| (name.to_owned(), tensor)).collect()
}

/// The elements of a tensor as the other face packs them: little-endian, flags as bytes.
///
/// # Panics
/// A type that no observation has.
pub fn packed(tensor: &pb::Tensor) -> Vec<u8> {
    match tensor.payload.as_ref().expect("elements") {
        Payload::Int32s(a) => a.array.iter().flat_map(|v| v.to_le_bytes()).collect(),
        Payload::Doubles(a) => a.array.iter().flat_map(|v| v.to_le_bytes()).collect(),
        Payload::Floats(a) => a.array.iter().flat_map(|v| v.to_le_bytes()).collect(),
        Payload::Bools(a) => a.array.iter().map(|&v| u8::from(v)).collect(),
        Payload::Uint8s(a) => a.array.to_vec(),
        other => panic!("{other:?}"),
    }
}
