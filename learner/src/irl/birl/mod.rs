//! `birl`: Bayesian inverse reinforcement learning, Ramachandran & Amir (2007).
//!
//! The posterior of the weights given the demonstrations is p(w | O) ∝ p(w) Π exp(β Q*(s,a; w)) / Σ_a' exp(β Q*(s,a'; w)), with Q* the
//! optimal action values of R = wᵀΦ, β the rationality and w in [0, 1]. The learned reward is the posterior mean: its optimal
//! policy minimises the expected loss over the posterior (their theorem 3).
//!
//! Their PolicyWalk moves one reward at a time on a grid. Here the same posterior is sampled by Hamiltonian Monte Carlo with
//! the gradient that is exact almost everywhere, because one gradient costs little more than one value. Chains run
//! in parallel, each from its own stream of random numbers; results do not depend on the number of threads.

mod chain;
mod optimum;
mod target;

use self::chain::Chain;
use self::target::{Model, Target};
use super::{Fit, FitError, Method, Problem, Progress, Stopped, Trace, diagnostics};
use rayon::prelude::*;

/// Draws of each chain where the options give none.
const DRAWS: u32 = 300;
/// Warm-up of each chain where the options give none.
const WARM_UP: u32 = 150;
/// Most states: the chains keep dense inverses.
const MAX_STATES: usize = 2000;
/// Most weights.
const MAX_WEIGHTS: usize = 4000;
/// Most numbers that all chains may keep together (800 MB).
const MAX_NUMBERS: usize = 100_000_000;
/// Largest discount below 1: beyond, rows that sum to 1 within 1e-9 leave the values undetermined.
const MAX_DISCOUNT: f64 = 1.0 - 1e-8;
/// Multiplications between two entries of the trace, about a tenth of a second.
const BLOCK_COST: usize = 100_000_000;

/// Posterior mean reward by Hamiltonian Monte Carlo.
pub(super) struct Birl;

impl Method for Birl {
    fn id(&self) -> &'static str {
        "birl"
    }

    fn description(&self) -> &'static str {
        "Bayesian: posterior mean reward of a Boltzmann-rational expert with credible intervals, Ramachandran & Amir (2007)"
    }

    fn fit(&self, problem: &Problem<'_>, progress: Progress<'_>) -> Result<Fit, FitError> {
        problem.check()?;
        let options = problem.options;
        let basis = problem.basis();
        let warm_up = options.warm_up.unwrap_or(WARM_UP);
        let draws = options.draws.unwrap_or(DRAWS);
        check_size(problem, basis.len(), draws)?;
        let counts = problem.statistics.counts(options.horizon);
        let model = Model {
            mdp: problem.mdp,
            basis: &basis,
            counts: &counts,
            discount: options.discount,
            horizon: problem.horizon(),
            rationality: options.rationality,
            prior: options.reward_prior,
        };
        let mut trace = Trace::new(progress);
        let mut chains: Vec<Chain<'_>> = (0..u64::from(options.chains))
            .into_par_iter()
            .map(|index| Chain::new(model, options.seed, index, warm_up))
            .collect();
        if !chains.iter().all(Chain::is_finite) {
            let message =
                format!("expected a rationality at which the likelihood is a number, got {}", options.rationality);
            return Err(FitError::InvalidOption { field: "rationality", message });
        }

        let total = warm_up.saturating_add(draws);
        let block =
            (BLOCK_COST / (10 * Target::cost(&model) * chains.len())).clamp(1, (total as usize).div_ceil(20)) as u32;
        let (mut done, mut last) = (0, None);
        while done < total {
            let n = block.min(total - done);
            chains.par_iter_mut().for_each(|chain| chain.advance(n));
            done += n;
            let objective = chains.iter().map(|c| c.log_posterior).sum::<f64>() / chains.len() as f64;
            trace.record(objective, last.map_or(0.0, |last| objective - last))?;
            last = Some(objective);
        }

        let acceptance = chains.iter().map(|c| c.accepted).sum::<f64>() / (f64::from(draws) * chains.len() as f64);
        let kept: Vec<Vec<f64>> = chains.into_iter().map(|chain| chain.draws).collect();
        let (mean, posterior) = diagnostics::posterior_of_chains(basis.len(), &kept, acceptance);
        drop(kept);
        let explored = posterior.diagnostics.as_ref().map_or(Vec::new(), diagnostics::warnings);
        let agree = posterior.diagnostics.iter().flat_map(|d| &d.split_rhat).all(|&r| r <= diagnostics::AGREEING_RHAT);
        let stopped = if agree { Stopped::Converged } else { Stopped::MaxIterations };
        let mut fit = Fit::planned(problem, &basis, mean, trace, stopped, explored)?;
        fit.posterior = Some(posterior);
        Ok(fit)
    }
}

fn check_size(problem: &Problem<'_>, n_weights: usize, draws: u32) -> Result<(), FitError> {
    let (n, options) = (problem.mdp.n_states(), problem.options);
    if options.discount > MAX_DISCOUNT && options.discount < 1.0 {
        let message =
            format!("expected at most {MAX_DISCOUNT}, or 1 to plan over the horizon, got {}", options.discount);
        return Err(FitError::InvalidOption { field: "discount", message });
    }
    let too_large = |what, limit, got| if got > limit { Err(FitError::TooLarge { what, limit, got }) } else { Ok(()) };
    too_large("states for birl", MAX_STATES, n)?;
    too_large("weights for birl", MAX_WEIGHTS, n_weights)?;
    let horizon = if options.discount < 1.0 { 0 } else { problem.horizon() as usize };
    let numbers = (draws as usize)
        .saturating_mul(n_weights)
        .saturating_add(n.saturating_mul(n.saturating_add(n_weights)))
        .saturating_add(n.saturating_mul(horizon))
        .saturating_mul(options.chains as usize);
    too_large(
        "numbers for birl, chains times (draws times weights + states times (states + weights + horizon at discount 1))",
        MAX_NUMBERS,
        numbers,
    )
}
