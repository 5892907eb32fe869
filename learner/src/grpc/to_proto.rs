//! From what the learner works with to messages.

use crate::store::{FitInfo, ModelInfo, Recording, TrajectorySummary, timestamp};
use mazeway_proto::learner as pb;

/// A whole trajectory.
pub fn trajectory(recording: Recording) -> pb::Trajectory {
    let (id, collection, seed, arrays) = recording.into_parts();
    pb::Trajectory {
        trajectory_id: id.to_string(),
        env_id: collection.env_id,
        model_id: collection.model_id,
        style: collection.style,
        source: collection.source,
        seed,
        n_states: collection.n_states,
        n_actions: collection.n_actions,
        states: arrays.states,
        actions: arrays.actions,
        rewards: arrays.rewards,
        final_state: arrays.final_state,
        terminated: arrays.terminated,
        truncated: arrays.truncated,
    }
}

/// A trajectory without its arrays.
pub fn trajectory_summary(summary: TrajectorySummary) -> pb::TrajectorySummary {
    pb::TrajectorySummary {
        trajectory_id: summary.id.to_string(),
        env_id: summary.collection.env_id,
        model_id: summary.collection.model_id,
        style: summary.collection.style,
        source: summary.collection.source,
        seed: summary.seed,
        steps: summary.steps,
        recorded_at: Some(timestamp(summary.recorded_at_us)),
    }
}

/// A model without its rows.
pub fn model_summary(model: ModelInfo) -> pb::ModelSummary {
    pb::ModelSummary {
        model_id: model.header.model_id,
        env_id: model.header.env_id,
        n_states: model.header.n_states,
        n_actions: model.header.n_actions,
        n_transitions: model.n_transitions,
        estimated: model.header.estimated,
        styles: model.header.rewards.into_iter().map(|table| table.style).collect(),
        stored_at: Some(timestamp(model.stored_at_us)),
    }
}

/// A fit without its arrays.
pub fn fit_summary(fit: FitInfo) -> pb::FitSummary {
    pb::FitSummary {
        fit_id: fit.fit_id,
        created_at: Some(timestamp(fit.created_at_us)),
        env_id: fit.env_id,
        style: fit.style,
        method: fit.method,
        trajectories: fit.trajectories,
        stopped: fit.stopped,
        iterations: fit.iterations,
        agreement: fit.agreement,
        model_id: fit.model_id,
    }
}
