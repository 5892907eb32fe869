//! Finite Markov decision processes: the checked model, policies, planners and occupancies.
//!
//! Arrays over state-action pairs are flat and row-major, index `state * n_actions + action`. Rewards are R(s, a), received
//! for taking action a in state s; Q(s,a) = R(s,a) + γ Σ P(s'|s,a) V(s'). Deliberately absent: sampling (that is the
//! simulators' work) and any notion of where a model comes from.

#![expect(clippy::doc_markdown, reason = "formulae in the notation of the papers are not code")]

mod estimate;
mod evaluation;
mod features;
mod linear;
mod numeric;
mod occupancy;
mod plan;
mod planners;
mod policy;
mod tabular;

pub use estimate::{EstimateError, EstimatedMdp, TransitionCounts};
pub use evaluation::evaluate_policy;
pub use features::{Features, FeaturesError};
pub use occupancy::{
    discounted_occupancy, finite_horizon_occupancy, state_action_occupancy, state_occupancies_by_step,
};
pub use plan::{HorizonPrior, Plan, PlanError, PlanOptions, PlannerKind, plan};
pub use planners::soft::SoftSolver;
pub use policy::{Policy, PolicyError, TIE_TOLERANCE};
pub use tabular::{MdpError, TabularMdp};

pub(crate) use linear::{Factored, Resolvent};
pub(crate) use numeric::{log_sum_exp, max_abs};
