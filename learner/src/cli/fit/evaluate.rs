//! How well a fit does: the learned policy let loose on the server, beside the expert and a random driver, and, where the true
//! reward is known, the value that is lost by acting on the learned one.
//!
//! All drivers face the same seeds, none of which the demonstrations used.

use super::{
    job::Job,
    narrate::Narrator,
    recordings::{Expert, evaluation_seed},
    services::Services,
};
use crate::cli::error::CliError;
use mazeway_client::{Controller, EnvSpec, Episodes, Rollout, SessionOptions};
use mazeway_learner::{
    eval,
    report::{DriverMetrics, Drivers, Evaluation},
};

/// Steps of one judging episode.
pub const STEPS: u32 = 200;

/// What the judging roll-outs show.
#[derive(Debug, Clone)]
pub struct Judged {
    /// The drivers side by side; `None` where the environment does not count their events.
    pub drivers: Option<Drivers>,
    /// Share of the expert's steps, none of them demonstrated, whose action the greedy policy takes.
    pub agreement: Option<f64>,
    /// Mean log π(a|s) of the same steps.
    pub log_likelihood_per_step: Option<f64>,
    /// The roll-outs behind these numbers, where there were any.
    pub evaluation: Option<Evaluation>,
}

impl Judged {
    /// Nothing was rolled out.
    pub const NONE: Self = Self { drivers: None, agreement: None, log_likelihood_per_step: None, evaluation: None };
}

/// Summed info columns that describe a driver.
const EVENTS: [&str; 4] = ["speed_mps", "collisions", "overtakes_left", "overtakes_right"];

/// Whether an environment counts what drivers do.
pub fn counts_events(spec: &EnvSpec) -> bool {
    EVENTS.iter().all(|name| spec.info_columns.iter().any(|c| c.summed && c.name == *name))
}

/// Rolls out the expert and, where the environment counts what drivers do, the learned and a random one.
///
/// # Errors
/// The server fails.
pub async fn judge(
    job: &Job,
    spec: &EnvSpec,
    policies: Policies<'_>,
    expert: Option<&Expert>,
    services: &Services,
    narrator: Narrator,
) -> Result<Judged, CliError> {
    let evaluation =
        Evaluation { episodes: u64::from(job.rollouts), steps: u64::from(STEPS), seed: evaluation_seed(job.seed) };
    let counts_events = counts_events(spec);
    let runs = u64::from(expert.is_some()) + if counts_events { 2 } else { 0 };
    let bar = narrator.bar("judge", u64::from(job.rollouts) * runs);
    let drive = async |controller: Controller, totals_only: bool| {
        let rollout = Rollout {
            options: job.env_options.clone(),
            seed: evaluation.seed,
            totals_only,
            ..Rollout::new(&job.env_id, controller, job.rollouts, STEPS)
        };
        services.rollout(rollout, |episodes| bar.inc(episodes)).await
    };
    let expert = match expert {
        Some(expert) => Some(drive(expert.controller.clone(), false).await?),
        None => None,
    };
    let drivers = if counts_events {
        let learned = drive(Controller::Policy(policies.greedy.to_vec()), true).await?;
        let random = drive(Controller::driver("random"), true).await?;
        metrics(&learned).zip(metrics(&random)).map(|(learned, random)| Drivers {
            expert: expert.as_ref().and_then(metrics),
            learned,
            random,
        })
    } else {
        None
    };
    bar.finish_and_clear();
    let seen = expert.as_ref().map(|episodes| pairs(episodes, policies.n_actions, policies.greedy.len()));
    Ok(Judged {
        drivers,
        agreement: seen.as_ref().map(|counts| eval::step_agreement(policies.greedy, counts)),
        log_likelihood_per_step: seen.as_ref().map(|counts| eval::log_likelihood_per_step(policies.stochastic, counts)),
        evaluation: Some(evaluation),
    })
}

/// What a fit learned, shape `(n_states, n_actions)` each.
#[derive(Debug, Clone, Copy)]
pub struct Policies<'a> {
    /// To act with.
    pub greedy: &'a [f64],
    /// That explains the demonstrations.
    pub stochastic: &'a [f64],
    /// Number of actions.
    pub n_actions: usize,
}

/// How often each state-action pair occurs, shape `(n_states * n_actions,)`.
fn pairs(episodes: &Episodes, n_actions: usize, n_pairs: usize) -> Vec<f64> {
    let mut counts = vec![0.0; n_pairs];
    for (&state, &action) in episodes.states.iter().zip(&episodes.actions) {
        counts[state as usize * n_actions + action as usize] += 1.0;
    }
    counts
}

/// Means per step with their confidence intervals over episodes; `None` where the environment counts no such events.
pub fn metrics(episodes: &Episodes) -> Option<DriverMetrics> {
    let column = |name: &str| {
        let totals = episodes.total(name)?.iter().zip(&episodes.lengths);
        let samples: Vec<_> = totals.map(|(&total, &steps)| (total, f64::from(steps))).collect();
        eval::ratio_interval(&samples)
    };
    let [speed_mps, collisions, overtakes_left, overtakes_right] = EVENTS.map(column);
    Some(DriverMetrics {
        speed_mps: speed_mps?,
        collisions: collisions?,
        overtakes_left: overtakes_left?,
        overtakes_right: overtakes_right?,
    })
}

/// A frame of the environment some way into an episode that the greedy policy drives.
///
/// # Errors
/// The server fails.
pub async fn frame(job: &Job, greedy: &[f64], n_actions: usize, services: &Services) -> Result<Vec<u8>, CliError> {
    const STEPS: usize = 40;
    let options = SessionOptions { options: job.env_options.clone(), ..SessionOptions::default() };
    let mut env = services.env(&job.env_id, options).await?;
    let (mut observation, _) = env.reset(Some(evaluation_seed(job.seed))).await.map_err(CliError::from)?;
    for _ in 0..STEPS {
        // Where the observation is not the tabular state, any action will do for a picture.
        let state = observation.discrete().unwrap_or(0) as usize;
        let row = greedy.chunks_exact(n_actions).nth(state).unwrap_or(&[]);
        let best = row.iter().enumerate().max_by(|a, b| a.1.total_cmp(b.1)).map_or(0, |(action, _)| action as u32);
        let step = env.step(best).await.map_err(CliError::from)?;
        if step.terminated || step.truncated {
            break;
        }
        observation = step.observation;
    }
    let png = env.render_png().await.map_err(CliError::from)?;
    env.close().await.map_err(CliError::from)?;
    Ok(png.to_vec())
}
