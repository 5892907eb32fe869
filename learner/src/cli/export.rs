//! `learner export` and `learner delete`: whole trajectories out of the store.

use super::{StoreArgs, connect::connect, data_directory, error::CliError, maintain::NAMED, models};
use clap::{Args, ValueEnum};
use mazeway_client::{ClientError, Code, Learner, packed::Packed};
use mazeway_learner::{
    files::{COLUMNS, Names, Naming, ParquetExport, Step},
    store::{self, Kind, Recording},
};
use mazeway_proto::learner as pb;
use serde_json::{Value, json};
use std::{
    collections::BTreeMap,
    fs::{self, File},
    io::{self, BufWriter, Write},
    path::PathBuf,
};
use tokio::task::spawn_blocking;

/// Which trajectories.
#[derive(Debug, Args)]
pub struct FilterArgs {
    /// Of this environment alone
    #[arg(long, value_name = "ENV", default_value = "", hide_default_value = true)]
    env: String,
    /// Of this style alone
    #[arg(long, value_name = "STYLE", default_value = "", hide_default_value = true)]
    style: String,
    /// By this source alone
    #[arg(long, value_name = "SOURCE", default_value = "", hide_default_value = true)]
    source: String,
    /// In this model alone; its whole id
    #[arg(long, value_name = "ID", default_value = "", hide_default_value = true)]
    model: String,
    /// This trajectory; its whole id. May be given several times
    #[arg(long = "id", value_name = "ID")]
    ids: Vec<String>,
}

impl FilterArgs {
    fn filter(&self) -> pb::TrajectoryFilter {
        pb::TrajectoryFilter {
            trajectory_ids: self.ids.clone(),
            env_id: self.env.clone(),
            style: self.style.clone(),
            model_id: self.model.clone(),
            source: self.source.clone(),
            ..Default::default()
        }
    }

    /// What the filter means, where no query can be asked.
    fn selects(&self, recording: &Recording) -> bool {
        let collection = recording.collection();
        let is = |wanted: &str, got: &str| wanted.is_empty() || wanted == got;
        is(&self.env, &collection.env_id)
            && is(&self.style, &collection.style)
            && is(&self.source, &collection.source)
            && is(&self.model, &collection.model_id)
            && (self.ids.is_empty() || self.ids.iter().any(|id| id.parse() == Ok(recording.id())))
    }
}

/// How trajectories are written.
#[derive(Debug, Clone, Copy, PartialEq, Eq, ValueEnum)]
enum Format {
    /// One JSON object a line and trajectory
    Jsonl,
    /// One line a step, under a header
    Csv,
    /// One row a step
    Parquet,
}

/// What to write, how and where.
#[derive(Debug, Args)]
pub struct ExportArgs {
    #[command(flatten)]
    filter: FilterArgs,
    /// What this fit used alone; its id, or the first eight or more characters of it
    #[arg(long, value_name = "FIT")]
    fit: Option<String>,
    /// How
    #[arg(long, value_enum, default_value_t = Format::Jsonl, value_name = "FORMAT")]
    format: Format,
    /// Where to; standard output unless said
    #[arg(long, value_name = "FILE")]
    out: Option<PathBuf>,
    /// Write states and actions by the labels of the environment's model rather than by their indices
    #[arg(long)]
    labels: bool,
    /// Leave out what is damaged, say what that is, and write all else; reads the directory itself
    #[arg(long, conflicts_with_all = ["fit", "labels", "addr"])]
    skip_damaged: bool,
    #[command(flatten)]
    store: StoreArgs,
}

/// Writes trajectories, in the order in which they were recorded. A file has its name once all is in it.
pub async fn export(args: ExportArgs) -> Result<(), CliError> {
    let Some(path) = args.out.clone() else {
        return write(args, Box::new(BufWriter::new(io::stdout()))).await;
    };
    let cannot = |error: io::Error| {
        CliError::failure(format!("cannot write {}: {error}", path.display()), "choose another file with --out")
    };
    // A pipe or a device has no name to be given.
    if path.metadata().is_ok_and(|there| !there.is_file()) {
        return write(args, Box::new(BufWriter::new(File::create(&path).map_err(cannot)?))).await;
    }
    let mut part = path.clone().into_os_string();
    part.push(".part");
    let part = PathBuf::from(part);
    let written = write(args, Box::new(BufWriter::new(File::create(&part).map_err(cannot)?))).await;
    let named = written.and_then(|()| fs::rename(&part, &path).map_err(cannot));
    if named.is_err() {
        // Half an export is of no use, and the error of the export is the one to tell.
        let _ = fs::remove_file(&part);
    }
    named
}

async fn write(args: ExportArgs, out: Box<dyn Write + Send>) -> Result<(), CliError> {
    let sink = Sink::new(args.format, args.labels, out)?;
    if args.skip_damaged {
        return spawn_blocking(move || write_sound(args, sink)).await.expect("writing does not panic");
    }
    let connected = connect(&args.store).await?;
    let written = write_all(&args, &connected.learner, sink).await;
    connected.finish(written).await
}

/// Where trajectories go.
enum Sink {
    Jsonl(Box<dyn Write + Send>),
    Csv(Box<dyn Write + Send>),
    Parquet(Box<ParquetExport<Box<dyn Write + Send>>>),
}

impl Sink {
    fn new(format: Format, labels: bool, mut out: Box<dyn Write + Send>) -> Result<Self, CliError> {
        Ok(match format {
            Format::Jsonl => Self::Jsonl(out),
            Format::Csv => {
                writeln!(out, "{}", COLUMNS.join(","))?;
                Self::Csv(out)
            }
            Format::Parquet => Self::Parquet(Box::new(ParquetExport::new(out, labels).map_err(cannot_write)?)),
        })
    }

    fn put(&mut self, trajectory: &pb::Trajectory, names: Option<&Called>) -> Result<(), CliError> {
        let torn =
            || CliError::failure(format!("trajectory {} is torn", trajectory.trajectory_id), "see 'learner list'");
        match self {
            Self::Parquet(parquet) => {
                let steps = steps(trajectory).ok_or_else(torn)?;
                parquet.write(trajectory, steps, names.map(|n| n as &dyn Naming)).map_err(cannot_write)
            }
            Self::Csv(out) => Ok(write_csv(trajectory, &steps(trajectory).ok_or_else(torn)?, names, out)?),
            Self::Jsonl(out) => {
                let mut value = plain(trajectory).ok_or_else(torn)?;
                if let Some(names) = names {
                    names.relabel(&mut value);
                }
                Ok(writeln!(out, "{value}")?)
            }
        }
    }

    fn finish(self) -> Result<(), CliError> {
        match self {
            Self::Parquet(parquet) => parquet.finish().map_err(cannot_write),
            Self::Csv(mut out) | Self::Jsonl(mut out) => Ok(out.flush()?),
        }
    }
}

async fn write_all(args: &ExportArgs, learner: &Learner, mut sink: Sink) -> Result<(), CliError> {
    let mut labels = Labels { wanted: args.labels, models: BTreeMap::new() };
    let filter = args.filter.filter();
    let mut pages = match &args.fit {
        None => learner.export_trajectories(&filter).await?,
        Some(fit) => learner.export_fit_trajectories(fit, &filter).await.map_err(|error| match error.code() {
            Code::NotFound => CliError::failure(format!("there is no fit '{fit}'"), "see the fits with 'learner list'"),
            Code::InvalidArgument if error.field() == Some("fit_id") => {
                CliError::usage(error.to_string(), "see the fits with 'learner list'")
            }
            _ => error.into(),
        })?,
    };
    while let Some(page) = pages.next().await.map_err(damaged)? {
        for trajectory in page {
            let names = labels.of(learner, &trajectory).await?;
            sink.put(&trajectory, names.as_ref())?;
        }
    }
    sink.finish()
}

/// What else can be done where the store is damaged.
fn damaged(error: ClientError) -> CliError {
    let is_damage = error.code() == Code::DataLoss;
    let mut error = CliError::from(error);
    if is_damage {
        "write all that is sound with --skip-damaged, or run 'learner repair'".clone_into(&mut error.hint);
    }
    error
}

/// Writes what is sound of a damaged store and names what is not.
fn write_sound(args: ExportArgs, mut sink: Sink) -> Result<(), CliError> {
    let directory = data_directory(args.store.data)?;
    let found = store::sound_trajectories(&directory, |recording| {
        if args.filter.selects(recording) {
            sink.put(&recording.clone().into(), None)?;
        }
        Ok::<_, CliError>(())
    })?;
    sink.finish()?;
    for damage in found.damage.iter().filter(|damage| damage.kind == Kind::Trajectory).take(NAMED) {
        eprintln!("left out {}: {}", damage.name, damage.message);
    }
    if found.trajectories.damaged > 0 {
        eprintln!("left out {} damaged trajectories in all", found.trajectories.damaged);
    }
    Ok(())
}

fn cannot_write(error: impl std::fmt::Display) -> CliError {
    CliError::failure(format!("could not write: {error}"), "check that the disk has room and that you may write there")
}

/// What states and actions are called, model by model.
struct Labels {
    wanted: bool,
    models: BTreeMap<String, Option<Called>>,
}

/// The labels of one model.
#[derive(Debug, Clone)]
struct Called(Names, Names);

impl Naming for Called {
    fn state(&self, index: u32) -> String {
        self.0.name(index)
    }

    fn action(&self, index: u32) -> String {
        self.1.name(index)
    }
}

impl Called {
    /// Puts labels in the place of indices.
    fn relabel(&self, value: &mut Value) {
        let index = |value: &Value| value.as_u64().and_then(|index| u32::try_from(index).ok());
        for (key, name) in [("states", &self.0), ("actions", &self.1)] {
            for cell in value[key].as_array_mut().into_iter().flatten() {
                if let Some(index) = index(cell) {
                    *cell = name.name(index).into();
                }
            }
        }
        if let Some(last) = index(&value["final_state"]) {
            value["final_state"] = self.0.name(last).into();
        }
    }
}

impl Labels {
    /// The labels of a trajectory's model; `None` where they are not wanted or not known.
    async fn of(&mut self, learner: &Learner, trajectory: &pb::Trajectory) -> Result<Option<Called>, CliError> {
        if !self.wanted {
            return Ok(None);
        }
        let id = &trajectory.model_id;
        if !self.models.contains_key(id) {
            let model = if id.is_empty() { None } else { known(learner.model(id).await)? };
            self.models.insert(id.clone(), model.map(|model| models::names(&model)).map(|(s, a)| Called(s, a)));
        }
        let plain =
            || Called(Names::numbered("state", trajectory.n_states), Names::numbered("action", trajectory.n_actions));
        Ok(Some(self.models[id].clone().unwrap_or_else(plain)))
    }
}

/// What is asked for, where it is there.
pub fn known<T>(answer: Result<T, mazeway_client::ClientError>) -> Result<Option<T>, CliError> {
    match answer {
        Ok(value) => Ok(Some(value)),
        Err(error) if error.code() == Code::NotFound => Ok(None),
        Err(error) => Err(error.into()),
    }
}

/// A trajectory step by step; `None` where an array is torn.
fn steps(t: &pb::Trajectory) -> Option<Vec<Step>> {
    let states = Packed::<u32>::new(t.states.clone())?.to_vec();
    let actions = Packed::<u32>::new(t.actions.clone())?.to_vec();
    let rewards = Packed::<f64>::new(t.rewards.clone())?.to_vec();
    let last = states.len().checked_sub(1);
    let step = |(step, &state): (usize, &u32)| Step {
        step: step as u64,
        state,
        action: actions.get(step).copied(),
        reward: rewards.get(step).copied(),
        next_state: states.get(step + 1).copied().or(t.final_state),
        terminated: Some(step) == last && t.terminated,
        truncated: Some(step) == last && t.truncated,
    };
    Some(states.iter().enumerate().map(step).collect())
}

/// A trajectory in plain arrays; `None` where one is torn.
pub fn plain(t: &pb::Trajectory) -> Option<Value> {
    Some(json!({
        "id": t.trajectory_id,
        "env": t.env_id,
        "model": t.model_id,
        "style": t.style,
        "source": t.source,
        "seed": t.seed,
        "n_states": t.n_states,
        "n_actions": t.n_actions,
        "states": Packed::<u32>::new(t.states.clone())?.to_vec(),
        "actions": Packed::<u32>::new(t.actions.clone())?.to_vec(),
        "rewards": Packed::<f64>::new(t.rewards.clone())?.to_vec(),
        "final_state": t.final_state,
        "terminated": t.terminated,
        "truncated": t.truncated,
    }))
}

/// One line a step. `terminated` and `truncated` are those of the step: true on the last one at most.
fn write_csv(t: &pb::Trajectory, steps: &[Step], names: Option<&Called>, out: &mut dyn Write) -> io::Result<()> {
    let seed = t.seed.map(|seed| seed.to_string()).unwrap_or_default();
    let labels = [&t.trajectory_id, &t.env_id, &t.model_id, &t.style, &t.source].map(|text| quoted(text)).join(",");
    let state = |index: u32| names.map_or_else(|| index.to_string(), |names| quoted(&names.state(index)));
    let action = |index: u32| names.map_or_else(|| index.to_string(), |names| quoted(&names.action(index)));
    for step in steps {
        writeln!(
            out,
            "{labels},{seed},{},{},{},{},{},{},{},{},{}",
            t.n_states,
            t.n_actions,
            step.step,
            state(step.state),
            step.action.map(action).unwrap_or_default(),
            // As JSON writes it: every digit that is needed, and a point.
            step.reward.map(|reward| Value::from(reward).to_string()).unwrap_or_default(),
            step.next_state.map(state).unwrap_or_default(),
            step.terminated,
            step.truncated,
        )?;
    }
    Ok(())
}

/// A text as a CSV field (RFC 4180).
fn quoted(text: &str) -> String {
    if text.contains(['"', ',', '\n', '\r']) { format!("\"{}\"", text.replace('"', "\"\"")) } else { text.to_owned() }
}

/// What to delete.
#[derive(Debug, Args)]
pub struct DeleteArgs {
    #[command(flatten)]
    filter: FilterArgs,
    /// A fit instead; its whole id
    #[arg(long, value_name = "ID", conflicts_with_all = ["env", "style", "source", "model", "ids"])]
    fit: Option<String>,
    /// Do it; without this, say how many trajectories it would delete
    #[arg(long)]
    yes: bool,
    #[command(flatten)]
    store: StoreArgs,
}

/// Deletes.
pub async fn delete(args: DeleteArgs) -> Result<(), CliError> {
    let filter = args.filter.filter();
    if args.fit.is_none() && filter == pb::TrajectoryFilter::default() {
        return Err(CliError::usage(
            "expected what to delete, got no condition",
            "name trajectories with --env, --style, --source, --model or --id, or a fit with --fit",
        ));
    }
    let connected = connect(&args.store).await?;
    let done = delete_with(&args, &filter, &connected.learner).await;
    let done = connected.finish(done).await?;
    Ok(writeln!(io::stdout(), "{done}")?)
}

async fn delete_with(args: &DeleteArgs, filter: &pb::TrajectoryFilter, learner: &Learner) -> Result<String, CliError> {
    let again = "add --yes to the same command to delete them for good";
    if let Some(fit) = &args.fit {
        if !args.yes {
            let summary = learner.get_fit(fit).await?;
            return Err(CliError::failure(format!("this would delete fit {}", summary.fit_id), again));
        }
        learner.delete_fit(fit).await?;
        return Ok(format!("deleted fit {fit}"));
    }
    if !args.yes {
        let count = learner.count_trajectories(filter).await?;
        return Err(CliError::failure(format!("this would delete {count} trajectories"), again));
    }
    let deleted = learner.delete_trajectories(filter).await?;
    Ok(format!("deleted {deleted} trajectories"))
}

#[cfg(test)]
mod tests {
    use super::*;
    use mazeway_client::packed::pack;

    #[test]
    fn csv_has_a_line_a_step_and_quotes_what_needs_it() {
        let trajectory = pb::Trajectory {
            trajectory_id: "t".into(),
            env_id: "a, \"b\"".into(),
            style: "s".into(),
            seed: Some(7),
            n_states: 9,
            n_actions: 4,
            states: pack([1_u32, 2]),
            actions: pack([3_u32, 0]),
            rewards: pack([0.5, -1.0]),
            final_state: Some(8),
            truncated: true,
            ..Default::default()
        };
        let mut out = Vec::new();
        write_csv(&trajectory, &steps(&trajectory).unwrap(), None, &mut out).unwrap();
        let lines = String::from_utf8(out).unwrap();
        let expected = [
            "t,\"a, \"\"b\"\"\",,s,,7,9,4,0,1,3,0.5,2,false,false",
            "t,\"a, \"\"b\"\"\",,s,,7,9,4,1,2,0,-1.0,8,false,true",
        ];
        assert_eq!(lines.lines().collect::<Vec<_>>(), expected);
    }
}
