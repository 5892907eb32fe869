//! A server from a listener to its shutdown.

use super::{host::Host, interact::Environments, rules::rule, service::EnvironmentGrpc, workers::Worker};
use crate::{config::Config, dm_env};
use futures_util::{StreamExt as _, stream::FuturesUnordered};
use mazeway_proto::env::environment_service_server::EnvironmentServiceServer;
use mazeway_serving::{
    DoorError, Listener,
    connections::Gate,
    door::Door,
    running::ends_within,
    telemetry::Telemetry,
    transport::{Transport, Wire},
};
use std::{future::Future, io, sync::Arc};
use tokio_util::sync::CancellationToken;
use tonic::service::Routes;
use tonic_health::ServingStatus;

/// Bytes of a stream that may wait to be read: a step of the largest batch. A client that sends ahead and reads no answers
/// costs so much and no more.
const STREAM_WINDOW_BYTES: u32 = 256 << 10;
/// Bytes of all streams of a connection that may wait: so many that a few blocked streams do not hold up the others.
const CONNECTION_WINDOW_BYTES: u32 = 16 << 20;
/// Largest frame taken in: a batch of actions comes in one.
const FRAME_BYTES: u32 = 256 << 10;

/// Why a server could not go on.
#[derive(Debug, thiserror::Error)]
pub enum ServeError {
    /// A certificate, a key or the file of tokens does not serve.
    #[error(transparent)]
    Door(#[from] DoorError),
    /// The descriptors of the protocol cannot be read.
    #[error("server reflection cannot read the descriptors: {0}")]
    Reflection(#[from] tonic_reflection::server::Error),
    /// There are no threads to serve on.
    #[error("no threads to serve connections: {0}")]
    Threads(io::Error),
}

/// Serves environments, health and reflection on `listener` until `shutdown` is ready, then lets running calls end for
/// [`Config::shutdown_grace`]. Interactive streams are told to go at once, roll-outs shortly before they are cut off.
///
/// # Errors
/// The settings of the door cannot be followed; there are no threads.
pub async fn serve(
    config: Config,
    listener: impl Into<Listener>,
    shutdown: impl Future<Output = ()>,
) -> Result<(), ServeError> {
    serve_observed(config, listener, Arc::new(telemetry()), shutdown).await
}

/// Numbers of an environment server.
pub fn telemetry() -> Telemetry {
    Telemetry::new("mazeway_server")
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
    let stopping = CancellationToken::new();
    // Whatever way this ends, the reaper, the workers and the streams learn of it.
    let _stop = stopping.clone().drop_guard();
    let (health, health_service) = tonic_health::server::health_reporter();
    health.set_serving::<EnvironmentServiceServer<EnvironmentGrpc>>().await;
    health.set_serving::<dm_env::EnvironmentServer>().await;
    let reflection = || {
        tonic_reflection::server::Builder::configure()
            .register_encoded_file_descriptor_set(mazeway_proto::FILE_DESCRIPTOR_SET)
            .register_encoded_file_descriptor_set(mazeway_proto::DM_ENV_RPC_FILE_DESCRIPTOR_SET)
            .register_encoded_file_descriptor_set(tonic_health::pb::FILE_DESCRIPTOR_SET)
    };
    let gate = Gate::new(listener.into(), config.door.max_connections, &telemetry);
    let door = Arc::new(Door::new(&config.door, rule, &telemetry)?);
    let (wire, door_config) = (wire(&config), config.door.clone());
    let (threads, grace, spin) = (config.threads(), config.shutdown_grace, config.spin());
    let host = Arc::new(Host::new(config, &telemetry, stopping.clone()));
    let last_words = host.last_words.clone();
    let routes = Routes::new(Environments::new(&host))
        .add_service(dm_env::EnvironmentServer(Arc::clone(&host)))
        .add_service(health_service)
        .add_service(reflection().build_v1()?)
        .add_service(reflection().build_v1alpha()?);
    let transport = Transport::new(&door_config, wire, Arc::clone(&door), routes)?;
    let start = |_| Worker::start(transport.clone(), stopping.clone(), grace, spin);
    let mut workers = (0..threads).map(start).collect::<Result<Vec<_>, _>>()?;
    let reaper = tokio::spawn(host.reap_sessions());
    let hand_over = async {
        loop {
            let connection = gate.next().await;
            if let Some(worker) = workers.iter().min_by_key(|worker| worker.load()) {
                worker.give(connection);
            }
        }
    };
    telemetry.set_serving(true);
    tokio::select! {
        () = hand_over => {}
        () = door.guard() => {}
        () = shutdown => {}
    }
    telemetry.set_serving(false);
    health.set_service_status("", ServingStatus::NotServing).await;
    health.set_not_serving::<EnvironmentServiceServer<EnvironmentGrpc>>().await;
    health.set_not_serving::<dm_env::EnvironmentServer>().await;
    // Nobody is let in any more, and a Unix socket is gone, before running calls are waited for.
    drop(gate);
    stopping.cancel();
    let ends: FuturesUnordered<_> = workers.iter_mut().map(Worker::ended).collect();
    let ended = ends.fold(Ok(()), |outcome, end| std::future::ready(outcome.and(end)));
    let outcome = ends_within(grace, ended, &last_words).await;
    reaper.abort();
    outcome
}

/// Settings of HTTP/2.
fn wire(config: &Config) -> Wire {
    Wire {
        keepalive: config.keepalive,
        max_streams: config.max_streams_per_connection,
        stream_window_bytes: STREAM_WINDOW_BYTES,
        connection_window_bytes: CONNECTION_WINDOW_BYTES,
        frame_bytes: FRAME_BYTES,
    }
}
