//! The calls of `LearnerService`: decode, call, encode.

use super::{
    blocking,
    fit::{FitQueue, Response as FitEvent},
    fit_job::FitJob,
    from_proto,
    models::{Models, unless},
    numbers::Refusals,
    record::{self, Recording},
    status::CallError,
    to_proto,
};
use crate::{
    config::Limits,
    store::{Allowance, Put, Store, check_model_id},
};
use futures_util::Stream;
use mazeway_proto::learner::{self as pb, learner_service_server::LearnerService};
use mazeway_serving::{Caller, telemetry::Telemetry};
use std::{io, pin::Pin, sync::Arc};
use tokio::sync::mpsc;
use tokio_stream::wrappers::ReceiverStream;
use tokio_util::sync::CancellationToken;
use tonic::{Request, Response, Status, Streaming};

/// Trajectories or fits on a page that does not say.
const PAGE_SIZE: u32 = 100;
/// Trajectories on a page at most.
const MAX_TRAJECTORY_PAGE: u32 = 10_000;
/// Fits on a page at most.
const MAX_FIT_PAGE: u32 = 1_000;
/// Pages of an export that wait for the reader.
const EXPORT_QUEUE: usize = 2;

type BoxStream<T> = Pin<Box<dyn Stream<Item = Result<T, Status>> + Send>>;

/// The service over a store.
pub struct LearnerGrpc {
    store: Store,
    limits: Arc<Limits>,
    fits: FitQueue,
    models: Models,
    recordings_refused: Refusals,
    models_refused: Refusals,
    stopping: CancellationToken,
    aborting: CancellationToken,
}

impl LearnerGrpc {
    /// `stopping` ends recording streams and keeps further fits from beginning; `aborting` ends running fits and all other
    /// streams.
    ///
    /// # Errors
    /// There are no threads for fits.
    pub fn new(
        store: Store,
        limits: Limits,
        telemetry: &Telemetry,
        stopping: CancellationToken,
        aborting: CancellationToken,
    ) -> io::Result<Self> {
        let fits = FitQueue::new(&limits, telemetry, stopping.clone(), aborting.clone())?;
        let limits = Arc::new(limits);
        let models = Models::new(&limits, stopping.clone(), aborting.clone());
        let (recordings_refused, models_refused) = (Refusals::of_recordings(telemetry), Refusals::of_models(telemetry));
        Ok(Self { store, limits, fits, models, recordings_refused, models_refused, stopping, aborting })
    }

    /// Reads the store off the async threads.
    async fn read<T: Send + 'static>(
        &self,
        read: impl FnOnce(&Store) -> Result<T, CallError> + Send + 'static,
    ) -> Result<T, CallError> {
        let store = self.store.clone();
        blocking(move || read(&store)).await
    }
}

/// At whose expense a caller records; nobody's where nobody is asked who he is.
fn allowance(caller: &Caller) -> Option<Allowance> {
    let name = Some(caller.name()).filter(|name| !name.is_empty());
    name.map(|name| Allowance { caller: name.into(), max_bytes: caller.quotas().max_recorded_bytes })
}

#[tonic::async_trait]
impl LearnerService for LearnerGrpc {
    type RecordTrajectoriesStream = BoxStream<pb::RecordTrajectoriesResponse>;
    type ExportTrajectoriesStream = ReceiverStream<Result<pb::ExportTrajectoriesResponse, Status>>;
    type FitStream = ReceiverStream<FitEvent>;
    type GetModelStream = ReceiverStream<Result<pb::GetModelResponse, Status>>;

    async fn record_trajectories(
        &self,
        request: Request<Streaming<pb::RecordTrajectoriesRequest>>,
    ) -> Result<Response<Self::RecordTrajectoriesStream>, Status> {
        let recording = Recording {
            store: self.store.clone(),
            allowance: allowance(&Caller::of(&request)),
            limits: Arc::clone(&self.limits),
            refused: self.recordings_refused.clone(),
            stopping: self.stopping.clone(),
        };
        Ok(Response::new(Box::pin(record::record(recording, request.into_inner()))))
    }

    async fn put_model(
        &self,
        request: Request<Streaming<pb::PutModelRequest>>,
    ) -> Result<Response<pb::PutModelResponse>, Status> {
        let allowance = allowance(&Caller::of(&request));
        let putting = async {
            let (model, replace, _turn) = self.models.receive(request.into_inner()).await?;
            let model_id = model.model_id().to_owned();
            let put = self.store.put_model_of(allowance, model, replace).await?;
            Ok(pb::PutModelResponse { model_id, already_stored: put == Put::Known })
        };
        let put: Result<_, CallError> = putting.await;
        Ok(Response::new(put.inspect_err(|error| self.models_refused.count(error))?))
    }

    async fn get_model(&self, request: Request<pb::GetModelRequest>) -> Result<Response<Self::GetModelStream>, Status> {
        let id = request.into_inner().model_id;
        check_model_id("model_id", &id).map_err(CallError::from)?;
        let turn = self.models.turn().await?;
        let model = self
            .read(move |store| store.model(&id)?.ok_or(CallError::NotFound { field: "model_id", what: "model", id }))
            .await?;
        Ok(Response::new(ReceiverStream::new(self.models.send(model, turn))))
    }

    async fn list_models(
        &self,
        request: Request<pb::ListModelsRequest>,
    ) -> Result<Response<pb::ListModelsResponse>, Status> {
        let env_id = request.into_inner().env_id;
        let models = self.read(move |store| Ok(store.models(&env_id)?)).await?;
        let models = models.into_iter().map(to_proto::model_summary).collect();
        Ok(Response::new(pb::ListModelsResponse { models }))
    }

    async fn list_trajectories(
        &self,
        request: Request<pb::ListTrajectoriesRequest>,
    ) -> Result<Response<pb::ListTrajectoriesResponse>, Status> {
        let request = request.into_inner();
        let limit =
            from_proto::page_size(request.page_size, PAGE_SIZE, MAX_TRAJECTORY_PAGE).map_err(CallError::from)?;
        let message = request.filter.unwrap_or_default();
        let scope = from_proto::page_scope("trajectories", &message);
        let after = from_proto::page_start(&request.page_token, scope).map_err(CallError::from)?;
        let filter = from_proto::filter(Some(message)).map_err(CallError::from)?;
        let (mut summaries, total) = self
            .read(move |store| {
                // One more than asked for tells whether there is a next page.
                Ok((store.summaries(&filter, after.unwrap_or(0), limit + 1)?, store.count(&filter)?))
            })
            .await?;
        let more = summaries.len() > limit as usize;
        summaries.truncate(limit as usize);
        let last = summaries.last().filter(|_| more);
        let next_page_token = last.map(|last| from_proto::page_token(last.seq, scope)).unwrap_or_default();
        let trajectories = summaries.into_iter().map(to_proto::trajectory_summary).collect();
        Ok(Response::new(pb::ListTrajectoriesResponse { trajectories, next_page_token, total }))
    }

    async fn delete_trajectories(
        &self,
        request: Request<pb::DeleteTrajectoriesRequest>,
    ) -> Result<Response<pb::DeleteTrajectoriesResponse>, Status> {
        let filter = from_proto::filter(request.into_inner().filter).map_err(CallError::from)?;
        if filter.is_empty() {
            let message = "expected at least one condition, got none: it would delete every trajectory";
            return Err(CallError::field("filter", message).into());
        }
        let deleted = self.store.delete_trajectories(filter).await.map_err(CallError::from)?;
        Ok(Response::new(pb::DeleteTrajectoriesResponse { deleted }))
    }

    async fn export_trajectories(
        &self,
        request: Request<pb::ExportTrajectoriesRequest>,
    ) -> Result<Response<Self::ExportTrajectoriesStream>, Status> {
        let request = request.into_inner();
        let filter = from_proto::filter(request.filter).map_err(CallError::from)?;
        let fit = from_proto::optional_fit_prefix(&request.fit_id).map_err(CallError::from)?;
        let mut cursor = self
            .read(move |store| match fit {
                None => Ok(store.cursor(&filter)?),
                Some(id) => store.fit_cursor(&id, &filter)?.ok_or_else(|| no_fit(id)),
            })
            .await?;
        let (pages, stream) = mpsc::channel(EXPORT_QUEUE);
        let (store, aborting) = (self.store.clone(), self.aborting.clone());
        tokio::spawn(async move {
            let exporting = async {
                // A place for a page first: a reader that is slow keeps neither a thread nor a page.
                while let Ok(place) = pages.reserve().await {
                    let reader = store.clone();
                    let (page, rest) = blocking(move || Ok((reader.next_page(&mut cursor)?, cursor))).await?;
                    if page.is_empty() {
                        break;
                    }
                    cursor = rest;
                    let trajectories = page.into_iter().map(pb::Trajectory::from).collect();
                    place.send(Ok(pb::ExportTrajectoriesResponse { trajectories }));
                }
                Ok(())
            };
            if let Err(error) = unless(&aborting, exporting).await.flatten() {
                // A caller that has gone reads no more.
                let _ = pages.send(Err(error.into())).await;
            }
        });
        Ok(Response::new(ReceiverStream::new(stream)))
    }

    async fn fit(&self, request: Request<pb::FitRequest>) -> Result<Response<Self::FitStream>, Status> {
        let caller = Caller::of(&request);
        let job = FitJob::new(request.into_inner(), &self.limits).inspect_err(|error| self.fits.refuses(error))?;
        let stream = self.fits.submit(&caller, caller.quotas().max_fits, job, self.store.clone())?;
        Ok(Response::new(ReceiverStream::new(stream)))
    }

    async fn get_fit(&self, request: Request<pb::GetFitRequest>) -> Result<Response<pb::GetFitResponse>, Status> {
        let id = from_proto::fit_prefix(&request.into_inner().fit_id).map_err(CallError::from)?;
        let fit = self.read(move |store| store.fit(&id)?.ok_or_else(|| no_fit(id))).await?;
        Ok(Response::new(pb::GetFitResponse { fit: Some(fit) }))
    }

    async fn list_fit_trajectories(
        &self,
        request: Request<pb::ListFitTrajectoriesRequest>,
    ) -> Result<Response<pb::ListFitTrajectoriesResponse>, Status> {
        let pb::ListFitTrajectoriesRequest { fit_id, page_size, page_token } = request.into_inner();
        let id = from_proto::fit_prefix(&fit_id).map_err(CallError::from)?;
        let limit = from_proto::page_size(page_size, PAGE_SIZE, MAX_TRAJECTORY_PAGE).map_err(CallError::from)?;
        let list = pb::ListFitTrajectoriesRequest { fit_id, ..Default::default() };
        let scope = from_proto::page_scope("fit trajectories", &list);
        let after = from_proto::page_start(&page_token, scope).map_err(CallError::from)?.unwrap_or(0).max(0) as u64;
        let (ids, total) = self
            .read(move |store| store.fit_trajectories(&id, after, limit as usize)?.ok_or_else(|| no_fit(id)))
            .await?;
        let read = after + ids.len() as u64;
        let more = read < total && !ids.is_empty();
        let next_page_token = if more { from_proto::page_token(read as i64, scope) } else { String::new() };
        let trajectory_ids = ids.iter().map(ToString::to_string).collect();
        Ok(Response::new(pb::ListFitTrajectoriesResponse { trajectory_ids, next_page_token, total }))
    }

    async fn list_fits(&self, request: Request<pb::ListFitsRequest>) -> Result<Response<pb::ListFitsResponse>, Status> {
        let pb::ListFitsRequest { env_id, style, page_size, page_token } = request.into_inner();
        let limit = from_proto::page_size(page_size, PAGE_SIZE, MAX_FIT_PAGE).map_err(CallError::from)?;
        let list = pb::ListFitsRequest { env_id, style, ..Default::default() };
        let scope = from_proto::page_scope("fits", &list);
        let before = from_proto::page_start(&page_token, scope).map_err(CallError::from)?.unwrap_or(i64::MAX);
        let mut fits = self.read(move |store| Ok(store.fits(&list.env_id, &list.style, before, limit + 1)?)).await?;
        let more = fits.len() > limit as usize;
        fits.truncate(limit as usize);
        let last = fits.last().filter(|_| more);
        let next_page_token = last.map(|last| from_proto::page_token(last.seq, scope)).unwrap_or_default();
        let fits = fits.into_iter().map(to_proto::fit_summary).collect();
        Ok(Response::new(pb::ListFitsResponse { fits, next_page_token }))
    }

    async fn delete_fit(
        &self,
        request: Request<pb::DeleteFitRequest>,
    ) -> Result<Response<pb::DeleteFitResponse>, Status> {
        let id = from_proto::fit_id(&request.into_inner().fit_id).map_err(CallError::from)?;
        if self.store.delete_fit(id.clone()).await.map_err(CallError::from)? {
            return Ok(Response::new(pb::DeleteFitResponse {}));
        }
        Err(no_fit(id).into())
    }
}

fn no_fit(id: String) -> CallError {
    CallError::NotFound { field: "fit_id", what: "fit", id }
}
