//! A learner service from a listener to its shutdown.

use super::{rules::rule, service::LearnerGrpc};
use crate::{
    config::Config,
    store::{Store, StoreError, StoreOptions, store_bytes},
};
use mazeway_proto::learner::learner_service_server::LearnerServiceServer;
use mazeway_serving::{
    DoorError, Listener,
    connections::Gate,
    door::Door,
    running::ends_within,
    telemetry::Telemetry,
    transport::{Transport, Wire},
};
use std::{future::Future, sync::Arc, time::Duration};
use tokio::task::spawn_blocking;
use tokio_util::{sync::CancellationToken, task::TaskTracker};
use tonic::service::Routes;
use tonic_health::{ServingStatus, server::HealthReporter};

/// Bytes of a stream, or of all streams of a connection, that may be under way.
const WINDOW_BYTES: u32 = 4 << 20;
/// Largest frame taken in.
const FRAME_BYTES: u32 = 64 << 10;

/// What health calls the taking of recordings, which needs room on the disk; all else goes on without.
const RECORDING: &str = "mazeway.learner.v1.LearnerService/RecordTrajectories";
/// Time between two looks at the store.
const STORE_PERIOD: Duration = Duration::from_secs(1);

/// Why a service could not begin or go on.
#[derive(Debug, thiserror::Error)]
pub enum ServeError {
    /// The store does not open.
    #[error(transparent)]
    Store(#[from] StoreError),
    /// A certificate, a key or the file of tokens does not serve.
    #[error(transparent)]
    Door(#[from] DoorError),
    /// There are no threads to fit on.
    #[error("no threads to fit on: {0}")]
    Threads(std::io::Error),
    /// The descriptors of the protocol cannot be read.
    #[error("server reflection cannot read the descriptors: {0}")]
    Reflection(#[from] tonic_reflection::server::Error),
}

/// Opens the store and serves the learner, health and reflection on `listener` until `shutdown` is ready. Recording
/// streams then answer what they have read and end, running fits and calls have [`Limits::shutdown_grace`] to end and are told
/// shortly before it is over, and everything that was accepted is on stable storage when this returns. `shutdown` is first
/// polled when everything has started.
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
    serve_observed(config, listener, Arc::new(telemetry()), shutdown).await
}

/// Numbers of a learner service.
pub fn telemetry() -> Telemetry {
    Telemetry::new("mazeway_learner")
}

/// As [`serve`]; what happens is counted there.
///
/// # Errors
/// As [`serve`].
pub async fn serve_observed(
    config: Config,
    listener: impl Into<Listener>,
    telemetry: Arc<Telemetry>,
    shutdown: impl Future<Output = ()>,
) -> Result<(), ServeError> {
    let door = Arc::new(Door::new(&config.door, rule, &telemetry)?);
    let gate = Gate::new(listener.into(), config.door.max_connections, &telemetry);
    let data = config.data.clone();
    let options = StoreOptions { max_bytes: config.limits.max_store_bytes, ..StoreOptions::default() };
    let opening = spawn_blocking(move || Store::open_with(&data, options));
    let store = opening.await.unwrap_or(Err(StoreError::Closed))?;
    let outcome = serve_store(config, store.clone(), door, gate, &telemetry, shutdown).await;
    telemetry.set_serving(false);
    // The last clone waits for the writer.
    let _ = spawn_blocking(move || drop(store)).await;
    outcome
}

async fn serve_store(
    config: Config,
    store: Store,
    door: Arc<Door>,
    gate: Gate,
    telemetry: &Telemetry,
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
    let learner = LearnerGrpc::new(store.clone(), limits, telemetry, stopping.clone(), aborting.clone())
        .map_err(ServeError::Threads)?;
    let learner = LearnerServiceServer::new(learner).max_decoding_message_size(max_message_bytes);
    let (health, health_service) = tonic_health::server::health_reporter();
    health.set_serving::<LearnerServiceServer<LearnerGrpc>>().await;
    health.set_service_status(RECORDING, ServingStatus::Serving).await;
    show(&store, telemetry);
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
    telemetry.set_serving(true);
    tokio::select! {
        () = take_in => {}
        () = watch_store(&store, &health) => {}
        () = door.guard() => {}
        () = shutdown => {}
    }
    telemetry.set_serving(false);
    for service in ["", RECORDING] {
        health.set_service_status(service, ServingStatus::NotServing).await;
    }
    health.set_not_serving::<LearnerServiceServer<LearnerGrpc>>().await;
    // Nobody is let in any more, and a Unix socket is gone, before running calls are waited for.
    drop(gate);
    stopping.cancel();
    connections.close();
    ends_within(grace, connections.wait(), &aborting).await;
    Ok(())
}

/// Shows what the store says of itself. The numbers may be shown for longer than it is open.
fn show(store: &Store, telemetry: &Telemetry) {
    store.activity().show(telemetry);
    let (activity, file) = (Arc::downgrade(store.activity()), store.path().to_owned());
    telemetry.read("writable", "1 where the last write of the store succeeded, 0 where it failed", move || {
        activity.upgrade().map_or(0, |activity| i64::from(activity.is_writable()))
    });
    telemetry.read("store_bytes", "Bytes of the database and its log on the disk", move || store_bytes(&file) as i64);
}

/// Tells whether recordings can be taken, and tries a write now and then where the last failed: who balances load by health
/// sends none meanwhile that could find out.
async fn watch_store(store: &Store, health: &HealthReporter) {
    let mut known = true;
    loop {
        tokio::time::sleep(STORE_PERIOD).await;
        if !store.activity().is_writable() {
            // How it went is noted by the store itself.
            let _ = store.try_writing().await;
        }
        let writable = store.activity().is_writable();
        if writable != known {
            known = writable;
            tracing::warn!(writable, "the store's disk or quota changed what recordings meet");
            let status = if writable { ServingStatus::Serving } else { ServingStatus::NotServing };
            health.set_service_status(RECORDING, status).await;
        }
    }
}
