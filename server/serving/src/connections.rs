//! A bound on connections, which the transport has not: one above it is closed at once, so that its client learns of it.

use super::listen::{Accepted, Listener, Socket};
use std::{
    io,
    pin::Pin,
    sync::{
        Arc,
        atomic::{AtomicUsize, Ordering},
    },
    task::{Context, Poll},
    time::Duration,
};
use tokio::{
    io::{AsyncRead, AsyncWrite, ReadBuf},
    sync::{OwnedSemaphorePermit, Semaphore},
};
use tonic::transport::server::Connected;

/// Pause after a connection that could not be taken: most often there are too many open files, and waiting helps.
const PAUSE: Duration = Duration::from_millis(50);

/// Takes connections, `max` at a time.
#[derive(Debug)]
pub struct Gate {
    listener: Listener,
    places: Arc<Semaphore>,
    max: usize,
}

impl Gate {
    /// Takes at most `max` connections at a time from `listener`.
    pub fn new(listener: Listener, max: usize) -> Self {
        Self { listener, places: Arc::new(Semaphore::new(max.min(Semaphore::MAX_PERMITS))), max }
    }

    /// The next connection within the limit, and its place.
    pub async fn next(&self) -> (Accepted, OwnedSemaphorePermit) {
        loop {
            match (self.listener.accept().await, Arc::clone(&self.places).try_acquire_owned()) {
                (Ok(connection), Ok(place)) => return (connection, place),
                (Ok(_), Err(_)) => tracing::warn!(max = self.max, "a connection beyond the limit was closed"),
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

/// A connection that counts until it is dropped.
#[derive(Debug)]
pub struct Connection {
    /// Its bytes.
    pub socket: Socket,
    /// Its place among all that are admitted.
    pub place: OwnedSemaphorePermit,
    /// Its part of a worker's load.
    pub load: Counted,
}

impl Connected for Connection {
    type ConnectInfo = ();

    fn connect_info(&self) {}
}

impl AsyncRead for Connection {
    fn poll_read(mut self: Pin<&mut Self>, cx: &mut Context<'_>, buf: &mut ReadBuf<'_>) -> Poll<io::Result<()>> {
        Pin::new(&mut self.socket).poll_read(cx, buf)
    }
}

impl AsyncWrite for Connection {
    fn poll_write(mut self: Pin<&mut Self>, cx: &mut Context<'_>, buf: &[u8]) -> Poll<io::Result<usize>> {
        Pin::new(&mut self.socket).poll_write(cx, buf)
    }

    fn poll_flush(mut self: Pin<&mut Self>, cx: &mut Context<'_>) -> Poll<io::Result<()>> {
        Pin::new(&mut self.socket).poll_flush(cx)
    }

    fn poll_shutdown(mut self: Pin<&mut Self>, cx: &mut Context<'_>) -> Poll<io::Result<()>> {
        Pin::new(&mut self.socket).poll_shutdown(cx)
    }

    fn poll_write_vectored(
        mut self: Pin<&mut Self>,
        cx: &mut Context<'_>,
        bufs: &[io::IoSlice<'_>],
    ) -> Poll<io::Result<usize>> {
        Pin::new(&mut self.socket).poll_write_vectored(cx, bufs)
    }

    fn is_write_vectored(&self) -> bool {
        self.socket.is_write_vectored()
    }
}
