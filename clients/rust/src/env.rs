//! One environment, as Gymnasium's `Env`.

use crate::{
    Autoreset, ClientError, Connection, EnvSpec, Image, SessionOptions, VectorEnv,
    info::{Infos, Observation},
    vector::Seeds,
};
use bytes::Bytes;

/// What came of an action.
#[derive(Debug, Clone, PartialEq)]
pub struct Step {
    /// What is seen now.
    pub observation: Observation,
    /// Reward of the step.
    pub reward: f64,
    /// The episode came to an end of its own.
    pub terminated: bool,
    /// The episode was cut off.
    pub truncated: bool,
    /// What else is known; a batch of one.
    pub info: Infos,
}

/// One environment on a server. An ended episode is reset by [`Env::reset`] and by nothing else.
#[derive(Debug)]
pub struct Env(VectorEnv);

impl Env {
    /// Makes an environment on the server at `address`.
    ///
    /// # Errors
    /// Nobody answers, no such environment, a wrong option, a limit.
    pub async fn connect(address: &str, env_id: &str, options: SessionOptions) -> Result<Self, ClientError> {
        Self::create(&Connection::open(address).await?, env_id, options).await
    }

    /// Makes an environment over a connection.
    ///
    /// # Errors
    /// No such environment, a wrong option, a limit.
    pub async fn create(connection: &Connection, env_id: &str, options: SessionOptions) -> Result<Self, ClientError> {
        Ok(Self(VectorEnv::create(connection, env_id, 1, Autoreset::Disabled, options).await?))
    }

    /// The environment as configured.
    pub fn spec(&self) -> &EnvSpec {
        self.0.spec()
    }

    /// Steps after which an episode is truncated; 0 means never.
    pub fn max_episode_steps(&self) -> u32 {
        self.0.max_episode_steps()
    }

    /// Name of the session on the server. Whoever knows it can take the session over.
    pub fn session_id(&self) -> &str {
        self.0.session_id()
    }

    /// Begins an episode; without a seed the generator goes on where it is.
    ///
    /// # Errors
    /// The server refuses, or the connection broke during an unseeded reset.
    pub async fn reset(&mut self, seed: Option<u64>) -> Result<(Observation, Infos), ClientError> {
        let batch = self.0.reset(seed.map_or(Seeds::Continue, Seeds::From)).await?;
        Ok((first(batch.observations.get(0))?, batch.infos))
    }

    /// Acts once.
    ///
    /// # Errors
    /// An action out of range, no reset yet, an ended episode, a connection that broke during the step.
    pub async fn step(&mut self, action: u32) -> Result<Step, ClientError> {
        let batch = self.0.step(&[action]).await?;
        Ok(Step {
            observation: first(batch.observations.get(0))?,
            reward: first(batch.rewards.get(0))?,
            terminated: batch.terminated.get(0) == Some(1),
            truncated: batch.truncated.get(0) == Some(1),
            info: batch.infos,
        })
    }

    /// As text.
    ///
    /// # Errors
    /// No reset yet.
    pub async fn render_text(&mut self) -> Result<String, ClientError> {
        self.0.render_text(0).await
    }

    /// As pixels.
    ///
    /// # Errors
    /// No reset yet.
    pub async fn render_rgb(&mut self) -> Result<Image, ClientError> {
        self.0.render_rgb(0).await
    }

    /// As a PNG file.
    ///
    /// # Errors
    /// No reset yet.
    pub async fn render_png(&mut self) -> Result<Bytes, ClientError> {
        self.0.render_png(0).await
    }

    /// Ends the session and frees the environment; a second time does nothing.
    ///
    /// # Errors
    /// The server cannot be reached; the lease ends the session then.
    pub async fn close(&mut self) -> Result<(), ClientError> {
        self.0.close().await
    }
}

fn first<T>(value: Option<T>) -> Result<T, ClientError> {
    value.ok_or_else(|| ClientError::protocol("expected one environment"))
}
