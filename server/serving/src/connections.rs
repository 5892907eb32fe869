//! Connections, encrypted or not, and a bound on them, which the transport has not: one above it is closed at once, so that
//! its client learns of it.

use super::{
    listen::{Accepted, Listener},
    socket::Socket,
    telemetry::{Connections, Telemetry},
};
use std::{
    io,
    pin::Pin,
    sync::{
        Arc,
        atomic::{AtomicBool, AtomicUsize, Ordering},
    },
    task::{Context, Poll},
    time::Duration,
};
use tokio::{
    io::{AsyncRead, AsyncWrite, ReadBuf},
    sync::{OwnedSemaphorePermit, Semaphore},
};
use tokio_rustls::server::TlsStream;

/// Pause after a connection that could not be taken: most often there are too many open files, and waiting helps.
const PAUSE: Duration = Duration::from_millis(50);

/// Takes connections, `max` at a time.
#[derive(Debug)]
pub struct Gate {
    listener: Listener,
    numbers: Connections,
    places: Arc<Semaphore>,
    max: usize,
}

impl Gate {
    /// Takes at most `max` connections at a time from `listener`.
    pub fn new(listener: Listener, max: usize, telemetry: &Telemetry) -> Self {
        let places = Arc::new(Semaphore::new(max.min(Semaphore::MAX_PERMITS)));
        let (free, all) = (Arc::downgrade(&places), places.available_permits());
        telemetry.read("connections", "Connections that are open", move || {
            free.upgrade().map_or(0, |places| all.saturating_sub(places.available_permits()) as i64)
        });
        Self { listener, numbers: telemetry.connections.clone(), places, max }
    }

    /// The next connection within the limit, and its place.
    pub async fn next(&self) -> (Accepted, OwnedSemaphorePermit) {
        loop {
            match (self.listener.accept().await, Arc::clone(&self.places).try_acquire_owned()) {
                (Ok(connection), Ok(place)) => {
                    self.numbers.accepted.add(1);
                    return (connection.counted(self.numbers.clone()), place);
                }
                (Ok(_), Err(_)) => {
                    self.numbers.refused.add(1);
                    tracing::warn!(max = self.max, "a connection beyond the limit was closed");
                }
                (Err(error), _) => {
                    tracing::warn!(%error, "a connection could not be taken");
                    tokio::time::sleep(PAUSE).await;
                }
            }
        }
    }
}

/// How many connections a worker has.
#[derive(Debug, Clone, Default)]
pub struct Load(Arc<AtomicUsize>);

impl Load {
    /// One more, until the returned is dropped.
    pub fn add(&self) -> Counted {
        self.0.fetch_add(1, Ordering::Relaxed);
        Counted(Arc::clone(&self.0))
    }

    /// How many there are.
    pub fn get(&self) -> usize {
        self.0.load(Ordering::Relaxed)
    }
}

/// One of a [`Load`].
#[derive(Debug)]
pub struct Counted(Arc<AtomicUsize>);

impl Drop for Counted {
    fn drop(&mut self) {
        self.0.fetch_sub(1, Ordering::Relaxed);
    }
}

/// The bytes of a connection, encrypted or not.
#[derive(Debug)]
enum Bytes {
    Plain(Socket),
    Tls(Box<TlsStream<Socket>>),
}

/// A connection that is ready for HTTP/2.
#[derive(Debug)]
pub struct Connection {
    bytes: Bytes,
    /// Told of the first byte that comes, and no more.
    spoken: Option<Arc<AtomicBool>>,
}

impl Connection {
    /// A connection that is not encrypted. `spoken` becomes true with the first byte from the peer.
    pub fn plain(socket: Socket, spoken: Arc<AtomicBool>) -> Self {
        Self { bytes: Bytes::Plain(socket), spoken: Some(spoken) }
    }

    /// A connection whose handshake is done.
    pub fn tls(stream: TlsStream<Socket>, spoken: Arc<AtomicBool>) -> Self {
        Self { bytes: Bytes::Tls(Box::new(stream)), spoken: Some(spoken) }
    }
}

impl AsyncRead for Connection {
    fn poll_read(mut self: Pin<&mut Self>, cx: &mut Context<'_>, buf: &mut ReadBuf<'_>) -> Poll<io::Result<()>> {
        let before = buf.filled().len();
        let read = match &mut self.bytes {
            Bytes::Plain(socket) => Pin::new(socket).poll_read(cx, buf),
            Bytes::Tls(stream) => Pin::new(stream).poll_read(cx, buf),
        };
        if self.spoken.is_some()
            && buf.filled().len() > before
            && let Some(spoken) = self.spoken.take()
        {
            spoken.store(true, Ordering::Relaxed);
        }
        read
    }
}

impl AsyncWrite for Connection {
    fn poll_write(mut self: Pin<&mut Self>, cx: &mut Context<'_>, buf: &[u8]) -> Poll<io::Result<usize>> {
        match &mut self.bytes {
            Bytes::Plain(socket) => Pin::new(socket).poll_write(cx, buf),
            Bytes::Tls(stream) => Pin::new(stream).poll_write(cx, buf),
        }
    }

    fn poll_flush(mut self: Pin<&mut Self>, cx: &mut Context<'_>) -> Poll<io::Result<()>> {
        match &mut self.bytes {
            Bytes::Plain(socket) => Pin::new(socket).poll_flush(cx),
            Bytes::Tls(stream) => Pin::new(stream).poll_flush(cx),
        }
    }

    fn poll_shutdown(mut self: Pin<&mut Self>, cx: &mut Context<'_>) -> Poll<io::Result<()>> {
        match &mut self.bytes {
            Bytes::Plain(socket) => Pin::new(socket).poll_shutdown(cx),
            Bytes::Tls(stream) => Pin::new(stream).poll_shutdown(cx),
        }
    }

    fn poll_write_vectored(
        mut self: Pin<&mut Self>,
        cx: &mut Context<'_>,
        bufs: &[io::IoSlice<'_>],
    ) -> Poll<io::Result<usize>> {
        match &mut self.bytes {
            Bytes::Plain(socket) => Pin::new(socket).poll_write_vectored(cx, bufs),
            Bytes::Tls(stream) => Pin::new(stream).poll_write_vectored(cx, bufs),
        }
    }

    fn is_write_vectored(&self) -> bool {
        match &self.bytes {
            Bytes::Plain(socket) => socket.is_write_vectored(),
            Bytes::Tls(stream) => stream.is_write_vectored(),
        }
    }
}
