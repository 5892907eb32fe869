//! Connections, encrypted or not, and a bound on them, which the transport has not: one above it is closed at once, so that
//! its client learns of it.

use super::{
    listen::{Accepted, Listener},
    socket::Socket,
    telemetry::{Connections, Telemetry},
};
use std::{
    io,
    mem::MaybeUninit,
    pin::Pin,
    sync::{
        Arc,
        atomic::{AtomicBool, AtomicUsize, Ordering},
    },
    task::{Context, Poll, ready},
    time::Duration,
};
use tokio::{
    io::{AsyncRead, AsyncWrite, ReadBuf},
    sync::{OwnedSemaphorePermit, Semaphore},
    time::{Sleep, sleep},
};
use tokio_rustls::server::TlsStream;

/// Pause after a connection that could not be taken: most often there are too many open files, and waiting helps.
const PAUSE: Duration = Duration::from_millis(50);
/// Time that a peer has to end a connection that we have ended. What it sent meanwhile is thrown away.
const LINGER: Duration = Duration::from_secs(2);

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
        if let Ok(address) = listener.address() {
            telemetry.life.listens(address);
        }
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

/// What begins every connection of HTTP/2, in bytes.
const PREFACE_BYTES: usize = b"PRI * HTTP/2.0\r\n\r\nSM\r\n\r\n".len();

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
    /// How much of the preface is still to come, and who is told once it is there.
    spoken: Option<(usize, Arc<AtomicBool>)>,
    /// How long the peer may take to end, once we have.
    linger: Option<Pin<Box<Sleep>>>,
}

impl Connection {
    /// A connection that is not encrypted. `spoken` becomes true once the peer has sent a whole preface.
    pub fn plain(socket: Socket, spoken: Arc<AtomicBool>) -> Self {
        Self { bytes: Bytes::Plain(socket), spoken: Some((PREFACE_BYTES, spoken)), linger: None }
    }

    /// A connection whose handshake is done.
    pub fn tls(stream: TlsStream<Socket>, spoken: Arc<AtomicBool>) -> Self {
        Self { bytes: Bytes::Tls(Box::new(stream)), spoken: Some((PREFACE_BYTES, spoken)), linger: None }
    }
}

impl AsyncRead for Connection {
    fn poll_read(mut self: Pin<&mut Self>, cx: &mut Context<'_>, buf: &mut ReadBuf<'_>) -> Poll<io::Result<()>> {
        let before = buf.filled().len();
        let read = match &mut self.bytes {
            Bytes::Plain(socket) => Pin::new(socket).poll_read(cx, buf),
            Bytes::Tls(stream) => Pin::new(stream).poll_read(cx, buf),
        };
        if let Some((missing, spoken)) = &mut self.spoken {
            *missing = missing.saturating_sub(buf.filled().len() - before);
            if *missing == 0 {
                spoken.store(true, Ordering::Relaxed);
                self.spoken = None;
            }
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

    /// Ends our half, and then waits for the peer to end its own: a socket that is closed with bytes unread is reset, and a
    /// peer that writes to it fails before it has read our last words.
    fn poll_shutdown(mut self: Pin<&mut Self>, cx: &mut Context<'_>) -> Poll<io::Result<()>> {
        if self.linger.is_none() {
            ready!(match &mut self.bytes {
                Bytes::Plain(socket) => Pin::new(socket).poll_shutdown(cx),
                Bytes::Tls(stream) => Pin::new(stream).poll_shutdown(cx),
            })?;
        }
        let ends = self.linger.get_or_insert_with(|| Box::pin(sleep(LINGER))).as_mut().poll(cx);
        if ends.is_ready() {
            return Poll::Ready(Ok(()));
        }
        let mut unread = [MaybeUninit::uninit(); 4 << 10];
        loop {
            let mut unread = ReadBuf::uninit(&mut unread);
            match ready!(self.as_mut().poll_read(cx, &mut unread)) {
                Ok(()) if !unread.filled().is_empty() => {}
                // It has ended, or is gone.
                Ok(()) | Err(_) => return Poll::Ready(Ok(())),
            }
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

#[cfg(test)]
mod tests {
    use super::*;
    use tokio::{
        io::{AsyncReadExt as _, AsyncWriteExt as _},
        net::{TcpListener, TcpStream},
    };

    #[tokio::test]
    async fn a_peer_that_goes_on_sending_reads_our_last_words() {
        let listener = TcpListener::bind("127.0.0.1:0").await.expect("listens");
        let mut peer = TcpStream::connect(listener.local_addr().expect("an address")).await.expect("connects");
        peer.write_all(&vec![1; 64 << 10]).await.expect("nobody has gone yet");
        let accepted = Accepted::from(listener.accept().await.expect("accepts").0.into_std().expect("a socket"));
        let socket = accepted.into_socket().expect("a socket");
        let closing = tokio::spawn(async {
            let mut connection = Connection::plain(socket, Arc::default());
            connection.write_all(b"goodbye").await.expect("sends");
            connection.shutdown().await.expect("ends well");
        });
        tokio::time::sleep(Duration::from_millis(50)).await;
        peer.write_all(&vec![2; 64 << 10]).await.expect("the socket was not reset");
        let mut heard = String::new();
        peer.read_to_string(&mut heard).await.expect("an end without a reset");
        assert_eq!(heard, "goodbye");
        drop(peer);
        closing.await.expect("ends well");
    }

    #[tokio::test]
    async fn a_peer_that_never_ends_is_not_waited_for() {
        let listener = TcpListener::bind("127.0.0.1:0").await.expect("listens");
        let peer = TcpStream::connect(listener.local_addr().expect("an address")).await.expect("connects");
        let accepted = Accepted::from(listener.accept().await.expect("accepts").0.into_std().expect("a socket"));
        let mut connection = Connection::plain(accepted.into_socket().expect("a socket"), Arc::default());
        let began = std::time::Instant::now();
        connection.shutdown().await.expect("ends well");
        assert!(began.elapsed() >= LINGER);
        drop(peer);
    }
}
