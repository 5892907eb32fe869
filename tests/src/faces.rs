//! The same batch of environments behind three faces: in process, unary calls, the interactive stream of the Rust client.

use mazeway_client::{Autoreset, ClientError, Connection, Seeds, SessionOptions, VectorEnv, channel, packed};
use mazeway_proto::env::{self as pb, environment_service_client::EnvironmentServiceClient};
use mazeway_server::{
    CallError,
    batch::{self, Batch, BatchOptions, StepBuffers},
    registry::Registry,
};
use serde_json::{Map, Value};
use tonic::{Code, Status, transport::Channel};

/// Through what an environment is used.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Face {
    /// [`Batch`] itself.
    InProcess,
    /// `Reset` and `Step` over gRPC.
    Unary,
    /// `Interact`, through [`VectorEnv`].
    Interact,
}

/// Every face.
pub const FACES: [Face; 3] = [Face::InProcess, Face::Unary, Face::Interact];

/// What to make.
#[derive(Debug, Clone)]
pub struct Make {
    /// Environment.
    pub env_id: &'static str,
    /// Its options.
    pub options: Map<String, Value>,
    /// Size of the batch.
    pub num_envs: usize,
    /// End of an episode.
    pub autoreset: Autoreset,
    /// Time limit; `None`: the environment's.
    pub max_episode_steps: Option<u32>,
}

impl Make {
    /// A batch under default options.
    pub fn new(env_id: &'static str, num_envs: usize, autoreset: Autoreset) -> Self {
        Self { env_id, options: Map::new(), num_envs, autoreset, max_episode_steps: None }
    }
}

/// A reply as bytes; of a reset, the rewards and flags are zero.
#[derive(Debug, Clone, Default, PartialEq)]
pub struct Reply {
    /// Packed observations.
    pub observations: Vec<u8>,
    /// One an environment.
    pub rewards: Vec<f64>,
    /// Flags.
    pub terminated: Vec<u8>,
    /// Flags.
    pub truncated: Vec<u8>,
    /// Packed columns.
    pub infos: Vec<Vec<u8>>,
    /// Packed, or empty.
    pub final_observations: Vec<u8>,
    /// Packed columns, or none.
    pub final_infos: Vec<Vec<u8>>,
}

impl Reply {
    /// True where environment `index`'s episode is over.
    pub fn ended(&self, index: usize) -> bool {
        self.terminated[index] == 1 || self.truncated[index] == 1
    }

    /// Environment `index`'s row of everything but the final parts.
    #[must_use]
    pub fn row(&self, index: usize) -> Self {
        let n = self.rewards.len();
        let slice = |bytes: &[u8]| bytes[index * bytes.len() / n..(index + 1) * bytes.len() / n].to_vec();
        Self {
            observations: slice(&self.observations),
            rewards: vec![self.rewards[index]],
            terminated: vec![self.terminated[index]],
            truncated: vec![self.truncated[index]],
            infos: self.infos.iter().map(|bytes| slice(bytes)).collect(),
            final_observations: Vec::new(),
            final_infos: Vec::new(),
        }
    }
}

/// A refused call.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Refusal {
    /// Status code.
    pub code: Code,
    /// The field that is to blame.
    pub field: Option<String>,
    /// What it says.
    pub message: String,
}

impl From<ClientError> for Refusal {
    fn from(error: ClientError) -> Self {
        Self { code: error.code(), field: error.field().map(str::to_owned), message: error.to_string() }
    }
}

impl From<Status> for Refusal {
    fn from(status: Status) -> Self {
        ClientError::from(status).into()
    }
}

/// A batch behind a face.
pub enum Subject {
    /// In process.
    InProcess(Box<dyn Batch>),
    /// Over unary calls, by session id.
    Unary(EnvironmentServiceClient<Channel>, String),
    /// Over the interactive stream.
    Interact(Box<VectorEnv>),
}

impl Subject {
    /// Makes a batch, on the server at `address` unless in process.
    ///
    /// # Panics
    /// It cannot be made.
    pub async fn make(face: Face, address: &str, make: &Make) -> Self {
        let Make { env_id, options, num_envs, autoreset, max_episode_steps } = make.clone();
        match face {
            Face::InProcess => {
                let environment = Registry::new().configure(env_id, &options).expect("an environment");
                let autoreset = match autoreset {
                    Autoreset::NextStep => batch::Autoreset::NextStep,
                    Autoreset::SameStep => batch::Autoreset::SameStep,
                    Autoreset::Disabled => batch::Autoreset::Disabled,
                };
                let limit = max_episode_steps.unwrap_or(environment.spec().max_episode_steps);
                let options = BatchOptions { num_envs, autoreset, max_episode_steps: limit, action_masks: true };
                Self::InProcess(environment.batch(options))
            }
            Face::Unary => {
                // The session is made by the other client: this test would otherwise repeat its conversions.
                let connection = Connection::open(address).await.expect("a connection");
                let made = Self::session(&connection, make).await;
                let id = made.session_id().to_owned();
                // It must live on without its maker.
                std::mem::forget(made);
                Self::Unary(EnvironmentServiceClient::new(channel(address).await.expect("a channel")), id)
            }
            Face::Interact => {
                let connection = Connection::open(address).await.expect("a connection");
                Self::Interact(Box::new(Self::session(&connection, make).await))
            }
        }
    }

    async fn session(connection: &Connection, make: &Make) -> VectorEnv {
        let Make { env_id, options, num_envs, autoreset, max_episode_steps } = make.clone();
        let options = SessionOptions { options, max_episode_steps, action_masks: true, ..SessionOptions::default() };
        VectorEnv::create(connection, env_id, num_envs as u32, autoreset, options).await.expect("a session")
    }

    /// Begins episodes.
    ///
    /// # Errors
    /// It is refused.
    pub async fn reset(&mut self, seeds: Seeds, mask: Option<&[bool]>) -> Result<Reply, Refusal> {
        match self {
            Self::InProcess(batch) => {
                let packed =
                    if let Seeds::Each(seeds) = &seeds { packed::pack(seeds.clone()) } else { Vec::new().into() };
                let seeds = match seeds {
                    Seeds::Continue => batch::Seeds::Continue,
                    Seeds::From(seed) => batch::Seeds::From(seed),
                    Seeds::Each(_) => batch::Seeds::Each(&packed),
                };
                let mask: Option<Vec<u8>> = mask.map(|mask| mask.iter().map(|&flag| flag.into()).collect());
                let buffers = batch.reset(seeds, mask.as_deref()).map_err(|e| Status::from(CallError::from(e)))?;
                Ok(from_buffers(buffers))
            }
            Self::Unary(service, id) => {
                let (seed, seeds) = match seeds {
                    Seeds::Continue => (None, Vec::new().into()),
                    Seeds::From(seed) => (Some(seed), Vec::new().into()),
                    Seeds::Each(seeds) => (None, packed::pack(seeds)),
                };
                let reset_mask = mask.unwrap_or_default().iter().map(|&flag| u8::from(flag)).collect();
                let request = pb::ResetRequest { session_id: id.clone(), seed, seeds, reset_mask };
                let answer = service.reset(request).await?.into_inner();
                Ok(first(answer.observations.into(), answer.infos.into_iter().map(Into::into).collect()))
            }
            Self::Interact(envs) => {
                let batch = match mask {
                    None => envs.reset(seeds).await?,
                    Some(mask) => envs.reset_some(seeds, mask).await?,
                };
                Ok(first(batch.observations.as_bytes().to_vec(), columns(&batch.infos)))
            }
        }
    }

    /// Steps every environment.
    ///
    /// # Errors
    /// It is refused.
    pub async fn step(&mut self, actions: &[u32]) -> Result<Reply, Refusal> {
        match self {
            Self::InProcess(batch) => {
                let actions = packed::pack(actions.iter().copied());
                Ok(from_buffers(batch.step(&actions).map_err(|error| Status::from(CallError::from(error)))?))
            }
            Self::Unary(service, id) => {
                let actions = packed::pack(actions.iter().copied());
                let answer = service.step(pb::StepRequest { session_id: id.clone(), actions }).await?.into_inner();
                Ok(Reply {
                    observations: answer.observations.into(),
                    rewards: packed::Packed::new(answer.rewards).expect("float64").to_vec(),
                    terminated: answer.terminated.into(),
                    truncated: answer.truncated.into(),
                    infos: answer.infos.into_iter().map(Into::into).collect(),
                    final_observations: answer.final_observations.into(),
                    final_infos: answer.final_infos.into_iter().map(Into::into).collect(),
                })
            }
            Self::Interact(envs) => {
                let batch = envs.step(actions).await?;
                Ok(Reply {
                    observations: batch.observations.as_bytes().to_vec(),
                    rewards: batch.rewards.to_vec(),
                    terminated: batch.terminated.to_vec(),
                    truncated: batch.truncated.to_vec(),
                    infos: columns(&batch.infos),
                    final_observations: batch
                        .last
                        .as_ref()
                        .map(|l| l.observations.as_bytes().to_vec())
                        .unwrap_or_default(),
                    final_infos: batch.last.as_ref().map(|last| columns(&last.infos)).unwrap_or_default(),
                })
            }
        }
    }
}

fn first(observations: Vec<u8>, infos: Vec<Vec<u8>>) -> Reply {
    // The action mask has one byte an action, the rest is read off the flags: the first column is a scalar of 4 bytes.
    let num_envs = infos[0].len() / 4;
    Reply {
        observations,
        rewards: vec![0.0; num_envs],
        terminated: vec![0; num_envs],
        truncated: vec![0; num_envs],
        infos,
        ..Reply::default()
    }
}

fn columns(infos: &mazeway_client::Infos) -> Vec<Vec<u8>> {
    let column = |name: &str| infos.as_bytes(name).expect("its own column").to_vec();
    infos.columns().iter().map(|known| column(&known.name)).collect()
}

fn from_buffers(buffers: &StepBuffers) -> Reply {
    let columns = 0..buffers.layout().infos.len();
    Reply {
        observations: buffers.observations().to_vec(),
        rewards: (0..buffers.layout().num_envs).map(|i| buffers.reward(i)).collect(),
        terminated: buffers.terminated().to_vec(),
        truncated: buffers.truncated().to_vec(),
        infos: columns.clone().map(|column| buffers.info(column).to_vec()).collect(),
        final_observations: buffers.final_observations().to_vec(),
        final_infos: if buffers.has_final() {
            columns.map(|column| buffers.final_info(column).to_vec()).collect()
        } else {
            Vec::new()
        },
    }
}
