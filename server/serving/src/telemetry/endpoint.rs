//! `/metrics` and `/healthz` over HTTP, on a port of their own: who watches a service needs no token for it, and a service
//! that is full still answers.
//!
//! It is bounded all the same: a connection has one request, which must come in time, and where there are too many the
//! newest takes the place of the oldest. Who asks at once is answered, however many others only listen.

use super::Telemetry;
use axum::{
    Router, extract::State, http::StatusCode, http::header::CONTENT_TYPE, response::IntoResponse, routing::get,
};
use hyper::server::conn::http1;
use hyper_util::{
    rt::{TokioIo, TokioTimer},
    service::TowerToHyperService,
};
use std::{collections::VecDeque, io, net::SocketAddr, sync::Arc, time::Duration};
use tokio::{
    net::{TcpListener, TcpStream},
    task::{AbortHandle, JoinSet},
    time::{sleep, timeout},
};
use tokio_util::sync::CancellationToken;

/// Connections at a time.
const MAX_CONNECTIONS: usize = 64;
/// Time that a request has to come.
const ASKING_TIME: Duration = Duration::from_secs(5);
/// Time that a connection has in all.
const TIME: Duration = Duration::from_secs(20);
/// Pause after a connection that could not be taken.
const PAUSE: Duration = Duration::from_millis(50);

/// The text format of Prometheus.
const TEXT: &str = "text/plain; version=0.0.4; charset=utf-8";

/// Listens, and answers until the returned is dropped or told to stop.
///
/// # Errors
/// The address is taken or none of this machine's.
pub async fn start(address: SocketAddr, telemetry: Arc<Telemetry>) -> io::Result<Endpoint> {
    let listener = TcpListener::bind(address).await?;
    let address = listener.local_addr()?;
    let stopping = CancellationToken::new();
    let routes = Router::new().route("/metrics", get(metrics)).route("/healthz", get(healthz)).with_state(telemetry);
    let stopped = stopping.clone().cancelled_owned();
    tokio::spawn(async move {
        tokio::select! {
            () = serve(listener, routes) => {}
            () = stopped => {}
        }
    });
    Ok(Endpoint { address, stopping })
}

async fn serve(listener: TcpListener, routes: Router) {
    // Whoever is inside goes with this.
    let mut inside = JoinSet::new();
    let mut by_age: VecDeque<AbortHandle> = VecDeque::new();
    loop {
        let stream = match listener.accept().await {
            Ok((stream, _)) => stream,
            Err(error) => {
                tracing::warn!(%error, "a connection that asks for numbers could not be taken");
                sleep(PAUSE).await;
                continue;
            }
        };
        while inside.try_join_next().is_some() {}
        by_age.retain(|connection| !connection.is_finished());
        if by_age.len() >= MAX_CONNECTIONS
            && let Some(oldest) = by_age.pop_front()
        {
            oldest.abort();
        }
        by_age.push_back(inside.spawn(answer(stream, routes.clone())));
    }
}

async fn answer(stream: TcpStream, routes: Router) {
    let mut http = http1::Builder::new();
    http.timer(TokioTimer::new()).header_read_timeout(ASKING_TIME).keep_alive(false);
    let answering = http.serve_connection(TokioIo::new(stream), TowerToHyperService::new(routes));
    match timeout(TIME, answering).await {
        Ok(Ok(())) => {}
        Ok(Err(error)) => tracing::debug!(%error, "numbers were not asked for in time, or not taken"),
        Err(_) => tracing::debug!("numbers were not taken in time"),
    }
}

/// Where the numbers are shown; no longer once it is dropped.
#[derive(Debug)]
pub struct Endpoint {
    address: SocketAddr,
    stopping: CancellationToken,
}

impl Endpoint {
    /// Where it listens.
    pub fn address(&self) -> SocketAddr {
        self.address
    }
}

impl Drop for Endpoint {
    fn drop(&mut self) {
        self.stopping.cancel();
    }
}

async fn metrics(State(telemetry): State<Arc<Telemetry>>) -> impl IntoResponse {
    match telemetry.text() {
        Ok(text) => (StatusCode::OK, [(CONTENT_TYPE, TEXT)], text),
        Err(error) => (StatusCode::INTERNAL_SERVER_ERROR, [(CONTENT_TYPE, TEXT)], error.to_string()),
    }
}

async fn healthz(State(telemetry): State<Arc<Telemetry>>) -> impl IntoResponse {
    if telemetry.is_serving() {
        (StatusCode::OK, "serving\n")
    } else {
        (StatusCode::SERVICE_UNAVAILABLE, "not serving\n")
    }
}
