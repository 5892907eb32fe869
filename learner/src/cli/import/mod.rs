//! `learner import`: models and demonstrations from files, through the real service into the real store.
//!
//! Files are read twice, in memory that does not grow with them: once to check everything, once to record. So nothing of a
//! file that is wrong is stored. A trajectory's UUID follows from its content and its name in the file: a repeated import
//! stores nothing twice.

mod args;
mod check;

pub use args::ImportArgs;

use super::{connect::connect, error::CliError, models, table};
use args::{ImpossibleArg, Job, ModelSource};
use check::Impossible;
use mazeway_client::{Code, Learner, Model};
use mazeway_learner::{
    files::{self, Collector, Demonstration, FileError, ModelFile, Names, Resolve},
    mdp::TransitionCounts,
};
use mazeway_proto::learner::Trajectory;
use serde_json::{Value, json};
use std::{collections::BTreeSet, io::Write as _, ops::ControlFlow, path::Path, sync::Arc};
use tokio::sync::mpsc;
use uuid::Uuid;

/// Namespace of the UUIDs of imported demonstrations.
const NAMESPACE: Uuid = Uuid::from_u128(0x6d61_7a65_7761_7900_8000_0000_0000_0002);
/// Trajectories that are read ahead.
const READ_AHEAD: usize = 64;

impl From<FileError> for CliError {
    fn from(error: FileError) -> Self {
        Self::failure(error.to_string(), error.hint)
    }
}

/// What was imported.
#[derive(Debug, Default)]
struct Summary {
    env: String,
    model: Option<ModelSummary>,
    files: usize,
    trajectories: u64,
    steps: u64,
    stored: u64,
    known: u64,
    styles: BTreeSet<String>,
    sources: BTreeSet<String>,
    impossible: Impossible,
    ignored_columns: BTreeSet<String>,
}

/// What became of the model.
#[derive(Debug)]
struct ModelSummary {
    id: String,
    text: String,
    estimated: bool,
    fate: &'static str,
    unseen: Vec<(String, String)>,
    pairs: u64,
}

/// Imports.
pub async fn run(args: ImportArgs) -> Result<(), CliError> {
    let job = Arc::new(Job::new(&args)?);
    let connected = connect(&args.store).await?;
    let outcome = tokio::select! {
        outcome = import(&job, &connected.learner) => outcome,
        _ = tokio::signal::ctrl_c() => Err(CliError::failure(
            "interrupted",
            "what was recorded is stored; the same command stores the rest",
        )),
    };
    let summary = connected.finish(outcome).await?;
    let mut out = std::io::stdout().lock();
    if args.json {
        writeln!(out, "{}", object(&summary))?;
    } else {
        write!(out, "{}", text(&job, &summary))?;
    }
    Ok(out.flush()?)
}

/// Runs work on files where it may block.
async fn blocking<T: Send + 'static>(
    work: impl FnOnce() -> Result<T, CliError> + Send + 'static,
) -> Result<T, CliError> {
    tokio::task::spawn_blocking(work)
        .await
        .unwrap_or_else(|error| Err(CliError::failure(format!("reading failed: {error}"), "report this as a defect")))
}

async fn import(job: &Arc<Job>, learner: &Learner) -> Result<Summary, CliError> {
    let described = match &job.model {
        ModelSource::File(path) | ModelSource::Estimate(Some(path)) => {
            let path = path.clone();
            Some(blocking(move || Ok(files::read_model(&path)?)).await?)
        }
        ModelSource::Stored | ModelSource::Estimate(None) => None,
    };
    let env = environment(job, described.as_ref()).await?;
    let mut summary = Summary { env: env.clone(), files: job.files.len(), ..Summary::default() };
    let model = match &job.model {
        ModelSource::Stored => stored(learner, &env).await?,
        ModelSource::File(_) => {
            let model = described.ok_or_else(|| CliError::failure("no model was read", "report this as a defect"))?;
            model.into_model(env.clone())?
        }
        ModelSource::Estimate(_) => {
            let (job, env) = (Arc::clone(job), env.clone());
            blocking(move || estimate(&job, &env, described)).await?
        }
    };
    let names = models::names(&model);
    let model = Arc::new(model);
    if !job.files.is_empty() {
        let (job, names, model, env) = (Arc::clone(job), names.clone(), Arc::clone(&model), env.clone());
        let checked = blocking(move || check(&job, &names, &model, &env)).await?;
        summary = Summary { ..checked };
    }
    if job.model != ModelSource::Stored {
        let fate = put(learner, &model, job.replace).await?;
        let unseen = models::unseen(&model);
        let named = |(state, action): (u32, u32)| (names.0.name(state), names.1.name(action));
        summary.model = Some(ModelSummary {
            id: model.model_id.clone(),
            text: models::describe(&model),
            estimated: model.estimated,
            fate,
            pairs: u64::from(model.n_states) * u64::from(model.n_actions),
            unseen: unseen.into_iter().map(named).collect(),
        });
    }
    if !job.files.is_empty() {
        record(job, learner, names, &model, &mut summary).await?;
    }
    Ok(summary)
}

/// The environment: as asked, as the model says, or as the first demonstration does.
async fn environment(job: &Arc<Job>, described: Option<&ModelFile>) -> Result<String, CliError> {
    let known = job.env.clone().or_else(|| described.and_then(|model| model.env.clone()));
    if let Some(env) = known.filter(|env| !env.is_empty()) {
        return Ok(env);
    }
    let job = Arc::clone(job);
    let first = blocking(move || {
        let Some(file) = job.files.first() else { return Ok(None) };
        let (mut states, mut actions) = (Collector::new("state"), Collector::new("action"));
        let mut env = None;
        files::read(file, &job.options, &mut states, &mut actions, &mut |d| {
            env = d.env;
            ControlFlow::Break(None)
        })?;
        Ok(env)
    });
    first.await?.ok_or_else(|| {
        CliError::usage("expected to be told the environment, which no file names", "name it with --env NAME")
    })
}

/// The model that is stored for an environment.
async fn stored(learner: &Learner, env: &str) -> Result<Model, CliError> {
    let Some((id, _)) = models::choose(learner, env, None).await? else {
        return Err(CliError::failure(
            format!("expected a model of {env}, got none stored"),
            "bring one with --model FILE, or have it estimated with --model estimate",
        ));
    };
    Ok(learner.model(&id).await?)
}

async fn put(learner: &Learner, model: &Model, replace: bool) -> Result<&'static str, CliError> {
    let put = if replace { learner.replace_model(model).await } else { learner.put_model(model).await };
    match put {
        Ok(response) if response.already_stored => Ok("known"),
        Ok(_) => Ok("stored"),
        Err(error) if error.code() == Code::AlreadyExists => {
            Err(CliError::failure(error.to_string(), "add --replace to describe it anew; its recordings and fits stay"))
        }
        Err(error) => Err(error.into()),
    }
}

/// Reads all files, and tells which one each demonstration is of.
fn for_each(
    job: &Job,
    states: &mut dyn Resolve,
    actions: &mut dyn Resolve,
    ignored: &mut BTreeSet<String>,
    mut visit: impl FnMut(&Path, Demonstration) -> ControlFlow<Option<FileError>>,
) -> Result<(), CliError> {
    for file in &job.files {
        let mut stopped = false;
        let columns = files::read(file, &job.options, states, actions, &mut |demonstration| {
            let flow = visit(file, demonstration);
            stopped = flow.is_break();
            flow
        })?;
        ignored.extend(columns);
        if stopped {
            break;
        }
    }
    Ok(())
}

/// A model from the transitions of all files.
fn estimate(job: &Job, env: &str, described: Option<ModelFile>) -> Result<Model, CliError> {
    let mut counts = TransitionCounts::default();
    let (mut new_states, mut new_actions) = (Collector::new("state"), Collector::new("action"));
    let known = described.as_ref().map(|model| (model.states.clone(), model.actions.clone()));
    let known_actions = known.as_ref().map(|(_, actions)| actions).filter(|actions| !actions.is_empty());
    {
        let (mut listed_states, mut listed_actions) = (known.as_ref().map(|(states, _)| states), known_actions);
        let states: &mut dyn Resolve = match &mut listed_states {
            Some(names) => names,
            None => &mut new_states,
        };
        let actions: &mut dyn Resolve = match &mut listed_actions {
            Some(names) => names,
            None => &mut new_actions,
        };
        for_each(job, states, actions, &mut BTreeSet::new(), |_, d| {
            counts.add_start(d.states[0]);
            let after = d.states[1..].iter().copied().chain(d.final_state);
            for ((&state, &action), next) in d.states.iter().zip(&d.actions).zip(after) {
                counts.add(state, action, next);
            }
            ControlFlow::Continue(())
        })?;
    }
    let cannot = |message: String| {
        let hint = "a model needs demonstrations with actions and with the state that follows each";
        CliError::failure(format!("cannot estimate a model: {message}"), hint)
    };
    let finish = |known: Option<Names>, new: Collector| match known {
        Some(names) => {
            let same = (0..names.len()).collect();
            Ok((names, same))
        }
        None => new.finish().map_err(cannot),
    };
    let known_actions = known_actions.cloned();
    let (states, state_index) = finish(known.map(|(states, _)| states), new_states)?;
    let (actions, action_index) = finish(known_actions, new_actions)?;
    let counts = counts.renumbered(&state_index, &action_index);
    let description = described.map_or_else(models::Description::default, |model| models::Description {
        features: model.features,
        terminal_states: model.terminal_states,
        rewards: model.rewards,
        initial_distribution: model.initial_distribution,
    });
    models::estimate(env, &counts, (&states, &actions), description, job.model_prior)
}

/// The first reading: everything that can be wrong is found, and counted.
fn check(job: &Job, names: &(Names, Names), model: &Model, env: &str) -> Result<Summary, CliError> {
    let mut summary = Summary { env: env.to_owned(), files: job.files.len(), ..Summary::default() };
    let (mut states, mut actions) = (&names.0, &names.1);
    let mut ignored = BTreeSet::new();
    for_each(job, &mut states, &mut actions, &mut ignored, |file, d| {
        if job.env.is_none()
            && let Some(other) = d.env.as_deref().filter(|other| *other != env)
        {
            return ControlFlow::Break(Some(FileError::new(
                file,
                files::Place::Line(d.places[0]),
                format!("expected demonstrations of {env}, got one of {other}"),
                "import each environment on its own, or say which one it is with --env",
            )));
        }
        let breaks = check::breaks(model, &d);
        summary.impossible.add(file, (&names.0, &names.1), &d, &breaks);
        summary.trajectories += 1;
        summary.steps += d.states.len() as u64;
        summary.styles.insert(style(job, &d));
        summary.sources.insert(source(job, file, &d));
        ControlFlow::Continue(())
    })?;
    summary.ignored_columns = ignored;
    if summary.trajectories == 0 {
        let names = job.files.iter().map(|file| file.display().to_string()).collect::<Vec<_>>().join(", ");
        return Err(CliError::failure(
            format!("{names}: expected at least one demonstration, got none"),
            "a file has a line for each step under its header",
        ));
    }
    let found = &summary.impossible;
    if found.transitions > 0 && job.impossible == ImpossibleArg::Refuse {
        let (message, hint) = (
            impossible_text(found, summary.steps, summary.trajectories),
            "correct them, or add --impossible split to cut the trajectories there, or --impossible keep",
        );
        return Err(CliError::failure(message, hint));
    }
    Ok(summary)
}

fn impossible_text(found: &Impossible, steps: u64, trajectories: u64) -> String {
    format!(
        "{} of {steps} transitions, in {} of {trajectories} trajectories, cannot happen in the model, such as {}",
        found.transitions,
        found.trajectories,
        found.examples.join("; "),
    )
}

fn style(job: &Job, d: &Demonstration) -> String {
    job.style.clone().or_else(|| d.style.clone()).unwrap_or_else(|| "expert".to_owned())
}

fn source(job: &Job, file: &Path, d: &Demonstration) -> String {
    let name = || file.file_name().map(|name| name.to_string_lossy().into_owned()).unwrap_or_default();
    job.source.clone().or_else(|| d.source.clone()).unwrap_or_else(|| format!("file:{}", name()))
}

/// The second reading: everything is recorded.
async fn record(
    job: &Arc<Job>,
    learner: &Learner,
    names: (Names, Names),
    model: &Arc<Model>,
    summary: &mut Summary,
) -> Result<(), CliError> {
    let (sender, mut read) = mpsc::channel::<Trajectory>(READ_AHEAD);
    let reading = tokio::task::spawn_blocking({
        let (job, model, env) = (Arc::clone(job), Arc::clone(model), summary.env.clone());
        move || send(&job, &names, &model, &env, &sender)
    });
    let mut recorder = learner.recorder();
    let mut refused = None;
    while let Some(trajectory) = read.recv().await {
        if let Err(error) = recorder.record(trajectory).await {
            refused = Some(error);
            break;
        }
    }
    // A reader that waits for its place finds nobody there, and stops.
    drop(read);
    let outcome = reading
        .await
        .unwrap_or_else(|error| Err(CliError::failure(format!("reading failed: {error}"), "report this as a defect")));
    if let Some(error) = refused {
        return Err(error.into());
    }
    outcome?;
    let receipt = recorder.finish().await?;
    (summary.stored, summary.known) = (receipt.stored, receipt.duplicates);
    Ok(())
}

fn send(
    job: &Job,
    names: &(Names, Names),
    model: &Model,
    env: &str,
    sender: &mpsc::Sender<Trajectory>,
) -> Result<(), CliError> {
    let (mut states, mut actions) = (&names.0, &names.1);
    for_each(job, &mut states, &mut actions, &mut BTreeSet::new(), |file, d| {
        let breaks = if job.impossible == ImpossibleArg::Split { check::breaks(model, &d) } else { Vec::new() };
        let whole = breaks.is_empty();
        let parts = if whole { vec![d] } else { check::split(d, &breaks) };
        for (part, d) in parts.into_iter().enumerate() {
            let (style, source, name) = (style(job, &d), source(job, file, &d), d.name.clone());
            let mut trajectory = Trajectory::from(mazeway_client::Demonstration {
                env_id: env.to_owned(),
                model_id: model.model_id.clone(),
                style,
                source,
                seed: d.seed,
                n_states: model.n_states,
                n_actions: model.n_actions,
                states: d.states,
                actions: d.actions,
                rewards: d.rewards,
                final_state: d.final_state,
                terminated: d.terminated,
                truncated: d.truncated,
            });
            // What was exported comes back under the id that it had.
            let relabelled = job.env.is_some() || job.style.is_some() || job.source.is_some();
            let own = Uuid::try_parse(&name).ok().filter(|_| whole && !relabelled && name.len() == 36);
            trajectory.trajectory_id = own.unwrap_or_else(|| content_uuid(&trajectory, &name, part)).to_string();
            if sender.blocking_send(trajectory).is_err() {
                return ControlFlow::Break(None);
            }
        }
        ControlFlow::Continue(())
    })
}

/// A UUID (version 5) over everything that a trajectory says, its name in the file and which part of it this is.
fn content_uuid(trajectory: &Trajectory, name: &str, part: usize) -> Uuid {
    let mut bytes = Vec::new();
    let labels = [&trajectory.env_id, &trajectory.model_id, &trajectory.style, &trajectory.source];
    for text in labels.into_iter().map(String::as_str).chain([name]) {
        bytes.extend((text.len() as u64).to_le_bytes());
        bytes.extend(text.as_bytes());
    }
    bytes.extend((part as u64).to_le_bytes());
    bytes.push(u8::from(trajectory.seed.is_some()));
    bytes.extend(trajectory.seed.unwrap_or_default().to_le_bytes());
    for array in [&trajectory.states, &trajectory.actions, &trajectory.rewards] {
        bytes.extend((array.len() as u64).to_le_bytes());
        bytes.extend(array.as_ref());
    }
    bytes.push(u8::from(trajectory.final_state.is_some()));
    bytes.extend(trajectory.final_state.unwrap_or_default().to_le_bytes());
    bytes.extend([u8::from(trajectory.terminated), u8::from(trajectory.truncated)]);
    Uuid::new_v5(&NAMESPACE, &bytes)
}

fn object(summary: &Summary) -> Value {
    let model = summary.model.as_ref().map(|model| {
        json!({
            "id": model.id,
            "stored": model.fate == "stored",
            "estimated": model.estimated,
            "pairs": model.pairs,
            "unseen_pairs": model.unseen,
        })
    });
    json!({
        "env": summary.env,
        "model": model,
        "files": summary.files,
        "trajectories": summary.trajectories,
        "steps": summary.steps,
        "stored": summary.stored,
        "already_stored": summary.known,
        "styles": summary.styles,
        "sources": summary.sources,
        "impossible": {
            "transitions": summary.impossible.transitions,
            "trajectories": summary.impossible.trajectories,
            "examples": summary.impossible.examples,
        },
        "ignored_columns": summary.ignored_columns,
    })
}

fn text(job: &Job, summary: &Summary) -> String {
    let mut lines = Vec::new();
    let mut line = |what: &str, detail: String| lines.push(format!("{what:<12}{detail}\n"));
    if let Some(model) = &summary.model {
        line("model", format!("{}; {} as {}", model.text, fate(model.fate), table::short(&model.id)));
        if !model.unseen.is_empty() {
            let few = model.unseen.iter().take(5).map(|(s, a)| format!("{s}/{a}")).collect::<Vec<_>>().join(", ");
            let more = if model.unseen.len() > 5 { ", ..." } else { "" };
            let unseen = model.unseen.len();
            line("warning", format!("no data for {unseen} of {} state-action pairs ({few}{more})", model.pairs));
        }
    }
    if summary.trajectories > 0 {
        let list = |set: &BTreeSet<String>| set.iter().map(|s| format!("'{s}'")).collect::<Vec<_>>().join(", ");
        line("checked", format!("{} trajectories, {} steps", summary.trajectories, summary.steps));
        if summary.impossible.transitions > 0 {
            let done = if job.impossible == ImpossibleArg::Split { "cut there" } else { "kept" };
            let text = impossible_text(&summary.impossible, summary.steps, summary.trajectories);
            line("warning", format!("{text}; {done}"));
        }
        if !summary.ignored_columns.is_empty() {
            line("ignored", format!("columns {}", list(&summary.ignored_columns)));
        }
        let (styles, sources) = (list(&summary.styles), list(&summary.sources));
        line(
            "recorded",
            format!("{} new, {} known already; style {styles}, source {sources}", summary.stored, summary.known),
        );
    }
    lines.concat()
}

fn fate(fate: &str) -> &str {
    if fate == "known" { "stored already" } else { "stored" }
}
