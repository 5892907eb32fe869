//! `learner compare`: methods on the same demonstrations, over numbers of demonstrations and seeds.
//!
//! Model and demonstrations come from a real environment server through the real client, or, for an environment that only the
//! learner knows, from its store; the fits run in this process. Every finished fit is in a journal, from which the same command
//! goes on.

mod args;
pub mod grid;
pub mod job;
mod journal;
pub mod output;
mod recorded;

pub use args::CompareArgs;

use super::{
    data_directory,
    error::CliError,
    fit::narrate::Narrator,
    scene::{Environments, Scene},
};
use grid::{Grid, Ground, Seed};
use job::Job;
use journal::Journal;
use mazeway_client::Connection;
use mazeway_learner::eval::comparison::{Cell, Comparison};
use std::{
    path::{Path, PathBuf},
    sync::{
        Arc,
        atomic::{AtomicBool, Ordering},
    },
};

/// Compares, and writes what came of it.
///
/// # Errors
/// Wrong usage, a server that fails, a directory that cannot be written to.
pub async fn run(args: CompareArgs) -> Result<(), CliError> {
    let mut job = Job::new(&args)?;
    let narrator = Narrator::new(args.json);
    let environments = Environments::start(args.env_addr.as_deref(), &args.access).await?;
    let outcome = async {
        let directory = |env_id: &str, style: &str| {
            if let Some(out) = &args.out {
                return Ok(out.clone());
            }
            let name = super::fit::directory_name(&["compare", env_id, style]);
            Ok(data_directory(args.data.clone())?.join("reports").join(name))
        };
        let served = environments.connection.list_environments().await?;
        let known = served.iter().any(|spec| spec.env_id == job.env_id);
        let stored = if known { None } else { recorded::find(&mut job, args.data.clone(), narrator).await? };
        let (comparison, out) = if let Some((ground, style, seeds)) = stored {
            let out = directory(&job.env_id, &style)?;
            (compare_on(&job, ground, seeds, &out, narrator).await?, out)
        } else {
            let env_id = job.env_id.clone();
            compare(&job, &environments.connection, narrator, |style| directory(&env_id, style)).await?
        };
        let written = output::write(&job, &comparison, &out)?;
        if args.json {
            let text = output::json(&comparison) + "\n";
            return Ok(std::io::Write::write_all(&mut std::io::stdout().lock(), text.as_bytes())?);
        }
        narrator.line("")?;
        narrator.line(output::table(&job, &comparison))?;
        for path in written {
            narrator.step("wrote", path.display())?;
        }
        Ok(())
    };
    let outcome = outcome.await;
    let stopped = environments.stop().await;
    outcome.and(stopped)
}

/// Makes all fits that the journal of the directory does not have; `directory` names it, given the style.
///
/// # Errors
/// A server that fails, a directory that cannot be written to, an interruption.
pub async fn compare(
    job: &Job,
    environments: &Connection,
    narrator: Narrator,
    directory: impl FnOnce(&str) -> Result<PathBuf, CliError>,
) -> Result<(Comparison, PathBuf), CliError> {
    let scene = Scene::open(
        environments,
        &job.env_id,
        job.env_options.clone(),
        job.style.as_deref(),
        (job.discount(), Some(job.horizon)),
    )
    .await?;
    let out = directory(&scene.style)?;
    narrator.step("model", super::fit::describe(&scene.model))?;
    let seeds = demonstrations(job, &scene, narrator).await?;
    let Scene { model, mdp, truth, .. } = scene;
    let ground = Ground { model, mdp, truth, features: None };
    Ok((compare_on(job, ground, seeds, &out, narrator).await?, out))
}

/// As [`compare`], on demonstrations that are there.
async fn compare_on(
    job: &Job,
    ground: Ground,
    seeds: Vec<Seed>,
    out: &Path,
    narrator: Narrator,
) -> Result<Comparison, CliError> {
    std::fs::create_dir_all(out).map_err(|error| {
        CliError::failure(
            format!("cannot make {}: {error}", out.display()),
            "choose a directory that you may write to with --out DIR",
        )
    })?;
    let (journal, known) = Journal::open(out)?;

    let grid = Arc::new(Grid::new(job, ground, seeds));
    let (mut cells, mut tasks) = (Vec::new(), Vec::new());
    for task in grid.tasks(&job.trajectories) {
        match known.get(&task.key) {
            // Another name for the same options is no other fit.
            Some(cell) => cells.push(grid.named(&task, cell.outcome.clone())),
            None => tasks.push(task),
        }
    }
    if !cells.is_empty() {
        narrator.step("found", format_args!("{} of {} fits, finished before", cells.len(), job.cells()))?;
    }
    cells.extend(fits(job, &grid, tasks, cells.len(), journal, narrator).await?);
    let names: Vec<&str> = job.entries.iter().map(|entry| entry.name.as_str()).collect();
    Ok(Comparison::new(&cells, &names, &job.trajectories, &job.baseline))
}

/// One list of demonstrations a seed, and what its fits are judged by.
async fn demonstrations(job: &Job, scene: &Scene, narrator: Narrator) -> Result<Vec<Seed>, CliError> {
    let most = job.trajectories.last().copied().unwrap_or(1);
    let bar = narrator.bar("drive", u64::from(job.seeds));
    let mut seeds = Vec::new();
    for seed in 0..job.seeds {
        seeds.push(Seed {
            seed,
            demonstrations: scene.demonstrations(seed, most, job.horizon).await?,
            held_out: scene.held_out(seed, job.rollouts, job.horizon).await?,
        });
        bar.inc(1);
    }
    bar.finish_and_clear();
    narrator.step(
        "recorded",
        format_args!("{} lists of {most} demonstrations of {} steps by {}", job.seeds, job.horizon, scene.expert.name),
    )?;
    Ok(seeds)
}

/// Makes fits on threads of their own; each is in the journal before it counts.
async fn fits(
    job: &Job,
    grid: &Arc<Grid>,
    tasks: Vec<grid::Task>,
    found: usize,
    mut journal: Journal,
    narrator: Narrator,
) -> Result<Vec<Cell>, CliError> {
    let bar = narrator.bar("fit", job.cells() as u64);
    bar.set_position(found as u64);
    let cancelled = Arc::new(AtomicBool::new(false));
    let (threads, number) = (job.threads, tasks.len());
    let mut running = tokio::task::spawn_blocking({
        let (grid, cancelled, bar) = (Arc::clone(grid), Arc::clone(&cancelled), bar.clone());
        move || {
            let mut cells = Vec::with_capacity(tasks.len());
            grid.run(&tasks, threads, &cancelled, |finished| {
                journal.append(finished.iter().cloned())?;
                bar.inc(finished.len() as u64);
                cells.extend(finished.into_iter().map(|(_, cell)| cell));
                Ok::<_, std::io::Error>(())
            })
            .map(|()| cells)
        }
    });
    let outcome = tokio::select! {
        outcome = &mut running => outcome,
        _ = tokio::signal::ctrl_c() => {
            cancelled.store(true, Ordering::Relaxed);
            running.await
        }
    };
    bar.finish_and_clear();
    let cells = outcome
        .map_err(|error| CliError::failure(format!("a fit failed: {error}"), "report this as a defect"))?
        .map_err(|error| {
            CliError::failure(
                format!("cannot keep what is finished: {error}"),
                "free some disk space, then run the same command: it goes on from there",
            )
        })?;
    if cells.len() < number {
        return Err(CliError::failure("interrupted", "what is finished is kept; the same command goes on from there"));
    }
    if number > 0 {
        narrator.step("fitted", format_args!("{number} fits, {threads} at a time"))?;
    }
    Ok(cells)
}
