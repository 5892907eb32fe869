//! Options of a fit, from the wire and back with the defaults filled in.

use crate::{
    irl::{
        BasisKind, FitOptions, HorizonPrior, MStep, Penalty, PlannerKind, PosteriorKind, Responsibility, RewardPrior,
        Stopped,
    },
    store::FieldError,
};
use mazeway_proto::learner as pb;

/// Reads options; what is not set takes its default.
pub fn from_proto(message: Option<&pb::FitOptions>) -> Result<FitOptions, FieldError> {
    let default = FitOptions::default();
    let Some(m) = message else { return Ok(default) };
    if m.horizon == Some(0) {
        return Err(FieldError::new("options.horizon", "expected at least 1, got 0"));
    }
    Ok(FitOptions {
        discount: m.discount.unwrap_or(default.discount),
        horizon: m.horizon,
        horizon_prior: match known("horizon_prior", m.horizon_prior)? {
            pb::HorizonPrior::Unspecified | pb::HorizonPrior::Geometric => HorizonPrior::Geometric,
            pb::HorizonPrior::Uniform => HorizonPrior::Uniform,
        },
        basis: match known("basis", m.basis)? {
            pb::Basis::Unspecified | pb::Basis::State => BasisKind::State,
            pb::Basis::StateAction => BasisKind::StateAction,
            pb::Basis::Features => BasisKind::Features,
        },
        m_step: match known("m_step", m.m_step)? {
            pb::MStep::Unspecified | pb::MStep::Nnls => MStep::Nnls,
            pb::MStep::Simplex => MStep::Simplex,
        },
        responsibility: match known("responsibility", m.responsibility)? {
            pb::Responsibility::Unspecified | pb::Responsibility::Approximate => Responsibility::Approximate,
            pb::Responsibility::Exact => Responsibility::Exact,
        },
        planner: match known("planner", m.planner)? {
            pb::Planner::Unspecified | pb::Planner::ValueIteration => PlannerKind::ValueIteration,
            pb::Planner::PolicyIteration => PlannerKind::PolicyIteration,
            pb::Planner::SoftValueIteration => PlannerKind::SoftValueIteration,
            pb::Planner::ExpectationMaximization => PlannerKind::ExpectationMaximization,
        },
        reference_basis: m.reference_basis.unwrap_or(default.reference_basis),
        penalty: match known("penalty", m.penalty)? {
            pb::Penalty::Unspecified | pb::Penalty::L1 => Penalty::L1,
            pb::Penalty::L2 => Penalty::L2,
            pb::Penalty::None => Penalty::None,
        },
        penalty_strength: m.penalty_strength,
        posterior: match known("posterior", m.posterior)? {
            pb::PosteriorKind::Unspecified => default.posterior,
            pb::PosteriorKind::None => PosteriorKind::None,
            pb::PosteriorKind::Laplace => PosteriorKind::Laplace,
            pb::PosteriorKind::Mcmc => PosteriorKind::Mcmc,
        },
        reward_prior: match known("reward_prior", m.reward_prior)? {
            pb::RewardPrior::Unspecified => default.reward_prior,
            pb::RewardPrior::Uniform => RewardPrior::Uniform,
            pb::RewardPrior::Exponential => RewardPrior::Exponential,
            pb::RewardPrior::Beta => RewardPrior::Beta,
        },
        rationality: m.rationality.unwrap_or(default.rationality),
        chains: m.chains.unwrap_or(default.chains),
        draws: m.draws,
        warm_up: m.warm_up,
        tolerance: m.tolerance.unwrap_or(default.tolerance),
        max_iterations: m.max_iterations.unwrap_or(default.max_iterations),
        smoothing: m.smoothing.unwrap_or(default.smoothing),
        seed: m.seed.unwrap_or(default.seed),
        features: m.features.clone(),
    })
}

/// A value that this release knows.
fn known<E: TryFrom<i32>>(field: &str, value: i32) -> Result<E, FieldError> {
    E::try_from(value).map_err(|_| {
        FieldError::new(format!("options.{field}"), format!("expected a value that this release knows, got {value}"))
    })
}

/// Writes options, every one of them.
pub fn to_proto(options: &FitOptions) -> pb::FitOptions {
    pb::FitOptions {
        discount: Some(options.discount),
        horizon: options.horizon,
        horizon_prior: match options.horizon_prior {
            HorizonPrior::Geometric => pb::HorizonPrior::Geometric,
            HorizonPrior::Uniform => pb::HorizonPrior::Uniform,
        } as i32,
        basis: match options.basis {
            BasisKind::State => pb::Basis::State,
            BasisKind::StateAction => pb::Basis::StateAction,
            BasisKind::Features => pb::Basis::Features,
        } as i32,
        m_step: match options.m_step {
            MStep::Nnls => pb::MStep::Nnls,
            MStep::Simplex => pb::MStep::Simplex,
        } as i32,
        responsibility: match options.responsibility {
            Responsibility::Approximate => pb::Responsibility::Approximate,
            Responsibility::Exact => pb::Responsibility::Exact,
        } as i32,
        planner: match options.planner {
            PlannerKind::ValueIteration => pb::Planner::ValueIteration,
            PlannerKind::PolicyIteration => pb::Planner::PolicyIteration,
            PlannerKind::SoftValueIteration => pb::Planner::SoftValueIteration,
            PlannerKind::ExpectationMaximization => pb::Planner::ExpectationMaximization,
        } as i32,
        reference_basis: Some(options.reference_basis),
        penalty: match options.penalty {
            Penalty::L1 => pb::Penalty::L1,
            Penalty::L2 => pb::Penalty::L2,
            Penalty::None => pb::Penalty::None,
        } as i32,
        penalty_strength: options.penalty_strength,
        posterior: match options.posterior {
            PosteriorKind::None => pb::PosteriorKind::None,
            PosteriorKind::Laplace => pb::PosteriorKind::Laplace,
            PosteriorKind::Mcmc => pb::PosteriorKind::Mcmc,
        } as i32,
        reward_prior: match options.reward_prior {
            RewardPrior::Uniform => pb::RewardPrior::Uniform,
            RewardPrior::Exponential => pb::RewardPrior::Exponential,
            RewardPrior::Beta => pb::RewardPrior::Beta,
        } as i32,
        rationality: Some(options.rationality),
        chains: Some(options.chains),
        draws: options.draws,
        warm_up: options.warm_up,
        tolerance: Some(options.tolerance),
        max_iterations: Some(options.max_iterations),
        smoothing: Some(options.smoothing),
        seed: Some(options.seed),
        features: options.features.clone(),
    }
}

/// How a fit stopped.
pub fn stopped(stopped: Stopped) -> pb::Stopped {
    match stopped {
        Stopped::Converged => pb::Stopped::Converged,
        Stopped::MaxIterations => pb::Stopped::MaxIterations,
        Stopped::Stalled => pb::Stopped::Stalled,
        Stopped::ClosedForm => pb::Stopped::ClosedForm,
    }
}

/// How a fit stopped, from the wire; `None` for a way that this version does not know.
pub fn stopped_from_proto(message: i32) -> Option<Stopped> {
    match pb::Stopped::try_from(message).ok()? {
        pb::Stopped::Converged => Some(Stopped::Converged),
        pb::Stopped::MaxIterations => Some(Stopped::MaxIterations),
        pb::Stopped::Stalled => Some(Stopped::Stalled),
        pb::Stopped::ClosedForm => Some(Stopped::ClosedForm),
        pb::Stopped::Unspecified => None,
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn what_is_not_set_takes_the_default_and_comes_back_whole() {
        let default = FitOptions::default();
        assert_eq!(from_proto(None).unwrap(), default);
        assert_eq!(from_proto(Some(&pb::FitOptions::default())).unwrap(), default);
        let other = FitOptions {
            discount: 0.5,
            horizon: Some(7),
            horizon_prior: HorizonPrior::Uniform,
            basis: BasisKind::StateAction,
            m_step: MStep::Simplex,
            responsibility: Responsibility::Exact,
            planner: PlannerKind::ExpectationMaximization,
            reference_basis: 3,
            penalty: Penalty::None,
            penalty_strength: Some(0.25),
            posterior: PosteriorKind::Laplace,
            reward_prior: RewardPrior::Beta,
            rationality: 3.0,
            chains: 2,
            draws: Some(100),
            warm_up: Some(50),
            tolerance: 1e-9,
            max_iterations: 5,
            smoothing: 0.5,
            seed: u64::MAX,
            features: vec!["speed".into(), "gap".into()],
        };
        for options in [default, other] {
            assert_eq!(from_proto(Some(&to_proto(&options))).unwrap(), options);
        }
    }

    #[test]
    fn an_unknown_value_names_its_field() {
        let wrong = pb::FitOptions { planner: 99, ..Default::default() };
        assert_eq!(from_proto(Some(&wrong)).unwrap_err().field, "options.planner");
        let wrong = pb::FitOptions { horizon: Some(0), ..Default::default() };
        assert_eq!(from_proto(Some(&wrong)).unwrap_err().field, "options.horizon");
    }
}
