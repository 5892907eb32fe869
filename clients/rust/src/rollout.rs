//! Roll-outs: closed loops that the server runs, and the episodes that come of them.

use crate::{
    ClientError,
    connect::within,
    packed::{Packed, pack},
    spec::{Options, options_to_wire},
};
use bytes::Bytes;
use mazeway_proto::env as pb;
use std::time::Duration;
use tonic::Streaming;

/// Who acts.
#[derive(Debug, Clone, PartialEq)]
pub enum Controller {
    /// A scripted driver of the environment, or `"random"`.
    Driver(String),
    /// π(a|s) over the tabular states, shape `(n_states, n_actions)`; rows sum to 1 within 1e-6.
    Policy(Vec<f64>),
}

impl Controller {
    /// A scripted driver by name.
    pub fn driver(name: impl Into<String>) -> Self {
        Self::Driver(name.into())
    }
}

/// What to roll out.
#[derive(Debug, Clone, PartialEq)]
pub struct Rollout {
    /// Environment.
    pub env_id: String,
    /// Its options.
    pub options: Options,
    /// Who acts.
    pub controller: Controller,
    /// Episode i is seeded with seed + i.
    pub seed: u64,
    /// How many episodes; at least 1.
    pub episodes: u32,
    /// Steps recorded of each; at least 1.
    pub steps: u32,
    /// Steps driven before the recording begins.
    pub burn_in_steps: u32,
    /// Leave out the arrays of every step.
    pub totals_only: bool,
}

impl Rollout {
    /// `episodes` of `steps` each under default options, seed 0, without burn-in.
    pub fn new(env_id: impl Into<String>, controller: Controller, episodes: u32, steps: u32) -> Self {
        Self {
            env_id: env_id.into(),
            options: Options::new(),
            controller,
            seed: 0,
            episodes,
            steps,
            burn_in_steps: 0,
            totals_only: false,
        }
    }

    /// As a message, for tests that look at the wire.
    #[doc(hidden)]
    pub fn into_wire(self) -> pb::RolloutRequest {
        use pb::rollout_request::Controller as Wire;
        pb::RolloutRequest {
            options: options_to_wire(&self.options),
            env_id: self.env_id,
            controller: Some(match self.controller {
                Controller::Driver(name) => Wire::Driver(name),
                Controller::Policy(values) => Wire::Policy(pb::TabularPolicy { probabilities: pack(values) }),
            }),
            seed: self.seed,
            episodes: self.episodes,
            steps: self.steps,
            burn_in_steps: self.burn_in_steps,
            totals_only: self.totals_only,
            // The same numbers in fewer bytes.
            compact: true,
        }
    }
}

/// Consecutive episodes, episode after episode in flat arrays.
#[derive(Debug, Clone, Default, PartialEq)]
pub struct Episodes {
    /// Rank of the first in its roll-out.
    pub first_episode: u32,
    /// Steps of each, shape `(episodes,)`.
    pub lengths: Vec<u32>,
    /// Tabular state before each step, shape `(sum of lengths,)`; empty where totals alone were asked for.
    pub states: Vec<u32>,
    /// Action of each step, likewise.
    pub actions: Vec<u32>,
    /// Reward of each step, likewise.
    pub rewards: Vec<f64>,
    /// Tabular state after the last step of each, shape `(episodes,)`.
    pub final_states: Vec<u32>,
    /// The episode came to an end of its own, shape `(episodes,)`.
    pub terminated: Vec<bool>,
    /// Sum of each episode's rewards, shape `(episodes,)`.
    pub returns: Vec<f64>,
    /// Sums of the summed info columns by name, each of shape `(episodes,)`.
    pub totals: Vec<(String, Vec<f64>)>,
}

/// One episode of [`Episodes`].
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Episode<'a> {
    /// Rank in its roll-out: it was seeded with the roll-out's seed + rank.
    pub rank: u32,
    /// Steps.
    pub length: u32,
    /// Tabular state before each step, shape `(length,)`; empty where totals alone were asked for.
    pub states: &'a [u32],
    /// Action of each step, likewise.
    pub actions: &'a [u32],
    /// Reward of each step, likewise.
    pub rewards: &'a [f64],
    /// Tabular state after the last step.
    pub final_state: u32,
    /// The episode came to an end of its own.
    pub terminated: bool,
    /// Sum of the rewards.
    pub total_reward: f64,
}

impl Episodes {
    /// Number of episodes.
    pub fn len(&self) -> usize {
        self.lengths.len()
    }

    /// True where there is none.
    pub fn is_empty(&self) -> bool {
        self.lengths.is_empty()
    }

    /// Steps of all episodes.
    pub fn total_steps(&self) -> u64 {
        self.lengths.iter().map(|&length| u64::from(length)).sum()
    }

    /// Sums of one summed info column, shape `(episodes,)`.
    pub fn total(&self, name: &str) -> Option<&[f64]> {
        self.totals.iter().find(|(known, _)| known == name).map(|(_, values)| values.as_slice())
    }

    /// The episodes in order.
    pub fn iter(&self) -> impl Iterator<Item = Episode<'_>> {
        let mut start = 0;
        (0..self.len()).map(move |i| {
            let end = if self.states.is_empty() { start } else { start + self.lengths[i] as usize };
            let steps = start..end;
            start = end;
            Episode {
                rank: self.first_episode + i as u32,
                length: self.lengths[i],
                states: &self.states[steps.clone()],
                actions: &self.actions[steps.clone()],
                rewards: &self.rewards[steps],
                final_state: self.final_states[i],
                terminated: self.terminated[i],
                total_reward: self.returns[i],
            }
        })
    }

    /// Appends the episodes that follow.
    fn extend(&mut self, next: Self) {
        if self.is_empty() {
            *self = next;
            return;
        }
        self.lengths.extend(next.lengths);
        self.states.extend(next.states);
        self.actions.extend(next.actions);
        self.rewards.extend(next.rewards);
        self.final_states.extend(next.final_states);
        self.terminated.extend(next.terminated);
        self.returns.extend(next.returns);
        for ((_, values), (_, more)) in self.totals.iter_mut().zip(next.totals) {
            values.extend(more);
        }
    }

    /// Forgets all episodes and keeps the room that they took.
    pub fn clear(&mut self) {
        self.lengths.clear();
        self.states.clear();
        self.actions.clear();
        self.rewards.clear();
        self.final_states.clear();
        self.terminated.clear();
        self.returns.clear();
        self.totals.iter_mut().for_each(|(_, values)| values.clear());
    }

    /// Appends a message, and says how many episodes it brought.
    fn append(&mut self, wire: pb::RolloutResponse, totals_only: bool) -> Result<usize, ClientError> {
        let episodes = wire.lengths.len() / 4;
        let lengths = Packed::<u32>::of_len(wire.lengths, episodes, "lengths")?;
        let steps = if totals_only { 0 } else { lengths.iter().map(|length| length as usize).sum() };
        extend_integers(&mut self.states, wire.states, wire.states_dtype, steps, "states")?;
        extend_integers(&mut self.actions, wire.actions, wire.actions_dtype, steps, "actions")?;
        extend_rewards(&mut self.rewards, wire.rewards, wire.reward_values, steps)?;
        if self.is_empty() {
            self.first_episode = wire.first_episode;
        }
        self.lengths.extend(lengths.iter());
        self.final_states.extend(Packed::<u32>::of_len(wire.final_states, episodes, "final states")?.iter());
        let terminated = Packed::<u8>::of_len(wire.terminated, episodes, "flags")?;
        self.terminated.extend(terminated.iter().map(|flag| flag != 0));
        self.returns.extend(Packed::<f64>::of_len(wire.returns, episodes, "returns")?.iter());
        if self.totals.is_empty() {
            self.totals = wire.totals.iter().map(|totals| (totals.name.clone(), Vec::new())).collect();
        }
        if !wire.totals.iter().map(|totals| &totals.name).eq(self.totals.iter().map(|(name, _)| name)) {
            return Err(ClientError::protocol("expected the same totals in every message"));
        }
        for ((_, values), totals) in self.totals.iter_mut().zip(wire.totals) {
            values.extend(Packed::<f64>::of_len(totals.values, episodes, &totals.name)?.iter());
        }
        Ok(episodes)
    }
}

/// Appends packed integers of the type that a message tells.
fn extend_integers(into: &mut Vec<u32>, bytes: Bytes, dtype: i32, len: usize, what: &str) -> Result<(), ClientError> {
    match pb::DType::try_from(dtype) {
        Ok(pb::DType::Unspecified | pb::DType::Int32) => into.extend(Packed::<u32>::of_len(bytes, len, what)?.iter()),
        Ok(pb::DType::Uint16) => into.extend(Packed::<u16>::of_len(bytes, len, what)?.iter().map(u32::from)),
        Ok(pb::DType::Uint8) => {
            into.extend(Packed::<u8>::of_len(bytes, len, what)?.as_bytes().iter().copied().map(u32::from));
        }
        _ => return Err(ClientError::protocol(format!("expected {what} as integers, got element type {dtype}"))),
    }
    Ok(())
}

/// Appends rewards, or those whose ranks came.
fn extend_rewards(into: &mut Vec<f64>, bytes: Bytes, values: Bytes, len: usize) -> Result<(), ClientError> {
    if values.is_empty() {
        into.extend(Packed::<f64>::of_len(bytes, len, "rewards")?.iter());
        return Ok(());
    }
    let values = Packed::<f64>::new(values).filter(|values| values.len() <= 256);
    let values = values.ok_or_else(|| ClientError::protocol("expected at most 256 distinct rewards"))?;
    let ranks = Packed::<u8>::of_len(bytes, len, "ranks of rewards")?;
    if let Some(&rank) = ranks.as_bytes().iter().max().filter(|&&rank| usize::from(rank) >= values.len()) {
        return Err(ClientError::protocol(format!("expected a rank below {}, got {rank}", values.len())));
    }
    // As long as a byte can say: no look-up needs a check.
    let mut table = [0.0; 256];
    values.copy_to(&mut table);
    into.extend(ranks.as_bytes().iter().map(|&rank| table[usize::from(rank)]));
    Ok(())
}

/// Episodes as they come. Dropping it stops the roll-out on the server.
#[derive(Debug)]
pub struct EpisodeStream {
    answers: Streaming<pb::RolloutResponse>,
    asked: u32,
    next_episode: u32,
    totals_only: bool,
    /// Longest wait for a message.
    deadline: Duration,
}

impl EpisodeStream {
    pub(crate) fn new(
        answers: Streaming<pb::RolloutResponse>,
        asked: u32,
        totals_only: bool,
        deadline: Duration,
    ) -> Self {
        Self { answers, asked, next_episode: 0, totals_only, deadline }
    }

    /// The next few episodes; `None` once all have come.
    ///
    /// # Errors
    /// The server failed or broke off.
    pub async fn next(&mut self) -> Result<Option<Episodes>, ClientError> {
        let mut episodes = Episodes::default();
        Ok(self.append_next(&mut episodes).await?.then_some(episodes))
    }

    /// As [`EpisodeStream::next`], into `episodes`, whose room is used again; false once all have come. The fastest way to
    /// read a long roll-out: nothing is allocated once the room suffices.
    ///
    /// # Errors
    /// The server failed or broke off.
    pub async fn next_into(&mut self, episodes: &mut Episodes) -> Result<bool, ClientError> {
        episodes.clear();
        self.append_next(episodes).await
    }

    async fn append_next(&mut self, episodes: &mut Episodes) -> Result<bool, ClientError> {
        let Some(answer) = within(self.deadline, self.answers.message()).await? else {
            return if self.next_episode == self.asked {
                Ok(false)
            } else {
                Err(ClientError::protocol(format!("expected {} episodes, got {}", self.asked, self.next_episode)))
            };
        };
        if answer.first_episode != self.next_episode {
            let message = format!("expected episode {}, got {}", self.next_episode, answer.first_episode);
            return Err(ClientError::protocol(message));
        }
        self.next_episode += episodes.append(answer, self.totals_only)? as u32;
        Ok(true)
    }

    /// All that are still to come, together.
    ///
    /// # Errors
    /// The server failed or broke off.
    pub async fn collect(self) -> Result<Episodes, ClientError> {
        let (mut stream, mut all) = (self, Episodes::default());
        while stream.append_next(&mut all).await? {}
        Ok(all)
    }

    /// As [`EpisodeStream::collect`], and tells of every part as it comes.
    ///
    /// # Errors
    /// The server failed or broke off.
    pub async fn collect_with(mut self, mut arrived: impl FnMut(&Episodes)) -> Result<Episodes, ClientError> {
        let mut all = Episodes::default();
        while let Some(more) = self.next().await? {
            arrived(&more);
            all.extend(more);
        }
        Ok(all)
    }
}
