//! The stream that records: requests go to the store in the order in which they came, answers come back in that order,
//! each once its trajectories are on stable storage. Reading goes on while the disk works, up to a limit.
//!
//! A recorder may be silent for as long as it likes: between two requests its stream holds neither memory nor a place that
//! others wait for.

use super::{blocking, from_proto, numbers::Refusals, status::CallError};
use crate::{
    config::Limits,
    store::{self, Allowance, Pending, Store},
};
use futures_util::{Stream, StreamExt as _};
use mazeway_proto::learner as pb;
use std::sync::Arc;
use tokio::sync::mpsc;
use tokio_stream::wrappers::ReceiverStream;
use tokio_util::sync::CancellationToken;
use tonic::{Status, Streaming};

/// Bytes of a request from which it is checked on a thread of its own.
const LARGE_BYTES: usize = 1 << 20;

/// A request that has its place in the order of recording.
struct Queued {
    trajectory_ids: Vec<String>,
    stored: Pending<u32>,
}

/// What a recording stream works with.
pub struct Recording {
    /// Where it records.
    pub store: Store,
    /// At whose expense.
    pub allowance: Option<Allowance>,
    /// What it refuses.
    pub limits: Arc<Limits>,
    /// Where that is counted.
    pub refused: Refusals,
    /// Cancelled when it is to end.
    pub stopping: CancellationToken,
}

/// Reads requests until the caller has no more, errs or goes, or the service stops.
pub fn record(
    recording: Recording,
    mut requests: Streaming<pb::RecordTrajectoriesRequest>,
) -> impl Stream<Item = Result<pb::RecordTrajectoriesResponse, Status>> {
    let Recording { store, allowance, limits, refused, stopping } = recording;
    let (queue, queued) = mpsc::channel::<Result<Queued, CallError>>(limits.max_requests_in_flight.max(1));
    tokio::spawn(async move {
        loop {
            // A place in the queue first: what is not read yet waits on the wire.
            let Ok(place) = queue.reserve().await else { return };
            let request = tokio::select! {
                request = requests.message() => request,
                () = stopping.cancelled() => return place.send(Err(CallError::ShuttingDown)),
                () = queue.closed() => return,
            };
            let outcome = match request {
                Ok(Some(request)) => enqueue(&store, allowance.clone(), &limits, request).await,
                Ok(None) => return,
                Err(status) => Err(status.into()),
            };
            let failed = outcome.is_err();
            place.send(outcome);
            if failed {
                return;
            }
        }
    });
    ReceiverStream::new(queued).then(move |queued| {
        let refused = refused.clone();
        async move {
            let answer = answer(queued).await;
            answer.inspect_err(|error| refused.count(error)).map_err(Status::from)
        }
    })
}

/// The answer to a request, once its trajectories are on stable storage.
async fn answer(queued: Result<Queued, CallError>) -> Result<pb::RecordTrajectoriesResponse, CallError> {
    let Queued { trajectory_ids, stored } = queued?;
    let stored = stored.committed().await?;
    Ok(pb::RecordTrajectoriesResponse { trajectory_ids, stored })
}

async fn enqueue(
    store: &Store,
    allowance: Option<Allowance>,
    limits: &Arc<Limits>,
    request: pb::RecordTrajectoriesRequest,
) -> Result<Queued, CallError> {
    let bytes = request.trajectories.iter().map(|t| t.states.len() + t.actions.len() + t.rewards.len()).sum::<usize>();
    let recordings: Vec<store::Recording> = if bytes < LARGE_BYTES {
        from_proto::recordings(request, limits)?
    } else {
        let limits = Arc::clone(limits);
        blocking(move || from_proto::recordings(request, &limits)).await?
    };
    let trajectory_ids = recordings.iter().map(|recording| recording.id().to_string()).collect();
    Ok(Queued { trajectory_ids, stored: store.queue_recordings_of(allowance, recordings).await? })
}
