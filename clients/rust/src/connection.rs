//! A connection to an environment server.

use crate::{
    ClientError, EnvSpec,
    model::{Model, ModelCollector},
    rollout::{EpisodeStream, Episodes, Rollout},
    spec::{Options, options_to_wire},
};
use mazeway_proto::env::{self as pb, environment_service_client::EnvironmentServiceClient};
use std::time::Duration;
use tonic::transport::{Channel, Endpoint};

/// Largest message taken in: above what a server sends by default.
pub(crate) const MAX_MESSAGE_BYTES: usize = 64 << 20;
/// Bytes of a stream that may wait for their reader.
const STREAM_WINDOW_BYTES: u32 = 4 << 20;
/// Bytes of all streams that may wait: so many that a stream nobody reads never holds up the others.
const CONNECTION_WINDOW_BYTES: u32 = 1 << 30;

/// Largest frame taken in: an answer comes in few.
const FRAME_BYTES: u32 = 1 << 20;

/// Connects to a server at `address`, such as `127.0.0.1:50051`, `http://[::1]:50051` or `unix:/run/mazeway.sock`.
///
/// # Errors
/// An address that is none; nobody answers.
pub async fn channel(address: &str) -> Result<Channel, ClientError> {
    let whole = address.contains("://") || address.starts_with("unix:");
    let uri = if whole { address.to_owned() } else { format!("http://{address}") };
    let endpoint = Endpoint::from_shared(uri)
        .map_err(|error| ClientError::Address { address: address.into(), message: error.to_string() })?;
    let endpoint = endpoint
        .connect_timeout(Duration::from_secs(5))
        .tcp_nodelay(true)
        .http2_keep_alive_interval(Duration::from_secs(10))
        .keep_alive_timeout(Duration::from_secs(10))
        .keep_alive_while_idle(true)
        .initial_stream_window_size(STREAM_WINDOW_BYTES)
        .initial_connection_window_size(CONNECTION_WINDOW_BYTES)
        .max_frame_size(FRAME_BYTES);
    endpoint.connect().await.map_err(|error| ClientError::Connect { address: address.into(), message: causes(&error) })
}

/// An error and what is behind it, in one line.
fn causes(error: &dyn std::error::Error) -> String {
    let mut message = error.to_string();
    let mut source = error.source();
    while let Some(cause) = source {
        let cause_message = cause.to_string();
        if !message.contains(&cause_message) {
            message = format!("{message}: {cause_message}");
        }
        source = cause.source();
    }
    message
}

/// A connection to an environment server. Cloning shares it.
#[derive(Debug, Clone)]
pub struct Connection {
    pub(crate) channel: Channel,
    pub(crate) service: EnvironmentServiceClient<Channel>,
}

impl Connection {
    /// Connects to a server at `address`, such as `127.0.0.1:50051` or `unix:/run/mazeway.sock`.
    ///
    /// # Errors
    /// An address that is none; nobody answers.
    pub async fn open(address: &str) -> Result<Self, ClientError> {
        Ok(Self::from_channel(channel(address).await?))
    }

    /// Uses a channel that is there already.
    pub fn from_channel(channel: Channel) -> Self {
        let service = EnvironmentServiceClient::new(channel.clone())
            .max_decoding_message_size(MAX_MESSAGE_BYTES)
            .max_encoding_message_size(MAX_MESSAGE_BYTES);
        Self { channel, service }
    }

    /// All environments with default options, in alphabetical order.
    ///
    /// # Errors
    /// The server fails.
    pub async fn list_environments(&self) -> Result<Vec<EnvSpec>, ClientError> {
        let answer = self.service.clone().list_environments(pb::ListEnvironmentsRequest {}).await?.into_inner();
        answer.environments.into_iter().map(EnvSpec::from_wire).collect()
    }

    /// The tabular model of an environment, its id and rows verified.
    ///
    /// # Errors
    /// No such environment, a wrong option, a model that is none.
    pub async fn model(&self, env_id: &str, options: &Options) -> Result<Model, ClientError> {
        let request = pb::GetModelRequest { env_id: env_id.into(), options: options_to_wire(options) };
        let mut parts = self.service.clone().get_model(request).await?.into_inner();
        let mut collector = ModelCollector::default();
        while let Some(answer) = parts.message().await? {
            collector.push(answer.part.unwrap_or_default())?;
        }
        Ok(collector.finish()?)
    }

    /// Has the server drive episodes, and hands them over as they come.
    ///
    /// # Errors
    /// A wrong field, a limit.
    pub async fn rollout_stream(&self, rollout: Rollout) -> Result<EpisodeStream, ClientError> {
        let (episodes, totals_only) = (rollout.episodes, rollout.totals_only);
        let answers = self.service.clone().rollout(rollout.into_wire()).await?.into_inner();
        Ok(EpisodeStream::new(answers, episodes, totals_only))
    }

    /// Has the server drive episodes, and waits for all of them.
    ///
    /// # Errors
    /// A wrong field, a limit, a server that breaks off.
    pub async fn rollout(&self, rollout: Rollout) -> Result<Episodes, ClientError> {
        self.rollout_stream(rollout).await?.collect().await
    }
}

/// All environments of the server at `address`; see [`Connection::list_environments`].
///
/// # Errors
/// Nobody answers, or the server fails.
pub async fn list_environments(address: &str) -> Result<Vec<EnvSpec>, ClientError> {
    Connection::open(address).await?.list_environments().await
}

/// The tabular model of an environment of the server at `address`; see [`Connection::model`].
///
/// # Errors
/// Nobody answers; as [`Connection::model`].
pub async fn model(address: &str, env_id: &str, options: &Options) -> Result<Model, ClientError> {
    Connection::open(address).await?.model(env_id, options).await
}

/// Episodes driven by the server at `address`; see [`Connection::rollout`].
///
/// # Errors
/// Nobody answers; as [`Connection::rollout`].
pub async fn rollout(address: &str, rollout: Rollout) -> Result<Episodes, ClientError> {
    Connection::open(address).await?.rollout(rollout).await
}
