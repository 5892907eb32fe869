//! A connection's bytes as they are on the wire: counted, and read when it is the connection's turn.

use crate::{fair::Pass, spin, telemetry::Connections};
use std::{
    io,
    pin::Pin,
    task::{Context, Poll, ready},
};
#[cfg(unix)]
use tokio::net::UnixStream;
use tokio::{
    io::{AsyncRead, AsyncReadExt as _, AsyncWrite, ReadBuf, Take},
    net::TcpStream,
};
use tokio_util::either::Either;

/// Bytes that a connection reads in a turn: some hundred steps that were sent ahead take that long.
const TURN_BYTES: u64 = 4 << 10;

/// A stream of either kind.
#[cfg(unix)]
type Stream = Either<TcpStream, UnixStream>;
/// A stream; there is but one kind here.
#[cfg(not(unix))]
type Stream = Either<TcpStream, TcpStream>;

/// A connection of either kind.
#[derive(Debug)]
pub struct Socket {
    stream: Take<Stream>,
    pass: Option<Pass>,
    numbers: Connections,
}

impl Socket {
    /// A connection of the present thread, whose bytes are counted.
    pub(crate) fn new(stream: Stream, numbers: Connections) -> Self {
        Self { stream: stream.take(0), pass: Pass::of_thread(), numbers }
    }
}

impl AsyncRead for Socket {
    fn poll_read(mut self: Pin<&mut Self>, cx: &mut Context<'_>, buf: &mut ReadBuf<'_>) -> Poll<io::Result<()>> {
        let Self { stream, pass, numbers } = &mut *self;
        let mut limit = u64::MAX;
        if let Some(pass) = pass {
            // An error is something to read.
            ready!(pass.poll_turn(cx, |cx| match stream.get_ref() {
                Either::Left(stream) => stream.poll_read_ready(cx).map(drop),
                Either::Right(stream) => stream.poll_read_ready(cx).map(drop),
            }));
            if pass.is_turn() {
                limit = TURN_BYTES;
            }
        }
        stream.set_limit(limit);
        let before = buf.filled().len();
        let read = ready!(Pin::new(stream).poll_read(cx, buf));
        let bytes = buf.filled().len() - before;
        if let Some(pass) = pass {
            pass.used(bytes);
        }
        if bytes > 0 {
            spin::read();
        }
        numbers.received.add(bytes as u64);
        Poll::Ready(read)
    }
}

impl Socket {
    fn sent(&self, written: Poll<io::Result<usize>>) -> Poll<io::Result<usize>> {
        if let Poll::Ready(Ok(bytes)) = &written {
            self.numbers.sent.add(*bytes as u64);
        }
        written
    }
}

impl AsyncWrite for Socket {
    fn poll_write(mut self: Pin<&mut Self>, cx: &mut Context<'_>, buf: &[u8]) -> Poll<io::Result<usize>> {
        let written = Pin::new(self.stream.get_mut()).poll_write(cx, buf);
        self.sent(written)
    }

    fn poll_flush(mut self: Pin<&mut Self>, cx: &mut Context<'_>) -> Poll<io::Result<()>> {
        Pin::new(self.stream.get_mut()).poll_flush(cx)
    }

    fn poll_shutdown(mut self: Pin<&mut Self>, cx: &mut Context<'_>) -> Poll<io::Result<()>> {
        Pin::new(self.stream.get_mut()).poll_shutdown(cx)
    }

    fn poll_write_vectored(
        mut self: Pin<&mut Self>,
        cx: &mut Context<'_>,
        bufs: &[io::IoSlice<'_>],
    ) -> Poll<io::Result<usize>> {
        let written = Pin::new(self.stream.get_mut()).poll_write_vectored(cx, bufs);
        self.sent(written)
    }

    fn is_write_vectored(&self) -> bool {
        self.stream.get_ref().is_write_vectored()
    }
}
