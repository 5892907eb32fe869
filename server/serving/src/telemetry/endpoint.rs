//! `/metrics` and `/healthz` over HTTP, on a port of their own: who watches a service needs no token for it, and a service
//! that is full still answers.

use super::Telemetry;
use axum::{
    Router, extract::State, http::StatusCode, http::header::CONTENT_TYPE, response::IntoResponse, routing::get,
};
use std::{io, net::SocketAddr, sync::Arc};
use tokio::net::TcpListener;
use tokio_util::sync::CancellationToken;

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
            outcome = async { axum::serve(listener, routes).await } => {
                if let Err(error) = outcome {
                    tracing::error!(%error, "numbers are no longer shown");
                }
            }
            () = stopped => {}
        }
    });
    Ok(Endpoint { address, stopping })
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
