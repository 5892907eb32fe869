//! A session over one interactive stream: what [`crate::Env`] and [`crate::VectorEnv`] have in common.
//!
//! Invariants: answers are matched to requests by their order, also where a caller dropped a call half-way; a request whose
//! outcome is unknown is never sent twice, unless doing so changes nothing (a seeded reset of all environments).

use crate::{
    ClientError, Connection, EnvSpec,
    spec::{Options, options_to_wire},
    stream::{Ask, Open, Sent},
};
use mazeway_proto::env::{self as pb, AutoresetMode, interact_response::Response};
use std::time::{Duration, Instant};
use tonic::{Code, Status};

/// Requests that may be sent before the first of their answers is received.
const MAX_UNDER_WAY: usize = 4096;
/// How long a session is tried to be taken up again, unless asked otherwise.
const RESUME: Duration = Duration::from_secs(10);

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
    closed: bool,
}

/// True where the connection and not the server is to blame.
fn is_broken(status: &Status) -> bool {
    use std::error::Error as _;
    matches!(status.code(), Code::Unavailable | Code::Cancelled)
        || (status.code() == Code::Unknown && status.source().is_some())
        || (status.code() == Code::Internal && status.message().contains("h2 protocol error"))
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
        let answer = connection.service.clone().create_session(request).await?.into_inner();
        Self::attach(connection, answer, options.resume_within)
    }

    /// Over a session that exists, as the server described it.
    pub fn attach(
        connection: Connection,
        created: pb::CreateSessionResponse,
        resume_within: Option<Duration>,
    ) -> Result<Self, ClientError> {
        let spec = created.spec.ok_or_else(|| ClientError::protocol("expected a description of the session"))?;
        let lease = created.lease.and_then(|lease| Duration::try_from(lease).ok()).unwrap_or(RESUME);
        Ok(Self {
            connection,
            id: created.session_id,
            spec: EnvSpec::from_wire(spec)?,
            num_envs: created.num_envs as usize,
            max_episode_steps: created.max_episode_steps,
            resume_within: resume_within.unwrap_or(RESUME).min(lease),
            open: None,
            closed: false,
        })
    }

    pub fn id(&self) -> &str {
        &self.id
    }

    /// The stream, opened anew where there is none, and the session's id.
    async fn stream(&mut self) -> Result<(&mut Open, &str), Status> {
        if self.open.is_none() {
            self.open = Some(Open::new(self.connection.channel.clone()).await?);
        }
        Ok((self.open.as_mut().expect("just opened"), &self.id))
    }

    /// Sends a request whose answer [`Self::receive`] will bring.
    pub async fn send(&mut self, ask: Ask<'_>) -> Result<(), ClientError> {
        if self.closed {
            return Err(ClientError::Argument { field: "session_id", message: "the environment was closed".into() });
        }
        let (open, id) = self.stream().await?;
        let too_many = |message| Err(ClientError::Argument { field: "request", message });
        if open.awaited == MAX_UNDER_WAY {
            return too_many(format!("expected at most {MAX_UNDER_WAY} requests without receiving their answers"));
        }
        match open.send(ask, id).await {
            Sent::Yes => Ok(()),
            Sent::Full => too_many("expected the answers that are waiting to be received before more is sent".into()),
            // Where it ended with answers to come, the last of these says why.
            Sent::Ended if open.awaited > 0 => Ok(()),
            Sent::Ended => {
                self.open = None;
                Err(ClientError::Interrupted { request: ask.name(), message: "the stream ended".into() })
            }
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
        match open.answer().await {
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
        let (mut give_up, mut pause) = (None, Duration::from_millis(5));
        loop {
            let error = match self.try_call(ask).await {
                Ok(response) => return Ok(response),
                Err(error) => error,
            };
            // The clock is asked once something is wrong.
            let give_up = *give_up.get_or_insert_with(|| Instant::now() + self.resume_within);
            if !error.retry || Instant::now() + pause > give_up {
                return Err(error.error);
            }
            tokio::time::sleep(pause).await;
            pause = (pause * 2).min(Duration::from_millis(500));
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
        // Nothing was sent yet: whatever fails here may be tried again.
        let stream = self.stream().await;
        let (open, id) = stream.map_err(|status| Attempt { retry: is_broken(&status), error: status.into() })?;
        if open.send(ask, id).await != Sent::Yes {
            self.open = None;
            let error = ClientError::Interrupted { request: ask.name(), message: "the stream ended".into() };
            return Err(Attempt { retry: true, error });
        }
        let answer = open.answer().await;
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
        Ok(self.connection.service.clone().render(request).await?.into_inner())
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
            Ok(_) => Ok(()),
            // It is gone already, which is what was wanted.
            Err(error) if matches!(error.code(), Code::NotFound | Code::DeadlineExceeded) => Ok(()),
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
        runtime.spawn(async move {
            // Our half of the stream ends first, and then the server's, which puts the session back.
            if let Some(open) = open {
                open.finish().await;
            }
            let _ = service.close_session(pb::CloseSessionRequest { session_id: id }).await;
        });
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
