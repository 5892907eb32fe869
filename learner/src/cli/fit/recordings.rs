//! Which recordings a fit learns from, and the scripted expert that demonstrates where there are none.
//!
//! Invariants: a scripted demonstration is a function of the model, the style and the settings, and its UUID a function of its
//! content, so that a run cut off half-way is completed by the next one and never recorded twice.

use super::{
    job::{Job, Source},
    narrate::Narrator,
    services::Services,
};
use crate::cli::error::CliError;
use mazeway_client::{Controller, Demonstration, EnvSpec, Episodes, Model, Rollout};
use mazeway_proto::learner::{Trajectory, TrajectoryFilter};
use uuid::Uuid;

/// Namespace of the UUIDs of scripted demonstrations.
const NAMESPACE: Uuid = Uuid::from_u128(0x6d61_7a65_7761_7900_8000_0000_0000_0001);

/// Steps that a scripted driver drives before a snapshot, so that snapshots show it in traffic rather than at the start.
const BURN_IN_STEPS: u32 = 20;

/// The scripted expert of a style.
#[derive(Debug, Clone)]
pub struct Expert {
    /// Who acts, as recordings name it.
    pub name: String,
    /// Who acts, as a roll-out takes it.
    pub controller: Controller,
    /// Steps before a recording begins.
    pub burn_in_steps: u32,
}

impl Expert {
    /// A driver that the server knows by the style's name.
    pub fn driver(style: &str) -> Self {
        Self {
            name: format!("driver:{style}"),
            controller: Controller::Driver(style.to_owned()),
            burn_in_steps: BURN_IN_STEPS,
        }
    }

    /// The optimal policy under a known reward; starts as the process does.
    pub fn optimal(policy: Vec<f64>, discount: f64) -> Self {
        Self {
            name: format!("policy:optimal discount={discount}"),
            controller: Controller::Policy(policy),
            burn_in_steps: 0,
        }
    }

    /// The source under which demonstrations with these settings are kept.
    fn source(&self, seed: u32, steps: u32) -> String {
        format!("{} seed={seed} steps={steps}", self.name)
    }
}

/// Seed of the first demonstration; demonstration i is seeded with it + i. Judging roll-outs begin at [`evaluation_seed`].
pub fn demonstration_seed(seed: u32) -> u64 {
    u64::from(seed) << 32
}

/// Seed of the first judging episode: apart from all demonstrations, and the same for every driver.
pub fn evaluation_seed(seed: u32) -> u64 {
    demonstration_seed(seed) + (1 << 31)
}

/// The recordings to fit on.
#[derive(Debug, Clone)]
pub struct Recordings {
    /// What selects them.
    pub filter: TrajectoryFilter,
    /// How many of them.
    pub trajectories: u32,
    /// Steps of each that count; `None`: all.
    pub horizon: Option<u32>,
}

/// A filter that nothing with a seed passes: recordings of people, agents and files.
fn unscripted(filter: &TrajectoryFilter) -> TrajectoryFilter {
    TrajectoryFilter { min_seed: Some(u64::MAX), max_seed: Some(0), ..filter.clone() }
}

/// Finds the recordings that the job asks for; lets the expert demonstrate what is missing.
///
/// # Errors
/// Nothing recorded and no expert or no leave to demonstrate; a service that fails.
pub async fn find(
    job: &Job,
    style: &str,
    spec: &EnvSpec,
    model: &Model,
    expert: Option<&Expert>,
    services: &Services,
    narrator: Narrator,
) -> Result<Recordings, CliError> {
    let base = TrajectoryFilter {
        env_id: job.env_id.clone(),
        style: style.to_owned(),
        model_id: model.model_id.clone(),
        min_steps: job.horizon.unwrap_or(0),
        ..TrajectoryFilter::default()
    };
    let own = match &job.source {
        Source::Preferred => Some(unscripted(&base)),
        Source::Any => Some(base.clone()),
        Source::Named(source) => Some(TrajectoryFilter { source: source.clone(), ..base.clone() }),
        Source::Expert => None,
    };
    if let Some(filter) = own {
        let found = services.count(&filter).await?;
        if let Some(recordings) = recorded(job, filter, found, style)? {
            narrator.step(
                "found",
                format_args!("{found} recordings of style '{style}'; using {}", recordings.trajectories),
            )?;
            return Ok(recordings);
        }
        if matches!(job.source, Source::Named(_) | Source::Any) {
            return Err(nothing_recorded(job, style));
        }
    }
    let Some(expert) = expert else {
        return Err(CliError::failure(
            format!("nothing is recorded for {} under style '{style}', and no scripted expert drives so", job.env_id),
            format!("record it first (see the README), or choose a style with an expert: {}", spec.styles.join(", ")),
        ));
    };
    demonstrated(job, style, model, expert, services, narrator).await
}

/// The recordings of people, agents and files, where there are any.
fn recorded(job: &Job, filter: TrajectoryFilter, found: u64, style: &str) -> Result<Option<Recordings>, CliError> {
    if found == 0 {
        return Ok(None);
    }
    let wanted = job.trajectories.map_or(found, u64::from);
    if wanted > found {
        return Err(CliError::failure(
            format!("expected {wanted} recordings of style '{style}', got {found}"),
            format!("leave out --trajectories to use all {found}, or add --source expert for the scripted expert"),
        ));
    }
    let trajectories = u32::try_from(wanted).map_err(|_| {
        CliError::failure(
            format!("expected at most {} recordings, got {wanted}", u32::MAX),
            "choose how many with --trajectories",
        )
    })?;
    Ok(Some(Recordings { filter, trajectories, horizon: job.horizon }))
}

fn nothing_recorded(job: &Job, style: &str) -> CliError {
    CliError::failure(
        format!("nothing is recorded for {} under style '{style}'", job.env_id),
        "see what is recorded with 'learner list'; leave out --no-demonstrate and --source to let the scripted expert demonstrate",
    )
}

/// The expert's demonstrations: those that are stored, and the missing ones, recorded now.
async fn demonstrated(
    job: &Job,
    style: &str,
    model: &Model,
    expert: &Expert,
    services: &Services,
    narrator: Narrator,
) -> Result<Recordings, CliError> {
    let (default_trajectories, default_horizon) = super::job::default_sizes(&job.env_id);
    let wanted = job.trajectories.unwrap_or(default_trajectories);
    let steps = job.horizon.unwrap_or(default_horizon);
    let source = expert.source(job.seed, steps);
    let first = demonstration_seed(job.seed);
    let filter = TrajectoryFilter {
        env_id: job.env_id.clone(),
        style: style.to_owned(),
        model_id: model.model_id.clone(),
        source: source.clone(),
        min_seed: Some(first),
        max_seed: Some(first + u64::from(wanted)),
        ..TrajectoryFilter::default()
    };
    let found = services.count(&filter).await?;
    if found >= u64::from(wanted) {
        narrator.step("found", format_args!("{found} recordings of style '{style}' by {source}"))?;
    } else if !job.demonstrate {
        return Err(if found == 0 {
            nothing_recorded(job, style)
        } else {
            CliError::failure(
                format!("expected {wanted} recordings of style '{style}', got {found}"),
                format!("add --trajectories {found}, or leave out --no-demonstrate"),
            )
        });
    } else {
        if found > 0 {
            narrator.step("found", format_args!("{found} of {wanted} recordings of style '{style}' by {source}"))?;
        }
        let rollout = Rollout {
            options: job.env_options.clone(),
            seed: first,
            burn_in_steps: expert.burn_in_steps,
            ..Rollout::new(&job.env_id, expert.controller.clone(), wanted, steps)
        };
        let bar = narrator.bar("drive", u64::from(wanted));
        let episodes = services.rollout(rollout, |episodes| bar.inc(episodes)).await?;
        bar.finish_and_clear();
        let bar = narrator.bar("record", u64::from(wanted));
        let trajectories = trajectories(job, style, model, &source, first, &episodes);
        let stored = services.record(trajectories, |acknowledged| bar.set_position(acknowledged)).await?;
        bar.finish_and_clear();
        narrator.step("recorded", format_args!("{stored} demonstrations of {steps} steps by {source}"))?;
    }
    Ok(Recordings { filter, trajectories: wanted, horizon: Some(steps) })
}

/// Episodes as trajectories, each under a UUID that its content decides.
fn trajectories(
    job: &Job,
    style: &str,
    model: &Model,
    source: &str,
    first_seed: u64,
    episodes: &Episodes,
) -> Vec<Trajectory> {
    episodes
        .iter()
        .enumerate()
        .map(|(rank, episode)| {
            let mut trajectory = Trajectory::from(Demonstration {
                env_id: job.env_id.clone(),
                model_id: model.model_id.clone(),
                style: style.to_owned(),
                source: source.to_owned(),
                seed: Some(first_seed + rank as u64),
                n_states: model.n_states,
                n_actions: model.n_actions,
                states: episode.states.to_vec(),
                actions: episode.actions.to_vec(),
                rewards: episode.rewards.to_vec(),
                final_state: Some(episode.final_state),
                terminated: episode.terminated,
                truncated: false,
            });
            trajectory.trajectory_id = content_uuid(&trajectory).to_string();
            trajectory
        })
        .collect()
}

/// A UUID (version 5) over everything that a trajectory says.
fn content_uuid(trajectory: &Trajectory) -> Uuid {
    let mut bytes = Vec::new();
    for text in [&trajectory.env_id, &trajectory.model_id, &trajectory.style, &trajectory.source] {
        bytes.extend((text.len() as u64).to_le_bytes());
        bytes.extend(text.as_bytes());
    }
    bytes.extend(trajectory.seed.unwrap_or_default().to_le_bytes());
    for array in [&trajectory.states, &trajectory.actions, &trajectory.rewards] {
        bytes.extend((array.len() as u64).to_le_bytes());
        bytes.extend(array.as_ref());
    }
    bytes.extend(trajectory.final_state.unwrap_or_default().to_le_bytes());
    bytes.push(u8::from(trajectory.terminated));
    Uuid::new_v5(&NAMESPACE, &bytes)
}
