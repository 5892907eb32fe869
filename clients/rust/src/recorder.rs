//! Records demonstrations with a learner, so that none is lost and none is stored twice.
//!
//! Invariants: a trajectory counts as recorded once the learner has it on stable storage; what is not acknowledged is kept
//! and sent again when the connection comes back; its UUID, made here, is what makes that safe. Trajectories are sent in
//! batches, several under way at a time, and stored in the order in which they were given.

use crate::{ClientError, ConnectOptions, connect::Wire, packed::pack, retry::Backoff};
use bytes::Bytes;
use mazeway_proto::learner::{self as pb, learner_service_client::LearnerServiceClient};
use std::{collections::VecDeque, future::Future, time::Duration};
use tokio::{sync::mpsc, time::timeout};
use tokio_stream::wrappers::ReceiverStream;
use tonic::{Code, Status, Streaming};
use uuid::Uuid;

/// Trajectories in a request at most.
const BATCH_TRAJECTORIES: usize = 256;
/// Bytes of arrays in a request, one trajectory more at most.
const BATCH_BYTES: usize = 1 << 20;
/// Requests that are under way at a time.
const IN_FLIGHT: usize = 16;
/// How long the end of a stream that has said all may take.
const FAREWELL: Duration = Duration::from_secs(1);
/// First and longest pause between two attempts to reach the learner.
const PAUSES: (Duration, Duration) = (Duration::from_millis(50), Duration::from_secs(2));

/// One demonstration in plain arrays.
#[derive(Debug, Clone, PartialEq, Default)]
pub struct Demonstration {
    /// Environment or process, such as `"Highway-v0"`.
    pub env_id: String,
    /// Model that describes it; empty where none is known.
    pub model_id: String,
    /// What the demonstrator was after, such as `"aggressive"`.
    pub style: String,
    /// Who acted, such as `"driver:aggressive"`.
    pub source: String,
    /// Seed of the episode where the source is scripted.
    pub seed: Option<u64>,
    /// Size of the state set.
    pub n_states: u32,
    /// Size of the action set.
    pub n_actions: u32,
    /// State before each step, shape (steps,).
    pub states: Vec<u32>,
    /// Action of each step, shape (steps,); empty where only the states were seen.
    pub actions: Vec<u32>,
    /// Reward of each step, shape (steps,); empty where unknown.
    pub rewards: Vec<f64>,
    /// State after the last step, where known.
    pub final_state: Option<u32>,
    /// The episode came to an end of its own.
    pub terminated: bool,
    /// The episode was cut off.
    pub truncated: bool,
}

impl From<Demonstration> for pb::Trajectory {
    /// Packs the arrays under a new random UUID.
    fn from(d: Demonstration) -> Self {
        Self {
            trajectory_id: Uuid::new_v4().to_string(),
            env_id: d.env_id,
            model_id: d.model_id,
            style: d.style,
            source: d.source,
            seed: d.seed,
            n_states: d.n_states,
            n_actions: d.n_actions,
            states: pack(d.states),
            actions: pack(d.actions),
            rewards: pack(d.rewards),
            final_state: d.final_state,
            terminated: d.terminated,
            truncated: d.truncated,
        }
    }
}

/// What the learner has acknowledged.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub struct Receipt {
    /// Trajectories that were not stored before.
    pub stored: u64,
    /// Trajectories that the learner had already.
    pub duplicates: u64,
}

impl Receipt {
    /// Trajectories on stable storage.
    pub fn acknowledged(&self) -> u64 {
        self.stored + self.duplicates
    }
}

/// Records trajectories over one stream. [`Recorder::finish`] it: what is dropped unfinished may not arrive.
#[derive(Debug)]
pub struct Recorder {
    service: LearnerServiceClient<Wire>,
    stream: Option<Open>,
    batch: Vec<pb::Trajectory>,
    batch_bytes: usize,
    /// Requests that are not acknowledged, the oldest first.
    waiting: VecDeque<pb::RecordTrajectoriesRequest>,
    receipt: Receipt,
    retry_for: Duration,
    /// Longest wait for an answer; then the stream counts as broken.
    deadline: Duration,
}

/// A stream that is open.
#[derive(Debug)]
struct Open {
    requests: mpsc::Sender<pb::RecordTrajectoriesRequest>,
    answers: Streaming<pb::RecordTrajectoriesResponse>,
    /// How many of the waiting requests were sent on it.
    sent: usize,
}

impl Recorder {
    /// Connects to a learner at `address`, such as `127.0.0.1:50052`.
    ///
    /// # Errors
    /// An address that is none; nobody answers.
    pub async fn connect(address: &str) -> Result<Self, ClientError> {
        Ok(Self::from_channel(Wire::open(address, &ConnectOptions::default()).await?))
    }

    /// Uses a channel that is there already.
    pub fn from_channel(channel: impl Into<Wire>) -> Self {
        let wire = channel.into();
        Self {
            deadline: wire.deadline,
            service: LearnerServiceClient::new(wire),
            stream: None,
            batch: Vec::new(),
            batch_bytes: 0,
            waiting: VecDeque::new(),
            receipt: Receipt::default(),
            retry_for: Duration::from_secs(30),
        }
    }

    /// For how long a learner that went away is waited for; 30 s unless said otherwise.
    #[must_use]
    pub fn retry_for(mut self, time: Duration) -> Self {
        self.retry_for = time;
        self
    }

    /// Takes a trajectory: a [`Demonstration`], or a message that has its UUID. It is on its way when this returns, or
    /// waits for the batch to fill; [`Recorder::flush`] waits until it is stored.
    ///
    /// # Errors
    /// Arrays that are no trajectory, of this one, which is not taken. As [`Recorder::flush`], of earlier ones.
    pub async fn record(&mut self, trajectory: impl Into<pb::Trajectory>) -> Result<(), ClientError> {
        let trajectory = trajectory.into();
        check(&trajectory)?;
        self.batch_bytes += trajectory.states.len() + trajectory.actions.len() + trajectory.rewards.len();
        self.batch.push(trajectory);
        if self.batch.len() < BATCH_TRAJECTORIES && self.batch_bytes < BATCH_BYTES {
            return Ok(());
        }
        self.close_batch();
        self.exchange(IN_FLIGHT).await
    }

    /// Sends what is left and waits until everything is on stable storage.
    ///
    /// # Errors
    /// A trajectory that the learner refuses: it is given up, and named; the others are kept, and go on with the next call.
    /// A learner that does not come back within [`Recorder::retry_for`]: everything unacknowledged is kept.
    pub async fn flush(&mut self) -> Result<Receipt, ClientError> {
        self.close_batch();
        self.exchange(0).await?;
        Ok(self.receipt)
    }

    /// Flushes and ends the stream.
    ///
    /// # Errors
    /// As [`Recorder::flush`].
    pub async fn finish(mut self) -> Result<Receipt, ClientError> {
        let receipt = self.flush().await?;
        if let Some(Open { requests, mut answers, .. }) = self.stream.take() {
            // A learner counts a stream that is dropped before its end as one whose caller has gone.
            drop(requests);
            let end = async { while let Ok(Some(_)) = answers.message().await {} };
            let _ = timeout(self.deadline.min(FAREWELL), end).await;
        }
        Ok(receipt)
    }

    /// What is acknowledged so far.
    pub fn receipt(&self) -> Receipt {
        self.receipt
    }

    /// Trajectories that were taken and are not acknowledged.
    pub fn unacknowledged(&self) -> usize {
        self.batch.len() + self.waiting.iter().map(|request| request.trajectories.len()).sum::<usize>()
    }

    fn close_batch(&mut self) {
        if !self.batch.is_empty() {
            let trajectories = std::mem::take(&mut self.batch);
            self.waiting.push_back(pb::RecordTrajectoriesRequest { trajectories });
            self.batch_bytes = 0;
        }
    }

    /// Sends and receives until at most `left` requests wait for their answer and all are sent.
    async fn exchange(&mut self, left: usize) -> Result<(), ClientError> {
        let mut backoff = None;
        let mut acknowledged = self.receipt.acknowledged();
        loop {
            let Err(status) = self.try_exchange(left).await else { return Ok(()) };
            self.stream = None;
            if !may_pass(&status) {
                return Err(self.give_up(status));
            }
            if self.receipt.acknowledged() > acknowledged {
                // It got on meanwhile: this is another interruption.
                acknowledged = self.receipt.acknowledged();
                backoff = None;
            }
            tracing::debug!(%status, "the recording stream broke; trying again");
            let backoff = backoff.get_or_insert_with(|| Backoff::new(PAUSES.0, PAUSES.1, self.retry_for));
            if !backoff.pause().await {
                return Err(status.into());
            }
        }
    }

    async fn try_exchange(&mut self, left: usize) -> Result<(), Status> {
        loop {
            let sent = self.stream.as_ref().map_or(0, |stream| stream.sent);
            if sent == self.waiting.len() && sent <= left {
                return Ok(());
            }
            let stream = match &mut self.stream {
                Some(stream) => stream,
                None => self.stream.insert(in_time(self.deadline, open(&mut self.service)).await?),
            };
            if stream.sent < self.waiting.len() && stream.sent < IN_FLIGHT {
                // Cheap: the arrays are shared.
                let request = self.waiting[stream.sent].clone();
                let sent = async { Ok(stream.requests.send(request).await) };
                if in_time(self.deadline, sent).await?.is_ok() {
                    stream.sent += 1;
                    continue;
                }
                // The stream has ended: its status lies behind the answers.
            }
            let answer = in_time(self.deadline, stream.answers.message()).await?;
            let Some(answer) = answer else { return Err(Status::unavailable("the learner ended the stream")) };
            let Some(request) = self.waiting.pop_front() else {
                return Err(Status::data_loss("an answer without a request"));
            };
            stream.sent = stream.sent.saturating_sub(1);
            self.receipt.stored += u64::from(answer.stored);
            self.receipt.duplicates += (request.trajectories.len() as u64).saturating_sub(u64::from(answer.stored));
        }
    }

    /// The oldest request was refused: gives up the trajectory that is to blame.
    fn give_up(&mut self, status: Status) -> ClientError {
        let error = ClientError::from(status);
        let rank = error.field().and_then(|field| {
            let rank = field.strip_prefix("trajectories[")?.split(']').next()?;
            rank.parse::<usize>().ok()
        });
        let Some(request) = self.waiting.front_mut() else { return error };
        let Some(rank) = rank.filter(|&rank| rank < request.trajectories.len()) else {
            // A full disk is no fault of the trajectories: they are kept.
            if matches!(error.code(), Code::InvalidArgument | Code::AlreadyExists) {
                self.waiting.pop_front();
            }
            return error;
        };
        let trajectory = request.trajectories.remove(rank);
        if request.trajectories.is_empty() {
            self.waiting.pop_front();
        }
        match error {
            ClientError::Status { code, field, message } => ClientError::Status {
                code,
                // The rank within a batch means nothing to the caller.
                field: field.and_then(|field| field.split_once("].").map(|(_, field)| field.to_owned())),
                message: if message.contains(&trajectory.trajectory_id) {
                    message
                } else {
                    format!("trajectory {}: {message}", trajectory.trajectory_id)
                },
            },
            other => other,
        }
    }
}

impl Drop for Recorder {
    fn drop(&mut self) {
        let left = self.unacknowledged();
        if left > 0 {
            tracing::warn!(trajectories = left, "a recorder was dropped before its trajectories were acknowledged");
        }
    }
}

/// What does not come in time is as good as lost.
async fn in_time<T>(deadline: Duration, wait: impl Future<Output = Result<T, Status>>) -> Result<T, Status> {
    let late = |_| Status::unavailable(format!("no answer within {} s", deadline.as_secs_f64()));
    timeout(deadline, wait).await.map_err(late)?
}

async fn open(service: &mut LearnerServiceClient<Wire>) -> Result<Open, Status> {
    let (requests, stream) = mpsc::channel(IN_FLIGHT);
    let answers = service.record_trajectories(ReceiverStream::new(stream)).await?.into_inner();
    Ok(Open { requests, answers, sent: 0 })
}

/// Whether the same request may succeed later: the learner is away, going or coming.
fn may_pass(status: &Status) -> bool {
    match status.code() {
        Code::Unavailable | Code::Cancelled | Code::Aborted | Code::Unknown => true,
        // What breaks a connection is INTERNAL, with its cause; what the learner itself reports has none.
        Code::Internal => std::error::Error::source(status).is_some() || status.message().starts_with("h2 "),
        _ => false,
    }
}

/// Refuses what the learner would refuse, before it travels with others.
fn check(trajectory: &pb::Trajectory) -> Result<(), ClientError> {
    let wrong = |field, message| Err(ClientError::Argument { field, message });
    let steps = trajectory.states.len() / 4;
    if steps == 0 || !trajectory.states.len().is_multiple_of(4) {
        return wrong("states", format!("expected at least one step, got {} bytes", trajectory.states.len()));
    }
    if trajectory.actions.is_empty() && steps == 1 && trajectory.final_state.is_none() {
        return wrong("states", "expected at least two states where there are no actions, got one".to_owned());
    }
    if !trajectory.actions.is_empty() && trajectory.actions.len() != steps * 4 {
        return wrong("actions", format!("expected {steps} actions or none, got {}", trajectory.actions.len() / 4));
    }
    if !trajectory.rewards.is_empty() && trajectory.rewards.len() != steps * 8 {
        return wrong("rewards", format!("expected {steps} rewards or none, got {}", trajectory.rewards.len() / 8));
    }
    let beyond = |packed: &Bytes, size: u32| {
        let indices = packed.chunks_exact(4).map(|b| u32::from_le_bytes([b[0], b[1], b[2], b[3]]));
        indices.enumerate().find(|&(_, index)| index >= size)
    };
    if let Some((step, state)) = beyond(&trajectory.states, trajectory.n_states) {
        return wrong("states", format!("expected states below {}, got {state} at step {step}", trajectory.n_states));
    }
    if let Some((step, action)) = beyond(&trajectory.actions, trajectory.n_actions) {
        return wrong(
            "actions",
            format!("expected actions below {}, got {action} at step {step}", trajectory.n_actions),
        );
    }
    if Uuid::try_parse(&trajectory.trajectory_id).is_err() {
        return wrong("trajectory_id", format!("expected a UUID, got {:?}", trajectory.trajectory_id));
    }
    Ok(())
}

#[cfg(test)]
mod tests {
    use super::*;

    fn demonstration() -> Demonstration {
        Demonstration {
            env_id: "e".into(),
            style: "s".into(),
            n_states: 3,
            n_actions: 2,
            states: vec![0, 2],
            actions: vec![1, 0],
            ..Demonstration::default()
        }
    }

    /// Makes a demonstration wrong.
    type Change = fn(&mut Demonstration);

    #[test]
    fn what_is_no_trajectory_is_refused_before_it_travels() {
        assert!(check(&demonstration().into()).is_ok());
        assert!(check(&Demonstration { actions: Vec::new(), ..demonstration() }.into()).is_ok());
        let cases: [(&str, Change); 6] = [
            ("states", |d| (d.states, d.actions) = (vec![1], Vec::new())),
            ("states", |d| d.states.clear()),
            ("states", |d| d.states[1] = 3),
            ("actions", |d| d.actions.push(0)),
            ("actions", |d| d.actions[0] = 2),
            ("rewards", |d| d.rewards.push(1.0)),
        ];
        for (field, change) in cases {
            let mut wrong = demonstration();
            change(&mut wrong);
            assert_eq!(check(&wrong.into()).expect_err("refused").field(), Some(field));
        }
    }
}
