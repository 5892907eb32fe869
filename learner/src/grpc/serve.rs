//! A learner service from a listener to its shutdown.

use super::{rules::rule, service::LearnerGrpc};
use crate::{
    config::Config,
    store::{Store, StoreError, StoreOptions},
};
use mazeway_proto::learner::learner_service_server::LearnerServiceServer;
use mazeway_serving::{
    DoorError, Listener,
    connections::Gate,
    door::Door,
    transport::{Transport, Wire},
};
use std::{future::Future, sync::Arc};
use tokio::task::spawn_blocking;
use tokio_util::{sync::CancellationToken, task::TaskTracker};
use tonic::service::Routes;

/// Bytes of a stream, or of all streams of a connection, that may be under way.
const WINDOW_BYTES: u32 = 4 << 20;
/// Largest frame taken in.
const FRAME_BYTES: u32 = 64 << 10;

/// Why a service could not begin or go on.
#[derive(Debug, thiserror::Error)]
pub enum ServeError {
    /// The store does not open.
    #[error(transparent)]
    Store(#[from] StoreError),
    /// A certificate, a key or the file of tokens does not serve.
    #[error(transparent)]
    Door(#[from] DoorError),
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
/// The store does not open; the settings of the door cannot be followed.
pub async fn serve(
    config: Config,
    listener: impl Into<Listener>,
    shutdown: impl Future<Output = ()>,
) -> Result<(), ServeError> {
    let door = Arc::new(Door::new(&config.door, rule)?);
    let gate = Gate::new(listener.into(), config.door.max_connections);
    let data = config.data.clone();
    let options = StoreOptions { max_bytes: config.limits.max_store_bytes, ..StoreOptions::default() };
    let opening = spawn_blocking(move || Store::open_with(&data, options));
    let store = opening.await.unwrap_or(Err(StoreError::Closed))?;
    let outcome = serve_store(config, store.clone(), door, gate, shutdown).await;
    // The last clone waits for the writer.
    let _ = spawn_blocking(move || drop(store)).await;
    outcome
}

async fn serve_store(
    config: Config,
    store: Store,
    door: Arc<Door>,
    gate: Gate,
    shutdown: impl Future<Output = ()>,
) -> Result<(), ServeError> {
    let (stopping, aborting) = (CancellationToken::new(), CancellationToken::new());
    // Whatever way this ends, streams and fits learn of it.
    let _guards = (stopping.clone().drop_guard(), aborting.clone().drop_guard());
    let limits = config.limits;
    let grace = limits.shutdown_grace;
    let wire = Wire {
        keepalive: limits.keepalive,
        max_streams: limits.max_streams_per_connection,
        stream_window_bytes: WINDOW_BYTES,
        connection_window_bytes: WINDOW_BYTES,
        frame_bytes: FRAME_BYTES,
    };
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
    let routes = Routes::new(learner)
        .add_service(health_service)
        .add_service(reflection().build_v1()?)
        .add_service(reflection().build_v1alpha()?);
    let transport = Transport::new(&config.door, wire, Arc::clone(&door), routes)?;
    let connections = TaskTracker::new();
    let take_in = async {
        loop {
            let (accepted, place) = gate.next().await;
            let (transport, stopping) = (transport.clone(), stopping.clone());
            connections.spawn(async move { transport.serve(accepted, place, &stopping, grace).await });
        }
    };
    tokio::select! {
        () = take_in => {}
        () = door.guard() => {}
        () = shutdown => {}
    }
    health.set_not_serving::<LearnerServiceServer<LearnerGrpc>>().await;
    // Nobody is let in any more, and a Unix socket is gone, before running calls are waited for.
    drop(gate);
    stopping.cancel();
    connections.close();
    connections.wait().await;
    Ok(())
}
