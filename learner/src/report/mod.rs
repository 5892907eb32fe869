//! What a person sees at the end of a fit: plain data, and what is drawn from them.
//!
//! [`Report`] is filled by whoever ran the fit. From it come the object for programs ([`json`]), the tables of a
//! terminal ([`table`]), the pictures ([`pictures`]), the page ([`html`]) and the directory with all of them ([`mod@write`]).
//! Invariants: everything here is a function of the report alone (no clock, no randomness, no map order); a number that is
//! not finite is drawn as missing, never printed as a number; text that came from a user is escaped wherever it lands.
//! Deliberately absent: any computation of what is reported.

mod format;
pub mod html;
pub mod json;
pub mod pictures;
#[cfg(test)]
mod samples;
mod space;
pub mod table;
#[cfg(test)]
mod tests;
pub mod uncertainty;
pub mod write;

pub use crate::eval::Interval;
pub use format::duration;

use self::uncertainty::Uncertainty;
use crate::eval::validation::Validation;
use crate::irl::{FitOptions, Hyperparameter, Stopped, TraceEntry};
use serde::{Deserialize, Serialize};

/// How a driver drives: means per step over roll-outs.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
pub struct DriverMetrics {
    /// Mean speed, m/s.
    pub speed_mps: Interval,
    /// Collisions a step.
    pub collisions: Interval,
    /// Vehicles a step overtaken on their left, which is legal.
    pub overtakes_left: Interval,
    /// Vehicles a step overtaken on their right, which is illegal.
    pub overtakes_right: Interval,
}

/// The drivers side by side.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
pub struct Drivers {
    /// The demonstrator; `None` where it cannot be rolled out (recordings from outside).
    pub expert: Option<DriverMetrics>,
    /// The learned greedy policy.
    pub learned: DriverMetrics,
    /// Uniformly random actions.
    pub random: DriverMetrics,
}

/// The roll-outs behind [`Drivers`], or behind the agreement where there is no roll-out of drivers.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
pub struct Evaluation {
    /// Episodes of each driver.
    pub episodes: u64,
    /// Steps of each episode, at most.
    pub steps: u64,
    /// Seed of the first episode.
    pub seed: u64,
}

/// Where recordings came from.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
pub struct Source {
    /// As recorded, such as `"driver:aggressive"`; text of a user.
    pub name: String,
    /// How many of the trajectories used came from it.
    pub trajectories: u64,
}

/// A feature of the model: its weight, and how much of it there is a step.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct FeatureRow {
    /// Its name; text of a user.
    pub name: String,
    /// Its weight with the 95 % interval, infinite where none is known.
    pub weight: Interval,
    /// Mean over the demonstrated steps.
    pub demonstrated: f64,
    /// Mean a step that the learned greedy policy meets in the model, over as many steps as the demonstrations have.
    pub learned: f64,
    /// The same of uniformly random actions.
    pub random: f64,
}

/// Where each state lies on a grid.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
pub struct GridLayout {
    /// Number of rows.
    pub rows: u32,
    /// Number of columns.
    pub columns: u32,
    /// Row-major cell (row * columns + column) of each state, shape (S,).
    pub cells: Vec<u32>,
}

/// What was learned in one model, used in another.
#[derive(Debug, Clone, PartialEq)]
pub struct Transfer {
    /// The other model, in a few words.
    pub target: String,
    /// Its states that the first does not have.
    pub new_states: u64,
    /// Who acts there, and how well.
    pub rows: Vec<TransferRow>,
}

/// One way to act in another model.
#[derive(Debug, Clone, PartialEq)]
pub struct TransferRow {
    /// Such as "reward planned on anew".
    pub name: String,
    /// Share of the states whose action is optimal there, where the truth is known.
    pub agreement: Option<f64>,
    /// What is lost there, where the truth is known.
    pub expected_value_difference: Option<f64>,
    /// How it drives there, where the environment counts that.
    pub metrics: Option<DriverMetrics>,
}

/// Everything that is shown of a fit.
#[derive(Debug, Clone, PartialEq)]
pub struct Report {
    /// Environment, such as `"Highway-v0"`.
    pub env_id: String,
    /// Style of the demonstrations; empty where they have none.
    pub style: String,
    /// Method, such as `"em-tied"`.
    pub method: String,
    /// Options of the fit, defaults filled in.
    pub options: FitOptions,
    /// Seed of the whole run, from which recordings and roll-outs drew theirs.
    pub seed: u64,
    /// Model in which it was fitted.
    pub model_id: String,
    /// Stored fit.
    pub fit_id: String,
    /// Number of states S.
    pub n_states: u32,
    /// Number of actions A.
    pub n_actions: u32,
    /// Label of each state, shape (S,); empty where there are none.
    pub state_labels: Vec<String>,
    /// Label of each action, shape (A,); empty where there are none.
    pub action_labels: Vec<String>,

    /// Trajectories used.
    pub trajectories: u64,
    /// Steps used in all.
    pub steps: u64,
    /// Steps of each trajectory used, at most.
    pub horizon: u32,
    /// Where the recordings came from.
    pub sources: Vec<Source>,
    /// Visits of each state by the demonstrations, shape (S,).
    pub state_visits: Vec<f64>,
    /// States that the demonstrations visit.
    pub states_covered: u32,

    /// Weights of the basis functions, shape (B,).
    pub weights: Vec<f64>,
    /// Their names; empty where the states and actions name them.
    pub weight_names: Vec<String>,
    /// What the data leave open of them, where the method says.
    pub uncertainty: Option<Uncertainty>,
    /// What the method learned beside the reward.
    pub hyperparameters: Vec<Hyperparameter>,
    /// R(s,a), shape (S, A).
    pub reward: Vec<f64>,
    /// π(a|s) that explains the demonstrations, shape (S, A).
    pub policy: Vec<f64>,
    /// Greedy policy to act with, ties split evenly, shape (S, A).
    pub greedy_policy: Vec<f64>,
    /// V(s), shape (S,).
    pub state_values: Vec<f64>,
    /// One entry an iteration; empty for methods without iterations.
    pub trace: Vec<TraceEntry>,
    /// How the fit stopped.
    pub stopped: Stopped,
    /// Iterations done.
    pub iterations: u32,
    /// Seconds of the fit alone.
    pub fit_secs: f64,
    /// Seconds of the whole run.
    pub total_secs: f64,
    /// What a careful reader should know.
    pub warnings: Vec<String>,

    /// Agreement of the greedy policy with the expert, ties split evenly, in [0, 1]: where the optimal policy is known, the
    /// share of the states whose action is optimal; else the share of the demonstrated steps whose action it takes.
    pub agreement: f64,
    /// Share of the expert's steps that the fit did not see whose action the greedy policy takes.
    pub agreement_held_out: Option<f64>,
    /// Mean log π(a|s) of the demonstrated steps, natural logarithm.
    pub log_likelihood_per_step: f64,
    /// The same on steps that the fit did not see.
    pub log_likelihood_per_step_held_out: Option<f64>,
    /// Drivers side by side, where the environment counts their events.
    pub drivers: Option<Drivers>,
    /// The roll-outs behind `drivers` and the held-out numbers.
    pub evaluation: Option<Evaluation>,
    /// Expected value difference: value of the optimal policy minus that of the learned one under the true reward and the
    /// initial distribution; `None` where the true reward is not known.
    pub expected_value_difference: Option<f64>,
    /// True reward, shape (S,) or (S, A), where known.
    pub true_reward: Option<Vec<f64>>,
    /// Optimal policy under the true reward, ties split evenly, shape (S, A), where known.
    pub optimal_policy: Option<Vec<f64>>,

    /// Cross-validation over the trajectories, where asked for.
    pub validation: Option<Validation>,
    /// What was learned, used in another model, where asked for.
    pub transfer: Option<Transfer>,

    /// Where each state lies, for environments on a grid.
    pub grid: Option<GridLayout>,
    /// A frame of the environment, driven by the learned policy, as PNG.
    pub frame_png: Option<Vec<u8>>,
    /// What the fit makes of the model's features; empty where it does not weigh them.
    pub features: Vec<FeatureRow>,
    /// Commands that repeat this run, one a line as typed.
    pub commands: Vec<String>,
}

/// Why a report cannot be shown.
#[derive(Debug, thiserror::Error)]
pub enum ReportError {
    /// An array has another length than the sizes say.
    #[error("expected {field} of length {expected}, got {got}")]
    Shape {
        /// Field of [`Report`].
        field: &'static str,
        /// What the sizes ask for.
        expected: usize,
        /// What came.
        got: usize,
    },
    /// A state lies outside the grid.
    #[error("expected grid cells below {cells}, got {got}")]
    Cell {
        /// rows * columns.
        cells: u64,
        /// What came.
        got: u32,
    },
    /// A picture could not be drawn.
    #[error("cannot draw {picture}: {message}")]
    Picture {
        /// Name of the picture.
        picture: &'static str,
        /// What the drawing library says.
        message: String,
    },
    /// The page could not be filled in.
    #[error("cannot fill in the page: {0}")]
    Page(#[from] minijinja::Error),
    /// A file could not be written.
    #[error("cannot write {path}: {source}")]
    Write {
        /// Which file.
        path: std::path::PathBuf,
        /// Why.
        source: std::io::Error,
    },
}

impl Report {
    /// Number of states as a length.
    pub(crate) fn states(&self) -> usize {
        self.n_states as usize
    }

    /// Number of actions as a length.
    pub(crate) fn actions(&self) -> usize {
        self.n_actions as usize
    }

    /// Whether this is the highway in its 36 tabular states and 12 actions.
    pub(crate) fn is_highway(&self) -> bool {
        self.env_id.starts_with("Highway") && self.n_states == 36 && self.n_actions == 12
    }

    /// Checks that every array has the shape that its documentation names.
    ///
    /// # Errors
    /// The first field whose length is another one, or a cell outside the grid.
    pub fn check(&self) -> Result<(), ReportError> {
        let (s, a) = (self.states(), self.actions());
        let exactly = |field: &'static str, got: usize, expected: usize| {
            if got == expected { Ok(()) } else { Err(ReportError::Shape { field, expected, got }) }
        };
        let labels = |field, got: usize, expected| if got == 0 { Ok(()) } else { exactly(field, got, expected) };
        labels("state_labels", self.state_labels.len(), s)?;
        labels("action_labels", self.action_labels.len(), a)?;
        exactly("state_visits", self.state_visits.len(), s)?;
        exactly("reward", self.reward.len(), s * a)?;
        exactly("policy", self.policy.len(), s * a)?;
        exactly("greedy_policy", self.greedy_policy.len(), s * a)?;
        exactly("state_values", self.state_values.len(), s)?;
        if let Some(uncertainty) = &self.uncertainty {
            uncertainty.check(self.weights.len())?;
        }
        if let Some(reward) = &self.true_reward
            && reward.len() != s
        {
            exactly("true_reward", reward.len(), s * a)?;
        }
        if let Some(policy) = &self.optimal_policy {
            exactly("optimal_policy", policy.len(), s * a)?;
        }
        if let Some(grid) = &self.grid {
            exactly("grid.cells", grid.cells.len(), s)?;
            let cells = u64::from(grid.rows) * u64::from(grid.columns);
            if let Some(&got) = grid.cells.iter().find(|&&cell| u64::from(cell) >= cells) {
                return Err(ReportError::Cell { cells, got });
            }
        }
        Ok(())
    }
}
