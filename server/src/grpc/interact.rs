//! The fast path: one stream that owns its session and answers in order.
//!
//! The stream is the body of its response. Where the transport asks it for more to send, it reads a request, steps the
//! batch and writes the answer into the bytes that go out: no task, no channel, no lock and, once its buffers have their
//! size, no allocation lie between. What is waiting is answered in one go, up to [`FRAME_BYTES`], and then nothing more is
//! read until the transport has room: a client that sends ahead and reads nothing is held by the flow control of HTTP/2.
//!
//! Invariants: the batch is out of its slot for as long as the stream lives, so that no step takes a lock; dropping the
//! stream at any point puts it back; a stream that is idle beyond the session's lease ends, and the session with it.
//! A peer that reads no answers is not idle: its session ends with its connection, which pings watch over.
//! Batches are stepped where the request is read, unless that takes so long that others would notice: then on a thread for
//! blocking work.

use super::{aside::Aside, from_proto, host::Host, reply, service::EnvironmentGrpc, status::CallError};
use crate::{
    batch::{Batch, BatchError},
    sessions::{Guard, SessionError, SessionId},
};
use bytes::{Bytes, BytesMut};
use http_body::Frame;
use mazeway_proto::env::{self as pb, environment_service_server::EnvironmentServiceServer, interact_request::Request};
use mazeway_serving::Caller;
use std::{
    convert::Infallible,
    future::Future as _,
    pin::Pin,
    sync::Arc,
    task::{Context, Poll, ready},
    time::{Duration, Instant},
};
use tokio::{
    sync::{mpsc, oneshot},
    task::JoinHandle,
    time::{Sleep, sleep_until},
};
use tokio_stream::Stream as _;
use tokio_util::sync::WaitForCancellationFutureOwned;
use tonic::{
    Status, Streaming,
    body::Body,
    codec::BufferSettings,
    codegen::{BoxFuture, Service, http},
    metadata::GRPC_CONTENT_TYPE,
    server::NamedService,
};
use tonic_prost::ProstCodec;

/// Answers that are gathered before they are handed to the transport.
const FRAME_BYTES: usize = 32 << 10;
/// Bytes that a stream keeps ready for its next request; larger ones take more.
const REQUEST_BYTES: usize = 64;
/// Largest batch that is stepped on an async thread before it is known how long it takes.
pub const INLINE_ENVS: usize = 256;
/// Longest that an async thread is kept from other connections.
const INLINE_TIME: Duration = Duration::from_micros(250);

/// `EnvironmentService`, with `Interact` answered here and everything else by the generated code.
#[derive(Clone)]
pub struct Environments {
    host: Arc<Host>,
    others: EnvironmentServiceServer<EnvironmentGrpc>,
}

impl Environments {
    pub fn new(host: &Arc<Host>) -> Self {
        let max_message_bytes = host.config.max_message_bytes;
        let others = EnvironmentServiceServer::new(EnvironmentGrpc(Arc::clone(host)))
            .max_decoding_message_size(max_message_bytes)
            // A reply's packed arrays are within the limit; their frame comes on top.
            .max_encoding_message_size(max_message_bytes + 4096);
        Self { host: Arc::clone(host), others }
    }
}

impl NamedService for Environments {
    const NAME: &'static str = <EnvironmentServiceServer<EnvironmentGrpc> as NamedService>::NAME;
}

impl Service<http::Request<Body>> for Environments {
    type Response = http::Response<Body>;
    type Error = Infallible;
    type Future = BoxFuture<Self::Response, Infallible>;

    fn poll_ready(&mut self, _: &mut Context<'_>) -> Poll<Result<(), Infallible>> {
        Poll::Ready(Ok(()))
    }

    fn call(&mut self, request: http::Request<Body>) -> Self::Future {
        if request.uri().path().strip_prefix('/').and_then(|path| path.split_once('/'))
            == Some((Self::NAME, "Interact"))
        {
            Box::pin(std::future::ready(Ok(interact(&self.host, request))))
        } else {
            self.others.call(request)
        }
    }
}

/// Answers the requests in the body of `request`, in order.
fn interact(host: &Arc<Host>, request: http::Request<Body>) -> http::Response<Body> {
    if let Some(encoding) = request.headers().get("grpc-encoding").filter(|encoding| *encoding != "identity") {
        let message = format!("expected messages that are not compressed, got {encoding:?}");
        let mut response: http::Response<Body> = Status::unimplemented(message).into_http();
        response.headers_mut().insert("grpc-accept-encoding", http::HeaderValue::from_static("identity"));
        return response;
    }
    let caller = Caller::of_http(&request);
    let settings = BufferSettings::new(REQUEST_BYTES, FRAME_BYTES);
    let decoder = ProstCodec::<pb::InteractResponse, pb::InteractRequest>::raw_decoder(settings);
    let limit = Some(host.config.max_message_bytes);
    let requests = Streaming::new_request(decoder, request.into_body(), None, limit);
    let mut response = http::Response::new(Body::new(Interaction::new(Arc::clone(host), caller, requests)));
    response.headers_mut().insert(http::header::CONTENT_TYPE, GRPC_CONTENT_TYPE);
    response
}

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

/// Where a stream is.
enum Phase {
    Reading,
    /// The batch is being stepped on another thread.
    Working(JoinHandle<Done>),
    /// What is written still goes out, and then this.
    Ending(Status),
    Ended,
}

/// A batch that comes back, and the bytes with its answer.
type Done = (Guard, BytesMut, Result<(), CallError>, Duration);

/// A stream and, from its first message on, its session.
struct Interaction {
    host: Arc<Host>,
    caller: Caller,
    requests: Streaming<pb::InteractRequest>,
    /// Read, but to be answered after what is written has gone.
    waiting: Option<Request>,
    held: Option<Guard>,
    phase: Phase,
    /// Answers that nobody has fetched.
    out: BytesMut,
    /// Bytes that were fetched the last time: as many may be needed again.
    fetched: usize,
    lease: Duration,
    last_used: Instant,
    /// How long the last step took, where that was measured.
    took: Option<Duration>,
    aside: Aside,
    /// Armed for the lease after some use; looked at anew when it fires, so that a step need not touch a timer.
    idle: Pin<Box<Sleep>>,
    shutdown: Pin<Box<WaitForCancellationFutureOwned>>,
    draw_sender: DrawSender,
    draw_jobs: mpsc::Receiver<DrawJob>,
}

impl http_body::Body for Interaction {
    type Data = Bytes;
    type Error = Status;

    fn poll_frame(self: Pin<&mut Self>, cx: &mut Context<'_>) -> Poll<Option<Result<Frame<Bytes>, Status>>> {
        let this = self.get_mut();
        loop {
            if let Phase::Working(work) = &mut this.phase {
                match ready!(Pin::new(work).poll(cx)) {
                    Ok(done) => this.take_back(done),
                    Err(error) => this.end(CallError::Internal(error.to_string()).into()),
                }
            }
            // Also what a request waits for that is to be answered on another thread.
            if this.out.len() >= FRAME_BYTES || (this.waiting.is_some() && !this.out.is_empty()) {
                return this.fetch();
            }
            match &this.phase {
                Phase::Reading | Phase::Working(_) => {}
                Phase::Ending(_) | Phase::Ended if !this.out.is_empty() => return this.fetch(),
                Phase::Ending(status) => {
                    let mut trailers = http::HeaderMap::with_capacity(3);
                    let written = status.add_header(&mut trailers);
                    this.phase = Phase::Ended;
                    return Poll::Ready(Some(written.map(|()| Frame::trailers(trailers))));
                }
                Phase::Ended => return Poll::Ready(None),
            }
            if let Some(request) = this.waiting.take() {
                this.answer(request);
                continue;
            }
            match Pin::new(&mut this.requests).poll_next(cx) {
                Poll::Ready(Some(Ok(pb::InteractRequest { request: Some(request) }))) => this.answer(request),
                Poll::Ready(Some(Ok(pb::InteractRequest { request: None }))) => {
                    this.end(CallError::malformed("request", "expected reset, step or close, got none").into());
                }
                Poll::Ready(Some(Err(status))) => this.end(status),
                Poll::Ready(None) => this.end(Status::new(tonic::Code::Ok, "")),
                Poll::Pending if !this.out.is_empty() => return this.fetch(),
                // Requests come first: the rest is looked at only when none is waiting.
                Poll::Pending if this.aside.has_rung(cx) => {
                    this.look_aside();
                    if matches!(this.phase, Phase::Reading) {
                        // Should it have rung meanwhile, it has woken this task.
                        return Poll::Pending;
                    }
                }
                Poll::Pending => return Poll::Pending,
            }
        }
    }
}

impl Interaction {
    fn new(host: Arc<Host>, caller: Caller, requests: Streaming<pb::InteractRequest>) -> Self {
        let (draw_sender, draw_jobs) = mpsc::channel(1);
        let (lease, last_used) = (host.config.default_lease, Instant::now());
        Self {
            idle: Box::pin(sleep_until((last_used + lease).into())),
            shutdown: Box::pin(host.shutdown.clone().cancelled_owned()),
            host,
            caller,
            requests,
            waiting: None,
            held: None,
            phase: Phase::Reading,
            out: BytesMut::new(),
            fetched: 0,
            lease,
            last_used,
            took: None,
            aside: Aside::new(),
            draw_sender,
            draw_jobs,
        }
    }

    /// What is written, as one frame.
    fn fetch(&mut self) -> Poll<Option<Result<Frame<Bytes>, Status>>> {
        let bytes = self.out.split().freeze();
        self.fetched = bytes.len();
        Poll::Ready(Some(Ok(Frame::data(bytes))))
    }

    /// Ends the stream once what is written has gone. The session is back in its slot before the caller hears of it.
    fn end(&mut self, status: Status) {
        self.held = None;
        self.phase = Phase::Ending(status);
    }

    fn answer(&mut self, request: Request) {
        if let Err(error) = self.try_answer(request) {
            self.end(error.into());
        }
    }

    fn try_answer(&mut self, request: Request) -> Result<(), CallError> {
        let session_id = match &request {
            Request::Reset(request) => &request.session_id,
            Request::Step(request) => &request.session_id,
            Request::Close(request) => &request.session_id,
        };
        let guard = match &mut self.held {
            // All but the first message may leave it out.
            Some(guard) if session_id.is_empty() || SessionId::parse(session_id) == Some(guard.id()) => guard,
            Some(_) => {
                let message = "expected the session that the stream began with, or none";
                return Err(CallError::malformed("session_id", message));
            }
            None => {
                let (id, owner) = (from_proto::session_id(session_id)?, Arc::new(self.draw_sender.clone()));
                let guard = self.host.sessions.take(id, self.caller.name(), Instant::now(), Some(owner))?;
                self.lease = guard.lease();
                self.idle.as_mut().reset((Instant::now() + self.lease).into());
                guard.set_waker(self.aside.waker().clone());
                self.aside.waker().wake_by_ref();
                self.held.insert(guard)
            }
        };
        if let Request::Close(_) = request {
            if let Some(guard) = self.held.take() {
                guard.close();
            }
            reply::close(&mut self.out);
            self.end(Status::new(tonic::Code::Ok, ""));
            return Ok(());
        }
        let inline = match self.took {
            Some(took) => took <= INLINE_TIME,
            None => guard.options().num_envs <= INLINE_ENVS,
        };
        if inline {
            if self.out.is_empty() {
                self.out.reserve(self.fetched);
            }
            let begun = Instant::now();
            work(&mut **guard, &request, &mut self.out)?;
            guard.show();
            self.last_used = Instant::now();
            let took = self.last_used - begun;
            self.took = Some(took);
            if let Request::Step(_) = request {
                self.host.numbers.stepped(guard.options().num_envs, took);
            }
        } else if !self.out.is_empty() {
            // The answers before it need not wait for it.
            self.waiting = Some(request);
        } else if let Some(mut guard) = self.held.take() {
            let (mut out, host) = (std::mem::take(&mut self.out), Arc::clone(&self.host));
            self.phase = Phase::Working(tokio::task::spawn_blocking(move || {
                let begun = Instant::now();
                let outcome = work(&mut *guard, &request, &mut out);
                let took = begun.elapsed();
                if let (Request::Step(_), Ok(())) = (&request, &outcome) {
                    host.numbers.stepped(guard.options().num_envs, took);
                }
                (guard, out, outcome, took)
            }));
        }
        Ok(())
    }

    fn take_back(&mut self, (guard, out, outcome, took): Done) {
        guard.show();
        (self.held, self.out) = (Some(guard), out);
        (self.last_used, self.took) = (Instant::now(), Some(took));
        self.phase = Phase::Reading;
        if let Err(error) = outcome {
            self.end(error.into());
        }
    }

    /// Does what others want of the stream, until nobody wants anything.
    fn look_aside(&mut self) {
        let waker = self.aside.waker().clone();
        let mut cx = Context::from_waker(&waker);
        if let Some(guard) = &self.held {
            guard.show();
        }
        while let Poll::Ready(Some(job)) = self.draw_jobs.poll_recv(&mut cx) {
            let picture = match &self.held {
                Some(guard) => draw(&**guard, job.index, job.mode),
                None => Err(BatchError::NeverReset),
            };
            // A caller that has gone wants no picture.
            let _ = job.reply.send(picture);
        }
        if self.shutdown.as_mut().poll(&mut cx).is_ready() {
            return self.end(CallError::ShuttingDown.into());
        }
        while self.idle.as_mut().poll(&mut cx).is_ready() {
            let expires = self.last_used + self.lease;
            if expires <= Instant::now() {
                if let Some(guard) = self.held.take() {
                    guard.expire();
                }
                return self.end(CallError::Session(SessionError::Expired).into());
            }
            self.idle.as_mut().reset(expires.into());
        }
    }
}

/// Resets or steps a batch and appends the answer.
fn work(batch: &mut dyn Batch, request: &Request, out: &mut BytesMut) -> Result<(), CallError> {
    match request {
        Request::Reset(request) => {
            let (seeds, mask) = from_proto::reset(request)?;
            reply::reset(batch.reset(seeds, mask)?, out);
        }
        Request::Step(request) => reply::step(batch.step(&request.actions)?, out),
        Request::Close(_) => {}
    }
    Ok(())
}

/// Does something to a batch for one call, where it costs others least.
pub async fn run<T: Send + 'static>(
    mut guard: Guard,
    work: impl FnOnce(&mut dyn Batch) -> Result<T, CallError> + Send + 'static,
) -> Result<T, CallError> {
    if guard.options().num_envs <= INLINE_ENVS {
        return work(&mut *guard);
    }
    let done = tokio::task::spawn_blocking(move || work(&mut *guard));
    done.await.map_err(|error| CallError::Internal(error.to_string()))?
}
