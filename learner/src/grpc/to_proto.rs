//! From what the learner works with to messages.

use crate::store::{FitInfo, Model, ModelInfo, TrajectorySummary, timestamp, unpack_u32};
use bytes::Bytes;
use mazeway_proto::{
    env::{ModelPart, RowBlock, model_part::Part},
    learner as pb,
};

/// Rows of a message.
const ROWS_A_BLOCK: usize = 4096;
/// Entries after which a message ends.
const ENTRIES_A_BLOCK: usize = 1 << 15;

/// A model as it travels: a header, then blocks of rows. They are copies, so that a part that waits for its reader keeps no
/// more than itself in memory.
pub fn model_parts(model: &Model) -> impl Iterator<Item = pb::GetModelResponse> + '_ {
    let rows = model.rows();
    let lengths: Vec<u32> = unpack_u32(&rows.row_lengths).collect();
    let (mut row, mut entry) = (0, 0);
    let blocks = std::iter::from_fn(move || {
        let (first_row, first_entry) = (row, entry);
        while row < lengths.len() && row - first_row < ROWS_A_BLOCK {
            let end = entry + lengths[row] as usize;
            if row > first_row && end - first_entry > ENTRIES_A_BLOCK {
                break;
            }
            (row, entry) = (row + 1, end);
        }
        (row > first_row).then(|| {
            let cut = |array: &Bytes, from: usize, to: usize| Bytes::copy_from_slice(&array[from..to]);
            let counts = &rows.visit_counts;
            Part::Rows(RowBlock {
                first_row: first_row as u32,
                row_lengths: cut(&rows.row_lengths, first_row * 4, row * 4),
                next_states: cut(&rows.next_states, first_entry * 4, entry * 4),
                probabilities: cut(&rows.probabilities, first_entry * 8, entry * 8),
                visit_counts: if counts.is_empty() { counts.clone() } else { cut(counts, first_row * 8, row * 8) },
            })
        })
    });
    std::iter::once(Part::Header(model.header().clone()))
        .chain(blocks)
        .map(|part| pb::GetModelResponse { part: Some(ModelPart { part: Some(part) }) })
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
        features: model.header.features.map(|table| table.names).unwrap_or_default(),
        n_terminal_states: (model.header.terminal_states.len() / 4) as u32,
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
