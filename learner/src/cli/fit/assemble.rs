//! From the answers of the services to the report.

use super::{evaluate::Judged, job::Job, judge::Answers};
use crate::cli::error::CliError;
use mazeway_client::{Model, packed::Packed};
use mazeway_learner::{
    eval,
    irl::{self, TraceEntry},
    mdp::{Policy, TabularMdp},
    report::{FeatureRow, GridLayout, Report, Source, uncertainty::Uncertainty},
};
use mazeway_proto::learner as pb;
use prost::bytes::Bytes;
use std::time::Instant;

/// What is known of the true reward.
#[derive(Debug, Clone)]
pub struct Truth {
    /// R(s,a), shape `(n_states, n_actions)`.
    pub reward: Vec<f64>,
    /// Optimal policy, ties split evenly, shape `(n_states, n_actions)`.
    pub optimal_policy: Vec<f64>,
}

/// The arrays of a fit, unpacked and of the right shapes.
#[derive(Debug, Clone)]
pub struct Learned {
    /// R(s,a).
    pub reward: Vec<f64>,
    /// π(a|s).
    pub policy: Vec<f64>,
    /// Best actions.
    pub greedy_policy: Vec<f64>,
    /// V(s).
    pub state_values: Vec<f64>,
    /// N(s).
    pub state_visits: Vec<f64>,
    /// w.
    pub weights: Vec<f64>,
    /// What the data leave open of them.
    pub uncertainty: Option<Uncertainty>,
}

impl Learned {
    /// Unpacks.
    ///
    /// # Errors
    /// Arrays of other shapes than the fit's sizes say.
    pub fn new(fit: &pb::Fit) -> Result<Self, CliError> {
        let states = fit.n_states as usize;
        let pairs = states * fit.n_actions as usize;
        let array = |bytes: &Bytes, len: usize, name: &str| {
            Packed::<f64>::new(bytes.clone())
                .filter(|packed| packed.len() == len)
                .map(|packed| packed.to_vec())
                .ok_or_else(|| {
                    CliError::failure(
                        format!("expected {} bytes of {name} in the fit, got {}", len * 8, bytes.len()),
                        "check that learner and service are of one version: learner --version",
                    )
                })
        };
        let weights = array(&fit.weights, fit.weights.len() / 8, "weights")?;
        let uncertainty = match &fit.posterior {
            Some(posterior) => Some(Uncertainty::from_posterior(irl::Posterior {
                standard_deviations: array(&posterior.standard_deviations, weights.len(), "standard_deviations")?,
                low: array(&posterior.low, weights.len(), "low")?,
                high: array(&posterior.high, weights.len(), "high")?,
                diagnostics: match &posterior.diagnostics {
                    Some(d) => Some(irl::Diagnostics {
                        chains: d.chains,
                        draws: d.draws,
                        acceptance: d.acceptance,
                        split_rhat: array(&d.split_rhat, weights.len(), "split_rhat")?,
                        effective_sample_size: array(&d.effective_sample_size, weights.len(), "effective_sample_size")?,
                    }),
                    None => None,
                },
            })),
            None if fit.standard_errors.is_empty() => None,
            None => {
                let errors = array(&fit.standard_errors, weights.len(), "standard_errors")?;
                Some(Uncertainty::from_standard_errors(&weights, &errors))
            }
        };
        Ok(Self {
            weights,
            uncertainty,
            reward: array(&fit.reward, pairs, "reward")?,
            policy: array(&fit.policy, pairs, "policy")?,
            greedy_policy: array(&fit.greedy_policy, pairs, "greedy_policy")?,
            state_values: array(&fit.state_values, states, "state_values")?,
            state_visits: array(&fit.state_visits, states, "state_visits")?,
        })
    }
}

/// Everything that a report is made from.
pub struct Parts<'a> {
    /// What was asked.
    pub job: &'a Job,
    /// Style in force.
    pub style: &'a str,
    /// Model as served.
    pub model: Model,
    /// The same, checked.
    pub mdp: &'a TabularMdp,
    /// True reward.
    pub truth: Option<Truth>,
    /// As stored.
    pub fit: pb::Fit,
    /// Its arrays.
    pub learned: Learned,
    /// Roll-outs.
    pub judged: Judged,
    /// What was asked beyond the fit.
    pub answers: Answers,
    /// A picture of the environment, where it can be drawn.
    pub frame: Option<Vec<u8>>,
    /// What the fit makes of the features, where it weighs them.
    pub features: Vec<FeatureRow>,
    /// Where the recordings came from.
    pub sources: Vec<Source>,
    /// When the run began.
    pub begun: Instant,
}

/// Puts the report together.
///
/// # Errors
/// A fit that the service describes wrongly.
pub fn report(parts: Parts<'_>) -> Result<Report, CliError> {
    let Parts { job, style, model, mdp, truth, fit, learned, judged, answers, frame, features, sources, begun } = parts;
    let n_actions = model.n_actions as usize;
    let n_weights = learned.weights.len();
    let wrong = |error: &dyn std::fmt::Display| {
        CliError::failure(
            format!("the service describes its fit wrongly: {error}"),
            "check that learner and service are of one version: learner --version",
        )
    };
    let request = fit.request.unwrap_or_default();
    let options: irl::FitOptions =
        mazeway_learner::fit_options(request.options.as_ref()).map_err(|error| wrong(&error))?;
    let stopped = mazeway_learner::stopped(fit.stopped).ok_or_else(|| wrong(&"unknown way of stopping"))?;
    let (agreement, difference) = match &truth {
        Some(truth) => {
            let greedy = Policy::new(n_actions, learned.greedy_policy.clone()).map_err(|error| wrong(&error))?;
            let lost = eval::expected_value_difference(mdp, &truth.reward, options.discount, options.horizon, &greedy)
                .map_err(|error| wrong(&error))?;
            let agreement = eval::state_agreement(&learned.greedy_policy, &truth.optimal_policy, n_actions);
            (agreement, Some(lost.difference))
        }
        None => (fit.agreement, None),
    };
    // Where several actions are optimal, the expert takes one of them and the greedy policy a part of each: their steps do not
    // tell how well it does, the states do.
    let agreement_held_out = judged.agreement.filter(|_| truth.is_none());
    let (true_reward, optimal_policy) = truth.map(|truth| (truth.reward, truth.optimal_policy)).unzip();
    Ok(Report {
        env_id: job.env_id.clone(),
        style: style.to_owned(),
        method: job.method.to_owned(),
        horizon: options.horizon.unwrap_or_default(),
        options,
        seed: u64::from(job.seed),
        model_id: fit.model_id,
        fit_id: fit.fit_id,
        n_states: model.n_states,
        n_actions: model.n_actions,
        state_labels: model.state_labels,
        action_labels: model.action_labels,
        trajectories: fit.trajectories,
        steps: fit.steps,
        sources,
        state_visits: learned.state_visits,
        states_covered: fit.states_covered,
        weights: learned.weights,
        weight_names: if fit.feature_names.len() == n_weights { fit.feature_names.clone() } else { Vec::new() },
        uncertainty: learned.uncertainty,
        hyperparameters: fit
            .hyperparameters
            .into_iter()
            .map(|h| irl::Hyperparameter { name: h.name, value: h.value })
            .collect(),
        validation: answers.validation,
        transfer: answers.transfer,
        reward: learned.reward,
        policy: learned.policy,
        greedy_policy: learned.greedy_policy,
        state_values: learned.state_values,
        trace: fit.trace.iter().map(trace_entry).collect(),
        stopped,
        iterations: fit.iterations,
        fit_secs: fit.fit_secs,
        total_secs: begun.elapsed().as_secs_f64(),
        warnings: fit.warnings,
        agreement,
        agreement_held_out,
        log_likelihood_per_step: fit.log_likelihood_per_step,
        log_likelihood_per_step_held_out: judged.log_likelihood_per_step,
        drivers: judged.drivers,
        evaluation: judged.evaluation,
        expected_value_difference: difference,
        true_reward,
        optimal_policy,
        grid: model.grid.map(|grid| GridLayout { rows: grid.rows, columns: grid.columns, cells: grid.cells }),
        frame_png: frame,
        features,
        commands: vec![command(std::env::args().skip(1))],
    })
}

fn trace_entry(progress: &pb::FitProgress) -> TraceEntry {
    TraceEntry {
        iteration: progress.iteration,
        objective: progress.objective,
        change: progress.change,
        elapsed_secs: progress.elapsed_secs,
    }
}

/// The command as it can be typed again.
fn command(arguments: impl Iterator<Item = String>) -> String {
    let quoted = arguments.map(|argument| {
        let plain =
            !argument.is_empty() && argument.chars().all(|c| c.is_ascii_alphanumeric() || "-_=./:,@+".contains(c));
        if plain { argument } else { format!("'{}'", argument.replace('\'', r"'\''")) }
    });
    std::iter::once("learner".to_owned()).chain(quoted).collect::<Vec<_>>().join(" ")
}

#[cfg(test)]
mod tests {
    use super::command;

    #[test]
    fn a_command_can_be_typed_again() {
        let arguments = ["fit", "--style", "my style", "--out", "it's"].map(String::from);
        assert_eq!(command(arguments.into_iter()), r"learner fit --style 'my style' --out 'it'\''s'");
    }
}
