//! Many environments at a time, as Gymnasium's vector environments.

use crate::{
    Autoreset, ClientError, Connection, EnvSpec, Image, SessionOptions,
    info::{Infos, Observations},
    packed::{Packed, pack},
    session::{RenderMode, Session},
    spec::InfoColumn,
    stream::Ask,
};
use bytes::Bytes;
use mazeway_proto::env::{self as pb, interact_response::Response};
use std::{sync::Arc, time::Duration};

/// How the environments of a reset are seeded.
#[derive(Debug, Clone, PartialEq, Eq, Default)]
pub enum Seeds {
    /// Every generator goes on where it is; one that was never seeded is seeded from the server's operating system.
    #[default]
    Continue,
    /// Environment i with seed + i.
    From(u64),
    /// A seed an environment.
    Each(Vec<u64>),
}

impl From<u64> for Seeds {
    fn from(seed: u64) -> Self {
        Self::From(seed)
    }
}

/// First observations of a batch.
#[derive(Debug, Clone, PartialEq)]
pub struct ResetBatch {
    /// Shape `(num_envs, ...)`.
    pub observations: Observations,
    /// Columns of shape `(num_envs, ...)`.
    pub infos: Infos,
}

/// What came of a batch of actions.
#[derive(Debug, Clone, PartialEq)]
pub struct StepBatch {
    /// Shape `(num_envs, ...)`.
    pub observations: Observations,
    /// Shape `(num_envs,)`.
    pub rewards: Packed<f64>,
    /// Flags: the episode came to an end of its own. Shape `(num_envs,)`.
    pub terminated: Packed<u8>,
    /// Flags: the episode was cut off. Shape `(num_envs,)`.
    pub truncated: Packed<u8>,
    /// Columns of shape `(num_envs, ...)`.
    pub infos: Infos,
    /// Mode `SameStep`, where an episode ended: the last observations and infos of those that did; other rows are zero.
    pub last: Option<ResetBatch>,
}

impl StepBatch {
    /// True where environment `index`'s episode is over.
    pub fn ended(&self, index: usize) -> bool {
        self.terminated.get(index) == Some(1) || self.truncated.get(index) == Some(1)
    }
}

/// A batch of environments on a server.
#[derive(Debug)]
pub struct VectorEnv {
    session: Session,
    columns: Arc<[InfoColumn]>,
    autoreset: Autoreset,
}

impl VectorEnv {
    /// Makes `num_envs` environments on the server at `address`.
    ///
    /// # Errors
    /// Nobody answers, no such environment, a wrong option, a limit.
    pub async fn connect(
        address: &str,
        env_id: &str,
        num_envs: u32,
        autoreset: Autoreset,
        options: SessionOptions,
    ) -> Result<Self, ClientError> {
        Self::create(&Connection::open(address).await?, env_id, num_envs, autoreset, options).await
    }

    /// Makes `num_envs` environments over a connection.
    ///
    /// # Errors
    /// No such environment, a wrong option, a limit.
    pub async fn create(
        connection: &Connection,
        env_id: &str,
        num_envs: u32,
        autoreset: Autoreset,
        options: SessionOptions,
    ) -> Result<Self, ClientError> {
        Ok(Self::over(Session::create(connection.clone(), env_id, num_envs, autoreset, options).await?, autoreset))
    }

    /// Takes up a session that is there already, from what the server said when it was made. Nothing is sent.
    ///
    /// # Errors
    /// A description that is none.
    pub fn attach(
        connection: &Connection,
        created: pb::CreateSessionResponse,
        resume_within: Option<Duration>,
    ) -> Result<Self, ClientError> {
        let autoreset = match created.autoreset_mode() {
            pb::AutoresetMode::SameStep => Autoreset::SameStep,
            pb::AutoresetMode::Disabled => Autoreset::Disabled,
            pb::AutoresetMode::NextStep | pb::AutoresetMode::Unspecified => Autoreset::NextStep,
        };
        Ok(Self::over(Session::attach(connection.clone(), created, resume_within)?, autoreset))
    }

    fn over(session: Session, autoreset: Autoreset) -> Self {
        let columns = session.spec.info_columns.clone().into();
        Self { session, columns, autoreset }
    }

    /// The environment as configured.
    pub fn spec(&self) -> &EnvSpec {
        &self.session.spec
    }

    /// Number of environments.
    pub fn num_envs(&self) -> usize {
        self.session.num_envs
    }

    /// Steps after which an episode is truncated; 0 means never.
    pub fn max_episode_steps(&self) -> u32 {
        self.session.max_episode_steps
    }

    /// What happens at the end of an episode.
    pub fn autoreset(&self) -> Autoreset {
        self.autoreset
    }

    /// Name of the session on the server. Whoever knows it can take the session over.
    pub fn session_id(&self) -> &str {
        self.session.id()
    }

    /// Begins new episodes everywhere.
    ///
    /// # Errors
    /// The server refuses, or the connection broke during an unseeded reset.
    pub async fn reset(&mut self, seeds: impl Into<Seeds>) -> Result<ResetBatch, ClientError> {
        self.reset_request(seeds.into(), Bytes::new()).await
    }

    /// Begins new episodes where `mask` says; the others keep theirs and repeat their observation.
    ///
    /// # Errors
    /// A mask of another length, or one that leaves out an environment which was never reset.
    pub async fn reset_some(&mut self, seeds: impl Into<Seeds>, mask: &[bool]) -> Result<ResetBatch, ClientError> {
        self.reset_request(seeds.into(), mask.iter().map(|&flag| u8::from(flag)).collect()).await
    }

    async fn reset_request(&mut self, seeds: Seeds, reset_mask: Bytes) -> Result<ResetBatch, ClientError> {
        let (seed, seeds) = match seeds {
            Seeds::Continue => (None, Bytes::new()),
            Seeds::From(seed) => (Some(seed), Bytes::new()),
            Seeds::Each(seeds) => (None, pack(seeds)),
        };
        let request = pb::ResetRequest { session_id: String::new(), seed, seeds, reset_mask };
        match self.session.call(Ask::Reset(&request)).await? {
            Response::Reset(answer) => self.reset_batch(answer.observations, answer.infos),
            _ => Err(ClientError::protocol("expected the answer to a reset")),
        }
    }

    /// Steps every environment once.
    ///
    /// # Errors
    /// Another number of actions, an action out of range, no reset yet, a connection that broke during the step.
    pub async fn step(&mut self, actions: &[u32]) -> Result<StepBatch, ClientError> {
        let answer = self.session.call(Ask::Step(actions)).await?;
        self.step_batch(answer)
    }

    /// Sends actions without waiting: [`Self::receive_step`] brings what came of them, in order. Up to 4,096 steps may be
    /// under way.
    ///
    /// # Errors
    /// Too many are under way; the stream has ended.
    pub async fn send_step(&mut self, actions: &[u32]) -> Result<(), ClientError> {
        self.session.send(Ask::Step(actions)).await
    }

    /// What came of the oldest actions that were sent and not yet received.
    ///
    /// # Errors
    /// As [`Self::step`]; nothing was sent.
    pub async fn receive_step(&mut self) -> Result<StepBatch, ClientError> {
        let answer = self.session.receive().await?;
        self.step_batch(answer)
    }

    fn reset_batch(&self, observations: Bytes, infos: Vec<Bytes>) -> Result<ResetBatch, ClientError> {
        Ok(ResetBatch {
            observations: Observations::from_wire(observations, &self.session.spec, self.num_envs())?,
            infos: Infos::from_wire(infos, &self.columns, self.num_envs())?,
        })
    }

    fn step_batch(&self, answer: Response) -> Result<StepBatch, ClientError> {
        let Response::Step(answer) = answer else {
            return Err(ClientError::protocol("expected the answer to a step"));
        };
        let n = self.num_envs();
        let ResetBatch { observations, infos } = self.reset_batch(answer.observations, answer.infos)?;
        let ended = !answer.final_observations.is_empty();
        Ok(StepBatch {
            observations,
            rewards: Packed::of_len(answer.rewards, n, "rewards")?,
            terminated: Packed::of_len(answer.terminated, n, "flags")?,
            truncated: Packed::of_len(answer.truncated, n, "flags")?,
            infos,
            last: ended.then(|| self.reset_batch(answer.final_observations, answer.final_infos)).transpose()?,
        })
    }

    /// Environment `index` as text.
    ///
    /// # Errors
    /// No such environment, no reset yet.
    pub async fn render_text(&mut self, index: u32) -> Result<String, ClientError> {
        let answer = self.session.render(index, RenderMode::Ansi).await?;
        String::from_utf8(answer.content.into()).map_err(|_| ClientError::protocol("expected text in UTF-8"))
    }

    /// Environment `index` as pixels.
    ///
    /// # Errors
    /// No such environment, no reset yet.
    pub async fn render_rgb(&mut self, index: u32) -> Result<Image, ClientError> {
        self.session.render_image(index).await
    }

    /// Environment `index` as a PNG file.
    ///
    /// # Errors
    /// No such environment, no reset yet.
    pub async fn render_png(&mut self, index: u32) -> Result<Bytes, ClientError> {
        Ok(self.session.render(index, RenderMode::Png).await?.content)
    }

    /// Ends the session and frees its environments; a second time does nothing.
    ///
    /// # Errors
    /// The server cannot be reached; the lease ends the session then.
    pub async fn close(&mut self) -> Result<(), ClientError> {
        self.session.close().await
    }
}
