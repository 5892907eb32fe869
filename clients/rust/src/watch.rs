//! Pictures of a session that somebody steps, as they change.

use crate::{ClientError, Connection};
use bytes::Bytes;
use mazeway_proto::env as pb;
use tokio::time::timeout;
use tonic::{Code, Streaming};

/// What a picture is.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub enum PictureMode {
    /// Text.
    #[default]
    Text,
    /// Raw RGB bytes, shape `(height, width, 3)`.
    Rgb,
    /// A PNG file.
    Png,
}

/// What is watched, and how.
#[derive(Debug, Clone, Copy, PartialEq, Default)]
pub struct WatchOptions {
    /// Which environment of the batch.
    pub index: u32,
    /// What the pictures are.
    pub mode: PictureMode,
    /// Pictures a second at most; `None`: as many as look natural.
    pub max_fps: Option<f32>,
    /// Pixels across at most, not for text; `None`: as wide as the environment draws.
    pub max_width: Option<u32>,
}

/// A picture and when it was.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Frame {
    /// As the mode says.
    pub content: Bytes,
    /// Pixels across; 0 for text.
    pub width: u32,
    /// Pixels down; 0 for text.
    pub height: u32,
    /// Steps of the session so far.
    pub step: u64,
    /// Steps of the environment's present episode so far.
    pub episode_step: u32,
    /// That episode has ended, and no other has begun.
    pub episode_ended: bool,
    /// Steps and resets since the picture before that were not shown.
    pub skipped: u64,
}

/// Pictures as they come. Dropping it ends the watch.
#[derive(Debug)]
pub struct Frames {
    connection: Connection,
    answers: Streaming<pb::WatchResponse>,
}

impl Frames {
    /// The next picture, once something has changed; `None` once the session has ended. A reader that comes late finds the
    /// later picture.
    ///
    /// It waits for as long as nothing happens in the environment. Where there is no picture within
    /// [`ConnectOptions::deadline`](crate::ConnectOptions::deadline), the server is asked whether it is there, and has as long
    /// to say so: then the wait goes on.
    ///
    /// # Errors
    /// No such session or environment, a limit; a server that goes away, or gives no sign of life.
    pub async fn next(&mut self) -> Result<Option<Frame>, ClientError> {
        let answer = loop {
            match timeout(self.connection.wire.deadline, self.answers.message()).await {
                Ok(answer) => break answer?,
                Err(_) => self.connection.ask_whether_it_is_there().await?,
            }
        };
        let Some(answer) = answer else { return Ok(None) };
        let pb::WatchResponse { content, width, height, step, episode_step, episode_ended, skipped } = answer;
        Ok(Some(Frame { content, width, height, step, episode_step, episode_ended, skipped }))
    }
}

impl Connection {
    /// Watches a session, whoever steps it, by its id ([`crate::Env::session_id`]).
    ///
    /// # Errors
    /// No such session, a wrong option; all else comes with the first picture.
    pub async fn watch(&self, session_id: &str, options: WatchOptions) -> Result<Frames, ClientError> {
        let mode = match options.mode {
            PictureMode::Text => pb::RenderMode::Ansi,
            PictureMode::Rgb => pb::RenderMode::RgbArray,
            PictureMode::Png => pb::RenderMode::Png,
        };
        let request = pb::WatchRequest {
            session_id: session_id.into(),
            index: options.index,
            mode: mode.into(),
            max_fps: options.max_fps.unwrap_or_default(),
            max_width: options.max_width.unwrap_or_default(),
        };
        let answers = self.wire.within(self.service.clone().watch(request)).await?;
        Ok(Frames { connection: self.clone(), answers })
    }

    /// Asks the server for what anybody may ask; a refusal is a sign of life as well.
    async fn ask_whether_it_is_there(&self) -> Result<(), ClientError> {
        match self.wire.within(self.service.clone().list_environments(pb::ListEnvironmentsRequest {})).await {
            Err(error) if matches!(error.code(), Code::DeadlineExceeded | Code::Unavailable) => Err(error),
            _ => Ok(()),
        }
    }
}
