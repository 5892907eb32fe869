//! An open interactive stream: requests are written into the bytes that go out, answers are views of those that came in.
//!
//! Invariants: bytes that wait to be sent are bounded, and so are answers that wait to be received; neither side waits
//! while the other waits for it. Deliberately absent: sessions, and what to do when a stream breaks.

use bytes::{BufMut as _, Bytes, BytesMut};
use http_body::{Body as HttpBody, Frame};
use mazeway_proto::env::{self as pb, interact_request::Request};
use prost::{
    Message as _,
    encoding::{WireType, encode_key, encode_varint, encoded_len_varint, key_len},
};
use std::{
    collections::VecDeque,
    convert::Infallible,
    future::poll_fn,
    pin::Pin,
    sync::{Arc, Mutex, MutexGuard, PoisonError},
    task::{Context, Poll, Waker},
};
use tokio_stream::Stream as _;
use tonic::{
    Code, Status, Streaming,
    body::Body,
    codec::BufferSettings,
    codegen::{Service as _, http},
    metadata::GRPC_CONTENT_TYPE,
};
use tonic_prost::ProstCodec;

use crate::{connect::Wire, connection::MAX_MESSAGE_BYTES};

/// The method.
const INTERACT: &str = "/mazeway.env.v1.EnvironmentService/Interact";
/// Bytes of requests that may wait to be sent, or one request beyond them.
const WAITING_BYTES: usize = 64 << 10;
/// Bytes of answers that may wait to be received while more is sent.
const EARLY_BYTES: usize = 256 << 20;
/// Bytes of gRPC's frame: a flag and the length of the message.
const FRAME_LEN: usize = 5;
/// Bytes that a stream keeps ready for its next answer; larger ones take more.
const ANSWER_BYTES: usize = 256;

/// A request to be written as often as it takes.
#[derive(Debug, Clone, Copy)]
pub(crate) enum Ask<'a> {
    Reset(&'a pb::ResetRequest),
    /// An action an environment.
    Step(&'a [u32]),
    Close,
}

impl Ask<'_> {
    /// What it is called in an error.
    pub fn name(self) -> &'static str {
        match self {
            Self::Reset(_) => "reset",
            Self::Step(_) => "step",
            Self::Close => "close",
        }
    }

    /// True where sending the request a second time changes nothing.
    pub fn is_repeatable(self) -> bool {
        match self {
            Self::Reset(reset) => (reset.seed.is_some() || !reset.seeds.is_empty()) && reset.reset_mask.is_empty(),
            Self::Step(_) => false,
            Self::Close => true,
        }
    }

    /// Appends it as a framed `InteractRequest`.
    fn write(self, session_id: &str, out: &mut BytesMut) {
        match self {
            Self::Reset(reset) => {
                let reset = pb::ResetRequest { session_id: session_id.into(), ..reset.clone() };
                write(&pb::InteractRequest { request: Some(Request::Reset(reset)) }, out);
            }
            Self::Step(actions) => write_step(session_id, actions, out),
            Self::Close => {
                let close = pb::CloseSessionRequest { session_id: session_id.into() };
                write(&pb::InteractRequest { request: Some(Request::Close(close)) }, out);
            }
        }
    }
}

fn begin_message(len: usize, out: &mut BytesMut) {
    out.reserve(FRAME_LEN + len);
    // Not compressed.
    out.put_u8(0);
    out.put_u32(len as u32);
}

fn write(message: &pb::InteractRequest, out: &mut BytesMut) {
    begin_message(message.encoded_len(), out);
    message.encode_raw(out);
}

/// The step of an `InteractRequest` without a message in between.
fn write_step(session_id: &str, actions: &[u32], out: &mut BytesMut) {
    let field_len = |number, len: usize| key_len(number) + encoded_len_varint(len as u64) + len;
    let begin_field = |number, len: usize, out: &mut BytesMut| {
        encode_key(number, WireType::LengthDelimited, out);
        encode_varint(len as u64, out);
    };
    let bytes = actions.len() * 4;
    // As proto3 has it, an empty field is left out.
    let id_len = if session_id.is_empty() { 0 } else { field_len(1, session_id.len()) };
    let len = id_len + if bytes == 0 { 0 } else { field_len(2, bytes) };
    begin_message(field_len(2, len), out);
    begin_field(2, len, out);
    if !session_id.is_empty() {
        begin_field(1, session_id.len(), out);
        out.put_slice(session_id.as_bytes());
    }
    if bytes > 0 {
        begin_field(2, bytes, out);
        let start = out.len();
        out.resize(start + bytes, 0);
        for (slot, action) in out[start..].as_chunks_mut::<4>().0.iter_mut().zip(actions) {
            *slot = action.to_le_bytes();
        }
    }
}

/// Requests on their way to the transport.
#[derive(Debug, Default)]
struct Outbox {
    bytes: BytesMut,
    /// Nothing more will come.
    ended: bool,
    /// Nobody fetches any more.
    abandoned: bool,
    /// Bytes that were fetched the last time: as many may be needed again.
    fetched: usize,
    transport: Option<Waker>,
    writer: Option<Waker>,
}

/// The outbox as its two sides share it. Each holds the lock for as long as it copies a request.
#[derive(Debug, Clone, Default)]
struct Shared(Arc<Mutex<Outbox>>);

impl Shared {
    fn lock(&self) -> MutexGuard<'_, Outbox> {
        self.0.lock().unwrap_or_else(PoisonError::into_inner)
    }

    fn end(&self) {
        let mut outbox = self.lock();
        outbox.ended = true;
        let waker = outbox.transport.take();
        drop(outbox);
        if let Some(waker) = waker {
            waker.wake();
        }
    }
}

/// The transport's side: the body of the HTTP request.
struct RequestBody(Shared);

impl HttpBody for RequestBody {
    type Data = Bytes;
    type Error = Infallible;

    fn poll_frame(self: Pin<&mut Self>, cx: &mut Context<'_>) -> Poll<Option<Result<Frame<Bytes>, Infallible>>> {
        let mut outbox = self.0.lock();
        if !outbox.bytes.is_empty() {
            let bytes = outbox.bytes.split().freeze();
            outbox.fetched = bytes.len();
            let waker = outbox.writer.take();
            drop(outbox);
            if let Some(waker) = waker {
                waker.wake();
            }
            Poll::Ready(Some(Ok(Frame::data(bytes))))
        } else if outbox.ended {
            Poll::Ready(None)
        } else {
            if !outbox.transport.as_ref().is_some_and(|waker| waker.will_wake(cx.waker())) {
                outbox.transport = Some(cx.waker().clone());
            }
            Poll::Pending
        }
    }
}

impl Drop for RequestBody {
    fn drop(&mut self) {
        let mut outbox = self.0.lock();
        outbox.abandoned = true;
        let waker = outbox.writer.take();
        drop(outbox);
        if let Some(waker) = waker {
            waker.wake();
        }
    }
}

/// What came: an answer, the end, or why there is none.
pub(crate) type Answer = Result<Option<pb::InteractResponse>, Status>;

/// How a request fared.
#[derive(Debug, PartialEq, Eq)]
pub(crate) enum Sent {
    Yes,
    /// The stream has ended.
    Ended,
    /// Too much waits to be received.
    Full,
}

/// An open stream.
#[derive(Debug)]
pub(crate) struct Open {
    outbox: Shared,
    answers: Streaming<pb::InteractResponse>,
    /// Answers that were read to make room for further requests.
    early: VecDeque<Answer>,
    early_bytes: usize,
    /// Requests whose answer nobody has received.
    pub awaited: usize,
    /// The server knows which session it is.
    named: bool,
}

impl Open {
    pub async fn new(mut channel: Wire) -> Result<Self, Status> {
        let outbox = Shared::default();
        let mut request = http::Request::post(INTERACT)
            .header(http::header::TE, "trailers")
            .body(Body::new(RequestBody(outbox.clone())))
            .map_err(|error| Status::internal(error.to_string()))?;
        *request.version_mut() = http::Version::HTTP_2;
        request.headers_mut().insert(http::header::CONTENT_TYPE, GRPC_CONTENT_TYPE);
        poll_fn(|cx| channel.poll_ready(cx)).await.map_err(|error| Status::from_error(Box::new(error)))?;
        let response = channel.call(request).await.map_err(|error| Status::from_error(Box::new(error)))?;
        if let Some(status) = Status::from_header_map(response.headers()).filter(|status| status.code() != Code::Ok) {
            return Err(status);
        }
        let (parts, body) = response.into_parts();
        let settings = BufferSettings::new(ANSWER_BYTES, WAITING_BYTES);
        let decoder = ProstCodec::<pb::InteractRequest, pb::InteractResponse>::raw_decoder(settings);
        let answers = Streaming::new_response(decoder, body, parts.status, None, Some(MAX_MESSAGE_BYTES));
        Ok(Self { outbox, answers, early: VecDeque::new(), early_bytes: 0, awaited: 0, named: false })
    }

    /// Waits for the oldest answer that nobody has received.
    pub async fn answer(&mut self) -> Answer {
        match self.early.pop_front() {
            Some(answer) => {
                self.early_bytes -= answer_bytes(&answer);
                answer
            }
            None => self.answers.message().await,
        }
    }

    /// Sends a request, reading answers as long as there is no room for it: otherwise both sides could wait for each
    /// other.
    pub async fn send(&mut self, ask: Ask<'_>, session_id: &str) -> Sent {
        poll_fn(|cx| self.poll_send(ask, session_id, cx)).await
    }

    fn poll_send(&mut self, ask: Ask<'_>, session_id: &str, cx: &mut Context<'_>) -> Poll<Sent> {
        let mut outbox = self.outbox.lock();
        if outbox.abandoned {
            return Poll::Ready(Sent::Ended);
        }
        if outbox.bytes.len() < WAITING_BYTES {
            if outbox.bytes.is_empty() {
                let expected = outbox.fetched;
                outbox.bytes.reserve(expected);
            }
            ask.write(if self.named { "" } else { session_id }, &mut outbox.bytes);
            (self.named, self.awaited) = (true, self.awaited + 1);
            let waker = outbox.transport.take();
            drop(outbox);
            if let Some(waker) = waker {
                waker.wake();
            }
            return Poll::Ready(Sent::Yes);
        }
        outbox.writer = Some(cx.waker().clone());
        drop(outbox);
        while self.awaited > self.early.len() && self.early.back().is_none_or(|answer| matches!(answer, Ok(Some(_)))) {
            if self.early_bytes > EARLY_BYTES {
                return Poll::Ready(Sent::Full);
            }
            let answer = match Pin::new(&mut self.answers).poll_next(cx) {
                Poll::Ready(answer) => answer.transpose(),
                Poll::Pending => break,
            };
            self.early_bytes += answer_bytes(&answer);
            self.early.push_back(answer);
        }
        Poll::Pending
    }

    /// True where what was written last has not been sent and never will be.
    pub fn is_unsent(&self) -> bool {
        let outbox = self.outbox.lock();
        outbox.abandoned && !outbox.bytes.is_empty()
    }

    /// Ends this side's half and waits for the other's, for as long as the caller does: a server that stands still never ends
    /// it.
    pub async fn finish(mut self) {
        self.outbox.end();
        while let Ok(Some(_)) = self.answers.message().await {}
    }
}

impl Drop for Open {
    fn drop(&mut self) {
        self.outbox.end();
    }
}

/// Bytes that an answer keeps, nearly.
fn answer_bytes(answer: &Answer) -> usize {
    match answer {
        Ok(Some(answer)) => answer.encoded_len(),
        _ => 0,
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::packed::pack;

    #[test]
    fn a_step_is_what_prost_writes() {
        for (session_id, actions) in
            [("", vec![]), ("", vec![3]), ("0123456789abcdef", vec![]), ("0123456789abcdef", (0..1000).collect())]
        {
            let step = pb::StepRequest { session_id: session_id.into(), actions: pack(actions.iter().copied()) };
            let (mut expected, mut out) = (BytesMut::new(), BytesMut::new());
            write(&pb::InteractRequest { request: Some(Request::Step(step)) }, &mut expected);
            Ask::Step(&actions).write(session_id, &mut out);
            assert_eq!(out, expected, "{} actions", actions.len());
        }
    }
}
