//! A learner service: models, recordings and fits, in the messages of `mazeway.learner.v1`.

use crate::{
    ClientError, ConnectOptions, Model, ModelCollector, Recorder,
    connect::{Wire, within},
    retry::reconnecting,
};
use mazeway_proto::{
    env::ModelPart,
    learner::{self as pb, fit_response::Event, learner_service_client::LearnerServiceClient},
};
use std::time::Duration;
use tonic::Streaming;

/// Largest message taken in: a fit in a large model carries several arrays over all its state-action pairs.
const MAX_MESSAGE_BYTES: usize = 512 << 20;
/// Summaries of trajectories asked for at a time.
const TRAJECTORY_PAGE: u32 = 10_000;
/// Summaries of fits asked for at a time.
const FIT_PAGE: u32 = 1_000;

/// A connection to a learner. Cloning shares it.
#[derive(Debug, Clone)]
pub struct Learner {
    wire: Wire,
    service: LearnerServiceClient<Wire>,
}

impl Learner {
    /// Connects to a learner at `address`, such as `127.0.0.1:50052`.
    ///
    /// # Errors
    /// An address that is none; nobody answers.
    pub async fn connect(address: &str) -> Result<Self, ClientError> {
        Self::connect_with(address, &ConnectOptions::default()).await
    }

    /// Connects to a learner at `address`, such as `https://robots.example:50052`, with a token or certificates.
    ///
    /// # Errors
    /// An address that is none, options that do not go with it; nobody answers.
    pub async fn connect_with(address: &str, options: &ConnectOptions) -> Result<Self, ClientError> {
        Ok(Self::from_channel(Wire::open(address, options).await?))
    }

    /// Uses a channel that is there already.
    pub fn from_channel(channel: impl Into<Wire>) -> Self {
        let wire = channel.into();
        let service = LearnerServiceClient::new(wire.clone()).max_decoding_message_size(MAX_MESSAGE_BYTES);
        Self { wire, service }
    }

    /// Begins to record over the same connection.
    pub fn recorder(&self) -> Recorder {
        Recorder::from_channel(self.wire.clone())
    }

    /// Stores a model; returns its id and whether it was stored already.
    ///
    /// # Errors
    /// A model that the learner refuses.
    pub async fn put_model(&self, model: &Model) -> Result<pb::PutModelResponse, ClientError> {
        self.put_model_parts(model.parts().collect()).await
    }

    /// As [`Learner::put_model`]; where the rows are stored with another header (labels, features, start, rewards), this one
    /// takes its place.
    ///
    /// # Errors
    /// A model that the learner refuses.
    pub async fn replace_model(&self, model: &Model) -> Result<pb::PutModelResponse, ClientError> {
        self.send_model(model.parts().collect(), true).await
    }

    /// A stored model.
    ///
    /// # Errors
    /// No such model.
    pub async fn model(&self, model_id: &str) -> Result<Model, ClientError> {
        let request = pb::GetModelRequest { model_id: model_id.into() };
        let ask = async || {
            let mut parts = self.wire.within(self.service.clone().get_model(request.clone())).await?;
            let mut collector = ModelCollector::default();
            while let Some(response) = within(self.wire.deadline, parts.message()).await? {
                collector.push(response.part.unwrap_or_default())?;
            }
            Ok(collector.finish()?)
        };
        reconnecting(ask).await
    }

    /// Stores a model that is there in parts: a header, then blocks of rows.
    ///
    /// # Errors
    /// A model that the learner refuses.
    pub async fn put_model_parts(&self, parts: Vec<ModelPart>) -> Result<pb::PutModelResponse, ClientError> {
        self.send_model(parts, false).await
    }

    async fn send_model(&self, parts: Vec<ModelPart>, replace: bool) -> Result<pb::PutModelResponse, ClientError> {
        // A model is known by what is in it: to send it again changes nothing.
        let ask = async || {
            let requests = parts.clone().into_iter().map(move |part| pb::PutModelRequest { part: Some(part), replace });
            self.wire.within(self.service.clone().put_model(tokio_stream::iter(requests))).await
        };
        reconnecting(ask).await
    }

    /// Models in the order of their ids; an empty `env_id` means any.
    ///
    /// # Errors
    /// The learner fails.
    pub async fn list_models(&self, env_id: &str) -> Result<Vec<pb::ModelSummary>, ClientError> {
        let request = pb::ListModelsRequest { env_id: env_id.into() };
        let ask = async || self.wire.within(self.service.clone().list_models(request.clone())).await;
        Ok(reconnecting(ask).await?.models)
    }

    /// How many trajectories a filter selects.
    ///
    /// # Errors
    /// A malformed filter.
    pub async fn count_trajectories(&self, filter: &pb::TrajectoryFilter) -> Result<u64, ClientError> {
        Ok(self.list_trajectories_page(filter, 1, "").await?.total)
    }

    /// Trajectories without their arrays, in the order in which they were recorded.
    ///
    /// # Errors
    /// A malformed filter.
    pub async fn list_trajectories(
        &self,
        filter: &pb::TrajectoryFilter,
    ) -> Result<Vec<pb::TrajectorySummary>, ClientError> {
        let (mut all, mut token) = (Vec::new(), String::new());
        loop {
            let page = self.list_trajectories_page(filter, TRAJECTORY_PAGE, &token).await?;
            all.extend(page.trajectories);
            if page.next_page_token.is_empty() {
                return Ok(all);
            }
            token = page.next_page_token;
        }
    }

    /// One page of them; `token` is empty for the first, then the `next_page_token` of the page before.
    ///
    /// # Errors
    /// A malformed filter, size or token.
    pub async fn list_trajectories_page(
        &self,
        filter: &pb::TrajectoryFilter,
        page_size: u32,
        token: &str,
    ) -> Result<pb::ListTrajectoriesResponse, ClientError> {
        let request =
            pb::ListTrajectoriesRequest { filter: Some(filter.clone()), page_size, page_token: token.to_owned() };
        reconnecting(async || self.wire.within(self.service.clone().list_trajectories(request.clone())).await).await
    }

    /// Deletes what a filter selects and returns how many there were.
    ///
    /// # Errors
    /// A malformed filter, or one without a condition.
    pub async fn delete_trajectories(&self, filter: &pb::TrajectoryFilter) -> Result<u64, ClientError> {
        let request = pb::DeleteTrajectoriesRequest { filter: Some(filter.clone()) };
        Ok(self.wire.within(self.service.clone().delete_trajectories(request)).await?.deleted)
    }

    /// Whole trajectories in the order in which they were recorded, as they come.
    ///
    /// # Errors
    /// A malformed filter.
    pub async fn export_trajectories(&self, filter: &pb::TrajectoryFilter) -> Result<TrajectoryStream, ClientError> {
        self.export(pb::ExportTrajectoriesRequest { filter: Some(filter.clone()), fit_id: String::new() }).await
    }

    /// As [`Learner::export_trajectories`], those alone that a fit used; those deleted since are passed over.
    ///
    /// # Errors
    /// No such fit, or several; a malformed filter.
    pub async fn export_fit_trajectories(
        &self,
        fit_id: &str,
        filter: &pb::TrajectoryFilter,
    ) -> Result<TrajectoryStream, ClientError> {
        self.export(pb::ExportTrajectoriesRequest { filter: Some(filter.clone()), fit_id: fit_id.into() }).await
    }

    async fn export(&self, request: pb::ExportTrajectoriesRequest) -> Result<TrajectoryStream, ClientError> {
        let ask = async || self.wire.within(self.service.clone().export_trajectories(request.clone())).await;
        Ok(TrajectoryStream(reconnecting(ask).await?, self.wire.deadline))
    }

    /// One page of the ids of the trajectories that a fit used, in the order used; `token` is empty for the first, then the
    /// `next_page_token` of the page before.
    ///
    /// # Errors
    /// No such fit, or several; a malformed size or token.
    pub async fn fit_trajectories_page(
        &self,
        fit_id: &str,
        page_size: u32,
        token: &str,
    ) -> Result<pb::ListFitTrajectoriesResponse, ClientError> {
        let request = pb::ListFitTrajectoriesRequest { fit_id: fit_id.into(), page_size, page_token: token.to_owned() };
        let ask = async || self.wire.within(self.service.clone().list_fit_trajectories(request.clone())).await;
        reconnecting(ask).await
    }

    /// Ids of the trajectories that a fit used, in the order used, all of them.
    ///
    /// # Errors
    /// No such fit, or several.
    pub async fn fit_trajectories(&self, fit_id: &str) -> Result<Vec<String>, ClientError> {
        let (mut all, mut token) = (Vec::new(), String::new());
        loop {
            let page = self.fit_trajectories_page(fit_id, TRAJECTORY_PAGE, &token).await?;
            all.extend(page.trajectory_ids);
            if page.next_page_token.is_empty() {
                return Ok(all);
            }
            token = page.next_page_token;
        }
    }

    /// Fits and returns the stored fit; calls `progress` now and then, at most about ten times a second. Dropping the
    /// future cancels the fit.
    ///
    /// # Errors
    /// Nothing to fit on, an unknown model, wrong options.
    pub async fn fit(
        &self,
        request: pb::FitRequest,
        mut progress: impl FnMut(&pb::FitProgress),
    ) -> Result<pb::Fit, ClientError> {
        let follow = |event: &Event| {
            if let Event::Progress(entry) = event {
                progress(entry);
            }
        };
        self.fit_following(request, follow).await
    }

    /// As [`Learner::fit`]; calls `follow` with all that happens before the fit is there, its places in the queue among it.
    ///
    /// # Errors
    /// Nothing to fit on, an unknown model, wrong options.
    pub async fn fit_following(
        &self,
        request: pb::FitRequest,
        mut follow: impl FnMut(&Event),
    ) -> Result<pb::Fit, ClientError> {
        let mut stream = self.fit_stream(request).await?;
        loop {
            match stream.next().await? {
                Some(Event::Fit(fit)) => return Ok(fit),
                Some(event) => follow(&event),
                None => return Err(ClientError::protocol("the stream of a fit ended without a fit")),
            }
        }
    }

    /// Fits; progress and result as they come. Dropping the stream cancels the fit.
    ///
    /// # Errors
    /// Wrong options; all else comes on the stream.
    pub async fn fit_stream(&self, request: pb::FitRequest) -> Result<FitStream, ClientError> {
        let mut service = self.service.clone();
        Ok(FitStream(
            within(self.wire.work_deadline, service.fit(request)).await?.into_inner(),
            self.wire.work_deadline,
        ))
    }

    /// A stored fit, by its id or eight or more characters of its beginning.
    ///
    /// # Errors
    /// No such fit, or several.
    pub async fn get_fit(&self, fit_id: &str) -> Result<pb::Fit, ClientError> {
        let request = pb::GetFitRequest { fit_id: fit_id.into() };
        let ask = async || self.wire.within(self.service.clone().get_fit(request.clone())).await;
        let answer = reconnecting(ask).await?;
        answer.fit.ok_or_else(|| ClientError::protocol("expected a fit, got an empty answer"))
    }

    /// Fits without their arrays, newest first; an empty `env_id` or `style` means any.
    ///
    /// # Errors
    /// The learner fails.
    pub async fn list_fits(&self, env_id: &str, style: &str) -> Result<Vec<pb::FitSummary>, ClientError> {
        let mut request = pb::ListFitsRequest {
            env_id: env_id.into(),
            style: style.into(),
            page_size: FIT_PAGE,
            page_token: String::new(),
        };
        let mut all = Vec::new();
        loop {
            let ask = async || self.wire.within(self.service.clone().list_fits(request.clone())).await;
            let page = reconnecting(ask).await?;
            all.extend(page.fits);
            if page.next_page_token.is_empty() {
                return Ok(all);
            }
            request.page_token = page.next_page_token;
        }
    }

    /// Deletes a fit by its whole id.
    ///
    /// # Errors
    /// No such fit.
    pub async fn delete_fit(&self, fit_id: &str) -> Result<(), ClientError> {
        self.wire.within(self.service.clone().delete_fit(pb::DeleteFitRequest { fit_id: fit_id.into() })).await?;
        Ok(())
    }
}

/// Trajectories as they come.
#[derive(Debug)]
pub struct TrajectoryStream(Streaming<pb::ExportTrajectoriesResponse>, Duration);

impl TrajectoryStream {
    /// The next ones, at least one; `None` after the last.
    ///
    /// # Errors
    /// The learner fails, or the connection.
    pub async fn next(&mut self) -> Result<Option<Vec<pb::Trajectory>>, ClientError> {
        loop {
            match within(self.1, self.0.message()).await? {
                Some(page) if page.trajectories.is_empty() => {}
                page => return Ok(page.map(|page| page.trajectories)),
            }
        }
    }
}

/// A fit as it goes on.
#[derive(Debug)]
pub struct FitStream(Streaming<pb::FitResponse>, Duration);

impl FitStream {
    /// The next progress, or the fit, which is last; `None` after it.
    ///
    /// # Errors
    /// Nothing to fit on, an unknown model, wrong options, a learner that fails.
    pub async fn next(&mut self) -> Result<Option<Event>, ClientError> {
        loop {
            match within(self.1, self.0.message()).await? {
                Some(pb::FitResponse { event: Some(event) }) => return Ok(Some(event)),
                // An event of a newer release.
                Some(_) => {}
                None => return Ok(None),
            }
        }
    }
}
