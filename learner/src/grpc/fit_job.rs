//! A fit from the request to the message that is stored: checked without I/O first, then run where it may block.

use super::{from_proto, options, status::CallError};
use crate::{
    config::Limits,
    eval,
    irl::{self, BasisKind, FitError, FitOptions, LatentActions, Method, Problem, TraceEntry},
    mdp::{Features, TabularMdp},
    statistics::{Statistics, StatisticsBuilder},
    store::{
        Collection, FieldError, Filter, IdList, Model, Store, Stored, check_model_id, clip, pack_f64, unpack_f64,
        unpack_u32,
    },
    trajectory::Demonstrations,
};
use mazeway_proto::{env::FeatureDomain, learner as pb};
use std::{ops::ControlFlow, time::Instant};
use uuid::Uuid;

/// Trajectories after which a fit looks whether its caller has gone.
const CANCELLED_EVERY: u64 = 64;

/// Sources that a fit names at most.
const MAX_SOURCES: usize = 1000;

/// What a fit is asked to do.
pub struct FitJob {
    request: pb::FitRequest,
    method: &'static dyn Method,
    filter: Filter,
    options: FitOptions,
}

/// The demonstrations of a fit, counted.
struct Data {
    ids: IdList,
    sources: Vec<pb::FitSource>,
    statistics: Statistics,
    demonstrations: Option<Demonstrations>,
    env_id: String,
    style: String,
    model_id: String,
}

impl FitJob {
    /// Checks a request as far as that goes without the data.
    pub fn new(mut request: pb::FitRequest, limits: &Limits) -> Result<Self, CallError> {
        let method = irl::method(&request.method).ok_or_else(|| {
            let known = irl::METHODS.iter().map(|method| method.id()).collect::<Vec<_>>().join(", ");
            CallError::field("method", format!("expected one of {known}, got {:?}", clip(&request.method)))
        })?;
        let filter = from_proto::filter(request.filter.clone())?;
        check_model_id("model_id", &request.model_id)?;
        let options = options::from_proto(request.options.as_ref())?;
        // What is kept of a fit grows with its iterations, what a planner holds with the horizon.
        for (field, what, limit, got) in [
            ("options.max_iterations", "iterations", limits.max_fit_iterations, options.max_iterations),
            ("options.horizon", "steps", limits.max_steps_per_trajectory as u32, options.horizon.unwrap_or(0)),
        ] {
            if got > limit {
                return Err(CallError::Limit { field: field.into(), what, limit: limit.into(), got: got.into() });
            }
        }
        request.options = Some(options::to_proto(&options));
        request.filter.get_or_insert_default();
        Ok(Self { request, method, filter, options })
    }

    /// Its method.
    pub fn method_id(&self) -> &'static str {
        self.method.id()
    }

    /// Reads the data, fits, and says everything that is worth storing, and the ids of the trajectories used. Calls
    /// `progress` after every iteration and asks `cancelled` between trajectories; blocks.
    pub fn run(
        self,
        store: &Store,
        mut progress: impl FnMut(&TraceEntry) -> ControlFlow<()>,
        cancelled: impl Fn() -> bool,
    ) -> Result<(pb::Fit, IdList), CallError> {
        let load = |model_id: &str| {
            store.model(model_id)?.ok_or_else(|| CallError::NotFound {
                field: "model_id",
                what: "model",
                id: model_id.to_owned(),
            })
        };
        // A model that is asked for is looked for before anything is read.
        let asked = if self.request.model_id.is_empty() { None } else { Some(load(&self.request.model_id)?) };
        let data = self.gather(store, cancelled)?;
        let model = asked.map_or_else(|| load(&data.model_id), Ok)?;
        check_sizes(&model, &data)?;
        let mdp = mdp(&model)?;
        let features = features(&model)?;
        let problem = Problem {
            mdp: &mdp,
            options: &self.options,
            statistics: &data.statistics,
            demonstrations: data.demonstrations.as_ref(),
            features: features.as_ref(),
        };
        let begun = Instant::now();
        let fit = irl::fit(self.method, &problem, &mut progress).map_err(refused)?;
        let judged = judge(&mdp, &data.statistics, &fit)?;
        let feature_names = match (&features, self.options.basis) {
            (Some(features), BasisKind::Features) if self.options.features.is_empty() => features.names().to_vec(),
            (_, BasisKind::Features) => self.options.features.clone(),
            _ => Vec::new(),
        };
        let mut described = self.describe(&model, &data, &fit, judged, begun.elapsed().as_secs_f64());
        described.feature_names = feature_names;
        described.warnings.extend(unseen_pairs(&model));
        Ok((described, data.ids))
    }

    /// Streams the trajectories through the counts.
    fn gather(&self, store: &Store, cancelled: impl Fn() -> bool) -> Result<Data, CallError> {
        let mut gathering = Gathering::new(self, store.id_list());
        let wanted = u64::from(self.request.max_trajectories);
        let outcome = store.for_each(&self.filter, |stored| {
            if gathering.ids.len().is_multiple_of(CANCELLED_EVERY) && cancelled() {
                return ControlFlow::Break(Err(CallError::Cancelled));
            }
            if let Err(error) = gathering.add(stored) {
                return ControlFlow::Break(Err(error));
            }
            if gathering.ids.len() == wanted { ControlFlow::Break(Ok(())) } else { ControlFlow::Continue(()) }
        })?;
        if let ControlFlow::Break(Err(error)) = outcome {
            return Err(error);
        }
        gathering.finish()
    }

    fn describe(self, model: &Model, data: &Data, fit: &irl::Fit, judged: Judged, fit_secs: f64) -> pb::Fit {
        let mut described = pb::Fit {
            fit_id: Uuid::new_v4().to_string(),
            created_at: None,
            version: env!("CARGO_PKG_VERSION").into(),
            env_id: data.env_id.clone(),
            style: data.style.clone(),
            model_id: model.model_id().into(),
            n_states: model.header().n_states,
            n_actions: model.header().n_actions,
            sources: data.sources.clone(),
            pair_visits: pack_f64(&data.statistics.counts(None)),
            longest: data.statistics.longest(),
            steps: data.statistics.n_steps(None),
            weights: pack_f64(&fit.weights),
            posterior: fit.posterior.as_ref().map(posterior_message),
            hyperparameters: fit.hyperparameters.iter().map(hyperparameter_message).collect(),
            standard_errors: fit.standard_errors.as_deref().map(pack_f64).unwrap_or_default(),
            reward: pack_f64(&fit.reward),
            policy: pack_f64(&fit.policy),
            greedy_policy: pack_f64(&fit.greedy_policy),
            state_values: pack_f64(&fit.state_values),
            state_visits: pack_f64(&data.statistics.state_visits(None)),
            trace: fit.trace.iter().map(progress_message).collect(),
            stopped: options::stopped(fit.stopped) as i32,
            iterations: fit.iterations,
            fit_secs,
            warnings: fit.warnings.clone(),
            feature_names: Vec::new(),
            log_likelihood_per_step: judged.log_likelihood_per_step,
            agreement: judged.agreement,
            states_covered: data.statistics.states_covered(None) as u32,
            request: Some(self.request),
            ..pb::Fit::default()
        };
        data.ids.describe(&mut described);
        described
    }
}

/// How well a fit explains the data that it was made from.
struct Judged {
    log_likelihood_per_step: f64,
    agreement: f64,
}

/// Where actions were not seen, the likelihood is that of the transitions, and the agreement an expected one.
fn judge(mdp: &TabularMdp, statistics: &Statistics, fit: &irl::Fit) -> Result<Judged, CallError> {
    if statistics.latent().is_empty() {
        let counts = statistics.counts(None);
        return Ok(Judged {
            log_likelihood_per_step: eval::log_likelihood_per_step(&fit.policy, &counts),
            agreement: eval::step_agreement(&fit.greedy_policy, &counts),
        });
    }
    let latent = LatentActions::new(mdp, statistics, None).map_err(refused)?;
    let steps = statistics.n_steps(None) as f64;
    Ok(Judged {
        log_likelihood_per_step: latent.log_likelihood(&fit.policy) / steps,
        agreement: eval::step_agreement(&fit.greedy_policy, &latent.complete(&fit.policy).counts(None)),
    })
}

/// Model and data must belong to processes of one size.
fn check_sizes(model: &Model, data: &Data) -> Result<(), CallError> {
    let (n_states, n_actions) = (model.header().n_states as usize, model.header().n_actions as usize);
    let (s, a) = (data.statistics.n_states(), data.statistics.n_actions());
    if (n_states, n_actions) == (s, a) {
        return Ok(());
    }
    let message = format!(
        "expected a model of {s} states and {a} actions as the trajectories have, got {n_states} states and \
         {n_actions} actions"
    );
    Err(CallError::field("model_id", message))
}

/// One iteration on the wire.
pub fn progress_message(entry: &TraceEntry) -> pb::FitProgress {
    pb::FitProgress {
        iteration: entry.iteration,
        objective: entry.objective,
        change: entry.change,
        elapsed_secs: entry.elapsed_secs,
    }
}

/// A posterior on the wire.
fn posterior_message(posterior: &irl::Posterior) -> pb::Posterior {
    pb::Posterior {
        standard_deviations: pack_f64(&posterior.standard_deviations),
        low: pack_f64(&posterior.low),
        high: pack_f64(&posterior.high),
        diagnostics: posterior.diagnostics.as_ref().map(|diagnostics| pb::Diagnostics {
            chains: diagnostics.chains,
            draws: diagnostics.draws,
            acceptance: diagnostics.acceptance,
            split_rhat: pack_f64(&diagnostics.split_rhat),
            effective_sample_size: pack_f64(&diagnostics.effective_sample_size),
        }),
    }
}

/// A learned number on the wire.
fn hyperparameter_message(hyperparameter: &irl::Hyperparameter) -> pb::Hyperparameter {
    pb::Hyperparameter { name: hyperparameter.name.clone(), value: hyperparameter.value }
}

/// Trajectories as they come in.
struct Gathering<'a> {
    job: &'a FitJob,
    builder: Option<StatisticsBuilder>,
    demonstrations: Option<Demonstrations>,
    ids: IdList,
    sources: Vec<pb::FitSource>,
    /// Of the first trajectory; a label in which another one differs is emptied.
    first: Collection,
    /// The collection of the last trajectory, and its source's rank.
    last: Option<(i64, usize)>,
}

impl<'a> Gathering<'a> {
    fn new(job: &'a FitJob, ids: IdList) -> Self {
        Self {
            job,
            builder: None,
            demonstrations: job.method.needs_demonstrations().then(Demonstrations::default),
            ids,
            sources: Vec::new(),
            first: Collection::default(),
            last: None,
        }
    }

    fn add(&mut self, stored: &Stored<'_>) -> Result<(), CallError> {
        let source = match self.last {
            Some((row, source)) if row == stored.collection_row() => source,
            _ => self.enter(stored)?,
        };
        let corrupt = |e: &dyn std::fmt::Display| CallError::Internal(format!("trajectory {}: {e}", stored.id()));
        let (states, actions) = (stored.states(), stored.actions());
        if let (true, Some(builder)) =
            (self.demonstrations.is_none() && states.len() == actions.len(), &mut self.builder)
        {
            // as they are stored: nothing is unpacked or kept
            builder.add_packed(states, actions).map_err(|e| corrupt(&e))?;
        } else {
            let trajectory = stored.recording().trajectory().map_err(|e| corrupt(&e))?;
            if let Some(builder) = &mut self.builder {
                builder.add(&trajectory).map_err(|e| corrupt(&e))?;
            }
            if let Some(demonstrations) = &mut self.demonstrations {
                demonstrations.push(match self.job.options.horizon {
                    Some(horizon) => trajectory.truncated(horizon as usize),
                    None => trajectory,
                });
            }
        }
        if let Some(source) = self.sources.get_mut(source) {
            source.trajectories += 1;
        }
        Ok(self.ids.push(stored.id())?)
    }

    /// A trajectory that has not all in common with the last one. Returns its source's rank.
    fn enter(&mut self, stored: &Stored<'_>) -> Result<usize, CallError> {
        let collection = stored.collection();
        if self.builder.is_none() {
            let (n_states, n_actions) = (collection.n_states as usize, collection.n_actions as usize);
            self.builder = Some(Statistics::builder(n_states, n_actions, self.job.options.horizon));
            self.first = collection.clone();
        }
        self.check_same_process(stored)?;
        if self.first.env_id != collection.env_id {
            self.first.env_id.clear();
        }
        if self.first.style != collection.style {
            self.first.style.clear();
        }
        let known = self.sources.iter().position(|known| known.source == collection.source);
        let source = known.unwrap_or(self.sources.len());
        if source == self.sources.len() && source < MAX_SOURCES {
            self.sources.push(pb::FitSource { source: collection.source.clone(), trajectories: 0 });
        }
        self.last = Some((stored.collection_row(), source));
        Ok(source)
    }

    /// One fit, one process: the model that is asked for, or the one that all trajectories name.
    fn check_same_process(&self, stored: &Stored<'_>) -> Result<(), CallError> {
        let (first, this) = (&self.first, stored.collection());
        let refuse = |kind, message| Err(CallError::Precondition { kind, field: "model_id", message });
        if self.job.request.model_id.is_empty() {
            if this.model_id.is_empty() {
                return refuse("NO_MODEL", format!("trajectory {} names no model, and none is asked for", stored.id()));
            }
            if this.model_id != first.model_id {
                let message = format!(
                    "expected trajectories of one model, got {} and {}; name one in filter.model_id",
                    first.model_id, this.model_id
                );
                return refuse("SEVERAL_MODELS", message);
            }
        }
        if (this.n_states, this.n_actions) != (first.n_states, first.n_actions) {
            let message = format!(
                "expected trajectories of one process, got {} states and {} actions beside {} states and {} actions",
                first.n_states, first.n_actions, this.n_states, this.n_actions
            );
            return refuse("SEVERAL_PROCESSES", message);
        }
        Ok(())
    }

    fn finish(self) -> Result<Data, CallError> {
        let (wanted, found) = (u64::from(self.job.request.max_trajectories), self.ids.len());
        let missing = |message| CallError::Precondition { kind: "TOO_FEW_TRAJECTORIES", field: "filter", message };
        let Some(builder) = self.builder else {
            let wanted = wanted.max(1);
            return Err(missing(format!("expected at least {wanted} trajectories, the filter selects 0")));
        };
        if found < wanted {
            return Err(missing(format!("expected at least {wanted} trajectories, the filter selects {found}")));
        }
        Ok(Data {
            ids: self.ids,
            sources: self.sources,
            statistics: builder.finish().map_err(|e| CallError::Internal(e.to_string()))?,
            demonstrations: self.demonstrations,
            env_id: self.first.env_id,
            style: self.first.style,
            model_id: self.first.model_id,
        })
    }
}

/// The process that a stored model describes.
fn mdp(model: &Model) -> Result<TabularMdp, CallError> {
    let (header, rows) = (model.header(), model.rows());
    let mut row_offsets = Vec::with_capacity(rows.row_lengths.len() / 4 + 1);
    row_offsets.push(0);
    let mut end = 0;
    row_offsets.extend(unpack_u32(&rows.row_lengths).map(|length| {
        end += length as usize;
        end
    }));
    let start = &header.initial_distribution;
    TabularMdp::new(
        header.n_states as usize,
        header.n_actions as usize,
        row_offsets,
        unpack_u32(&rows.next_states).collect(),
        unpack_f64(&rows.probabilities).collect(),
        if start.is_empty() { None } else { Some(unpack_f64(start).collect()) },
    )
    .map_err(|e| CallError::Internal(format!("model {}: {e}", model.model_id())))
}

/// The features of a stored model, spread over its state-action pairs.
fn features(model: &Model) -> Result<Option<Features>, CallError> {
    let header = model.header();
    let Some(table) = &header.features else { return Ok(None) };
    let (n_states, n_actions) = (header.n_states as usize, header.n_actions as usize);
    let (names, values) = (table.names.clone(), unpack_f64(&table.values).collect::<Vec<_>>());
    let features = match FeatureDomain::try_from(table.domain) {
        Ok(FeatureDomain::State) => Features::of_states(n_states, n_actions, names, &values),
        _ => Features::of_pairs(n_states * n_actions, names, &values),
    };
    features.map(Some).map_err(|e| CallError::Internal(format!("model {}: {e}", model.model_id())))
}

/// Says where an estimated model has no data to go by.
fn unseen_pairs(model: &Model) -> Option<String> {
    let counts = &model.rows().visit_counts;
    let unseen = counts.chunks_exact(8).filter(|count| count.iter().all(|&byte| byte == 0)).count();
    (model.header().estimated && unseen > 0).then(|| {
        let all = counts.len() / 8;
        format!("the model has no data for {unseen} of {all} state-action pairs: what they lead to is a guess")
    })
}

/// Why a method refused.
fn refused(error: FitError) -> CallError {
    match error {
        FitError::Cancelled => CallError::Cancelled,
        FitError::InvalidOption { field, message } => FieldError::new(format!("options.{field}"), message).into(),
        FitError::TooLarge { what, limit, got } => {
            CallError::Limit { field: "model_id".into(), what, limit: limit as u64, got: got as u64 }
        }
        FitError::Plan(error) => CallError::field("options.planner", error.to_string()),
        FitError::NeedsActions { .. } => CallError::field("method", error.to_string()),
        FitError::ImpossibleTransitions { .. } => {
            CallError::Precondition { kind: "IMPOSSIBLE_TRANSITIONS", field: "filter", message: error.to_string() }
        }
        FitError::Mismatch { .. } | FitError::NeedsDemonstrations { .. } | FitError::LatentActions { .. } => {
            CallError::Internal(error.to_string())
        }
    }
}
