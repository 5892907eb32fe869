//! What is asked beyond a fit: cross-validation over its trajectories, and how well it serves in another model.
//!
//! Both need the trajectories themselves: they come back from the learner service, and the fits of the folds and of the clone
//! run in this process.

use super::{
    args::FitArgs,
    assemble::Learned,
    evaluate::{self, STEPS},
    job::Job,
    narrate::Narrator,
    recordings::{Expert, evaluation_seed},
    services::Services,
};
use crate::cli::{compare::job::env_options, error::CliError, models, scene};
use mazeway_client::{Controller, EnvSpec, FeatureDomain, Model, Options, Rollout};
use mazeway_learner::{
    eval::{
        self,
        transfer::Matching,
        validation::{Validation, cross_validate},
    },
    irl::{self, FitOptions, Problem},
    mdp::{Features, PlanOptions, PlannerKind, Policy, TabularMdp, plan},
    report::{Transfer, TransferRow},
    statistics::Statistics,
    trajectory::{Demonstrations, Trajectory},
};
use mazeway_proto::learner as pb;
use std::ops::ControlFlow;

/// What is asked beyond a fit.
#[derive(Debug, Clone, Default)]
pub struct Extras {
    /// Folds of the cross-validation.
    pub folds: Option<u32>,
    /// Where the reward is planned on anew.
    pub plan_in: Option<PlanIn>,
}

/// Where a reward is planned on anew.
#[derive(Debug, Clone)]
pub enum PlanIn {
    /// In the environment under other options.
    Options(Options),
    /// In a stored model, by the beginning of its id.
    Model(String),
}

/// Both answers.
#[derive(Debug, Clone, Default)]
pub struct Answers {
    /// Cross-validation.
    pub validation: Option<Validation>,
    /// Another model.
    pub transfer: Option<Transfer>,
}

impl Extras {
    /// Checks the flags.
    ///
    /// # Errors
    /// Malformed options, a layout that cannot be read: usage errors.
    pub fn new(args: &FitArgs) -> Result<Self, CliError> {
        let asked = !args.plan_in_options.is_empty() || args.plan_in_layout.is_some();
        let plan_in = match &args.plan_in {
            Some(id) => Some(PlanIn::Model(id.clone())),
            None if asked => Some(PlanIn::Options(env_options(&args.plan_in_options, args.plan_in_layout.as_deref())?)),
            None => None,
        };
        Ok(Self { folds: args.folds, plan_in })
    }
}

/// What a fit was made from and what came of it.
pub struct Fitted<'a> {
    /// What was asked.
    pub job: &'a Job,
    /// Environment; `None` where only the learner knows it.
    pub spec: Option<&'a EnvSpec>,
    /// Style in force.
    pub style: &'a str,
    /// Model fitted in.
    pub model: &'a Model,
    /// The same, checked.
    pub mdp: &'a TabularMdp,
    /// As stored.
    pub fit: &'a pb::Fit,
    /// Its arrays.
    pub learned: &'a Learned,
}

/// Answers what was asked.
///
/// # Errors
/// A method that refuses, models that share nothing, a service that fails.
pub async fn answer(
    extras: &Extras,
    fitted: &Fitted<'_>,
    services: &Services,
    narrator: Narrator,
) -> Result<Answers, CliError> {
    if extras.folds.is_none() && extras.plan_in.is_none() {
        return Ok(Answers::default());
    }
    let request = fitted.fit.request.clone().unwrap_or_default();
    let options = mazeway_learner::fit_options(request.options.as_ref()).map_err(|error| wrong(&error))?;
    let trajectories = services.trajectories(fitted.fit).await?;
    let validation = match extras.folds {
        None => None,
        Some(folds) => {
            let spinner = narrator.spinner("validate");
            let features = features_of(fitted.model)?;
            let (mdp, data, options, method) =
                (fitted.mdp.clone(), trajectories.clone(), options.clone(), fitted.job.method);
            let validated = tokio::task::spawn_blocking(move || {
                let method = irl::method(method).ok_or_else(|| wrong(&"unknown method"))?;
                cross_validate(method, (&mdp, features.as_ref()), &options, &data, folds).map_err(|error| {
                    CliError::failure(
                        format!("cannot cross-validate: {error}"),
                        "choose another number of --folds, or none",
                    )
                })
            });
            let validation = validated.await.map_err(|error| wrong(&error))??;
            spinner.finish_and_clear();
            narrator.step("validated", format_args!("{folds} folds of {} trajectories", trajectories.len()))?;
            Some(validation)
        }
    };
    let transfer = match &extras.plan_in {
        None => None,
        Some(plan_in) => {
            let transfer = transfer(plan_in, fitted, &options, &trajectories, services).await?;
            narrator.step("transferred", &transfer.target)?;
            Some(transfer)
        }
    };
    Ok(Answers { validation, transfer })
}

/// Plans on the learned reward in another model, beside policies that are carried over as they are.
async fn transfer(
    plan_in: &PlanIn,
    fitted: &Fitted<'_>,
    options: &FitOptions,
    trajectories: &[Trajectory],
    services: &Services,
) -> Result<Transfer, CliError> {
    let (job, learned) = (fitted.job, fitted.learned);
    let (target, told, driven) = target(plan_in, fitted, services).await?;
    let target_mdp = scene::checked(&target)?;
    let truth = scene::truth((job.discount(), job.horizon), fitted.style, &target, &target_mdp)?;
    let matching = Matching::new((fitted.mdp, &fitted.model.state_labels), (&target_mdp, &target.state_labels))
        .map_err(|error| {
            CliError::failure(error.to_string(), "plan in a model with the same actions and labelled states")
        })?;

    let plan_options =
        PlanOptions { discount: options.discount, horizon: options.horizon, horizon_prior: options.horizon_prior };
    let planner = own_planner(fitted, options, &plan_options)?;
    let refused = |error: &dyn std::fmt::Display| {
        CliError::failure(format!("cannot plan in the other model: {error}"), "try another --planner")
    };
    let planned =
        matching.plan(&target_mdp, &learned.reward, planner, &plan_options).map_err(|error| refused(&error))?;
    let clone = clone_of(fitted.mdp, options, trajectories)?;

    let mut acting = vec![
        (format!("{}: its reward, planned on anew", job.method), planned.into_probabilities()),
        (format!("{}: its policy, unchanged", job.method), matching.policy(&learned.greedy_policy)),
        ("bc: its policy, unchanged".to_owned(), matching.policy(&clone)),
    ];
    if let Some(truth) = &truth {
        acting.push(("the optimal policy there".to_owned(), truth.optimal_policy.clone()));
    }
    let n_actions = target_mdp.n_actions();
    let counts_events = driven.is_some() && fitted.spec.is_some_and(evaluate::counts_events);
    let env_options = driven.unwrap_or_default();
    if truth.is_none() && !counts_events {
        return Err(CliError::failure(
            format!("nothing to judge by in {told}: no reward of style '{}' is known there", fitted.style),
            "import a model with that style's reward, or plan in the environment with --plan-in-option",
        ));
    }
    let drive = async |controller: Controller, burn_in_steps: u32| {
        let rollout = Rollout {
            options: env_options.clone(),
            seed: evaluation_seed(job.seed),
            totals_only: true,
            burn_in_steps,
            ..Rollout::new(&job.env_id, controller, job.rollouts, STEPS)
        };
        services.rollout(rollout, |_| ()).await.map(|episodes| evaluate::metrics(&episodes))
    };
    let mut rows = Vec::new();
    for (name, policy) in acting {
        let (mut agreement, mut lost) = (None, None);
        if let Some(truth) = &truth {
            let checked = Policy::new(n_actions, policy.clone()).map_err(|error| wrong(&error))?;
            let difference = eval::expected_value_difference(
                &target_mdp,
                &truth.reward,
                options.discount,
                options.horizon,
                &checked,
            )
            .map_err(|error| refused(&error))?;
            agreement = Some(eval::state_agreement(&policy, &truth.optimal_policy, n_actions));
            lost = Some(difference.difference);
        }
        let metrics = if counts_events { drive(Controller::Policy(policy), 0).await? } else { None };
        rows.push(TransferRow { name, agreement, expected_value_difference: lost, metrics });
    }
    if counts_events && fitted.spec.is_some_and(|spec| spec.drivers.iter().any(|(name, _)| name == fitted.style)) {
        let expert = Expert::driver(fitted.style);
        let metrics = drive(expert.controller, 0).await?;
        rows.push(TransferRow {
            name: "the expert there".to_owned(),
            agreement: None,
            expected_value_difference: None,
            metrics,
        });
    }
    Ok(Transfer { target: told, new_states: matching.unmatched() as u64, rows })
}

/// The other model, what it is called, and the options to drive there where a server simulates it.
async fn target(
    plan_in: &PlanIn,
    fitted: &Fitted<'_>,
    services: &Services,
) -> Result<(Model, String, Option<Options>), CliError> {
    let job = fitted.job;
    match (plan_in, fitted.spec) {
        (PlanIn::Options(plan_in), Some(spec)) => {
            let mut options = job.env_options.clone();
            options.extend(plan_in.clone());
            let model = scene::model(services.environments()?, spec, &options).await?;
            let told = plan_in.iter().map(|(name, value)| match value {
                serde_json::Value::String(text) if text.contains('\n') => {
                    format!("{name} of {} rows", text.lines().count())
                }
                other => format!("{name}={other}"),
            });
            let told = format!("{} with {}", job.env_id, told.collect::<Vec<_>>().join(", "));
            Ok((model, told, Some(options)))
        }
        (PlanIn::Options(_), None) => Err(CliError::usage(
            format!("no server simulates {}, so that it has no options to plan under", job.env_id),
            "name another stored model with --plan-in MODEL; see 'learner list --models'",
        )),
        (PlanIn::Model(asked), _) => {
            // Of any environment: its states decide whether it fits.
            let chosen = models::choose(services.learner(), "", Some(asked)).await?;
            let (id, _) = chosen.ok_or_else(|| {
                CliError::failure(format!("there is no model '{asked}'"), "see the models with 'learner list --models'")
            })?;
            let model = services.learner().model(&id).await?;
            let told = format!("model {} of {}", id.chars().take(12).collect::<String>(), model.env_id);
            Ok((model, told, None))
        }
    }
}

/// The users' features of a model, as the mathematics takes them.
///
/// # Errors
/// They do not belong to it.
pub fn features_of(model: &Model) -> Result<Option<Features>, CliError> {
    let Some(table) = &model.features else { return Ok(None) };
    let (n_states, n_actions) = (model.n_states as usize, model.n_actions as usize);
    let features = match table.domain {
        FeatureDomain::States => Features::of_states(n_states, n_actions, table.names.clone(), &table.values),
        FeatureDomain::StateActions => Features::of_pairs(n_states * n_actions, table.names.clone(), &table.values),
    };
    features.map(Some).map_err(|error| wrong(&error))
}

/// The planner under which the learned reward gives the learned policy: a method may have planned softly, whatever planner was
/// asked for.
fn own_planner(fitted: &Fitted<'_>, options: &FitOptions, plan_options: &PlanOptions) -> Result<PlannerKind, CliError> {
    let mut best = (f64::NEG_INFINITY, options.planner);
    for planner in [options.planner, PlannerKind::SoftValueIteration] {
        let planned = plan(planner, fitted.mdp, &fitted.learned.reward, plan_options).map_err(|error| {
            CliError::failure(format!("cannot plan on the learned reward: {error}"), "try another --planner")
        })?;
        let greedy = planned.greedy_policy();
        let shared: f64 =
            greedy.probabilities().iter().zip(&fitted.learned.greedy_policy).map(|(a, b)| a.min(*b)).sum();
        if shared > best.0 + 1e-9 {
            best = (shared, planner);
        }
    }
    Ok(best.1)
}

/// Behaviour cloning on the same trajectories: its greedy policy.
fn clone_of(mdp: &TabularMdp, options: &FitOptions, trajectories: &[Trajectory]) -> Result<Vec<f64>, CliError> {
    let method = irl::method("bc").ok_or_else(|| wrong(&"no method bc"))?;
    let mut builder = Statistics::builder(mdp.n_states(), mdp.n_actions(), options.horizon);
    builder.extend(trajectories).map_err(|error| wrong(&error))?;
    let statistics = builder.finish().map_err(|error| wrong(&error))?;
    let demonstrations = Demonstrations::new(trajectories.to_vec());
    // A clone has no reward, hence no basis.
    let options = &FitOptions { basis: irl::BasisKind::State, ..options.clone() };
    let problem =
        Problem { mdp, options, statistics: &statistics, demonstrations: Some(&demonstrations), features: None };
    let fit = irl::fit(method, &problem, &mut |_| ControlFlow::Continue(()))
        .map_err(|error| CliError::failure(format!("bc: {error}"), "see 'learner fit --help'"))?;
    Ok(fit.greedy_policy)
}

fn wrong(error: &dyn std::fmt::Display) -> CliError {
    CliError::failure(
        format!("the service describes its fit wrongly: {error}"),
        "check that learner and service are of one version: learner --version",
    )
}
