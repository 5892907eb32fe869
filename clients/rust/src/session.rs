//! A session over one interactive stream: what [`crate::Env`] and [`crate::VectorEnv`] have in common.
//!
//! Invariants: answers are matched to requests by their order, also where a caller dropped a call half-way; a request whose
//! outcome is unknown is never sent twice, unless doing so changes nothing (a seeded reset of all environments).

use crate::{
    ClientError, Connection, EnvSpec,
    error::is_broken,
    patience::Patience,
    retry::{Backoff, RECONNECT, reconnecting},
    spec::{Options, options_to_wire},
    stream::{Ask, Open, Sent},
};
use mazeway_proto::env::{self as pb, AutoresetMode, interact_response::Response};
use std::time::Duration;
use tokio::time::timeout;
use tonic::Code;

/// First and longest pause between two attempts to take a session up again.
const PAUSES: (Duration, Duration) = (Duration::from_millis(5), Duration::from_millis(500));
/// How long the end of a session that was dropped may take; after that the lease ends it.
const FAREWELL: Duration = Duration::from_secs(10);
/// Requests that may be sent before the first of their answers is received.
const MAX_UNDER_WAY: usize = 4096;

/// What happens to an environment whose episode has ended (Gymnasium 1.x).
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub enum Autoreset {
    /// The next step ignores its action, resets, and returns the first observation with reward 0 and no flag set.
    #[default]
    NextStep,
    /// The same step resets and returns the last observation apart.
    SameStep,
    /// Nothing: stepping an ended episode is refused.
    Disabled,
}

/// How a session is made.
#[derive(Debug, Clone, Default, PartialEq)]
pub struct SessionOptions {
    /// Options of the environment; those not given take their defaults.
    pub options: Options,
    /// Steps after which an episode is truncated, 0 for never; `None`: the environment's default.
    pub max_episode_steps: Option<u32>,
    /// How long the server keeps the session beyond its last use; `None`: the server's default.
    pub lease: Option<Duration>,
    /// Append the info column `action_mask`.
    pub action_masks: bool,
    /// How long a call tries to take the session up again where the connection is broken, at most the lease; `None`: 10 s.
    pub resume_within: Option<Duration>,
}

/// How to draw.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) enum RenderMode {
    Ansi,
    RgbArray,
    Png,
}

/// A picture as raw RGB bytes.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Image {
    /// Pixels across.
    pub width: u32,
    /// Pixels down.
    pub height: u32,
    /// RGB, shape `(height, width, 3)`.
    pub rgb: bytes::Bytes,
}

#[derive(Debug)]
pub(crate) struct Session {
    connection: Connection,
    id: String,
    pub spec: EnvSpec,
    pub num_envs: usize,
    pub max_episode_steps: u32,
    resume_within: Duration,
    open: Option<Open>,
    patience: Patience,
    closed: bool,
}

impl Session {
    pub async fn create(
        connection: Connection,
        env_id: &str,
        num_envs: u32,
        autoreset: Autoreset,
        options: SessionOptions,
    ) -> Result<Self, ClientError> {
        let lease = options.lease.map(prost_types::Duration::try_from).transpose();
        let request = pb::CreateSessionRequest {
            env_id: env_id.into(),
            options: options_to_wire(&options.options),
            num_envs,
            autoreset_mode: match autoreset {
                Autoreset::NextStep => AutoresetMode::NextStep,
                Autoreset::SameStep => AutoresetMode::SameStep,
                Autoreset::Disabled => AutoresetMode::Disabled,
            }
            .into(),
            max_episode_steps: options.max_episode_steps,
            lease: lease.map_err(|error| ClientError::Argument { field: "lease", message: error.to_string() })?,
            action_masks: options.action_masks,
        };
        // A session whose answer was lost ends with its lease: to ask for another does no harm.
        let ask = async || connection.wire.within(connection.service.clone().create_session(request.clone())).await;
        let answer = reconnecting(ask).await?;
        Self::attach(connection, answer, options.resume_within)
    }

    /// Over a session that exists, as the server described it.
    pub fn attach(
        connection: Connection,
        created: pb::CreateSessionResponse,
        resume_within: Option<Duration>,
    ) -> Result<Self, ClientError> {
        let spec = created.spec.ok_or_else(|| ClientError::protocol("expected a description of the session"))?;
        let lease = created.lease.and_then(|lease| Duration::try_from(lease).ok()).unwrap_or(RECONNECT);
        Ok(Self {
            patience: Patience::new(connection.wire.deadline, connection.wire.spin),
            connection,
            id: created.session_id,
            spec: EnvSpec::from_wire(spec)?,
            num_envs: created.num_envs as usize,
            max_episode_steps: created.max_episode_steps,
            resume_within: resume_within.unwrap_or(RECONNECT).min(lease),
            open: None,
            closed: false,
        })
    }

    pub fn id(&self) -> &str {
        &self.id
    }

    /// Opens a stream where there is none.
    async fn ensure_open(&mut self) -> Result<(), Attempt> {
        if self.open.is_none() {
            let opening = self.patience.wait(Open::new(self.connection.wire.clone())).await;
            // Nothing was sent yet: whatever broke here may be tried again. But the caller waits no longer than was said.
            let opened = opening.map_err(Attempt::last)?;
            self.open = Some(opened.map_err(|status| Attempt { retry: is_broken(&status), error: status.into() })?);
        }
        Ok(())
    }

    /// Writes a request to the open stream.
    async fn write(&mut self, ask: Ask<'_>) -> Result<Sent, ClientError> {
        let Some(open) = &mut self.open else { return Ok(Sent::Ended) };
        self.patience.wait(open.send(ask, &self.id)).await
    }

    /// Sends a request whose answer [`Self::receive`] will bring.
    pub async fn send(&mut self, ask: Ask<'_>) -> Result<(), ClientError> {
        if self.closed {
            return Err(ClientError::Argument { field: "session_id", message: "the environment was closed".into() });
        }
        self.ensure_open().await.map_err(|attempt| attempt.error)?;
        let too_many = |message| Err(ClientError::Argument { field: "request", message });
        let awaited = self.open.as_ref().map_or(0, |open| open.awaited);
        if awaited == MAX_UNDER_WAY {
            return too_many(format!("expected at most {MAX_UNDER_WAY} requests without receiving their answers"));
        }
        match self.write(ask).await? {
            Sent::Yes => Ok(()),
            Sent::Full => too_many("expected the answers that are waiting to be received before more is sent".into()),
            // Where it ended with answers to come, the last of these says why.
            Sent::Ended if awaited > 0 => Ok(()),
            Sent::Ended => {
                let message = self.last_words().await;
                Err(ClientError::Interrupted { request: ask.name(), message })
            }
        }
    }

    /// Why the stream has ended that takes no more requests, as the server says.
    async fn last_words(&mut self) -> String {
        let Some(mut open) = self.open.take() else { return "the stream ended".into() };
        match self.patience.wait(open.answer()).await {
            Ok(Err(status)) if !status.message().is_empty() => status.message().into(),
            _ => "the stream ended".into(),
        }
    }

    /// The next answer.
    pub async fn receive(&mut self) -> Result<Response, ClientError> {
        let Some(open) = self.open.as_mut().filter(|open| open.awaited > 0) else {
            return Err(ClientError::Argument {
                field: "request",
                message: "nothing was asked that is not answered".into(),
            });
        };
        let answer = match self.patience.wait(open.answer()).await {
            Ok(answer) => answer,
            Err(late) => {
                self.open = None;
                return Err(late);
            }
        };
        match answer {
            Ok(Some(pb::InteractResponse { response: Some(response) })) => {
                open.awaited -= 1;
                Ok(response)
            }
            Ok(Some(_)) => Err(ClientError::protocol("expected an answer, got an empty one")),
            Ok(None) => {
                self.open = None;
                Err(ClientError::Interrupted { request: "request", message: "the stream ended".into() })
            }
            Err(status) => {
                self.open = None;
                if is_broken(&status) {
                    Err(ClientError::Interrupted { request: "request", message: status.message().into() })
                } else {
                    Err(status.into())
                }
            }
        }
    }

    /// Sends a request and waits for its answer; takes the session up again where the connection broke before.
    pub async fn call(&mut self, ask: Ask<'_>) -> Result<Response, ClientError> {
        self.settle().await;
        let mut backoff = None;
        loop {
            let error = match self.try_call(ask).await {
                Ok(response) => return Ok(response),
                Err(error) => error,
            };
            if !error.retry {
                return Err(error.error);
            }
            // The clock is asked once something is wrong.
            let backoff = backoff.get_or_insert_with(|| Backoff::new(PAUSES.0, PAUSES.1, self.resume_within));
            if !backoff.pause().await {
                return Err(error.error);
            }
        }
    }

    /// Reads what is still to come for calls that were dropped half-way.
    async fn settle(&mut self) {
        while self.open.as_ref().is_some_and(|open| open.awaited > 0) {
            if self.receive().await.is_err() {
                self.open = None;
            }
        }
    }

    async fn try_call(&mut self, ask: Ask<'_>) -> Result<Response, Attempt> {
        if self.closed {
            let message = "the environment was closed".into();
            return Err(Attempt::last(ClientError::Argument { field: "session_id", message }));
        }
        let fresh = self.open.is_none();
        self.ensure_open().await?;
        if self.write(ask).await.map_err(Attempt::last)? != Sent::Yes {
            let message = self.last_words().await;
            return Err(Attempt { retry: true, error: ClientError::Interrupted { request: ask.name(), message } });
        }
        let Some(open) = &mut self.open else {
            return Err(Attempt::last(ClientError::protocol("expected a stream that was just opened")));
        };
        let answer = match self.patience.wait(open.answer()).await {
            Ok(answer) => answer,
            Err(late) => {
                // Whether it was carried out nobody knows.
                self.open = None;
                return Err(Attempt::last(late));
            }
        };
        let retry = !matches!(answer, Ok(Some(_))) && (ask.is_repeatable() || open.is_unsent());
        let broken =
            |message: String| Attempt { retry, error: ClientError::Interrupted { request: ask.name(), message } };
        match answer {
            Ok(Some(pb::InteractResponse { response: Some(response) })) => {
                open.awaited -= 1;
                Ok(response)
            }
            Ok(Some(_)) => Err(Attempt::last(ClientError::protocol("expected an answer, got an empty one"))),
            Ok(None) => {
                self.open = None;
                Err(broken("the stream ended".into()))
            }
            Err(status) => {
                self.open = None;
                if is_broken(&status) {
                    return Err(broken(status.message().into()));
                }
                // The server may not have noticed yet that our last stream is gone. It carried out nothing.
                let error = ClientError::from(status);
                let retry = fresh && error.code() == Code::FailedPrecondition && error.field() == Some("session_id");
                Err(Attempt { retry, error })
            }
        }
    }

    pub async fn render(&mut self, index: u32, mode: RenderMode) -> Result<pb::RenderResponse, ClientError> {
        let mode = match mode {
            RenderMode::Ansi => pb::RenderMode::Ansi,
            RenderMode::RgbArray => pb::RenderMode::RgbArray,
            RenderMode::Png => pb::RenderMode::Png,
        };
        let request = pb::RenderRequest { session_id: self.id.clone(), index, mode: mode.into() };
        let Connection { wire, service } = &self.connection;
        reconnecting(async || wire.within(service.clone().render(request.clone())).await).await
    }

    pub async fn render_image(&mut self, index: u32) -> Result<Image, ClientError> {
        let answer = self.render(index, RenderMode::RgbArray).await?;
        if answer.content.len() as u64 != u64::from(answer.width) * u64::from(answer.height) * 3 {
            return Err(ClientError::protocol("expected three bytes a pixel"));
        }
        Ok(Image { width: answer.width, height: answer.height, rgb: answer.content })
    }

    /// Ends the session; a second time does nothing.
    pub async fn close(&mut self) -> Result<(), ClientError> {
        if self.closed {
            return Ok(());
        }
        let outcome = self.call(Ask::Close).await;
        (self.closed, self.open) = (true, None);
        match outcome {
            // Where it is gone already, that is what was wanted.
            Ok(_) | Err(ClientError::Status { code: Code::NotFound | Code::DeadlineExceeded, .. }) => Ok(()),
            Err(error) => Err(error),
        }
    }
}

impl Drop for Session {
    /// Frees the server's memory without waiting for it; should that fail, the lease does.
    fn drop(&mut self) {
        let Ok(runtime) = tokio::runtime::Handle::try_current() else { return };
        if self.closed {
            return;
        }
        let (open, id, mut service) = (self.open.take(), std::mem::take(&mut self.id), self.connection.service.clone());
        let farewell = async move {
            // Our half of the stream ends first, and then the server's, which puts the session back.
            if let Some(open) = open {
                open.finish().await;
            }
            let _ = service.close_session(pb::CloseSessionRequest { session_id: id }).await;
        };
        runtime.spawn(timeout(self.connection.wire.deadline.min(FAREWELL), farewell));
    }
}

/// A failed attempt and whether another one may be made.
struct Attempt {
    retry: bool,
    error: ClientError,
}

impl Attempt {
    fn last(error: ClientError) -> Self {
        Self { retry: false, error }
    }
}
