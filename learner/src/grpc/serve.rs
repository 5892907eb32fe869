//! A learner service from a listener to its shutdown.

use super::service::LearnerGrpc;
use crate::{
    config::Config,
    store::{Store, StoreError, StoreOptions},
};
use mazeway_proto::learner::learner_service_server::LearnerServiceServer;
use std::{future::Future, time::Duration};
use tokio::{net::TcpListener, task::spawn_blocking, time::timeout};
use tokio_util::sync::CancellationToken;
use tonic::transport::{Server, server::TcpIncoming};

/// Bytes of a stream, or of all streams of a connection, that may be under way.
const WINDOW_BYTES: u32 = 4 << 20;
/// Time that a peer has to answer a ping.
const PING_TIMEOUT: Duration = Duration::from_secs(10);

/// Why a service could not begin or go on.
#[derive(Debug, thiserror::Error)]
pub enum ServeError {
    /// The store does not open.
    #[error(transparent)]
    Store(#[from] StoreError),
    /// The transport failed.
    #[error("the transport failed: {0}")]
    Transport(#[from] tonic::transport::Error),
    /// The descriptors of the protocol cannot be read.
    #[error("server reflection cannot read the descriptors: {0}")]
    Reflection(#[from] tonic_reflection::server::Error),
}

/// Opens the store and serves the learner, health and reflection on `listener` until `shutdown` is ready. Recording
/// streams then answer what they have read and end, running fits and calls have [`Limits::shutdown_grace`] to end, and
/// everything that was accepted is on stable storage when this returns.
///
/// [`Limits::shutdown_grace`]: crate::config::Limits::shutdown_grace
///
/// # Errors
/// The store does not open; the transport fails.
pub async fn serve(
    config: Config,
    listener: TcpListener,
    shutdown: impl Future<Output = ()>,
) -> Result<(), ServeError> {
    let data = config.data.clone();
    let options = StoreOptions { max_bytes: config.limits.max_store_bytes, ..StoreOptions::default() };
    let opening = spawn_blocking(move || Store::open_with(&data, options));
    let store = opening.await.unwrap_or(Err(StoreError::Closed))?;
    let outcome = serve_store(config, store.clone(), listener, shutdown).await;
    // The last clone waits for the writer.
    let _ = spawn_blocking(move || drop(store)).await;
    outcome
}

async fn serve_store(
    config: Config,
    store: Store,
    listener: TcpListener,
    shutdown: impl Future<Output = ()>,
) -> Result<(), ServeError> {
    let (stopping, aborting) = (CancellationToken::new(), CancellationToken::new());
    // Whatever way this ends, streams and fits learn of it.
    let _guards = (stopping.clone().drop_guard(), aborting.clone().drop_guard());
    let limits = config.limits;
    let grace = limits.shutdown_grace;
    let mut builder = Server::builder()
        .http2_keepalive_interval(Some(limits.keepalive))
        .http2_keepalive_timeout(Some(PING_TIMEOUT))
        .initial_stream_window_size(WINDOW_BYTES)
        .initial_connection_window_size(WINDOW_BYTES)
        .max_concurrent_streams(limits.max_streams_per_connection);
    let max_message_bytes = limits.max_message_bytes;
    // What is sent is bounded by what was accepted: a fit's arrays by its model, a page of trajectories by its size.
    let learner = LearnerServiceServer::new(LearnerGrpc::new(store, limits, stopping.clone(), aborting))
        .max_decoding_message_size(max_message_bytes);
    let (health, health_service) = tonic_health::server::health_reporter();
    health.set_serving::<LearnerServiceServer<LearnerGrpc>>().await;
    let reflection = || {
        tonic_reflection::server::Builder::configure()
            .register_encoded_file_descriptor_set(mazeway_proto::FILE_DESCRIPTOR_SET)
            .register_encoded_file_descriptor_set(tonic_health::pb::FILE_DESCRIPTOR_SET)
    };
    let router = builder
        .add_service(learner)
        .add_service(health_service)
        .add_service(reflection().build_v1()?)
        .add_service(reflection().build_v1alpha()?);
    let incoming = TcpIncoming::from(listener).with_nodelay(Some(true));
    let serving = router.serve_with_incoming_shutdown(incoming, stopping.clone().cancelled_owned());
    tokio::pin!(serving);
    tokio::select! {
        outcome = &mut serving => Ok(outcome?),
        () = shutdown => {
            health.set_not_serving::<LearnerServiceServer<LearnerGrpc>>().await;
            stopping.cancel();
            // Calls that need longer are cut off.
            Ok(timeout(grace, serving).await.unwrap_or(Ok(()))?)
        }
    }
}
