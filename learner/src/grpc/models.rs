//! Models on their way in and out, in parts: a header, then blocks of rows in order, without gaps.
//!
//! Invariants: as many models are in memory at a time as there are permits; a peer that sends or reads nothing holds none
//! for long (see `pace`), and one that has not begun holds none at all; what waits for a permit with its first part in hand
//! is bounded.

use super::{blocking, pace::Pace, status::CallError, to_proto};
use crate::{
    config::Limits,
    store::{Model, Rows, check_header},
};
use mazeway_proto::{
    env::{ModelHeader, ModelPart, RowBlock, model_part::Part},
    learner as pb,
};
use prost::Message as _;
use std::sync::Arc;
use tokio::sync::{OwnedSemaphorePermit, Semaphore, mpsc};
use tokio_util::sync::CancellationToken;
use tonic::{Status, Streaming};

/// Bytes of first parts, of all callers together, that wait for their turn; further ones are refused.
const WAITING_BYTES: usize = 64 << 20;
/// Parts of a model that wait for the reader.
const PART_QUEUE: usize = 2;

/// A model that has come, whether it may take the place of one with other labels, and what it may be in memory by.
pub type Received = (Model, bool, OwnedSemaphorePermit);

/// Lets models in and out.
#[derive(Debug)]
pub struct Models {
    permits: Arc<Semaphore>,
    waiting: Arc<Semaphore>,
    limits: Arc<Limits>,
    /// Cancelled when no further model may begin to come.
    stopping: CancellationToken,
    /// Cancelled when those under way must end.
    aborting: CancellationToken,
}

impl Models {
    /// None is under way yet.
    pub fn new(limits: &Arc<Limits>, stopping: CancellationToken, aborting: CancellationToken) -> Self {
        Self {
            permits: Arc::new(Semaphore::new(limits.max_concurrent_models.clamp(1, Semaphore::MAX_PERMITS))),
            waiting: Arc::new(Semaphore::new(WAITING_BYTES)),
            limits: Arc::clone(limits),
            stopping,
            aborting,
        }
    }

    /// Waits for the turn to have a model in memory.
    pub async fn turn(&self) -> Result<OwnedSemaphorePermit, CallError> {
        let turn = Arc::clone(&self.permits).acquire_owned();
        unless(&self.aborting, turn).await?.map_err(|_| CallError::ShuttingDown)
    }

    /// Takes a model in. Its first part comes before its turn: whoever sends none keeps nobody waiting.
    pub async fn receive(&self, mut parts: Streaming<pb::PutModelRequest>) -> Result<Received, CallError> {
        let mut pace = Pace::new(self.limits.model_patience);
        let first = unless(&self.stopping, pace.wait(parts.message())).await??;
        let Some(first) = first.map_err(CallError::from)? else {
            return Err(CallError::field("part.header", "expected a header, got no part"));
        };
        let turn = match Arc::clone(&self.permits).try_acquire_owned() {
            Ok(turn) => turn,
            Err(_) => self.turn_of(&first).await?,
        };
        let (replace, mut next) = (first.replace, Some(first));
        let mut builder = ModelBuilder::default();
        while let Some(request) = next {
            pace.moved(request.encoded_len());
            builder.add(request.part, &self.limits)?;
            next = unless(&self.aborting, pace.wait(parts.message())).await??.map_err(CallError::from)?;
        }
        Ok((blocking(move || builder.finish()).await?, replace, turn))
    }

    /// Waits for the turn of a model whose first part is in memory already.
    async fn turn_of(&self, first: &pb::PutModelRequest) -> Result<OwnedSemaphorePermit, CallError> {
        let bytes = first.encoded_len().min(WAITING_BYTES) as u32;
        let full =
            |_| CallError::Full { field: "part", what: "bytes of models that wait", limit: WAITING_BYTES as u64 };
        let _waiting = self.waiting.try_acquire_many(bytes).map_err(full)?;
        self.turn().await
    }

    /// Gives a model out, which is in memory by `turn` until it has gone.
    pub fn send(
        &self,
        model: Model,
        turn: OwnedSemaphorePermit,
    ) -> mpsc::Receiver<Result<pb::GetModelResponse, Status>> {
        let (parts, stream) = mpsc::channel(PART_QUEUE);
        let (patience, aborting) = (self.limits.model_patience, self.aborting.clone());
        tokio::spawn(async move {
            let mut pace = Pace::new(patience);
            let sending = async {
                for part in to_proto::model_parts(&model) {
                    let bytes = part.encoded_len();
                    // A caller that has gone reads no more.
                    let Ok(place) = pace.wait(parts.reserve()).await? else { return Ok(()) };
                    place.send(Ok(part));
                    pace.moved(bytes);
                }
                Ok(())
            };
            let sent = unless(&aborting, sending).await.flatten();
            drop((model, turn));
            if let Err(error) = sent {
                let _ = parts.send(Err(error.into())).await;
            }
        });
        stream
    }
}

/// Waits for something unless that must end first.
pub async fn unless<T>(end: &CancellationToken, work: impl Future<Output = T>) -> Result<T, CallError> {
    tokio::select! {
        biased;
        done = work => Ok(done),
        () = end.cancelled() => Err(CallError::ShuttingDown),
    }
}

/// Puts parts together. Invariant: what it holds is within the limits, whatever was sent.
#[derive(Debug, Default)]
pub struct ModelBuilder {
    header: Option<ModelHeader>,
    row_lengths: Vec<u8>,
    next_states: Vec<u8>,
    probabilities: Vec<u8>,
    visit_counts: Vec<u8>,
}

impl ModelBuilder {
    /// Takes the next part.
    pub fn add(&mut self, part: Option<ModelPart>, limits: &Limits) -> Result<(), CallError> {
        match (part.and_then(|part| part.part), &self.header) {
            (None, _) => Err(CallError::field("part", "expected a header or rows, got neither")),
            (Some(Part::Header(_)), Some(_)) => {
                Err(CallError::field("part.header", "expected one header, got another"))
            }
            (Some(Part::Header(header)), None) => self.add_header(header, limits),
            (Some(Part::Rows(_)), None) => Err(CallError::field("part.rows", "expected the header first, got rows")),
            (Some(Part::Rows(rows)), Some(_)) => self.add_rows(&rows, limits),
        }
    }

    fn add_header(&mut self, header: ModelHeader, limits: &Limits) -> Result<(), CallError> {
        check_header(&header).map_err(|error| error.within("part"))?;
        let (limit, got) = (limits.max_model_rows, u64::from(header.n_states) * u64::from(header.n_actions));
        if got > limit {
            return Err(CallError::Limit { field: "part.header.n_states".into(), what: "rows", limit, got });
        }
        self.header = Some(header);
        Ok(())
    }

    fn add_rows(&mut self, rows: &RowBlock, limits: &Limits) -> Result<(), CallError> {
        let expected = self.row_lengths.len() / 4;
        if rows.first_row as usize != expected {
            let message = format!("expected row {expected} next, got {}", rows.first_row);
            return Err(CallError::field("part.rows.first_row", message));
        }
        let got = ((self.next_states.len() + rows.next_states.len()) / 4) as u64;
        if got > limits.max_model_transitions {
            let (field, limit) = ("part.rows.next_states".into(), limits.max_model_transitions);
            return Err(CallError::Limit { field, what: "transitions", limit, got });
        }
        let n_rows = self.header.as_ref().map_or(0, |h| u64::from(h.n_states) * u64::from(h.n_actions));
        let arrays = [
            ("row_lengths", &rows.row_lengths, &mut self.row_lengths, 4, n_rows),
            ("next_states", &rows.next_states, &mut self.next_states, 4, limits.max_model_transitions),
            ("probabilities", &rows.probabilities, &mut self.probabilities, 8, limits.max_model_transitions),
            ("visit_counts", &rows.visit_counts, &mut self.visit_counts, 8, n_rows),
        ];
        for (field, part, whole, size, limit) in arrays {
            let got = (whole.len() + part.len()) as u64 / size;
            if !(part.len() as u64).is_multiple_of(size) || got > limit {
                let message = format!("expected {size} bytes an entry and {limit} entries in all at most, got {got}");
                return Err(CallError::field(format!("part.rows.{field}"), message));
            }
            whole.extend_from_slice(part);
        }
        Ok(())
    }

    /// Checks the whole and names it. Takes time that grows with the model.
    pub fn finish(self) -> Result<Model, CallError> {
        let header = self.header.ok_or_else(|| CallError::field("part.header", "expected a header, got no part"))?;
        let rows = Rows {
            row_lengths: self.row_lengths.into(),
            next_states: self.next_states.into(),
            probabilities: self.probabilities.into(),
            visit_counts: self.visit_counts.into(),
        };
        Ok(Model::new(header, rows).map_err(|error| error.within("part"))?)
    }
}
