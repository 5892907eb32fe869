//! What the sessions of the load do. Nobody ends: who loses a session or its stream comes back, as real clients do.
//!
//! Invariants: a session is left only when the server says that it is gone, so that none ends but by its lease. Streams that
//! nobody reads share their connection: what is unread is held by the flow control of each stream, and the connection's
//! window has room for all of them.

use crate::load::Kind;
use mazeway_client::{ClientError, Code, Connection, Env, SessionOptions};
use mazeway_proto::env::{self as pb, environment_service_client::EnvironmentServiceClient, interact_request::Request};
use std::time::Duration;
use tokio::{
    sync::oneshot,
    time::{sleep, timeout},
};
use tonic::{
    Status,
    transport::{Channel, Endpoint},
};

/// Bytes of a stream that a client takes in before somebody reads them.
const STREAM_WINDOW_BYTES: u32 = 64 << 10;
/// Bytes of all streams of a connection: more than those of a connection's sessions together.
const CONNECTION_WINDOW_BYTES: u32 = 4 << 20;
/// Before what failed is tried again.
const PAUSE: Duration = Duration::from_millis(100);
/// Longest that the last words of a stream that has ended are waited for.
const LAST_WORDS: Duration = Duration::from_secs(5);

/// Where sessions are: on a connection.
#[derive(Debug, Clone)]
pub struct Place {
    channel: Channel,
    connection: Connection,
    lease: Duration,
}

impl Place {
    /// Connects, sooner or later.
    pub async fn open(address: &str, lease: Duration) -> Self {
        let endpoint = Endpoint::from_shared(format!("http://{address}")).expect("an address");
        let endpoint = endpoint
            .tcp_nodelay(true)
            .initial_stream_window_size(STREAM_WINDOW_BYTES)
            .initial_connection_window_size(CONNECTION_WINDOW_BYTES);
        loop {
            if let Ok(channel) = endpoint.connect().await {
                return Self { connection: Connection::from_channel(channel.clone()), channel, lease };
            }
            sleep(PAUSE).await;
        }
    }

    /// A new session, sooner or later.
    pub async fn session(&self) -> Env {
        let options =
            SessionOptions { max_episode_steps: Some(0), lease: Some(self.lease), ..SessionOptions::default() };
        loop {
            if let Ok(env) = Env::create(&self.connection, "Maze-v0", options.clone()).await {
                return env;
            }
            sleep(PAUSE).await;
        }
    }
}

/// Uses a session, and another one when it is gone, for ever.
pub async fn keep(kind: Kind, place: Place, mut env: Env) {
    loop {
        match kind {
            // On a machine that is too busy to let it act in time the lease runs out.
            Kind::Idle => act(&mut env, Some(place.lease / 3)).await,
            Kind::Stepping | Kind::Vanishing => act(&mut env, None).await,
            Kind::Silent => send_ahead(&place.channel, env.session_id()).await,
        }
        env = place.session().await;
    }
}

/// Acts until the session is gone.
async fn act(env: &mut Env, pause: Option<Duration>) {
    loop {
        match env.reset(Some(1)).await {
            Ok(_) => step(env, pause).await,
            Err(ClientError::Status { code, .. }) if is_gone(code) => return,
            Err(_) => sleep(PAUSE).await,
        }
    }
}

/// Steps as long as it goes well: a server that is under load may end what it likes.
async fn step(env: &mut Env, pause: Option<Duration>) {
    for action in (0..4).cycle() {
        if let Some(pause) = pause {
            sleep(pause).await;
        }
        if env.step(action).await.is_err() {
            return;
        }
    }
}

/// Sends steps and reads no answer, on one stream after the other, until the session is gone.
async fn send_ahead(channel: &Channel, session_id: &str) {
    let mut service = EnvironmentServiceClient::new(channel.clone());
    loop {
        let (unwanted, ended) = oneshot::channel();
        let reset = pb::ResetRequest { session_id: session_id.to_owned(), ..Default::default() };
        let step = pb::StepRequest { actions: 1_u32.to_le_bytes().to_vec().into(), ..Default::default() };
        let requests = Requests { reset: Some(reset), step, _unwanted: unwanted };
        let Ok(answers) = service.interact(tokio_stream::iter(requests)).await else {
            sleep(PAUSE).await;
            continue;
        };
        // Nothing is ever sent: it ends when the transport drops the requests, as their stream has ended.
        let _ = ended.await;
        let mut answers = answers.into_inner();
        let last_words = async {
            loop {
                match answers.message().await {
                    Ok(Some(_)) => {}
                    Ok(None) => return Code::Ok,
                    Err(status) => return Status::code(&status),
                }
            }
        };
        if timeout(LAST_WORDS, last_words).await.is_ok_and(is_gone) {
            return;
        }
        // The server puts the session back when the stream has ended.
        sleep(PAUSE).await;
    }
}

fn is_gone(code: Code) -> bool {
    matches!(code, Code::NotFound | Code::DeadlineExceeded)
}

/// A reset, and then steps without end.
struct Requests {
    reset: Option<pb::ResetRequest>,
    step: pb::StepRequest,
    /// Tells by its end that nobody asks for more.
    _unwanted: oneshot::Sender<()>,
}

impl Iterator for Requests {
    type Item = pb::InteractRequest;

    fn next(&mut self) -> Option<pb::InteractRequest> {
        let request = self.reset.take().map_or_else(|| Request::Step(self.step.clone()), Request::Reset);
        Some(pb::InteractRequest { request: Some(request) })
    }
}
