//! A connection to an environment server.
//!
//! What only reads is asked again where the connection broke meanwhile.

use crate::{
    ClientError, ConnectOptions, EnvSpec,
    connect::{Wire, within},
    model::{Model, ModelCollector},
    retry::reconnecting,
    rollout::{EpisodeStream, Episodes, Rollout},
    spec::{Options, options_to_wire},
};
use mazeway_proto::env::{self as pb, environment_service_client::EnvironmentServiceClient};

/// Largest message taken in: above what a server sends by default.
pub(crate) const MAX_MESSAGE_BYTES: usize = 64 << 20;

/// A connection to an environment server. Cloning shares it.
#[derive(Debug, Clone)]
pub struct Connection {
    pub(crate) wire: Wire,
    pub(crate) service: EnvironmentServiceClient<Wire>,
}

impl Connection {
    /// Connects to a server at `address`, such as `127.0.0.1:50051` or `unix:/run/mazeway.sock`.
    ///
    /// # Errors
    /// An address that is none; nobody answers.
    pub async fn open(address: &str) -> Result<Self, ClientError> {
        Self::connect(address, &ConnectOptions::default()).await
    }

    /// Connects to a server at `address`, such as `https://robots.example:50051`, with a token or certificates.
    ///
    /// # Errors
    /// An address that is none, options that do not go with it; nobody answers.
    pub async fn connect(address: &str, options: &ConnectOptions) -> Result<Self, ClientError> {
        Ok(Self::from_channel(Wire::open(address, options).await?))
    }

    /// Uses a channel that is there already.
    pub fn from_channel(channel: impl Into<Wire>) -> Self {
        let wire = channel.into();
        let service = EnvironmentServiceClient::new(wire.clone())
            .max_decoding_message_size(MAX_MESSAGE_BYTES)
            .max_encoding_message_size(MAX_MESSAGE_BYTES);
        Self { wire, service }
    }

    /// All environments with default options, in alphabetical order.
    ///
    /// # Errors
    /// The server fails.
    pub async fn list_environments(&self) -> Result<Vec<EnvSpec>, ClientError> {
        let ask = async || {
            let mut service = self.service.clone();
            self.wire.within(service.list_environments(pb::ListEnvironmentsRequest {})).await
        };
        let answer = reconnecting(ask).await?;
        answer.environments.into_iter().map(EnvSpec::from_wire).collect()
    }

    /// The tabular model of an environment, its id and rows verified.
    ///
    /// # Errors
    /// No such environment, a wrong option, a model that is none.
    pub async fn model(&self, env_id: &str, options: &Options) -> Result<Model, ClientError> {
        let request = pb::GetModelRequest { env_id: env_id.into(), options: options_to_wire(options) };
        let ask = async || {
            let mut service = self.service.clone();
            let asked = within(self.wire.work_deadline, service.get_model(request.clone())).await?;
            let (mut parts, mut collector) = (asked.into_inner(), ModelCollector::default());
            while let Some(answer) = within(self.wire.work_deadline, parts.message()).await? {
                collector.push(answer.part.unwrap_or_default())?;
            }
            Ok(collector.finish()?)
        };
        reconnecting(ask).await
    }

    /// Has the server drive episodes, and hands them over as they come.
    ///
    /// # Errors
    /// A wrong field, a limit.
    pub async fn rollout_stream(&self, rollout: Rollout) -> Result<EpisodeStream, ClientError> {
        let (episodes, totals_only) = (rollout.episodes, rollout.totals_only);
        let mut service = self.service.clone();
        let asked = within(self.wire.work_deadline, service.rollout(rollout.into_wire())).await?;
        let answers = asked.into_inner();
        Ok(EpisodeStream::new(answers, episodes, totals_only, self.wire.work_deadline))
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
