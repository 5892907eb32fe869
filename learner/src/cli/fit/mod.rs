//! `learner fit`: drive, record, learn, and look.
//!
//! One path: without running services the real ones are started in process, on loopback ports, and talked to through the same
//! client. What a person reads goes to standard output a line a step; see [`narrate`].

mod args;
pub mod assemble;
mod evaluate;
pub mod imported;
pub mod job;
pub mod judge;
pub mod learning;
pub mod narrate;
pub mod recordings;
pub mod services;

pub use args::FitArgs;

use super::{error::CliError, scene};
use evaluate::Policies;
use job::Job;
use judge::{Extras, Fitted};
use mazeway_client::Model;
use mazeway_learner::report::{self, json, table::Terminal, write};
use mazeway_proto::learner::FitRequest;
use narrate::Narrator;
use recordings::{Expert, Recordings};
use services::Services;
use std::{
    path::{Path, PathBuf},
    time::Instant,
};

/// Fits and reports.
///
/// # Errors
/// Wrong usage, nothing to learn from, a service that fails, a report that cannot be written.
pub async fn run(args: FitArgs) -> Result<(), CliError> {
    let narrator = Narrator::new(args.json);
    let (report, out) = make(&args, narrator).await?;
    show(&report, &out, args.json, narrator)
}

/// Fits; returns the report and the directory that it is meant for, which may not be there yet.
///
/// # Errors
/// Wrong usage, nothing to learn from, a service that fails.
pub async fn make(args: &FitArgs, narrator: Narrator) -> Result<(report::Report, PathBuf), CliError> {
    let job = Job::new(args)?;
    let extras = Extras::new(args)?;
    if let Some(out) = &args.out {
        // A report that cannot be written is better known before the work than after it.
        std::fs::create_dir_all(out)
            .map_err(|error| cannot_write(format!("cannot make {}: {error}", out.display())))?;
    }
    let services = Services::start(args, narrator).await?;
    let outcome = tokio::select! {
        outcome = fit(args, &job, &extras, &services, narrator) => outcome,
        // Dropping the calls cancels them; what was acknowledged is stored.
        _ = tokio::signal::ctrl_c() => Err(CliError::failure(
            "interrupted",
            "what was recorded is stored; the same command goes on from there",
        )),
    };
    let stopped = services.stop().await;
    outcome.and_then(|made| stopped.map(|()| made))
}

async fn fit(
    args: &FitArgs,
    job: &Job,
    extras: &Extras,
    services: &Services,
    narrator: Narrator,
) -> Result<(report::Report, PathBuf), CliError> {
    let begun = Instant::now();
    let spec = match (&job.model, services.spec(&job.env_id).await) {
        (None, Ok(spec)) => spec,
        (Some(_), _) => return imported::fit(args, job, extras, services, narrator, begun).await,
        (None, Err(error)) => {
            if services.imported(&job.env_id).await? {
                return imported::fit(args, job, extras, services, narrator, begun).await;
            }
            return Err(error);
        }
    };
    let style = match &job.style {
        Some(style) => style.clone(),
        None => spec.styles.first().cloned().unwrap_or_default(),
    };

    let spinner = narrator.spinner("model");
    let model = services.model(job, &spec).await?;
    services.put_model(&model).await?;
    spinner.finish_and_clear();
    narrator.step("model", describe(&model))?;

    let mdp = scene::checked(&model)?;
    let truth = scene::truth((job.discount(), job.horizon), &style, &model, &mdp)?;
    let expert = match &truth {
        Some(truth) => Some(Expert::optimal(truth.optimal_policy.clone(), job.discount())),
        None => spec.drivers.iter().any(|(name, _)| *name == style && name != "random").then(|| Expert::driver(&style)),
    };
    let recordings = recordings::find(job, &style, &spec, &model, expert.as_ref(), services, narrator).await?;

    let fit = learn(job, &model, &recordings, services, narrator).await?;
    let learned = assemble::Learned::new(&fit)?;
    let policies =
        Policies { greedy: &learned.greedy_policy, stochastic: &learned.policy, n_actions: model.n_actions as usize };
    let judged = evaluate::judge(job, &spec, policies, expert.as_ref(), services, narrator).await?;
    if let Some(evaluation) = judged.evaluation {
        let (episodes, steps) = (evaluation.episodes, evaluation.steps);
        narrator.step("judged", format_args!("{episodes} episodes of up to {steps} steps a driver"))?;
    }
    let fitted =
        Fitted { job, spec: Some(&spec), style: &style, model: &model, mdp: &mdp, fit: &fit, learned: &learned };
    let answers = judge::answer(extras, &fitted, services, narrator).await?;
    let frame = evaluate::frame(job, &learned.greedy_policy, policies.n_actions, services).await?;
    let sources = services::sources(&fit);

    let out = match &args.out {
        Some(out) => out.clone(),
        None => services.data().join("reports").join(directory_name(&[&job.env_id, &style, job.method])),
    };
    let report = assemble::report(assemble::Parts {
        job,
        style: &style,
        model,
        mdp: &mdp,
        truth,
        fit,
        learned,
        judged,
        answers,
        frame: Some(frame),
        features: Vec::new(),
        sources,
        begun,
    })?;
    Ok((report, out))
}

/// Fits on the recordings, with a bar while it runs.
async fn learn(
    job: &Job,
    model: &Model,
    recordings: &Recordings,
    services: &Services,
    narrator: Narrator,
) -> Result<mazeway_proto::learner::Fit, CliError> {
    let basis = job.basis.unwrap_or_else(|| job::default_basis(&job.env_id));
    let mut options = job.options.clone();
    options.horizon = recordings.horizon;
    options.basis = basis.into();
    let request = FitRequest {
        method: job.method.to_owned(),
        filter: Some(recordings.filter.clone()),
        max_trajectories: recordings.trajectories,
        model_id: model.model_id.clone(),
        options: Some(options),
    };
    let spinner = narrator.spinner("fit");
    let fit = services
        .fit(request, |event| {
            if let Some(message) = narrate::fit_event(event) {
                spinner.set_message(message);
            }
        })
        .await?;
    spinner.finish_and_clear();
    narrator.step(
        "fitted",
        format_args!(
            "{} on {} trajectories in {}; fit {}",
            job.method,
            fit.trajectories,
            report::duration(fit.fit_secs),
            fit.fit_id,
        ),
    )?;
    Ok(fit)
}

/// A model in a line.
pub fn describe(model: &Model) -> String {
    let visits: u64 = model.visit_counts.iter().flatten().sum();
    let origin = if model.estimated { format!("estimated from {visits} simulated steps") } else { "exact".to_owned() };
    format!(
        "{}: {} states, {} actions, {} transitions, {origin}",
        model.env_id,
        model.n_states,
        model.n_actions,
        model.next_states.len(),
    )
}

/// Prints the tables or the object, and where the report is.
fn show(report: &report::Report, out: &Path, json: bool, narrator: Narrator) -> Result<(), CliError> {
    let fail = |error: report::ReportError| cannot_write(error.to_string());
    let written = write::write(report, out).map_err(fail)?;
    if json {
        let mut object = json::to_string(report, Some(&written.html));
        object.push('\n');
        return Ok(std::io::Write::write_all(&mut std::io::stdout().lock(), object.as_bytes())?);
    }
    narrator.line("")?;
    narrator.line(report::table::render(report, Terminal::stdout()).map_err(fail)?)?;
    narrator.step("report", written.html.display())?;
    for picture in &written.pictures {
        narrator.step("picture", picture.display())?;
    }
    Ok(())
}

fn cannot_write(message: String) -> CliError {
    CliError::failure(message, "choose a directory that you may write to with --out DIR")
}

/// A directory's name from names that may hold anything.
pub fn directory_name(names: &[&str]) -> String {
    let safe = |name: &str| -> String {
        name.chars().map(|c| if c.is_alphanumeric() || "-_.".contains(c) { c } else { '_' }).collect()
    };
    names.iter().map(|name| safe(name)).collect::<Vec<_>>().join("-")
}

#[cfg(test)]
mod tests {
    use super::directory_name;

    #[test]
    fn a_directory_is_one_component_whatever_the_style() {
        assert_eq!(directory_name(&["Highway-v0", "aggressive", "em-tied"]), "Highway-v0-aggressive-em-tied");
        assert_eq!(directory_name(&["Maze-v0", "../../x y/z"]), "Maze-v0-.._.._x_y_z");
    }
}
