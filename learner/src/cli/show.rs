//! `learner show ID`: one fit, trajectory or model.

use super::{
    StoreArgs,
    connect::connect,
    error::CliError,
    export::known,
    hexadecimal,
    list::stopped,
    models,
    table::{facts, table, time},
};
use clap::Args;
use mazeway_client::{ClientError, Code, Learner, packed::Packed};
use mazeway_learner::files::Names;
use mazeway_learner::report::uncertainty::Uncertainty;
use mazeway_proto::learner as pb;
use serde_json::{Value, json};
use std::io::Write as _;

/// Rows of a table for people; `--json` has them all.
const MOST_ROWS: usize = 64;
/// Fewest characters of an id.
const MIN_PREFIX: usize = 8;

/// What to show.
#[derive(Debug, Args)]
pub struct ShowArgs {
    /// Id of a fit or a model, or its first eight or more characters; or the whole id of a trajectory
    #[arg(value_name = "ID")]
    id: String,
    /// One JSON object on standard output, with all arrays
    #[arg(long)]
    json: bool,
    #[command(flatten)]
    store: StoreArgs,
}

/// What an id stands for.
enum Found {
    Fit(Box<pb::Fit>),
    Trajectory(Box<pb::Trajectory>),
    Model(Box<pb::ModelSummary>),
}

/// Shows.
pub async fn run(args: ShowArgs) -> Result<(), CliError> {
    let id = args.id.to_ascii_lowercase();
    if id.len() < MIN_PREFIX || !id.bytes().all(|b| b.is_ascii_hexdigit() || b == b'-') {
        return Err(CliError::usage(
            format!("expected an id or its first {MIN_PREFIX} or more characters, got '{}'", args.id),
            "see the ids with 'learner list'",
        ));
    }
    let connected = connect(&args.store).await?;
    let found = find_named(&connected.learner, &id).await;
    let (found, names) = connected.finish(found).await?;
    let mut out = std::io::stdout().lock();
    if args.json {
        let value = match &found {
            Found::Fit(fit) => fit_json(fit, &names)?,
            Found::Trajectory(trajectory) => trajectory_json(trajectory)?,
            Found::Model(model) => model_json(model),
        };
        writeln!(out, "{value}")?;
    } else {
        match &found {
            Found::Fit(fit) => write!(out, "{}", fit_text(fit, &names)?)?,
            Found::Trajectory(trajectory) => write!(out, "{}", trajectory_text(trajectory, &names)?)?,
            Found::Model(model) => write!(out, "{}", model_text(model))?,
        }
    }
    Ok(out.flush()?)
}

/// Finds it, and what its states and actions are called: by the labels of its model where that is known.
async fn find_named(learner: &Learner, id: &str) -> Result<(Found, (Names, Names)), CliError> {
    let found = find(learner, id).await?;
    let (model_id, n_states, n_actions) = match &found {
        Found::Fit(fit) => (&fit.model_id, fit.n_states, fit.n_actions),
        Found::Trajectory(t) => (&t.model_id, t.n_states, t.n_actions),
        Found::Model(m) => return Ok((found_model(m), (Names::numbered("state", 0), Names::numbered("action", 0)))),
    };
    let model = if model_id.is_empty() { None } else { known(learner.model(model_id).await)? };
    let names = match model.filter(|m| (m.n_states, m.n_actions) == (n_states, n_actions)) {
        Some(model) => models::names(&model),
        None => (Names::numbered("state", n_states), Names::numbered("action", n_actions)),
    };
    Ok((found, names))
}

fn found_model(model: &pb::ModelSummary) -> Found {
    Found::Model(Box::new(model.clone()))
}

async fn find(learner: &Learner, id: &str) -> Result<Found, CliError> {
    if id.len() <= 36 {
        match learner.get_fit(id).await {
            Ok(fit) => return Ok(Found::Fit(Box::new(fit))),
            Err(ClientError::Status { code: Code::NotFound, .. }) => {}
            Err(error) => return Err(error.into()),
        }
    }
    if id.len() == 36 {
        let filter = pb::TrajectoryFilter { trajectory_ids: vec![id.to_owned()], ..Default::default() };
        let found = learner.export_trajectories(&filter).await?.next().await?;
        if let Some(trajectory) = found.into_iter().flatten().next() {
            return Ok(Found::Trajectory(Box::new(trajectory)));
        }
    }
    let mut models = learner.list_models("").await?;
    models.retain(|model| model.model_id.starts_with(id));
    match models.len() {
        1 => Ok(Found::Model(Box::new(models.swap_remove(0)))),
        0 => Err(CliError::failure(
            format!("there is no fit, trajectory or model '{id}'"),
            "see the ids with 'learner list', those of trajectories with 'learner list --trajectories'",
        )),
        several => Err(CliError::failure(format!("{several} models begin with '{id}'"), "give more of the id")),
    }
}

/// An array of an answer.
fn array(bytes: &bytes::Bytes, len: usize, what: &str) -> Result<Vec<f64>, CliError> {
    let array = Packed::<f64>::new(bytes.clone()).map(|packed| packed.to_vec()).filter(|array| array.len() == len);
    array.ok_or_else(|| broken(&format!("expected {len} values of {what}, got {} bytes", bytes.len())))
}

fn broken(message: &str) -> CliError {
    CliError::failure(message, "the learner is of another release, or its data directory is damaged")
}

fn indices(bytes: &bytes::Bytes) -> Result<Vec<u32>, CliError> {
    Packed::<u32>::new(bytes.clone()).map(|packed| packed.to_vec()).ok_or_else(|| broken("a torn array"))
}

/// Values by state and action, one list a state.
fn by_state(values: &[f64], n_actions: usize) -> Vec<Vec<f64>> {
    values.chunks(n_actions.max(1)).map(<[f64]>::to_vec).collect()
}

fn fit_json(fit: &pb::Fit, names: &(Names, Names)) -> Result<Value, CliError> {
    let (s, a) = (fit.n_states as usize, fit.n_actions as usize);
    let weights_len = fit.weights.len() / 8;
    let weights = array(&fit.weights, weights_len, "weights")?;
    let request = fit.request.clone().unwrap_or_default();
    let trace = fit.trace.iter();
    let trace = trace.map(|e| json!({"iteration": e.iteration, "objective": e.objective, "change": e.change, "elapsed_secs": e.elapsed_secs}));
    Ok(json!({
        "kind": "fit",
        "id": fit.fit_id,
        "created_at": time(fit.created_at),
        "version": fit.version,
        "env": fit.env_id,
        "style": fit.style,
        "method": request.method,
        "options": options_json(&request.options.unwrap_or_default()),
        "model": fit.model_id,
        "n_states": fit.n_states,
        "n_actions": fit.n_actions,
        "trajectories": fit.trajectories,
        "trajectories_digest": hexadecimal(&fit.trajectories_digest),
        "sources": fit.sources.iter().map(|s| json!({"source": s.source, "trajectories": s.trajectories})).collect::<Vec<_>>(),
        "steps": fit.steps,
        "stopped": stopped(fit.stopped),
        "iterations": fit.iterations,
        "fit_secs": fit.fit_secs,
        "agreement": fit.agreement,
        "log_likelihood_per_step": fit.log_likelihood_per_step,
        "states_covered": fit.states_covered,
        "warnings": fit.warnings,
        "state_labels": names.0.labels(),
        "action_labels": names.1.labels(),
        "features": fit.feature_names,
        "weights": weights,
        "standard_errors": array(&fit.standard_errors, fit.standard_errors.len() / 8, "standard errors")?,
        "posterior": posterior_json(fit, weights_len)?,
        "hyperparameters": fit.hyperparameters.iter().map(|h| (h.name.clone(), json!(h.value))).collect::<serde_json::Map<_, _>>(),
        "reward": by_state(&array(&fit.reward, s * a, "the reward")?, a),
        "policy": by_state(&array(&fit.policy, s * a, "the policy")?, a),
        "greedy_policy": by_state(&array(&fit.greedy_policy, s * a, "the greedy policy")?, a),
        "state_values": array(&fit.state_values, s, "the state values")?,
        "state_visits": array(&fit.state_visits, s, "the state visits")?,
        "trace": trace.collect::<Vec<_>>(),
    }))
}

/// Intervals of the weights; null where the method has none.
fn posterior_json(fit: &pb::Fit, weights: usize) -> Result<Value, CliError> {
    let Some(posterior) = &fit.posterior else { return Ok(Value::Null) };
    let diagnostics = match &posterior.diagnostics {
        None => Value::Null,
        Some(d) => json!({
            "chains": d.chains,
            "draws": d.draws,
            "acceptance": d.acceptance,
            "split_rhat": array(&d.split_rhat, weights, "split R-hat")?,
            "effective_sample_size": array(&d.effective_sample_size, weights, "effective sample sizes")?,
        }),
    };
    Ok(json!({
        "standard_deviations": array(&posterior.standard_deviations, weights, "standard deviations")?,
        "low": array(&posterior.low, weights, "lower ends")?,
        "high": array(&posterior.high, weights, "upper ends")?,
        "diagnostics": diagnostics,
    }))
}

fn options_json(options: &pb::FitOptions) -> Value {
    // The library's names of the same options: "state-action", "value-iteration", …
    mazeway_learner::fit_options(Some(options)).ok().and_then(|o| serde_json::to_value(o).ok()).unwrap_or(Value::Null)
}

fn fit_text(fit: &pb::Fit, names: &(Names, Names)) -> Result<String, CliError> {
    let (s, a) = (fit.n_states as usize, fit.n_actions as usize);
    let request = fit.request.clone().unwrap_or_default();
    let options = match options_json(&request.options.unwrap_or_default()) {
        Value::Object(options) => {
            let set = options.into_iter().filter(|(_, value)| !value.is_null());
            let text = |value: Value| value.as_str().map_or_else(|| value.to_string(), str::to_owned);
            set.map(|(name, value)| format!("{name} {}", text(value))).collect::<Vec<_>>().join(", ")
        }
        _ => String::new(),
    };
    let mut text = facts([
        ("fit", fit.fit_id.clone()),
        ("created at", time(fit.created_at)),
        ("environment", fit.env_id.clone()),
        ("style", fit.style.clone()),
        ("method", request.method),
        ("options", options),
        ("model", format!("{} ({} states, {} actions)", fit.model_id, fit.n_states, fit.n_actions)),
        ("data", format!("{} trajectories, {} steps", fit.trajectories, fit.steps)),
        ("data's digest", hexadecimal(&fit.trajectories_digest)),
        ("states covered", format!("{} of {}", fit.states_covered, fit.n_states)),
        ("agreement", format!("{:.3} of the demonstrated steps", fit.agreement)),
        ("log-likelihood", format!("{:.4} a step", fit.log_likelihood_per_step)),
        ("stopped", format!("{} after {} iterations, {:.3} s", stopped(fit.stopped), fit.iterations, fit.fit_secs)),
        ("learned beside it", {
            let told = fit.hyperparameters.iter().map(|h| format!("{} {:.4}", h.name, h.value));
            told.collect::<Vec<_>>().join(", ")
        }),
        ("version", fit.version.clone()),
    ]);
    for warning in &fit.warnings {
        text.push_str("warning: ");
        text.push_str(warning);
        text.push('\n');
    }
    if !fit.feature_names.is_empty() {
        let weights = array(&fit.weights, fit.feature_names.len(), "the weights")?;
        let rows = fit.feature_names.iter().zip(weights).map(|(name, weight)| [name.clone(), format!("{weight:.4}")]);
        text.push('\n');
        text.push_str(&table(["feature", "#weight"], rows));
        text.push('\n');
    }
    let visits = array(&fit.state_visits, s, "the state visits")?;
    let values = array(&fit.state_values, s, "the state values")?;
    let greedy = by_state(&array(&fit.greedy_policy, s * a, "the greedy policy")?, a);
    let policy = by_state(&array(&fit.policy, s * a, "the policy")?, a);
    let reward = by_state(&array(&fit.reward, s * a, "the reward")?, a);
    let rows = (0..s.min(MOST_ROWS)).map(|state| {
        let best = (0..a).filter(|&action| greedy[state][action] > 0.0).collect::<Vec<_>>();
        let likely = best.iter().map(|&action| policy[state][action]).sum::<f64>();
        let actions = best.iter().map(|&action| names.1.name(action as u32)).collect::<Vec<_>>().join(" ");
        let gain = best.iter().map(|&action| reward[state][action]).fold(f64::NEG_INFINITY, f64::max);
        let (visits, value) = (format!("{}", visits[state]), format!("{:.4}", values[state]));
        [names.0.name(state as u32), visits, value, actions, format!("{gain:.4}"), format!("{likely:.3}")]
    });
    text.push('\n');
    let state = if names.0.labels().is_empty() { "#state" } else { "state" };
    text.push_str(&table([state, "#visits", "#value", "greedy action", "#its reward", "#its probability"], rows));
    text.push('\n');
    text.push_str(&rest(s));
    text.push_str(&weights_text(fit)?);
    Ok(text)
}

/// The weights with what the data leave open of them; nothing where the method does not say.
fn weights_text(fit: &pb::Fit) -> Result<String, CliError> {
    let n = fit.weights.len() / 8;
    let weights = array(&fit.weights, n, "weights")?;
    let uncertainty = match &fit.posterior {
        Some(posterior) => Uncertainty::from_posterior(mazeway_learner::irl::Posterior {
            standard_deviations: array(&posterior.standard_deviations, n, "standard deviations")?,
            low: array(&posterior.low, n, "lower ends")?,
            high: array(&posterior.high, n, "upper ends")?,
            diagnostics: None,
        }),
        None if fit.standard_errors.is_empty() => return Ok(String::new()),
        None => Uncertainty::from_standard_errors(&weights, &array(&fit.standard_errors, n, "standard errors")?),
    };
    let rows = (0..n.min(MOST_ROWS)).map(|weight| {
        let (sd, low, high) =
            (uncertainty.standard_deviations[weight], uncertainty.low[weight], uncertainty.high[weight]);
        let interval =
            if uncertainty.determined(weight) { format!("{low:.4} to {high:.4}") } else { "not determined".to_owned() };
        let sd = if sd.is_finite() { format!("{sd:.4}") } else { "∞".to_owned() };
        [weight.to_string(), format!("{:.4}", weights[weight]), sd, interval]
    });
    let table = table(["#weight", "#estimate", "#standard deviation", "#95% interval"], rows);
    Ok(format!("\n{table}\n{}", rest(n)))
}

/// Says what a table leaves out.
fn rest(rows: usize) -> String {
    match rows.saturating_sub(MOST_ROWS) {
        0 => String::new(),
        more => format!("and {more} more; --json has them all\n"),
    }
}

fn trajectory_json(t: &pb::Trajectory) -> Result<Value, CliError> {
    let mut value = super::export::plain(t).ok_or_else(|| broken("a torn array"))?;
    value["kind"] = "trajectory".into();
    Ok(value)
}

fn trajectory_text(t: &pb::Trajectory, names: &(Names, Names)) -> Result<String, CliError> {
    let (states, actions) = (indices(&t.states)?, indices(&t.actions)?);
    let rewards = array(&t.rewards, if t.rewards.is_empty() { 0 } else { states.len() }, "the rewards")?;
    let ended = match (t.terminated, t.truncated) {
        (true, _) => "terminated",
        (false, true) => "truncated",
        (false, false) => "goes on",
    };
    let mut text = facts([
        ("trajectory", t.trajectory_id.clone()),
        ("environment", t.env_id.clone()),
        ("style", t.style.clone()),
        ("source", t.source.clone()),
        ("seed", t.seed.map(|seed| seed.to_string()).unwrap_or_default()),
        ("model", t.model_id.clone()),
        ("sizes", format!("{} states, {} actions", t.n_states, t.n_actions)),
        ("steps", states.len().to_string()),
        ("return", if rewards.is_empty() { String::new() } else { format!("{:.4}", rewards.iter().sum::<f64>()) }),
        ("final state", t.final_state.map(|state| names.0.name(state)).unwrap_or_default()),
        ("then", ended.into()),
    ]);
    text.push('\n');
    let rows = states.iter().enumerate().take(MOST_ROWS).map(|(step, state)| {
        let action = actions.get(step).map(|&action| names.1.name(action)).unwrap_or_default();
        let reward = rewards.get(step).map(f64::to_string).unwrap_or_default();
        [step.to_string(), names.0.name(*state), action, reward]
    });
    text.push_str(&table(["#step", "#state", "#action", "#reward"], rows));
    text.push('\n');
    text.push_str(&rest(states.len()));
    Ok(text)
}

fn model_json(m: &pb::ModelSummary) -> Value {
    json!({
        "kind": "model",
        "id": m.model_id,
        "env": m.env_id,
        "n_states": m.n_states,
        "n_actions": m.n_actions,
        "n_transitions": m.n_transitions,
        "estimated": m.estimated,
        "styles": m.styles,
        "features": m.features,
        "n_terminal_states": m.n_terminal_states,
        "stored_at": time(m.stored_at),
    })
}

fn model_text(m: &pb::ModelSummary) -> String {
    facts([
        ("model", m.model_id.clone()),
        ("environment", m.env_id.clone()),
        ("sizes", format!("{} states, {} actions, {} transitions", m.n_states, m.n_actions, m.n_transitions)),
        ("kind", if m.estimated { "estimated" } else { "exact" }.into()),
        ("rewards", m.styles.join(", ")),
        ("features", m.features.join(", ")),
        ("terminal states", if m.n_terminal_states > 0 { m.n_terminal_states.to_string() } else { String::new() }),
        ("stored at", time(m.stored_at)),
    ])
}
