//! A connection from its acceptance to its end: the TLS handshake where there is one, then HTTP/2.
//!
//! Invariants: a handshake holds up nobody else and ends in time; what a peer may leave unfinished, unread or in the queue
//! is bounded; a connection that is told to go ends its calls first, for as long as it is given.

use crate::{
    config::{DoorConfig, DoorError},
    connections::Connection,
    door::{Door, Entrance},
    listen::Accepted,
    tls::certified,
    watch::Visit,
};
use hyper::server::conn::http2;
use hyper_util::rt::{TokioIo, TokioTimer};
use std::{fmt, io, pin::pin, sync::Arc, time::Duration};
use tokio::time::timeout;
use tokio_rustls::TlsAcceptor;
use tokio_util::sync::CancellationToken;
use tonic::service::Routes;

/// Time that a peer has to answer a ping.
const PING_TIMEOUT: Duration = Duration::from_secs(10);
/// Streams that were reset before the service has seen them, at most; with more the connection ends.
const MAX_UNSEEN_RESETS: usize = 20;
/// Streams that had to be reset because of the peer's own errors, at most; with more the connection ends.
const MAX_ERRORS: usize = 256;
/// Bytes of a stream that wait to be sent, beyond one frame.
const SEND_BYTES: usize = 400 << 10;

/// Settings of HTTP/2 that depend on what is served.
#[derive(Debug, Clone, Copy)]
pub struct Wire {
    /// Time between pings.
    pub keepalive: Duration,
    /// Calls of a connection at a time.
    pub max_streams: u32,
    /// Bytes of a stream that may wait for their reader.
    pub stream_window_bytes: u32,
    /// Bytes of all streams of a connection that may wait.
    pub connection_window_bytes: u32,
    /// Largest frame taken in.
    pub frame_bytes: u32,
}

/// Serves connections.
#[derive(Clone)]
pub struct Transport {
    door: Arc<Door>,
    tls: Option<TlsAcceptor>,
    handshake_timeout: Duration,
    max_metadata_bytes: u32,
    wire: Wire,
    routes: Routes,
}

impl fmt::Debug for Transport {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.debug_struct("Transport").field("tls", &self.tls.is_some()).field("wire", &self.wire).finish_non_exhaustive()
    }
}

impl Transport {
    /// Serves `routes` behind `door`.
    ///
    /// # Errors
    /// A certificate or a key does not serve.
    pub fn new(config: &DoorConfig, wire: Wire, door: Arc<Door>, routes: Routes) -> Result<Self, DoorError> {
        Ok(Self {
            door,
            tls: config.acceptor()?,
            handshake_timeout: config.handshake_timeout,
            max_metadata_bytes: config.max_metadata_bytes,
            wire,
            routes: routes.prepare(),
        })
    }

    /// Serves a connection until its peer goes, or until `stopping` and then for `grace`. `keep` is let go at its end.
    pub async fn serve<K>(self, accepted: Accepted, keep: K, stopping: &CancellationToken, grace: Duration) {
        let _keep = keep;
        let visit = self.door.watch.visit(stopping.child_token());
        let connection = match self.connect(accepted, &visit).await {
            Ok(connection) => connection,
            Err(error) => return tracing::debug!(%error, "a connection came to nothing"),
        };
        let entrance = Entrance::new(Arc::clone(&self.door), Arc::clone(&visit), self.routes.clone());
        let mut http = pin!(self.http(&visit).serve_connection(TokioIo::new(connection), entrance));
        let ended = tokio::select! {
            biased;
            ended = http.as_mut() => ended,
            () = visit.leave().cancelled() => {
                if visit.is_ended_at_once() {
                    return;
                }
                http.as_mut().graceful_shutdown();
                // Where the service goes on, nothing was under way: a peer that does not leave need not be waited for so long.
                let grace = if stopping.is_cancelled() { grace } else { grace.min(self.handshake_timeout) };
                // Calls that need longer are cut off.
                timeout(grace, http).await.unwrap_or(Ok(()))
            }
        };
        if let Err(error) = ended {
            tracing::debug!(%error, "a connection failed");
        }
    }

    async fn connect(&self, accepted: Accepted, visit: &Arc<Visit>) -> io::Result<Connection> {
        let socket = accepted.into_socket()?;
        let Some(tls) = &self.tls else { return Ok(Connection::plain(socket, visit.spoken())) };
        let shaken = tokio::select! {
            shaken = timeout(self.handshake_timeout, tls.accept(socket)) => shaken,
            () = visit.leave().cancelled() => return Err(io::ErrorKind::ConnectionAborted.into()),
        };
        let stream = shaken.map_err(|_| io::Error::new(io::ErrorKind::TimedOut, "the handshake took too long"))??;
        if let Some(certificate) = stream.get_ref().1.peer_certificates().and_then(|chain| chain.first()) {
            visit.certify(certified(certificate));
        }
        Ok(Connection::tls(stream, visit.spoken()))
    }

    fn http(&self, visit: &Arc<Visit>) -> http2::Builder<Tasks> {
        let mut http = http2::Builder::new(Tasks(Arc::clone(visit)));
        http.timer(TokioTimer::new())
            .keep_alive_interval(self.wire.keepalive)
            .keep_alive_timeout(PING_TIMEOUT)
            .initial_stream_window_size(self.wire.stream_window_bytes)
            .initial_connection_window_size(self.wire.connection_window_bytes)
            .max_frame_size(self.wire.frame_bytes)
            .max_concurrent_streams(self.wire.max_streams)
            .max_header_list_size(self.max_metadata_bytes)
            .max_pending_accept_reset_streams(MAX_UNSEEN_RESETS)
            .max_local_error_reset_streams(MAX_ERRORS)
            .max_send_buf_size(SEND_BYTES);
        http
    }
}

/// Starts the tasks of calls, so that each can be ended from outside.
#[derive(Debug, Clone)]
struct Tasks(Arc<Visit>);

impl<F> hyper::rt::Executor<F> for Tasks
where
    F: Future<Output = ()> + Send + 'static,
{
    fn execute(&self, task: F) {
        self.0.started(tokio::spawn(task).abort_handle());
    }
}
