//! Models in a learner: which one is meant, what its states and actions are called, and estimates of new ones.

use super::error::CliError;
use mazeway_client::{FeatureTable, Learner, Model};
use mazeway_learner::{
    files::Names,
    mdp::{EstimatedMdp, TransitionCounts},
};
use mazeway_proto::learner as pb;

/// The model of an environment that is meant: the one whose id begins so, else the one that was stored last. Also how many
/// there are.
///
/// # Errors
/// No model of that id; the learner fails.
pub async fn choose(learner: &Learner, env: &str, asked: Option<&str>) -> Result<Option<(String, usize)>, CliError> {
    let models = learner.list_models(env).await?;
    let count = models.len();
    let Some(asked) = asked else {
        let at = |model: &pb::ModelSummary| model.stored_at.map_or((0, 0), |at| (at.seconds, at.nanos));
        return Ok(models.into_iter().max_by_key(at).map(|model| (model.model_id, count)));
    };
    let mut found = models.iter().filter(|model| model.model_id.starts_with(asked));
    match (found.next(), found.next()) {
        (Some(one), None) => Ok(Some((one.model_id.clone(), count))),
        (None, _) => Err(CliError::failure(
            format!("expected a model of {env}, got none whose id begins with '{asked}'"),
            format!("see the models with 'learner list --models --env {env}'"),
        )),
        (Some(_), Some(_)) => Err(CliError::failure(
            format!("expected one model of {env}, got several whose ids begin with '{asked}'"),
            "give more of the id",
        )),
    }
}

/// What a model calls its states and actions.
pub fn names(model: &Model) -> (Names, Names) {
    (
        Names::of_model("state", model.n_states, &model.state_labels),
        Names::of_model("action", model.n_actions, &model.action_labels),
    )
}

/// What an estimated model says beside its transitions.
#[derive(Debug, Clone, Default)]
pub struct Description {
    /// Features.
    pub features: Option<FeatureTable>,
    /// Terminal states, rising.
    pub terminal_states: Vec<u32>,
    /// Known rewards.
    pub rewards: Vec<(String, Vec<f64>)>,
    /// p(s₁); as the demonstrations start where `None`.
    pub initial_distribution: Option<Vec<f64>>,
}

/// A model from transitions that were seen.
///
/// # Errors
/// No transition; a terminal state that was left.
pub fn estimate(
    env: &str,
    counts: &TransitionCounts,
    (states, actions): (&Names, &Names),
    description: Description,
    prior: f64,
) -> Result<Model, CliError> {
    let EstimatedMdp { mdp, visits } =
        counts.estimate(states.len() as usize, actions.len() as usize, prior).map_err(|error| {
            CliError::failure(
                format!("cannot estimate a model: {error}"),
                "a model needs demonstrations with actions and with the state that follows each",
            )
        })?;
    let left = description.terminal_states.iter().find(|&&state| {
        let first = state as usize * actions.len() as usize;
        visits[first..first + actions.len() as usize].iter().any(|&n| n > 0)
    });
    if let Some(&state) = left {
        return Err(CliError::failure(
            format!("expected nothing to leave the terminal state '{}', but demonstrations do", states.name(state)),
            "take it out of the terminal states, or end the demonstrations there",
        ));
    }
    let mut model = Model {
        env_id: env.to_owned(),
        model_id: String::new(),
        n_states: states.len(),
        n_actions: actions.len(),
        state_labels: states.labels().to_vec(),
        action_labels: actions.labels().to_vec(),
        initial_distribution: description.initial_distribution.unwrap_or_else(|| mdp.initial_distribution().to_vec()),
        row_offsets: mdp.row_offsets().to_vec(),
        next_states: mdp.next_states().to_vec(),
        probabilities: mdp.probabilities().to_vec(),
        visit_counts: Some(visits),
        estimated: true,
        rewards: description.rewards,
        grid: None,
        features: description.features,
        terminal_states: description.terminal_states,
    };
    model.model_id = model.compute_id();
    Ok(model)
}

/// Pairs (state, action) of which an estimated model has no data.
pub fn unseen(model: &Model) -> Vec<(u32, u32)> {
    let counts = model.visit_counts.as_deref().filter(|_| model.estimated).unwrap_or_default();
    let pairs = counts.iter().enumerate().filter(|(_, count)| **count == 0);
    pairs.map(|(pair, _)| (pair as u32 / model.n_actions, pair as u32 % model.n_actions)).collect()
}

/// One line about a model.
pub fn describe(model: &Model) -> String {
    let visits: u64 = model.visit_counts.iter().flatten().sum();
    let origin = if model.estimated { format!("estimated from {visits} steps") } else { "exact".to_owned() };
    let names = model.features.as_ref().map(|table| table.names.join(", "));
    let features = names.map_or_else(String::new, |names| format!(", features {names}"));
    let terminal = match model.terminal_states.len() {
        0 => String::new(),
        n => format!(", {n} terminal"),
    };
    format!(
        "{}: {} states, {} actions, {} transitions, {origin}{features}{terminal}",
        model.env_id,
        model.n_states,
        model.n_actions,
        model.next_states.len(),
    )
}
