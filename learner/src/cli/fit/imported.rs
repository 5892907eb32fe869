//! A fit of an environment that only the learner knows: its model came from a file or from the recordings themselves.
//!
//! There is no server to ask: nobody demonstrates, drives or draws. What can be judged is judged in the model.

use super::{
    args::FitArgs,
    assemble::{self, Learned},
    directory_name,
    evaluate::Judged,
    job::{AskedModel, Job, Source},
    judge::{self, Extras, Fitted},
    learn,
    narrate::Narrator,
    recordings::Recordings,
    services::{Services, sources},
};
use crate::cli::{error::CliError, models, scene};
use mazeway_client::{Code, FeatureDomain, Learner, Model, packed::Packed};
use mazeway_learner::{
    files::Names,
    mdp::{Policy, TabularMdp, TransitionCounts, finite_horizon_occupancy, state_action_occupancy},
    report::{FeatureRow, Interval, Report},
};
use mazeway_proto::learner::{Fit, TrajectoryFilter};
use std::{collections::BTreeSet, path::PathBuf, time::Instant};

/// Recordings that are asked for at a time.
const PAGE: u32 = 10_000;

/// Fits; returns the report and the directory that it is meant for.
pub async fn fit(
    args: &FitArgs,
    job: &Job,
    extras: &Extras,
    services: &Services,
    narrator: Narrator,
    begun: Instant,
) -> Result<(Report, PathBuf), CliError> {
    let learner = services.learner();
    let style = style(&job.env_id, job.style.as_deref(), learner).await?;
    let spinner = narrator.spinner("model");
    let (model, count) = match &job.model {
        Some(AskedModel::Estimate(prior)) => (estimate(job, *prior, learner).await?, 1),
        other => {
            let asked = if let Some(AskedModel::Id(id)) = other { Some(id.as_str()) } else { None };
            let chosen = models::choose(learner, &job.env_id, asked).await?;
            let (id, count) = chosen.ok_or_else(|| {
                CliError::failure(
                    format!("expected a model of {}, got none stored", job.env_id),
                    "import one with 'learner import --model FILE', or add --model estimate",
                )
            })?;
            (learner.model(&id).await?, if other.is_some() { 1 } else { count })
        }
    };
    spinner.finish_and_clear();
    let among = if count > 1 { format!("; the newest of {count}, --model ID takes another") } else { String::new() };
    narrator.step("model", format_args!("{}{among}", models::describe(&model)))?;
    say_unseen(&model, narrator)?;

    let mdp = scene::checked(&model)?;
    let truth = scene::truth((job.discount(), job.horizon), &style, &model, &mdp)?;
    let recordings = find(job, &style, &model, learner).await?;
    let source =
        if recordings.filter.source.is_empty() { String::new() } else { format!(" by {}", recordings.filter.source) };
    narrator.step("found", format_args!("{} recordings of style '{style}'{source}", recordings.trajectories))?;

    let fit = learn(job, &model, &recordings, services, narrator).await?;
    let learned = Learned::new(&fit)?;
    let features = features(&model, &mdp, &fit, &learned)?;
    let longest = fit.longest;
    let fitted = Fitted { job, spec: None, style: &style, model: &model, mdp: &mdp, fit: &fit, learned: &learned };
    let answers = judge::answer(extras, &fitted, services, narrator).await?;
    let sources = sources(&fit);
    let out = match &args.out {
        Some(out) => out.clone(),
        None => services.data().join("reports").join(directory_name(&[&job.env_id, &style, job.method])),
    };
    let mut report = assemble::report(assemble::Parts {
        job,
        style: &style,
        model,
        mdp: &mdp,
        truth,
        fit,
        learned,
        judged: Judged::NONE,
        answers,
        frame: None,
        features,
        sources,
        begun,
    })?;
    report.horizon = longest;
    Ok((report, out))
}

/// The style that is asked for, or the only one that is recorded.
///
/// # Errors
/// There is none, or several are; the learner fails.
pub async fn style(env_id: &str, asked: Option<&str>, learner: &Learner) -> Result<String, CliError> {
    if let Some(style) = asked {
        return Ok(style.to_owned());
    }
    let filter = TrajectoryFilter { env_id: env_id.to_owned(), ..TrajectoryFilter::default() };
    let (mut styles, mut token) = (BTreeSet::new(), String::new());
    loop {
        let page = learner.list_trajectories_page(&filter, PAGE, &token).await?;
        styles.extend(page.trajectories.into_iter().map(|summary| summary.style));
        if page.next_page_token.is_empty() {
            break;
        }
        token = page.next_page_token;
    }
    let mut all = styles.iter();
    match (all.next(), all.next()) {
        (Some(one), None) => Ok(one.clone()),
        (None, _) => Err(CliError::failure(
            format!("nothing is recorded for {env_id}"),
            "import demonstrations with 'learner import FILE'",
        )),
        (Some(_), Some(_)) => {
            let known = styles.iter().cloned().collect::<Vec<_>>().join(", ");
            Err(CliError::usage("expected --style, since several are recorded", format!("choose one of {known}")))
        }
    }
}

/// Which recordings: those of the model, or, where one is asked for, all that are of its size.
async fn find(job: &Job, style: &str, model: &Model, learner: &Learner) -> Result<Recordings, CliError> {
    let nothing = |who: &str| {
        CliError::failure(
            format!("nothing is recorded for {} under style '{style}'{who}", job.env_id),
            "see what is recorded with 'learner list', or import demonstrations with 'learner import FILE'",
        )
    };
    let source = match &job.source {
        Source::Preferred | Source::Any => String::new(),
        Source::Named(name) => name.clone(),
        Source::Expert => return Err(nothing(" by a scripted expert")),
    };
    let filter = TrajectoryFilter {
        env_id: job.env_id.clone(),
        style: style.to_owned(),
        source,
        model_id: if job.model.is_some() { String::new() } else { model.model_id.clone() },
        min_steps: job.horizon.unwrap_or(0),
        ..TrajectoryFilter::default()
    };
    let found = learner.count_trajectories(&filter).await?;
    if found == 0 {
        return Err(nothing(""));
    }
    let wanted = job.trajectories.map_or(found, u64::from);
    let trajectories = u32::try_from(wanted).ok().filter(|_| wanted <= found).ok_or_else(|| {
        CliError::failure(
            format!("expected {wanted} recordings of style '{style}', got {found}"),
            "leave out --trajectories to use all of them",
        )
    })?;
    Ok(Recordings { filter, trajectories, horizon: job.horizon })
}

/// A model from all recordings of the environment, whatever their style: how the world answers does not depend on what its
/// driver wants. Labels, features and terminal states are those of the stored model of the same sizes, where there is one.
async fn estimate(job: &Job, prior: f64, learner: &Learner) -> Result<Model, CliError> {
    let filter = TrajectoryFilter { env_id: job.env_id.clone(), ..TrajectoryFilter::default() };
    let mut counts = TransitionCounts::default();
    let mut sizes = None;
    let mut pages = learner.export_trajectories(&filter).await?;
    while let Some(page) = pages.next().await? {
        for t in page {
            let known = *sizes.get_or_insert((t.n_states, t.n_actions));
            if known != (t.n_states, t.n_actions) {
                return Err(CliError::failure(
                    format!(
                        "expected recordings of one process, got {} states and {} actions beside {} and {}",
                        t.n_states, t.n_actions, known.0, known.1
                    ),
                    "delete what does not belong there with 'learner delete', or use another --env",
                ));
            }
            let torn = || CliError::failure(format!("trajectory {} is torn", t.trajectory_id), "see 'learner list'");
            let states = Packed::<u32>::new(t.states.clone()).ok_or_else(torn)?.to_vec();
            let actions = Packed::<u32>::new(t.actions.clone()).ok_or_else(torn)?.to_vec();
            counts.add_start(states[0]);
            let after = states[1..].iter().copied().chain(t.final_state);
            for ((&state, &action), next) in states.iter().zip(&actions).zip(after) {
                counts.add(state, action, next);
            }
        }
    }
    let Some((n_states, n_actions)) = sizes else {
        return Err(CliError::failure(
            format!("nothing is recorded for {}", job.env_id),
            "import demonstrations with 'learner import FILE'",
        ));
    };
    let mut stored = None;
    if let Some((id, _)) = models::choose(learner, &job.env_id, None).await? {
        stored = Some(learner.model(&id).await?).filter(|m| (m.n_states, m.n_actions) == (n_states, n_actions));
    }
    let (names, description) = if let Some(model) = stored {
        let names = models::names(&model);
        let (features, terminal_states, rewards) = (model.features, model.terminal_states, model.rewards);
        (names, models::Description { features, terminal_states, rewards, initial_distribution: None })
    } else {
        let names = (Names::numbered("state", n_states), Names::numbered("action", n_actions));
        (names, models::Description::default())
    };
    let model = models::estimate(&job.env_id, &counts, (&names.0, &names.1), description, prior)?;
    match learner.put_model(&model).await {
        Err(error) if error.code() == Code::AlreadyExists => Ok(learner.model(&model.model_id).await?),
        outcome => {
            outcome?;
            Ok(model)
        }
    }
}

fn say_unseen(model: &Model, narrator: Narrator) -> Result<(), CliError> {
    let unseen = models::unseen(model);
    if unseen.is_empty() {
        return Ok(());
    }
    let (states, actions) = models::names(model);
    let few = unseen.iter().take(5).map(|&(s, a)| format!("{}/{}", states.name(s), actions.name(a)));
    let few = few.collect::<Vec<_>>().join(", ");
    let (more, pairs) =
        (if unseen.len() > 5 { ", ..." } else { "" }, u64::from(model.n_states) * u64::from(model.n_actions));
    Ok(narrator.step("no data", format_args!("{} of {pairs} state-action pairs ({few}{more})", unseen.len()))?)
}

/// What the fit makes of the features: their weights, and how much of each there is a step, seen, learned and at random.
fn features(model: &Model, mdp: &TabularMdp, fit: &Fit, learned: &Learned) -> Result<Vec<FeatureRow>, CliError> {
    let Some(table) = model.features.as_ref().filter(|_| !fit.feature_names.is_empty()) else { return Ok(Vec::new()) };
    let wrong = |what: &str| {
        CliError::failure(
            format!("the service describes its fit wrongly: {what}"),
            "check that learner and service are of one version: learner --version",
        )
    };
    let array = |bytes: &bytes::Bytes| Packed::<f64>::new(bytes.clone()).map(|packed| packed.to_vec());
    let weights =
        array(&fit.weights).filter(|w| w.len() == fit.feature_names.len()).ok_or_else(|| wrong("its weights"))?;
    let n_actions = mdp.n_actions();
    let seen = array(&fit.pair_visits).filter(|n| n.len() == mdp.n_pairs()).ok_or_else(|| wrong("its visits"))?;
    let longest = fit.longest;
    let greedy = Policy::new(n_actions, learned.greedy_policy.clone()).map_err(|error| wrong(&error.to_string()))?;
    let random = Policy::uniform(mdp.n_states(), n_actions);
    let flow = |policy: &Policy| state_action_occupancy(policy, &finite_horizon_occupancy(mdp, policy, 1.0, longest));
    let flows = [seen, flow(&greedy), flow(&random)];
    let value = |pair: usize, column: usize| {
        let row = if table.domain == FeatureDomain::States { pair / n_actions } else { pair };
        table.values[row * table.names.len() + column]
    };
    let ends = |rank: usize| {
        let posterior = fit.posterior.as_ref();
        let end = |bytes: &bytes::Bytes| array(bytes).and_then(|ends| ends.get(rank).copied());
        let errors = array(&fit.standard_errors).and_then(|errors| errors.get(rank).copied()).filter(|e| e.is_finite());
        match (posterior.and_then(|p| end(&p.low)), posterior.and_then(|p| end(&p.high)), errors) {
            (Some(low), Some(high), _) => (low, high),
            // The central 95 % of a normal distribution.
            (_, _, Some(error)) => (weights[rank] - 1.959_964 * error, weights[rank] + 1.959_964 * error),
            _ => (f64::NEG_INFINITY, f64::INFINITY),
        }
    };
    let row = |(rank, name): (usize, &String)| {
        let column = table.names.iter().position(|known| known == name).ok_or_else(|| wrong("its features"))?;
        let mean = |flow: &Vec<f64>| {
            let total: f64 = flow.iter().sum();
            flow.iter().enumerate().filter(|(_, n)| **n > 0.0).map(|(pair, n)| n * value(pair, column)).sum::<f64>()
                / total
        };
        let [demonstrated, learned, random] = flows.each_ref().map(mean);
        let (low, high) = ends(rank);
        Ok(FeatureRow {
            name: name.clone(),
            weight: Interval { mean: weights[rank], low, high },
            demonstrated,
            learned,
            random,
        })
    };
    fit.feature_names.iter().enumerate().map(row).collect()
}
