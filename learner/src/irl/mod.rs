//! Inverse reinforcement learning: one file a method, one trait, one registry.
//!
//! A method takes a [`Problem`] and returns a [`Fit`]. Stopping is a value: a fit that did not converge still gives its
//! best. Deliberately absent: where the data come from and where the fit goes.

#![expect(clippy::doc_markdown, reason = "formulae in the notation of the papers are not code")]

mod apprenticeship;
mod basis;
mod bc;
mod bc_planning;
mod birl;
mod bounded;
mod diagnostics;
mod em;
mod em_features;
mod em_mixture;
pub mod em_tied;
mod gpirl;
mod latent;
mod lp;
mod maxent;
mod mce;
pub mod nnls;
mod options;
mod penalty;
mod random;
mod simplex;
mod stationary;
mod temperature;
#[cfg(test)]
mod test_cases;
mod visits;

pub use crate::mdp::{HorizonPrior, PlannerKind};
pub use basis::Basis;
pub use latent::LatentActions;
pub use options::{BasisKind, FitOptions, MStep, Penalty, PosteriorKind, Responsibility, RewardPrior};

use self::temperature::most_likely_boltzmann;
use crate::mdp::{Features, FeaturesError, PlanError, PlanOptions, TabularMdp, plan};
use crate::statistics::Statistics;
use crate::trajectory::Demonstrations;
use serde::{Deserialize, Serialize};
use std::ops::ControlFlow;
use std::time::Instant;

/// What a method is given.
#[derive(Debug, Clone, Copy)]
pub struct Problem<'a> {
    /// The process that the expert acted in.
    pub mdp: &'a TabularMdp,
    /// How to fit.
    pub options: &'a FitOptions,
    /// Counts of what the expert did.
    pub statistics: &'a Statistics,
    /// The trajectories themselves, where [`Method::needs_demonstrations`] asks for them.
    pub demonstrations: Option<&'a Demonstrations>,
    /// The user's features, where there are any.
    pub features: Option<&'a Features>,
}

/// A way to learn a reward and a policy.
pub trait Method: Sync {
    /// Its name, as in "em-tied".
    fn id(&self) -> &'static str;

    /// One line about it.
    fn description(&self) -> &'static str;

    /// True where the counts are not enough and [`Problem::demonstrations`] must be there.
    fn needs_demonstrations(&self) -> bool {
        false
    }

    /// Log-density of the method's prior at a fit, up to a constant: what it adds to the log-likelihood of the demonstrated
    /// actions, 0 for a method without penalty.
    fn log_prior(&self, _options: &FitOptions, _fit: &Fit) -> f64 {
        0.0
    }

    /// Fits; calls `progress` after every iteration. Use [`fit`], which also takes demonstrations without actions.
    ///
    /// # Errors
    /// Options or data that the method cannot work with, and cancellation by `progress`.
    fn fit(&self, problem: &Problem<'_>, progress: Progress<'_>) -> Result<Fit, FitError>;
}

/// All methods, the default first.
pub const METHODS: &[&dyn Method] = &[
    &em_tied::EmTied,
    &em::Em,
    &em_mixture::EmMixture,
    &maxent::MaxEnt,
    &mce::Mce,
    &mce::MceLikelihood,
    &apprenticeship::Projection,
    &apprenticeship::MaxMargin,
    &lp::Lp,
    &birl::Birl,
    &gpirl::Gpirl,
    &bc::Bc,
    &bc_planning::BcPlanning,
];

/// The method of a name.
pub fn method(id: &str) -> Option<&'static dyn Method> {
    METHODS.iter().copied().find(|method| method.id() == id)
}

/// Why there is no fit.
#[derive(Debug, Clone, PartialEq, thiserror::Error)]
pub enum FitError {
    /// The progress callback said so.
    #[error("the fit was cancelled")]
    Cancelled,
    /// An option outside its range, or one that does not go with the others.
    #[error("{field}: {message}")]
    InvalidOption {
        /// Name of the field of [`FitOptions`].
        field: &'static str,
        /// What was expected and what came.
        message: String,
    },
    /// Model and data belong to different processes.
    #[error(
        "expected statistics of {n_states} states and {n_actions} actions, got {got_states} states and {got_actions} actions"
    )]
    Mismatch {
        /// States of the model.
        n_states: usize,
        /// Actions of the model.
        n_actions: usize,
        /// States of the data.
        got_states: usize,
        /// Actions of the data.
        got_actions: usize,
    },
    /// A method that needs whole trajectories was given none.
    #[error("method {method} needs the demonstrations themselves, got only their counts")]
    NeedsDemonstrations {
        /// Its name.
        method: &'static str,
    },
    /// A method that cannot infer actions that were not seen.
    #[error("method {method} needs the demonstrations' actions, got demonstrations of states alone")]
    NeedsActions {
        /// Its name.
        method: &'static str,
    },
    /// [`Method::fit`] was given demonstrations without actions.
    #[error("expected demonstrations with actions, got {transitions} transitions without")]
    LatentActions {
        /// How many there are.
        transitions: u64,
    },
    /// Demonstrations without actions that the model cannot make.
    #[error(
        "expected transitions that an action of the model makes, got {count} that none makes, the first from state {state} to \
         state {next_state} at step {step}"
    )]
    ImpossibleTransitions {
        /// How many there are.
        count: u64,
        /// Step of the first.
        step: usize,
        /// Where it begins.
        state: u32,
        /// Where it ends.
        next_state: u32,
    },
    /// Too large to be solved in memory.
    #[error("expected at most {limit} {what}, got {got}")]
    TooLarge {
        /// What there is too much of.
        what: &'static str,
        /// The limit.
        limit: usize,
        /// What came.
        got: usize,
    },
    /// The planner refused.
    #[error(transparent)]
    Plan(#[from] PlanError),
}

impl Problem<'_> {
    /// Checks all that the methods have in common.
    fn check(&self) -> Result<(), FitError> {
        self.check_options()?;
        match self.statistics.latent().total(None) {
            0.0 => Ok(()),
            transitions => Err(FitError::LatentActions { transitions: transitions as u64 }),
        }
    }

    /// Checks options and model against each other.
    fn check_options(&self) -> Result<(), FitError> {
        let (mdp, statistics) = (self.mdp, self.statistics);
        if (mdp.n_states(), mdp.n_actions()) != (statistics.n_states(), statistics.n_actions()) {
            return Err(FitError::Mismatch {
                n_states: mdp.n_states(),
                n_actions: mdp.n_actions(),
                got_states: statistics.n_states(),
                got_actions: statistics.n_actions(),
            });
        }
        match self.features {
            None if self.options.basis == BasisKind::Features => {
                let message = "expected a model with features for the basis features, got none".to_owned();
                return Err(FitError::InvalidOption { field: "basis", message });
            }
            Some(features) if features.n_pairs() != mdp.n_pairs() => {
                let message =
                    format!("expected features of {} state-action pairs, got {}", mdp.n_pairs(), features.n_pairs());
                return Err(FitError::InvalidOption { field: "basis", message });
            }
            _ => {}
        }
        self.options.check()
    }

    /// K of the horizon prior, at least 1.
    fn horizon(&self) -> u32 {
        self.options.horizon.unwrap_or_else(|| self.statistics.longest())
    }

    fn basis(&self) -> Basis {
        match (self.options.basis, self.features) {
            (BasisKind::State, _) => Basis::state(self.mdp),
            (BasisKind::StateAction, _) => Basis::state_action(self.mdp),
            (BasisKind::Features, Some(features)) => Basis::features(features),
            (BasisKind::Features, None) => unreachable!("checked before"),
        }
    }

    fn plan_options(&self) -> PlanOptions {
        PlanOptions {
            discount: self.options.discount,
            horizon: Some(self.horizon()),
            horizon_prior: self.options.horizon_prior,
        }
    }
}

/// Keeps the trace of a fit and tells its caller.
struct Trace<'a> {
    begun: Instant,
    entries: Vec<TraceEntry>,
    progress: Progress<'a>,
}

impl<'a> Trace<'a> {
    fn new(progress: Progress<'a>) -> Self {
        Self { begun: Instant::now(), entries: Vec::new(), progress }
    }

    fn record(&mut self, objective: f64, change: f64) -> Result<(), FitError> {
        let iteration = self.entries.len() as u32 + 1;
        let entry = TraceEntry { iteration, objective, change, elapsed_secs: self.begun.elapsed().as_secs_f64() };
        self.entries.push(entry);
        if (self.progress)(&entry).is_break() { Err(FitError::Cancelled) } else { Ok(()) }
    }

    /// Asks whether to go on where there is nothing new to tell.
    fn check(&mut self) -> Result<(), FitError> {
        match self.entries.last() {
            Some(entry) if (self.progress)(entry).is_break() => Err(FitError::Cancelled),
            _ => Ok(()),
        }
    }
}

/// How a fit stopped.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum Stopped {
    /// The change fell below the tolerance.
    Converged,
    /// The iterations ran out.
    MaxIterations,
    /// No further improvement at this precision.
    Stalled,
    /// Nothing to iterate.
    ClosedForm,
}

/// One iteration of a fit.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
pub struct TraceEntry {
    /// From 1 on.
    pub iteration: u32,
    /// What the method maximises.
    pub objective: f64,
    /// What the stopping rule watches.
    pub change: f64,
    /// Seconds since the fit began; never part of a result's comparison.
    pub elapsed_secs: f64,
}

/// A learned reward and policy.
#[derive(Debug, Clone, PartialEq)]
pub struct Fit {
    /// w, shape (`n_basis`,).
    pub weights: Vec<f64>,
    /// R(s,a), shape (`n_states * n_actions`,).
    pub reward: Vec<f64>,
    /// The stochastic policy that explains the demonstrations, π(a|s), shape (`n_states * n_actions`,).
    pub policy: Vec<f64>,
    /// The greedy policy to act with, ties split evenly, shape (`n_states * n_actions`,).
    pub greedy_policy: Vec<f64>,
    /// V(s) under the reward and the planner, shape (`n_states`,).
    pub state_values: Vec<f64>,
    /// Standard errors of the weights from the exact Hessian (unpenalised likelihood only), shape (`n_basis`,).
    pub standard_errors: Option<Vec<f64>>,
    /// What the data leave open, where the method has a posterior.
    pub posterior: Option<Posterior>,
    /// What the method learned beside the reward, such as the strength of its prior.
    pub hyperparameters: Vec<Hyperparameter>,
    /// One entry an iteration.
    pub trace: Vec<TraceEntry>,
    /// How it stopped.
    pub stopped: Stopped,
    /// Iterations done.
    pub iterations: u32,
    /// What a careful reader should know.
    pub warnings: Vec<String>,
}

/// The posterior of the weights, function by function.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct Posterior {
    /// Standard deviations, shape (`n_basis`,).
    pub standard_deviations: Vec<f64>,
    /// Lower ends of the central 95% intervals, shape (`n_basis`,).
    pub low: Vec<f64>,
    /// Upper ends, shape (`n_basis`,).
    pub high: Vec<f64>,
    /// How well the chains explored it, where it was sampled.
    pub diagnostics: Option<Diagnostics>,
}

/// How well Markov chains explored a posterior, after Vehtari, Gelman, Simpson, Carpenter & Bürkner (2021).
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct Diagnostics {
    /// Number of chains.
    pub chains: u32,
    /// Draws kept of each.
    pub draws: u32,
    /// Share of proposals that were accepted.
    pub acceptance: f64,
    /// Split-R̂ of each weight, near 1 where the chains agree, shape (`n_basis`,).
    pub split_rhat: Vec<f64>,
    /// Draws that independent ones would need to tell as much, of each weight, shape (`n_basis`,).
    pub effective_sample_size: Vec<f64>,
}

/// A number that a method learned beside the reward.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct Hyperparameter {
    /// Its name, as in "penalty_strength".
    pub name: String,
    /// Its value.
    pub value: f64,
}

impl Fit {
    /// The fit of a reward that a planner turns into a policy: its greedy policy is the plan's, its stochastic one the
    /// Boltzmann policy of the plan's action values that explains the demonstrations best.
    fn planned(
        problem: &Problem<'_>,
        basis: &Basis,
        weights: Vec<f64>,
        trace: Trace<'_>,
        stopped: Stopped,
        mut warnings: Vec<String>,
    ) -> Result<Self, FitError> {
        let reward = basis.reward(&weights);
        let planned = plan(problem.options.planner, problem.mdp, &reward, &problem.plan_options())?;
        let counts = problem.statistics.counts(problem.options.horizon);
        let (policy, _) = most_likely_boltzmann(problem.mdp.n_actions(), &planned.action_values, &counts);
        if !planned.converged {
            warnings.push("the planner stopped before it converged".to_owned());
        }
        let iterations = trace.entries.len() as u32;
        Ok(Self {
            weights,
            reward,
            policy: policy.into_probabilities(),
            greedy_policy: planned.greedy_policy().into_probabilities(),
            state_values: planned.state_values,
            standard_errors: None,
            posterior: None,
            hyperparameters: Vec::new(),
            trace: trace.entries,
            stopped,
            iterations,
            warnings,
        })
    }
}

/// Fits with a method; the one entry for every caller. Actions that were not seen are inferred.
///
/// # Errors
/// As [`Method::fit`]; without actions also transitions that the model cannot make, and methods that need whole trajectories; a
/// feature that is asked for and that there is not.
pub fn fit(method: &dyn Method, problem: &Problem<'_>, progress: Progress<'_>) -> Result<Fit, FitError> {
    let names = &problem.options.features;
    if let Some(features) = problem.features
        && problem.options.basis == BasisKind::Features
        && !names.is_empty()
    {
        let unknown = |error: FeaturesError| FitError::InvalidOption { field: "features", message: error.to_string() };
        let selected = features.select(names).map_err(unknown)?;
        let options = FitOptions { features: Vec::new(), ..problem.options.clone() };
        return fit(method, &Problem { features: Some(&selected), options: &options, ..*problem }, progress);
    }
    if problem.statistics.latent().is_empty() {
        method.fit(problem, progress)
    } else {
        latent::fit(method, problem, progress)
    }
}

/// Called after every iteration; `Break` cancels the fit.
pub type Progress<'a> = &'a mut dyn FnMut(&TraceEntry) -> ControlFlow<()>;
