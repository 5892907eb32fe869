//! `mazeway.env.v1.EnvironmentService`: each method decodes, calls and encodes.

use super::{
    from_proto::{self, RenderMode},
    host::{Host, blocking},
    interact::{self, DrawJob, DrawSender},
    status::CallError,
    to_proto, watch,
};
use crate::{
    raster::{Format, rasterise},
    rollout::EpisodeChunk,
    sessions::{SessionError, SessionId},
};
use bytes::Bytes;
use futures_util::{Stream, StreamExt as _, stream};
use mazeway_proto::env::{self as pb, environment_service_server::EnvironmentService};
use mazeway_serving::Caller;
use std::{pin::Pin, sync::Arc, time::Instant};
use tokio::sync::{mpsc, oneshot};
use tonic::{Request, Response, Status, Streaming};

/// Messages of a roll-out that may wait for their reader.
const WAITING_CHUNKS: usize = 2;

type Answers<T> = Pin<Box<dyn Stream<Item = Result<T, Status>> + Send>>;

/// The service over one [`Host`].
pub struct EnvironmentGrpc(pub Arc<Host>);

#[tonic::async_trait]
impl EnvironmentService for EnvironmentGrpc {
    type InteractStream = stream::Empty<Result<pb::InteractResponse, Status>>;
    type RolloutStream = Answers<pb::RolloutResponse>;
    type GetModelStream = Answers<pb::GetModelResponse>;
    type WatchStream = Answers<pb::WatchResponse>;

    async fn list_environments(
        &self,
        _request: Request<pb::ListEnvironmentsRequest>,
    ) -> Result<Response<pb::ListEnvironmentsResponse>, Status> {
        let specs = self.0.registry.specs();
        let environments = specs.iter().map(|spec| to_proto::spec(spec, &spec.info_columns)).collect();
        Ok(Response::new(pb::ListEnvironmentsResponse { environments }))
    }

    async fn create_session(
        &self,
        request: Request<pb::CreateSessionRequest>,
    ) -> Result<Response<pb::CreateSessionResponse>, Status> {
        let caller = Caller::of(&request);
        let (asked, host) = (from_proto::create_session(request.into_inner())?, Arc::clone(&self.0));
        let session = blocking(move || {
            let (guard, lease) = host.create_session(&caller, &asked)?;
            let lease = lease.try_into().map_err(|_| CallError::Internal("a lease beyond all bounds".into()))?;
            Ok(to_proto::session(guard.id().to_string(), lease, &*guard))
        });
        Ok(Response::new(session.await?))
    }

    async fn reset(&self, request: Request<pb::ResetRequest>) -> Result<Response<pb::ResetResponse>, Status> {
        let caller = Caller::of(&request);
        let request = request.into_inner();
        let guard = self.0.take(&caller, from_proto::session_id(&request.session_id)?)?;
        let work = interact::run(guard, move |batch| {
            let (seeds, mask) = from_proto::reset(&request)?;
            Ok(to_proto::reset(batch.reset(seeds, mask)?))
        });
        Ok(Response::new(work.await?))
    }

    async fn step(&self, request: Request<pb::StepRequest>) -> Result<Response<pb::StepResponse>, Status> {
        let caller = Caller::of(&request);
        let request = request.into_inner();
        let guard = self.0.take(&caller, from_proto::session_id(&request.session_id)?)?;
        let host = Arc::clone(&self.0);
        let work = interact::run(guard, move |batch| {
            let (num_envs, begun) = (batch.options().num_envs, Instant::now());
            let answer = to_proto::step(batch.step(&request.actions)?);
            host.numbers.stepped(num_envs, begun.elapsed());
            Ok(answer)
        });
        Ok(Response::new(work.await?))
    }

    /// Never called: [`interact::Environments`] answers it without the detour over messages.
    async fn interact(
        &self,
        _request: Request<Streaming<pb::InteractRequest>>,
    ) -> Result<Response<Self::InteractStream>, Status> {
        Err(CallError::Internal("expected the fast path to take this call".into()).into())
    }

    async fn rollout(&self, request: Request<pb::RolloutRequest>) -> Result<Response<Self::RolloutStream>, Status> {
        let (request, host) = (request.into_inner(), &self.0);
        let asked = Arc::clone(host);
        let (environment, plan) = blocking(move || asked.plan_rollout(request)).await?;
        let permit = Arc::clone(&host.rollouts).try_acquire_owned().map_err(|_| {
            let limit = host.config.max_concurrent_rollouts as u64;
            CallError::Limit { field: "rollouts", what: "roll-outs at a time", limit, asked: limit + 1 }
        })?;
        let (sender, receiver) = mpsc::channel(WAITING_CHUNKS);
        let (host, last_words) = (Arc::clone(host), host.last_words.clone());
        tokio::task::spawn_blocking(move || {
            let _permit = permit;
            // Sending waits for the reader and fails once it has gone.
            let mut emit = |chunk: EpisodeChunk| {
                host.numbers.rolled_out(chunk.lengths.iter().map(|&length| u64::from(length)).sum());
                sender.blocking_send(Ok(to_proto::episodes(chunk))).is_ok()
            };
            environment.roll_out(&plan, &|| sender.is_closed(), &mut emit);
        });
        let chunks = stream::unfold(Some(receiver), move |receiver| {
            let last_words = last_words.clone();
            async move {
                let mut receiver = receiver?;
                tokio::select! {
                    biased;
                    () = last_words.cancelled() => Some((Err(CallError::ShuttingDown.into()), None)),
                    chunk = receiver.recv() => Some((chunk?, Some(receiver))),
                }
            }
        });
        Ok(Response::new(chunks.boxed()))
    }

    async fn get_model(&self, request: Request<pb::GetModelRequest>) -> Result<Response<Self::GetModelStream>, Status> {
        let request = request.into_inner();
        let model = self.0.model(request.env_id, from_proto::options(request.options)?).await?;
        let parts = to_proto::model_parts(model).map(|part| Ok(pb::GetModelResponse { part: Some(part) }));
        Ok(Response::new(stream::iter(parts).boxed()))
    }

    async fn render(&self, request: Request<pb::RenderRequest>) -> Result<Response<pb::RenderResponse>, Status> {
        let caller = Caller::of(&request);
        let request = request.into_inner();
        let (id, mode) = (from_proto::session_id(&request.session_id)?, from_proto::render_mode(request.mode)?);
        let drawing = draw(&self.0, &caller, id, request.index as usize, mode).await?;
        Ok(Response::new(finish(drawing, mode).await?))
    }

    async fn watch(&self, request: Request<pb::WatchRequest>) -> Result<Response<Self::WatchStream>, Status> {
        Ok(Response::new(watch::watch(&self.0, &Caller::of(&request), request.get_ref())?.boxed()))
    }

    async fn close_session(
        &self,
        request: Request<pb::CloseSessionRequest>,
    ) -> Result<Response<pb::CloseSessionResponse>, Status> {
        let caller = Caller::of(&request);
        self.0.take(&caller, from_proto::session_id(&request.into_inner().session_id)?)?.close();
        Ok(Response::new(pb::CloseSessionResponse {}))
    }
}

/// Draws an environment of a session that is free or owned by a stream.
async fn draw(
    host: &Arc<Host>,
    caller: &Caller,
    id: SessionId,
    index: usize,
    mode: RenderMode,
) -> Result<String, CallError> {
    let busy = CallError::Session(SessionError::Busy);
    match host.take(caller, id) {
        Ok(guard) => Ok(interact::draw(&*guard, index, mode)?),
        Err(error) if error == busy => {
            let owner = host.sessions.owner(id).and_then(|owner| owner.downcast::<DrawSender>().ok());
            let owner = owner.ok_or_else(|| busy.clone())?;
            let (reply, picture) = oneshot::channel();
            owner.send(DrawJob { index, mode, reply }).await.map_err(|_| busy.clone())?;
            Ok(picture.await.map_err(|_| busy)??)
        }
        Err(error) => Err(error),
    }
}

async fn finish(drawing: String, mode: RenderMode) -> Result<pb::RenderResponse, CallError> {
    let format = match mode {
        RenderMode::Ansi => return Ok(pb::RenderResponse { content: Bytes::from(drawing), width: 0, height: 0 }),
        RenderMode::RgbArray => Format::Rgb,
        RenderMode::Png => Format::Png,
    };
    blocking(move || {
        let picture = rasterise(&drawing, format).map_err(|error| CallError::Internal(error.to_string()))?;
        Ok(pb::RenderResponse { content: picture.content.into(), width: picture.width, height: picture.height })
    })
    .await
}
