//! From the optimum to the posterior: which way, how many draws, and what to act on.

use super::places::{Neighbours, Places};
use super::prior::Prior;
use super::soft_process::SoftProcess;
use super::spike_slab::Chain;
use super::{MAX_STANDARD_ERRORS, SoftLikelihood, laplace};
use crate::irl::random::Stream;
use crate::irl::{
    Basis, Fit, FitError, Hyperparameter, Penalty, Posterior, PosteriorKind, Problem, Trace, diagnostics,
};
use crate::mdp::{Policy, TabularMdp, plan};
use rayon::prelude::*;

/// Most basis functions that are sampled.
const MAX_BASIS: usize = 2000;
/// Draws that a chain forgets and keeps, where the options do not say.
const WARM_UP: u32 = 100;
const DRAWS: u32 = 100;
/// Proposals from one draw to the next.
const PROPOSALS: u32 = 15;
/// Power of the likelihood at which chains begin.
const WARMEST: f64 = 0.02;
/// Most numbers that all chains may keep together (800 MB).
const MAX_NUMBERS: u64 = 100_000_000;
/// Chains with a larger split-R̂ do not agree.
const LARGEST_RHAT: f64 = 1.1;
/// What the most probable action of the expert is worth beside the value, in full rewards: actions that are worth nearly the same
/// under the mean reward are told apart by how many draws put them first.
const AGREEMENT: f64 = 1.0;
/// Draws between two looks at whether the fit is still wanted.
const BLOCK: u32 = 20;

/// Adds what the options ask for; `fit` holds the optimum.
pub(super) fn add(
    problem: &Problem<'_>,
    basis: &Basis,
    likelihood: &mut dyn SoftLikelihood,
    strength: f64,
    fit: &mut Fit,
    trace: &mut Trace<'_>,
) -> Result<(), FitError> {
    let options = problem.options;
    let gaussian = options.posterior == PosteriorKind::Laplace || options.penalty == Penalty::L2;
    if !gaussian && options.discount < 1.0 && basis.len() <= MAX_BASIS {
        let counts = problem.statistics.counts(options.horizon);
        if let Some(process) = SoftProcess::new(problem.mdp, options.discount, &counts) {
            let slopes: Vec<f64> = likelihood.value_and_gradient(&fit.weights).1.iter().map(|g| strength - g).collect();
            return sample(problem, (basis, &Places::new(&slopes)), &process, fit, trace);
        }
    }
    if basis.len() > MAX_STANDARD_ERRORS {
        fit.warnings.push(format!(
            "no posterior: expected at most {MAX_STANDARD_ERRORS} basis functions, got {}; the policy is the optimum's",
            basis.len()
        ));
        return Ok(());
    }
    fit.hyperparameters.push(Hyperparameter { name: "penalty_strength".to_owned(), value: strength });
    let (mean, posterior) = laplace::around(problem, likelihood, &fit.weights, strength);
    fit.posterior = Some(posterior);
    if gaussian && options.penalty == Penalty::L1 {
        likelihood.value_and_gradient(&mean);
        let n_actions = problem.mdp.n_actions();
        fit.reward = basis.reward(&mean);
        fit.weights = mean;
        fit.policy = Policy::boltzmann(n_actions, likelihood.action_values(), 1.0).into_probabilities();
        fit.greedy_policy = Policy::greedy(n_actions, likelihood.action_values()).into_probabilities();
        fit.state_values = likelihood.state_values().to_vec();
    } else if !gaussian {
        fit.warnings.push(format!(
            "the posterior is a Gaussian around the optimum, whose policy this is: sampling takes a discount below 1, at most \
             {MAX_BASIS} basis functions, and a model whose factors are sparse or small"
        ));
    }
    Ok(())
}

/// Draws from the posterior under the sparse prior and acts on the mean of the reward.
fn sample(
    problem: &Problem<'_>,
    (basis, places): (&Basis, &Places),
    process: &SoftProcess<'_>,
    fit: &mut Fit,
    trace: &mut Trace<'_>,
) -> Result<(), FitError> {
    let (mdp, options) = (problem.mdp, problem.options);
    let (warm_up, draws) = (options.warm_up.unwrap_or(WARM_UP), options.draws.unwrap_or(DRAWS));
    let n_chains = options.chains;
    let numbers = u64::from(draws).saturating_mul(basis.len() as u64).saturating_mul(u64::from(n_chains));
    if numbers > MAX_NUMBERS {
        return Err(FitError::TooLarge {
            what: "numbers for em-tied, chains times draws times basis functions",
            limit: MAX_NUMBERS as usize,
            got: numbers as usize,
        });
    }
    let neighbours = Neighbours::new(mdp, options.basis, basis.len());
    let start = &fit.weights;
    let largest = start.iter().copied().fold(0.0, f64::max);
    let fixed = options.penalty_strength.is_some_and(|strength| strength > 0.0);
    let mut chains: Vec<Sampled<'_>> = (0..u64::from(n_chains))
        .into_par_iter()
        .map(|index| {
            let mut stream = Stream::new(options.seed, index);
            // chains begin apart: each with the optimum's rewards above a threshold of its own, all alike
            let prior = Prior::begin(options.penalty_strength.filter(|_| fixed));
            let least = largest * (0.05 + 0.55 * stream.uniform());
            let from = start.iter().map(|&w| if w > least { prior.scale } else { 0.0 }).collect();
            let setting = (basis, &neighbours, places);
            let chain = Chain::new(setting, process.clone(), from, (prior, fixed), stream);
            Sampled::new(chain, mdp)
        })
        .collect();
    let total = warm_up.saturating_add(draws);
    let mut done = 0;
    while done < total {
        let now = done..total.min(done + BLOCK);
        chains.par_iter_mut().for_each(|chain| {
            for draw in now.clone() {
                chain.chain.set_coldness(coldness(draw, warm_up));
                chain.draw(draw >= warm_up);
            }
        });
        done = now.end;
        trace.check()?;
    }

    let acceptance = chains.iter().map(|c| c.chain.acceptance()).sum::<f64>() / chains.len() as f64;
    let kept: Vec<Vec<f64>> = chains.iter_mut().map(|c| std::mem::take(&mut c.weights)).collect();
    let (mean, posterior) = diagnostics::posterior_of_chains(basis.len(), &kept, acceptance);
    fit.warnings.extend(warnings(&posterior));
    let n_kept = f64::from(draws) * chains.len() as f64;
    let average = |of: &dyn Fn(&Sampled<'_>) -> f64| chains.iter().map(of).sum::<f64>() / n_kept;
    fit.hyperparameters = [
        ("inclusion", average(&|c| c.prior.inclusion)),
        ("full", average(&|c| c.prior.full)),
        ("scale", average(&|c| c.prior.scale)),
        ("shape", average(&|c| c.prior.shape)),
    ]
    .map(|(name, value)| Hyperparameter { name: name.to_owned(), value })
    .to_vec();
    fit.policy = (0..mdp.n_pairs()).map(|pair| average(&|c| c.policy[pair])).collect();
    fit.reward = basis.reward(&mean);
    let planned = plan(options.planner, mdp, &fit.reward, &problem.plan_options())?;
    if !planned.converged {
        fit.warnings.push("the planner stopped before it converged".to_owned());
    }
    // the value of acting on the mean reward, and what it is worth to act as most draws would
    let full = fit.reward.iter().fold(0.0, |largest: f64, r| largest.max(r.abs()));
    let of_draws = |pair: usize| average(&|c| c.greedy_policy[pair]);
    let worth: Vec<f64> =
        planned.action_values.iter().enumerate().map(|(pair, q)| q + AGREEMENT * full * of_draws(pair)).collect();
    fit.greedy_policy = Policy::greedy(mdp.n_actions(), &worth).into_probabilities();
    fit.state_values = planned.state_values;
    fit.weights = mean;
    fit.posterior = Some(posterior);
    Ok(())
}

/// Power of the likelihood at a draw: chains are annealed over the first half of their warm-up.
fn coldness(draw: u32, warm_up: u32) -> f64 {
    let left = 1.0 - 2.0 * f64::from(draw) / f64::from(warm_up.max(1));
    WARMEST.powf(left.max(0.0))
}

/// A chain and what is kept of it.
struct Sampled<'a> {
    chain: Chain<'a>,
    n_actions: usize,
    /// Weights of all kept draws, one after the other.
    weights: Vec<f64>,
    /// Sum of the policies of the kept draws.
    policy: Vec<f64>,
    /// Sum of their greedy policies.
    greedy_policy: Vec<f64>,
    /// Sums of the prior's parameters over the kept draws.
    prior: Prior,
}

impl<'a> Sampled<'a> {
    fn new(chain: Chain<'a>, mdp: &TabularMdp) -> Self {
        let prior = Prior { inclusion: 0.0, full: 0.0, scale: 0.0, shape: 0.0 };
        let zeros = vec![0.0; mdp.n_pairs()];
        let n_actions = mdp.n_actions();
        Self { chain, n_actions, weights: Vec::new(), policy: zeros.clone(), greedy_policy: zeros, prior }
    }

    fn draw(&mut self, keep: bool) {
        self.chain.advance(PROPOSALS);
        if keep {
            self.weights.extend_from_slice(self.chain.weights());
            let policy = self.chain.policy();
            let greedy_policy = Policy::greedy(self.n_actions, policy);
            let sums = self.policy.iter_mut().zip(&mut self.greedy_policy);
            for ((sum, greedy), (p, g)) in sums.zip(policy.iter().zip(greedy_policy.probabilities())) {
                *sum += p;
                *greedy += g;
            }
            let prior = self.chain.prior();
            self.prior.inclusion += prior.inclusion;
            self.prior.full += prior.full;
            self.prior.scale += prior.scale;
            self.prior.shape += prior.shape;
        }
    }
}

fn warnings(posterior: &Posterior) -> Option<String> {
    let rhat = &posterior.diagnostics.as_ref()?.split_rhat;
    let apart = rhat.iter().filter(|&&r| r > LARGEST_RHAT).count();
    let worst = rhat.iter().copied().fold(0.0, f64::max);
    (apart > 0).then(|| {
        format!(
            "the chains do not agree on {apart} of {} weights (split-R̂ up to {worst:.2}): their intervals are rough, more \
             draws make them better",
            rhat.len()
        )
    })
}
