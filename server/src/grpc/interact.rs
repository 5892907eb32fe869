//! The fast path: one stream that owns its session and answers in order.
//!
//! Invariants: the batch is out of its slot for as long as the stream lives, so that no step takes a lock; dropping the
//! stream at any point puts it back; a stream that is idle beyond the session's lease ends, and the session with it.
//! A peer that reads no answers is not idle: its session ends with its connection, which pings watch over.
//! Small batches are stepped where the request is read; large ones on a thread for blocking work.

use super::{from_proto, host::Host, status::CallError, to_proto};
use crate::{
    batch::{Batch, BatchError},
    sessions::{Guard, SessionError, SessionId},
};
use futures_util::{Stream, stream};
use mazeway_proto::env::{self as pb, interact_request::Request, interact_response::Response};
use std::{
    pin::Pin,
    sync::Arc,
    time::{Duration, Instant},
};
use tokio::{
    sync::{mpsc, oneshot},
    time::{Sleep, sleep_until},
};
use tokio_util::sync::WaitForCancellationFutureOwned;
use tonic::{Status, Streaming};

/// Largest batch that is stepped on an async thread: some hundred microseconds of the costliest simulator.
pub const INLINE_ENVS: usize = 256;

/// A picture wanted of a session that a stream owns, drawn between two of its steps.
pub struct DrawJob {
    pub index: usize,
    pub mode: from_proto::RenderMode,
    pub reply: oneshot::Sender<Result<String, BatchError>>,
}

/// How others reach the stream that owns a session.
pub type DrawSender = mpsc::Sender<DrawJob>;

/// Draws as text: the picture itself or an SVG document of it.
pub fn draw(batch: &dyn Batch, index: usize, mode: from_proto::RenderMode) -> Result<String, BatchError> {
    match mode {
        from_proto::RenderMode::Ansi => batch.render_text(index),
        from_proto::RenderMode::RgbArray | from_proto::RenderMode::Png => batch.render_svg(index),
    }
}

/// Answers the requests of `inbound`, in order.
pub fn interact(
    host: Arc<Host>,
    inbound: Streaming<pb::InteractRequest>,
) -> impl Stream<Item = Result<pb::InteractResponse, Status>> + Send {
    let (draw_sender, draw_jobs) = mpsc::channel(1);
    let lease = host.config.default_lease;
    let state = Interaction {
        idle: Box::pin(sleep_until((Instant::now() + lease).into())),
        shutdown: Box::pin(host.shutdown.clone().cancelled_owned()),
        host,
        inbound,
        held: None,
        lease,
        last_used: Instant::now(),
        draw_sender,
        draw_jobs,
    };
    // After an error or the end there is no state, and so nothing more to be asked.
    stream::unfold(Some(state), async |state| {
        let mut state = state?;
        match state.next().await {
            Ok(Some(Response::Close(answer))) => Some((Ok(Response::Close(answer)), None)),
            Ok(Some(answer)) => Some((Ok(answer), Some(state))),
            Ok(None) => None,
            Err(status) => {
                // The session is back in its slot before the caller hears of the end.
                drop(state);
                Some((Err(status), None))
            }
        }
        .map(|(answer, state)| (answer.map(|response| pb::InteractResponse { response: Some(response) }), state))
    })
}

struct Interaction {
    host: Arc<Host>,
    inbound: Streaming<pb::InteractRequest>,
    held: Option<Guard>,
    lease: Duration,
    last_used: Instant,
    /// Armed for the lease after some use; looked at anew when it fires, so that a step need not touch a timer.
    idle: Pin<Box<Sleep>>,
    shutdown: Pin<Box<WaitForCancellationFutureOwned>>,
    draw_sender: DrawSender,
    draw_jobs: mpsc::Receiver<DrawJob>,
}

impl Interaction {
    async fn next(&mut self) -> Result<Option<Response>, Status> {
        let request = loop {
            // Requests come first: the rest is looked at only when none is waiting.
            tokio::select! {
                biased;
                message = self.inbound.message() => match message? {
                    None => return Ok(None),
                    Some(pb::InteractRequest { request: Some(request) }) => break request,
                    Some(pb::InteractRequest { request: None }) => {
                        let message = "expected reset, step or close, got none";
                        return Err(CallError::malformed("request", message).into());
                    }
                },
                Some(job) = self.draw_jobs.recv() => self.draw(job),
                () = &mut self.shutdown => return Err(CallError::ShuttingDown.into()),
                () = &mut self.idle => {
                    let expires = self.last_used + self.lease;
                    if expires <= Instant::now() {
                        if let Some(guard) = self.held.take() {
                            guard.expire();
                        }
                        return Err(CallError::Session(SessionError::Expired).into());
                    }
                    self.idle.as_mut().reset(expires.into());
                }
            }
        };
        let answer = self.answer(request).await?;
        self.last_used = Instant::now();
        Ok(Some(answer))
    }

    async fn answer(&mut self, request: Request) -> Result<Response, CallError> {
        match request {
            Request::Reset(request) => {
                let guard = self.hold(&request.session_id)?;
                let (guard, answer) = run(guard, move |batch| {
                    let (seeds, mask) = from_proto::reset(&request)?;
                    Ok(to_proto::reset(batch.reset(seeds, mask)?))
                })
                .await?;
                self.held = Some(guard);
                Ok(Response::Reset(answer?))
            }
            Request::Step(request) => {
                let guard = self.hold(&request.session_id)?;
                let (guard, answer) =
                    run(guard, move |batch| Ok(to_proto::step(batch.step(&request.actions)?))).await?;
                self.held = Some(guard);
                Ok(Response::Step(answer?))
            }
            Request::Close(request) => {
                self.hold(&request.session_id)?.close();
                Ok(Response::Close(pb::CloseSessionResponse {}))
            }
        }
    }

    /// The stream's session: the first message says which it is.
    fn hold(&mut self, session_id: &str) -> Result<Guard, CallError> {
        let Some(guard) = self.held.take() else {
            let id = from_proto::session_id(session_id)?;
            let owner = Arc::new(self.draw_sender.clone());
            let guard = self.host.sessions.take(id, Instant::now(), Some(owner))?;
            self.lease = guard.lease();
            self.last_used = Instant::now();
            self.idle.as_mut().reset((self.last_used + self.lease).into());
            return Ok(guard);
        };
        if session_id.is_empty() || SessionId::parse(session_id) == Some(guard.id()) {
            Ok(guard)
        } else {
            Err(CallError::malformed("session_id", "expected the session that the stream began with, or none"))
        }
    }

    fn draw(&mut self, job: DrawJob) {
        let picture = match &self.held {
            Some(guard) => draw(&**guard, job.index, job.mode),
            None => Err(BatchError::NeverReset),
        };
        // A caller that has gone wants no picture.
        let _ = job.reply.send(picture);
    }
}

/// Does something to a batch, where it costs others least, and gives it back.
pub async fn run<T: Send + 'static>(
    mut guard: Guard,
    work: impl FnOnce(&mut dyn Batch) -> Result<T, CallError> + Send + 'static,
) -> Result<(Guard, Result<T, CallError>), CallError> {
    if guard.options().num_envs <= INLINE_ENVS {
        let answer = work(&mut *guard);
        return Ok((guard, answer));
    }
    let done = tokio::task::spawn_blocking(move || {
        let answer = work(&mut *guard);
        (guard, answer)
    });
    done.await.map_err(|error| CallError::Internal(error.to_string()))
}
