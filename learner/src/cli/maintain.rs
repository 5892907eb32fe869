//! `learner verify`, `repair`, `backup` and `vacuum`: looking after the data directory itself.
//!
//! They work on the directory and not through a service: a service may be at work on it meanwhile, but for a repair.

use super::{data_directory, error::CliError, table::table};
use clap::Args;
use mazeway_learner::store::{self, Kind, Repair, Store, StoreError, Tally, Verification};
use serde_json::{Value, json};
use std::{
    io::Write as _,
    path::{Path, PathBuf},
};
use tokio::task::spawn_blocking;

/// Things that are named on a terminal at most.
pub const NAMED: usize = 50;

/// Which directory, and how it is told.
#[derive(Debug, Args)]
pub struct MaintainArgs {
    /// Directory of the recordings, models and fits [default: the platform's data directory]
    #[arg(long, value_name = "DIR", env = "MAZEWAY_DATA")]
    data: Option<PathBuf>,
    /// One JSON object on standard output
    #[arg(long)]
    json: bool,
}

/// Where the copy is to be.
#[derive(Debug, Args)]
pub struct BackupArgs {
    /// Directory of the copy, made where it is missing; it may not hold a store already
    #[arg(value_name = "DIR")]
    destination: PathBuf,
    #[command(flatten)]
    common: MaintainArgs,
}

/// Checks everything that is stored. Fails where something is damaged.
pub async fn verify(args: MaintainArgs) -> Result<(), CliError> {
    let directory = data_directory(args.data)?;
    let found = blocking(move || store::verify(&directory)).await?;
    let nothing = nothing(&found);
    let sound = found.is_sound() && nothing.is_none();
    let said = if nothing.is_some() { String::new() } else { text(&found) };
    tell(args.json, &json!({ "sound": sound, "found": found }), &said)?;
    if let Some(error) = nothing {
        return Err(error);
    }
    if sound {
        return Ok(());
    }
    Err(CliError::failure(
        format!("{} is damaged: {}", found.path.display(), summary(&found)),
        "run 'learner repair': it takes over what is sound and keeps the damaged file",
    ))
}

/// Writes a new store of what is sound in a damaged one.
pub async fn repair(args: MaintainArgs) -> Result<(), CliError> {
    let directory = data_directory(args.data)?;
    let repaired = blocking(move || Ok(store::repair(&directory))).await?;
    let Repair { found, kept } = repaired.map_err(|error| match error {
        // `learner verify` would say no more.
        StoreError::Corrupt { .. } => CliError::failure(error.to_string(), RESTORE),
        error => error.into(),
    })?;
    if kept.is_none()
        && let Some(error) = nothing(&found)
    {
        return Err(error);
    }
    let said = match &kept {
        None => "nothing to repair\n".to_owned(),
        Some(kept) => format!(
            "repaired    took over {} trajectories, {} models and {} fits\nkept        {}, as it was\n",
            found.trajectories.sound,
            found.models.sound,
            found.fits.sound,
            kept.display()
        ),
    };
    tell(args.json, &json!({ "repaired": kept.is_some(), "kept": kept, "found": found }), &(text(&found) + &said))
}

/// Copies the store as it is at one moment.
pub async fn backup(args: BackupArgs) -> Result<(), CliError> {
    let directory = data_directory(args.common.data)?;
    let destination = args.destination;
    let place = destination.clone();
    let found = blocking(move || Ok(store::backup(&directory, &destination))).await?.map_err(|error| {
        let of_the_copy = match &error {
            StoreError::Directory { path, .. } => *path == place,
            StoreError::DiskFull { path } | StoreError::Database { path, .. } => path.parent() == Some(&place),
            _ => false,
        };
        if of_the_copy {
            CliError::failure(error.to_string(), "name another directory for the copy")
        } else {
            error.into()
        }
    })?;
    if let Some(error) = nothing(&found) {
        return Err(error);
    }
    let bytes = std::fs::metadata(&found.path)?.len();
    let said = format!("copied      {bytes} bytes, on stable storage and checked\n");
    tell(
        args.common.json,
        &json!({ "path": found.path, "bytes": bytes, "sound": found.is_sound(), "found": found }),
        &(text(&found) + &said),
    )?;
    if found.is_sound() {
        return Ok(());
    }
    Err(CliError::failure(
        format!("the copy {} is as damaged as its source: {}", found.path.display(), summary(&found)),
        "run 'learner repair' on the source, then copy it to another directory",
    ))
}

/// Gives the room that deleting has left back to the disk.
pub async fn vacuum(args: MaintainArgs) -> Result<(), CliError> {
    let directory = data_directory(args.data)?;
    let store = blocking(move || Store::open_existing(&directory)).await?;
    let size = |path: &Path| std::fs::metadata(path).map(|file| file.len());
    let before = size(store.path())?;
    store.vacuum().await?;
    let (path, after) = (store.path().to_owned(), size(store.path())?);
    blocking(move || {
        drop(store);
        Ok(())
    })
    .await?;
    let said = format!("store       {}\nbytes       {before} before, {after} now\n", path.display());
    tell(args.json, &json!({ "path": path, "bytes_before": before, "bytes": after }), &said)
}

async fn blocking<T: Send + 'static>(
    work: impl FnOnce() -> Result<T, store::StoreError> + Send + 'static,
) -> Result<T, CliError> {
    let outcome = spawn_blocking(work).await;
    Ok(outcome.map_err(|error| CliError::failure(error.to_string(), "report this as a defect"))??)
}

/// What to do where nothing can be taken over.
const RESTORE: &str = "restore a copy that 'learner backup' made, or move the file away: a service begins a new one";

/// What there is to say of a file in which there is nothing to verify, repair or copy.
fn nothing(found: &Verification) -> Option<CliError> {
    let tallies = [found.trajectories, found.models, found.fits];
    // A store knows its schema from the moment in which it is made.
    if found.schema != 0 || tallies.iter().any(|tally| tally.sound + tally.damaged > 0) {
        return None;
    }
    let path = found.path.display();
    let message = match found.structure.first() {
        None => format!("{path} is no store: there is nothing in it"),
        Some(finding) => format!("nothing of {path} reads: {finding}"),
    };
    Some(CliError::failure(message, RESTORE))
}

fn tell(as_json: bool, value: &Value, text: &str) -> Result<(), CliError> {
    let mut out = std::io::stdout().lock();
    if as_json {
        writeln!(out, "{value}")?;
    } else {
        write!(out, "{text}")?;
    }
    Ok(out.flush()?)
}

fn summary(found: &Verification) -> String {
    let counts = [(found.trajectories, "trajectories"), (found.models, "models"), (found.fits, "fits")];
    let mut parts = Vec::new();
    if !found.structure.is_empty() {
        parts.push(format!("{} findings in its structure", found.structure.len()));
    }
    let damaged = counts.iter().filter(|(tally, _)| tally.damaged > 0);
    parts.extend(damaged.map(|(tally, what)| format!("{} {what}", tally.damaged)));
    parts.join(", ")
}

fn text(found: &Verification) -> String {
    let mut text = format!("store       {}, schema {}\n", found.path.display(), found.schema);
    if found.structure.is_empty() {
        text += "structure   sound\n";
    }
    for finding in found.structure.iter().take(NAMED) {
        text.extend(["structure   ", &finding.split_whitespace().collect::<Vec<_>>().join(" "), "\n"]);
    }
    let row = |what: &str, tally: Tally| [what.to_owned(), tally.sound.to_string(), tally.damaged.to_string()];
    let rows = [row("trajectories", found.trajectories), row("models", found.models), row("fits", found.fits)];
    text.extend(["\n", table(["what", "#sound", "#damaged"], rows).as_str(), "\n\n"]);
    if !found.damage.is_empty() {
        let rows = found.damage.iter().take(NAMED).map(|damage| {
            let kind = match damage.kind {
                Kind::Trajectory => "trajectory",
                Kind::Model => "model",
                Kind::Fit => "fit",
            };
            [kind.to_owned(), damage.name.clone(), damage.message.clone()]
        });
        text.extend([table(["damaged", "which", "why"], rows).as_str(), "\n"]);
        if found.damage.len() > NAMED {
            text.extend(["and ", &(found.damage.len() - NAMED).to_string(), " more; --json names them\n"]);
        }
        text.push('\n');
    }
    text
}
