//! The ground of a comparison on what users imported: a stored model with its features, and stored recordings.
//!
//! There is no expert to ask for more: each seed draws its demonstrations from the recordings without putting any back, and
//! what it judges by from the rest. Invariant: what a seed draws is a function of the recordings, in the order in which they
//! were recorded, and of the seed; fewer demonstrations are the first of more.

use super::{
    grid::{Ground, Seed},
    job::Job,
};
use crate::cli::{
    connect::connect_to_data,
    error::CliError,
    fit::{imported, judge::features_of, narrate::Narrator, services::checked},
    models, scene,
};
use mazeway_client::Learner;
use mazeway_learner::trajectory::Trajectory;
use mazeway_proto::learner::TrajectoryFilter;
use rand_core::Rng as _;
use rand_pcg::Pcg64;
use std::path::PathBuf;

/// Stream of the generator that draws recordings.
const STREAM: u128 = 0x636f_6d70_6172_6521;

/// Model, style and demonstrations of an environment that the learner's store knows; `None` where it knows none of that name.
/// The horizon of the job becomes the longest demonstration where none was asked for.
///
/// # Errors
/// A store that cannot be used; too few recordings.
pub async fn find(
    job: &mut Job,
    data: Option<PathBuf>,
    narrator: Narrator,
) -> Result<Option<(Ground, String, Vec<Seed>)>, CliError> {
    let connected = connect_to_data(data).await?;
    let found = gather(job, &connected.learner, narrator).await;
    connected.finish(found).await
}

async fn gather(
    job: &mut Job,
    learner: &Learner,
    narrator: Narrator,
) -> Result<Option<(Ground, String, Vec<Seed>)>, CliError> {
    let Some((id, _)) = models::choose(learner, &job.env_id, None).await? else { return Ok(None) };
    if !job.env_options.is_empty() {
        return Err(CliError::usage(
            format!("no server simulates {}, so that it has no options or layout", job.env_id),
            "leave out --env-option and --layout",
        ));
    }
    let style = imported::style(&job.env_id, job.style.as_deref(), learner).await?;
    let model = learner.model(&id).await?;
    narrator.step("model", models::describe(&model))?;
    let mdp = scene::checked(&model)?;
    let truth = scene::truth((job.discount(), Some(job.horizon)), &style, &model, &mdp)?;
    let features = features_of(&model)?;
    let recordings = recordings(job, &style, &id, learner).await?;
    let most = job.trajectories.last().copied().unwrap_or(1) as usize;
    if recordings.len() <= most {
        return Err(CliError::failure(
            format!(
                "expected more than {most} recordings of style '{style}', {most} to learn from and some to judge by, got {}",
                recordings.len()
            ),
            "compare with fewer --trajectories, or import more demonstrations",
        ));
    }
    job.set_horizon(recordings.iter().map(Trajectory::len).max().unwrap_or(1) as u32);
    let seeds = (0..job.seeds).map(|seed| draw(&recordings, seed, most, job)).collect::<Vec<_>>();
    let held_out = seeds.first().map_or(0, |seed| seed.held_out.len());
    narrator.step(
        "drew",
        format_args!(
            "{} lists of {most} of {} recordings of style '{style}', and {held_out} others to judge by",
            job.seeds,
            recordings.len(),
        ),
    )?;
    Ok(Some((Ground { model, mdp, truth, features }, style, seeds)))
}

/// All recordings of a style in a model.
async fn recordings(job: &Job, style: &str, model_id: &str, learner: &Learner) -> Result<Vec<Trajectory>, CliError> {
    let filter = TrajectoryFilter {
        env_id: job.env_id.clone(),
        style: style.to_owned(),
        model_id: model_id.to_owned(),
        ..TrajectoryFilter::default()
    };
    let (mut all, mut steps) = (Vec::new(), 0);
    let mut pages = learner.export_trajectories(&filter).await?;
    while let Some(page) = pages.next().await? {
        for trajectory in &page {
            let recording = checked(trajectory)?;
            if !recording.has_actions() {
                return Err(CliError::failure(
                    format!("expected recordings with actions, trajectory {} has none", trajectory.trajectory_id),
                    "'learner fit' learns from states alone; a comparison is judged by actions",
                ));
            }
            steps += recording.len() as u64;
            job.check_steps(steps)?;
            all.push(recording);
        }
    }
    Ok(all)
}

/// What a seed learns from and what it is judged by.
fn draw(recordings: &[Trajectory], seed: u32, most: usize, job: &Job) -> Seed {
    let mut random = Pcg64::new(u128::from(seed), STREAM);
    let mut order: Vec<usize> = (0..recordings.len()).collect();
    let wanted = recordings.len().min(most + job.rollouts as usize);
    for rank in 0..wanted {
        // of so few, the bias of a remainder cannot be seen
        let other = rank + (random.next_u64() % (order.len() - rank) as u64) as usize;
        order.swap(rank, other);
    }
    let cut = |&rank: &usize| recordings[rank].clone().truncated(job.horizon as usize);
    Seed {
        seed,
        demonstrations: order[..most].iter().map(cut).collect(),
        held_out: order[most..wanted].iter().map(cut).collect(),
    }
}
