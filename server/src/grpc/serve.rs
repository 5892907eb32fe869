//! A server from a listener to its shutdown.

use super::{connections::at_most, host::Host, service::EnvironmentGrpc};
use crate::{config::Config, dm_env};
use mazeway_proto::env::environment_service_server::EnvironmentServiceServer;
use std::{future::Future, sync::Arc, time::Duration};
use tokio::{net::TcpListener, time::timeout};
use tokio_util::sync::CancellationToken;
use tonic::transport::{Server, server::TcpIncoming};

/// Bytes of a stream that may wait for their reader: some steps of the largest batch.
const STREAM_WINDOW_BYTES: u32 = 1 << 20;
/// Bytes of all streams of a connection that may wait: so many that a few blocked streams do not hold up the others.
const CONNECTION_WINDOW_BYTES: u32 = 16 << 20;
/// Time that a peer has to answer a ping.
const PING_TIMEOUT: Duration = Duration::from_secs(10);

/// Why a server could not go on.
#[derive(Debug, thiserror::Error)]
pub enum ServeError {
    /// The transport failed.
    #[error("the transport failed: {0}")]
    Transport(#[from] tonic::transport::Error),
    /// The descriptors of the protocol cannot be read.
    #[error("server reflection cannot read the descriptors: {0}")]
    Reflection(#[from] tonic_reflection::server::Error),
}

/// Serves environments, health and reflection on `listener` until `shutdown` is ready, then lets running calls end for
/// [`Config::shutdown_grace`]. Interactive streams are told to go at once.
///
/// # Errors
/// The transport fails.
pub async fn serve(
    config: Config,
    listener: TcpListener,
    shutdown: impl Future<Output = ()>,
) -> Result<(), ServeError> {
    let stopping = CancellationToken::new();
    // Whatever way this ends, the reaper and the streams learn of it.
    let _stop = stopping.clone().drop_guard();
    let (max_message_bytes, grace) = (config.max_message_bytes, config.shutdown_grace);
    let max_connections = config.max_connections;
    let mut builder = Server::builder()
        .http2_keepalive_interval(Some(config.keepalive))
        .http2_keepalive_timeout(Some(PING_TIMEOUT))
        .initial_stream_window_size(STREAM_WINDOW_BYTES)
        .initial_connection_window_size(CONNECTION_WINDOW_BYTES)
        .max_concurrent_streams(config.max_streams_per_connection)
        .concurrency_limit_per_connection(config.max_streams_per_connection as usize);
    let host = Arc::new(Host::new(config, stopping.clone()));
    let environments = EnvironmentServiceServer::new(EnvironmentGrpc(Arc::clone(&host)))
        .max_decoding_message_size(max_message_bytes)
        // A reply's packed arrays are within the limit; their frame comes on top.
        .max_encoding_message_size(max_message_bytes + 4096);
    let worlds = dm_env::EnvironmentServer(Arc::clone(&host));
    let (health, health_service) = tonic_health::server::health_reporter();
    health.set_serving::<EnvironmentServiceServer<EnvironmentGrpc>>().await;
    health.set_serving::<dm_env::EnvironmentServer>().await;
    let reflection = || {
        tonic_reflection::server::Builder::configure()
            .register_encoded_file_descriptor_set(mazeway_proto::FILE_DESCRIPTOR_SET)
            .register_encoded_file_descriptor_set(mazeway_proto::DM_ENV_RPC_FILE_DESCRIPTOR_SET)
            .register_encoded_file_descriptor_set(tonic_health::pb::FILE_DESCRIPTOR_SET)
    };
    let router = builder
        .add_service(environments)
        .add_service(worlds)
        .add_service(health_service)
        .add_service(reflection().build_v1()?)
        .add_service(reflection().build_v1alpha()?);
    let incoming = at_most(max_connections, TcpIncoming::from(listener).with_nodelay(Some(true)));
    let serving = router.serve_with_incoming_shutdown(incoming, stopping.clone().cancelled_owned());
    tokio::pin!(serving);
    let reaper = tokio::spawn(host.reap_sessions());
    let outcome = tokio::select! {
        outcome = &mut serving => outcome,
        () = shutdown => {
            health.set_not_serving::<EnvironmentServiceServer<EnvironmentGrpc>>().await;
            health.set_not_serving::<dm_env::EnvironmentServer>().await;
            stopping.cancel();
            // Calls that need longer are cut off.
            timeout(grace, serving).await.unwrap_or(Ok(()))
        }
    };
    reaper.abort();
    Ok(outcome?)
}
