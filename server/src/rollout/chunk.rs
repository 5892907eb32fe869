//! Some episodes computed together on all cores, each written where it belongs: nothing is gathered or copied afterwards.
//!
//! Invariant: episodes are grouped by the plan alone, so that no number depends on the cores.

pub(super) use super::episode::Stopped;
use super::{
    RewardFormat, RolloutPlan, StepFormat, Steps,
    episode::{self, Nothing, Packed, Summary},
    rewards::RewardTable,
};
use crate::sim::{Configured, EnvSpec, Simulator};
use rayon::prelude::*;
use std::ops::Range;

/// Steps that a core computes in one go: many times what handing them to it costs.
const GROUP_STEPS: u64 = 4096;

/// Consecutive episodes of a roll-out.
#[derive(Debug, Clone, PartialEq)]
pub struct EpisodeChunk {
    /// Rank of the first.
    pub first_episode: u32,
    /// Steps of each, shape `(episodes,)`.
    pub lengths: Vec<u32>,
    /// What happened in each step, episode after episode; empty where totals alone were asked for.
    pub steps: Steps,
    /// Tabular state after the last step of each, shape `(episodes,)`.
    pub final_states: Vec<u32>,
    /// The episode came to an end of its own, shape `(episodes,)`.
    pub terminated: Vec<bool>,
    /// Sum of each episode's rewards, shape `(episodes,)`.
    pub returns: Vec<f64>,
    /// Names of the summed info columns.
    pub total_names: Vec<&'static str>,
    /// Sums of each summed column, shape `(columns, episodes)`.
    pub totals: Vec<Vec<f64>>,
}

/// Neighbouring episodes that one core computes.
struct Group<'a> {
    first: u32,
    summaries: &'a mut [Summary],
    /// Shape (episodes, summed columns).
    totals: &'a mut [f64],
    states: &'a mut [u8],
    actions: &'a mut [u8],
    rewards: &'a mut [u8],
    table: RewardTable,
}

/// Computes the episodes of ranks `ranks`.
pub(super) fn run<S: Simulator>(
    configured: &Configured<S>,
    plan: &RolloutPlan,
    format: StepFormat,
    ranks: Range<u32>,
    cancelled: &(dyn Fn() -> bool + Sync),
) -> Result<EpisodeChunk, Stopped> {
    let spec = &configured.spec;
    let summed: Vec<usize> = (0..spec.info_columns.len()).filter(|&i| spec.info_columns[i].summed).collect();
    let episodes = ranks.len();
    let capacity = if plan.totals_only { 0 } else { plan.steps as usize };
    let mut steps = Steps::new(format, episodes * capacity);
    let mut summaries = vec![Summary::default(); episodes];
    let mut totals = vec![0.0; episodes * summed.len()];
    let group_episodes = (GROUP_STEPS / (u64::from(plan.steps) + u64::from(plan.burn_in_steps))).max(1) as usize;
    let mut groups =
        split(&mut steps, &mut summaries, &mut totals, summed.len(), capacity, ranks.start, group_episodes);
    groups.par_iter_mut().try_for_each(|group| group.run(configured, plan, format, &summed, capacity, cancelled))?;
    if format.rewards == RewardFormat::Ranks && capacity > 0 {
        steps.reward_values = merge(groups)?;
    }
    let lengths: Vec<u32> = summaries.iter().map(|summary| summary.length).collect();
    if capacity > 0 && lengths.iter().any(|&length| length as usize != capacity) {
        steps.close_gaps(capacity, &lengths);
    }
    Ok(gather(spec, &summed, ranks.start, lengths, steps, &summaries, &totals))
}

fn split<'a>(
    steps: &'a mut Steps,
    summaries: &'a mut [Summary],
    totals: &'a mut [f64],
    n_summed: usize,
    capacity: usize,
    first: u32,
    group_episodes: usize,
) -> Vec<Group<'a>> {
    let format = steps.format;
    let mut rest = Group {
        first,
        summaries,
        totals,
        states: &mut steps.states,
        actions: &mut steps.actions,
        rewards: &mut steps.rewards,
        table: RewardTable::new(),
    };
    let mut groups = Vec::new();
    while rest.summaries.len() > group_episodes {
        let (group, others) = rest.split(group_episodes, n_summed, group_episodes * capacity, format);
        groups.push(group);
        rest = others;
    }
    groups.push(rest);
    groups
}

impl Group<'_> {
    /// The first `episodes`, which have room for `n_steps`, and the others.
    fn split(self, episodes: usize, n_summed: usize, n_steps: usize, format: StepFormat) -> (Self, Self) {
        let (summaries, summaries_after) = self.summaries.split_at_mut(episodes);
        let (totals, totals_after) = self.totals.split_at_mut(episodes * n_summed);
        let (states, states_after) = self.states.split_at_mut(n_steps * format.states.size());
        let (actions, actions_after) = self.actions.split_at_mut(n_steps * format.actions.size());
        let (rewards, rewards_after) = self.rewards.split_at_mut(n_steps * format.rewards.size());
        let after = Group {
            first: self.first + episodes as u32,
            summaries: summaries_after,
            totals: totals_after,
            states: states_after,
            actions: actions_after,
            rewards: rewards_after,
            table: RewardTable::new(),
        };
        (Self { summaries, totals, states, actions, rewards, ..self }, after)
    }

    fn run<S: Simulator>(
        &mut self,
        configured: &Configured<S>,
        plan: &RolloutPlan,
        format: StepFormat,
        summed: &[usize],
        capacity: usize,
        cancelled: &(dyn Fn() -> bool + Sync),
    ) -> Result<(), Stopped> {
        let Self { first, summaries, totals, states, actions, rewards, table } = self;
        let mut simulator = configured.prototype.clone();
        for (at, summary) in summaries.iter_mut().enumerate() {
            let (rank, totals) = (*first + at as u32, &mut totals[at * summed.len()..][..summed.len()]);
            *summary = if plan.totals_only {
                episode::run(&mut simulator, plan, rank, summed, totals, &mut Nothing, cancelled)?
            } else {
                let row = |size: usize| at * capacity * size..(at + 1) * capacity * size;
                let mut recorder = Packed {
                    format,
                    states: &mut states[row(format.states.size())],
                    actions: &mut actions[row(format.actions.size())],
                    rewards: &mut rewards[row(format.rewards.size())],
                    table,
                };
                episode::run(&mut simulator, plan, rank, summed, totals, &mut recorder, cancelled)?
            };
        }
        Ok(())
    }
}

/// One table for all groups, in the order of the first appearance.
fn merge(groups: Vec<Group<'_>>) -> Result<Vec<f64>, Stopped> {
    let mut all = RewardTable::new();
    for group in groups {
        let mut ranks = [0; 256];
        let mut same = true;
        for (own, &value) in group.table.values().iter().enumerate() {
            ranks[own] = all.rank(value).ok_or(Stopped::ManyRewards)?;
            same &= usize::from(ranks[own]) == own;
        }
        if !same {
            group.rewards.iter_mut().for_each(|rank| *rank = ranks[usize::from(*rank)]);
        }
    }
    Ok(all.values().to_vec())
}

fn gather(
    spec: &EnvSpec,
    summed: &[usize],
    first_episode: u32,
    lengths: Vec<u32>,
    steps: Steps,
    summaries: &[Summary],
    totals: &[f64],
) -> EpisodeChunk {
    let column = |at: usize| totals.iter().skip(at).step_by(summed.len()).copied().collect();
    EpisodeChunk {
        first_episode,
        lengths,
        steps,
        final_states: summaries.iter().map(|summary| summary.final_state).collect(),
        terminated: summaries.iter().map(|summary| summary.terminated).collect(),
        returns: summaries.iter().map(|summary| summary.total_reward).collect(),
        total_names: summed.iter().map(|&column| spec.info_columns[column].name).collect(),
        totals: (0..summed.len()).map(column).collect(),
    }
}
