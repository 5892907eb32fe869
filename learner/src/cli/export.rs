//! `learner export` and `learner delete`: whole trajectories out of the store.

use super::{StoreArgs, connect::connect, error::CliError};
use clap::{Args, ValueEnum};
use mazeway_client::{Learner, packed::Packed};
use mazeway_proto::learner as pb;
use serde_json::{Value, json};
use std::{
    fs::File,
    io::{self, BufWriter, Write},
    path::PathBuf,
};

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
}

/// How trajectories are written.
#[derive(Debug, Clone, Copy, PartialEq, Eq, ValueEnum)]
enum Format {
    /// One JSON object a line and trajectory
    Jsonl,
    /// One line a step, under a header
    Csv,
}

/// What to write, how and where.
#[derive(Debug, Args)]
pub struct ExportArgs {
    #[command(flatten)]
    filter: FilterArgs,
    /// How
    #[arg(long, value_enum, default_value_t = Format::Jsonl, value_name = "FORMAT")]
    format: Format,
    /// Where to; standard output unless said
    #[arg(long, value_name = "FILE")]
    out: Option<PathBuf>,
    #[command(flatten)]
    store: StoreArgs,
}

/// Writes trajectories, in the order in which they were recorded.
pub async fn export(args: ExportArgs) -> Result<(), CliError> {
    let mut out: Box<dyn Write + Send> = match &args.out {
        None => Box::new(BufWriter::new(io::stdout())),
        Some(path) => Box::new(BufWriter::new(File::create(path).map_err(|error| {
            CliError::failure(format!("cannot write {}: {error}", path.display()), "choose another file with --out")
        })?)),
    };
    let connected = connect(&args.store).await?;
    let written = write(&args, &connected.learner, &mut out).await;
    connected.finish(written).await
}

async fn write(args: &ExportArgs, learner: &Learner, out: &mut (dyn Write + Send)) -> Result<(), CliError> {
    let mut pages = learner.export_trajectories(&args.filter.filter()).await?;
    if args.format == Format::Csv {
        writeln!(out, "{CSV_HEADER}")?;
    }
    while let Some(page) = pages.next().await? {
        for trajectory in page {
            let torn =
                || CliError::failure(format!("trajectory {} is torn", trajectory.trajectory_id), "see 'learner list'");
            let value = plain(&trajectory).ok_or_else(torn)?;
            match args.format {
                Format::Jsonl => writeln!(out, "{value}")?,
                Format::Csv => write_csv(&trajectory, &value, out)?,
            }
        }
    }
    Ok(out.flush()?)
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

const CSV_HEADER: &str =
    "id,env,model,style,source,seed,n_states,n_actions,step,state,action,reward,next_state,terminated,truncated";

/// One line a step. `terminated` and `truncated` are those of the step: true on the last one at most.
fn write_csv(t: &pb::Trajectory, value: &Value, out: &mut (dyn Write + Send)) -> io::Result<()> {
    let seed = t.seed.map(|seed| seed.to_string()).unwrap_or_default();
    let labels = [&t.trajectory_id, &t.env_id, &t.model_id, &t.style, &t.source].map(|text| quoted(text)).join(",");
    let steps = value["states"].as_array().map_or(0, Vec::len);
    for step in 0..steps {
        let last = step + 1 == steps;
        let cell = |value: &Value| if value.is_null() { String::new() } else { value.to_string() };
        let next = if last { cell(&value["final_state"]) } else { cell(&value["states"][step + 1]) };
        writeln!(
            out,
            "{labels},{seed},{},{},{step},{},{},{},{next},{},{}",
            t.n_states,
            t.n_actions,
            value["states"][step],
            cell(&value["actions"][step]),
            cell(&value["rewards"][step]),
            last && t.terminated,
            last && t.truncated,
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
        write_csv(&trajectory, &plain(&trajectory).unwrap(), &mut out).unwrap();
        let lines = String::from_utf8(out).unwrap();
        let expected = [
            "t,\"a, \"\"b\"\"\",,s,,7,9,4,0,1,3,0.5,2,false,false",
            "t,\"a, \"\"b\"\"\",,s,,7,9,4,1,2,0,-1.0,8,false,true",
        ];
        assert_eq!(lines.lines().collect::<Vec<_>>(), expected);
    }
}
