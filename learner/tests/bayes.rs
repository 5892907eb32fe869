//! Laws of the Bayesian methods: the posterior is the one that quadrature gives, intervals cover what they say, draws repeat.

mod random;

use mazeway_learner::irl::{self, BasisKind, Fit, FitError, FitOptions, Problem, RewardPrior};
use mazeway_learner::mdp::{Features, PlanOptions, PlannerKind, Policy, SoftSolver, TabularMdp, plan};
use mazeway_learner::trajectory::Demonstrations;
use random::{episodes, generator, mdp, policy, statistics, vector};
use std::ops::ControlFlow;

fn fit(
    id: &str,
    mdp: &TabularMdp,
    data: &Demonstrations,
    features: Option<&Features>,
    options: &FitOptions,
) -> Result<Fit, FitError> {
    let statistics = statistics(mdp, data);
    let problem = Problem { mdp, options, statistics: &statistics, demonstrations: Some(data), features };
    irl::fit(irl::method(id).expect("a method"), &problem, &mut |_| ControlFlow::Continue(()))
}

/// Optimal action values of one weight a state.
fn optimal(mdp: &TabularMdp, weights: &[f64], discount: f64) -> Vec<f64> {
    let reward: Vec<f64> = (0..mdp.n_pairs()).map(|pair| weights[pair / mdp.n_actions()]).collect();
    let options = PlanOptions { discount, horizon: Some(4), ..PlanOptions::default() };
    plan(PlannerKind::PolicyIteration, mdp, &reward, &options).expect("a plan").action_values
}

fn log_likelihood(action_values: &[f64], counts: &[f64], n_actions: usize, rationality: f64) -> f64 {
    let choices = Policy::boltzmann(n_actions, action_values, rationality);
    choices.probabilities().iter().zip(counts).filter(|(_, n)| **n > 0.0).map(|(p, n)| n * p.ln()).sum()
}

#[test]
fn the_posterior_is_that_of_quadrature() {
    let mut random = generator(21);
    let process = mdp(2, 2, 2, &mut random);
    let data = episodes(&process, &policy(2, 2, &mut random), 4, 4, &mut random);
    let counts = statistics(&process, &data).counts(Some(4));
    for (prior, discount) in [
        (RewardPrior::Uniform, 0.9),
        (RewardPrior::Exponential, 0.9),
        (RewardPrior::Beta, 0.9),
        (RewardPrior::Uniform, 1.0),
    ] {
        // midpoints of cells of equal prior mass but for the exponential's density: w = sin²(πt/2) has the density of Beta(½, ½)
        let cells = 120;
        let at = |i: usize| {
            let t = (i as f64 + 0.5) / f64::from(cells);
            if prior == RewardPrior::Beta { (std::f64::consts::FRAC_PI_2 * t).sin().powi(2) } else { t }
        };
        let rate = if prior == RewardPrior::Exponential { 5.0 } else { 0.0 };
        let (mut mass, mut first, mut second) = (0.0, [0.0; 2], [0.0; 2]);
        let mut marginal = vec![0.0; cells as usize];
        for (i, marginal) in marginal.iter_mut().enumerate() {
            for j in 0..cells as usize {
                let w = [at(i), at(j)];
                let q = optimal(&process, &w, discount);
                let p = (log_likelihood(&q, &counts, 2, 3.0) - rate * (w[0] + w[1])).exp();
                mass += p;
                *marginal += p;
                for b in 0..2 {
                    first[b] += p * w[b];
                    second[b] += p * w[b] * w[b];
                }
            }
        }
        let options = FitOptions {
            discount,
            horizon: Some(4),
            rationality: 3.0,
            reward_prior: prior,
            draws: Some(4000),
            warm_up: Some(300),
            ..FitOptions::default()
        };
        let found = fit("birl", &process, &data, None, &options).expect("a fit");
        let posterior = found.posterior.expect("a posterior");
        let diagnostics = posterior.diagnostics.expect("diagnostics");
        assert!(diagnostics.split_rhat.iter().all(|r| *r < 1.02), "{prior:?}: {diagnostics:?}");
        for b in 0..2 {
            let (mean, variance) = (first[b] / mass, second[b] / mass - (first[b] / mass).powi(2));
            let error = 5.0 * (variance / diagnostics.effective_sample_size[b]).sqrt() + 1e-3;
            let (got, sd) = (found.weights[b], posterior.standard_deviations[b]);
            assert!((got - mean).abs() < error, "{prior:?} at {discount}: mean {got}, by quadrature {mean}");
            assert!((sd / variance.sqrt() - 1.0).abs() < 0.05, "{prior:?}: {sd}, by quadrature {}", variance.sqrt());
        }
        let below: f64 = (0..cells as usize).filter(|&i| at(i) < posterior.low[0]).map(|i| marginal[i]).sum();
        assert!((below / mass - 0.025).abs() < 0.02, "{prior:?}: {} lies below the interval", below / mass);
    }
}

#[test]
fn draws_do_not_depend_on_threads() {
    let mut random = generator(22);
    let process = mdp(12, 3, 4, &mut random);
    let data = episodes(&process, &policy(12, 3, &mut random), 10, 10, &mut random);
    let options = FitOptions { draws: Some(40), warm_up: Some(40), seed: 5, ..FitOptions::default() };
    let on = |threads: usize, options: &FitOptions| {
        let pool = rayon::ThreadPoolBuilder::new().num_threads(threads).build().expect("threads");
        let found = pool.install(|| fit("birl", &process, &data, None, options)).expect("a fit");
        let objectives: Vec<f64> = found.trace.iter().map(|t| t.objective).collect();
        (found.weights, found.posterior, objectives, found.greedy_policy)
    };
    assert_eq!(on(1, &options), on(4, &options));
    assert_ne!(on(1, &options).0, on(1, &FitOptions { seed: 6, ..options.clone() }).0);
}

#[test]
fn intervals_cover_the_rewards_that_made_the_data() {
    let (mut covered, mut asked, mut squares) = (0, 0, 0.0);
    for seed in 0..60 {
        let mut random = generator(500 + seed);
        let process = mdp(4, 3, 3, &mut random);
        let truth = vector(4, &mut random);
        let expert = Policy::boltzmann(3, &optimal(&process, &truth, 0.8), 5.0);
        let data = episodes(&process, &expert, 8, 15, &mut random);
        let options = FitOptions {
            discount: 0.8,
            rationality: 5.0,
            reward_prior: RewardPrior::Uniform,
            draws: Some(300),
            warm_up: Some(150),
            chains: 2,
            seed,
            ..FitOptions::default()
        };
        let found = fit("birl", &process, &data, None, &options).expect("a fit");
        let posterior = found.posterior.expect("a posterior");
        for (b, w) in truth.iter().enumerate() {
            covered += usize::from(posterior.low[b] <= *w && *w <= posterior.high[b]);
            asked += 1;
            squares += ((w - found.weights[b]) / posterior.standard_deviations[b]).powi(2);
        }
    }
    println!("{covered} of {asked} within their 95% intervals, mean square of z {:.2}", squares / asked as f64);
    // 228 expected of 240, with a standard deviation of 3.4 if they were independent
    assert!((216..=238).contains(&covered), "{covered} of {asked}");
    assert!((0.75..1.25).contains(&(squares / asked as f64)), "{squares}");
}

#[test]
fn what_is_too_large_is_refused() {
    let mut random = generator(23);
    let process = mdp(5, 2, 3, &mut random);
    let data = episodes(&process, &policy(5, 2, &mut random), 2, 5, &mut random);
    let endless = FitOptions { draws: Some(u32::MAX), ..FitOptions::default() };
    assert!(matches!(fit("birl", &process, &data, None, &endless), Err(FitError::TooLarge { .. })));
    let near_one = FitOptions { discount: 1.0 - 1e-12, ..FitOptions::default() };
    for id in ["birl", "gpirl"] {
        let error = fit(id, &process, &data, None, &near_one).expect_err("a refusal");
        assert!(matches!(error, FitError::InvalidOption { field: "discount", .. }), "{error}");
    }
    let large = mdp(2100, 1, 2, &mut random);
    let data = episodes(&large, &Policy::uniform(2100, 1), 2, 5, &mut random);
    for id in ["birl", "gpirl"] {
        let error = fit(id, &large, &data, None, &FitOptions::default()).expect_err("a refusal");
        assert!(matches!(error, FitError::TooLarge { got: 2100, .. }), "{error}");
    }
}

/// A corridor of `n` states, with one feature that the reward depends on, not linearly, and one that it does not.
fn corridor(n: usize) -> (TabularMdp, Features, Vec<f64>) {
    let (mut offsets, mut next) = (vec![0], Vec::new());
    for state in 0..n {
        for to in [state.saturating_sub(1), (state + 1).min(n - 1)] {
            next.push(to as u32);
            offsets.push(next.len());
        }
    }
    let probabilities = vec![1.0; next.len()];
    let process = TabularMdp::new(n, 2, offsets, next, probabilities, None).expect("a model");
    let mut random = generator(24);
    let place = |state: usize| state as f64 / (n - 1) as f64;
    let table: Vec<f64> = (0..n).flat_map(|s| [place(s), vector(1, &mut random)[0]]).collect();
    let features = Features::of_states(n, 2, ["place", "noise"].map(str::to_owned).to_vec(), &table).expect("features");
    let reward = (0..n).map(|s| 2.0 * (-((place(s) - 0.6) / 0.15).powi(2)).exp()).collect();
    (process, features, reward)
}

#[test]
fn a_gaussian_process_learns_which_feature_matters() {
    let n = 24;
    let (process, features, truth) = corridor(n);
    let mut soft = SoftSolver::new(&process, 0.9);
    soft.solve(&truth.iter().flat_map(|r| [*r, *r]).collect::<Vec<f64>>());
    let expert = Policy::boltzmann(2, soft.action_values(), 1.0);
    let data = episodes(&process, &expert, 60, 20, &mut generator(25));
    for basis in [BasisKind::Features, BasisKind::State] {
        let options = FitOptions { basis, ..FitOptions::default() };
        let found = fit("gpirl", &process, &data, Some(&features), &options).expect("a fit");
        let of = |name: &str| found.hyperparameters.iter().find(|h| h.name == name).expect("a hyperparameter").value;
        assert!(of("length_scale_noise") > 1.5 * of("length_scale_place"), "{:?}", found.hyperparameters);
        // a constant changes no choice
        let got: Vec<f64> = found.reward.iter().step_by(2).copied().collect();
        let mean = |x: &[f64]| x.iter().sum::<f64>() / n as f64;
        let (a, b) = (mean(&got), mean(&truth));
        let product: f64 = got.iter().zip(&truth).map(|(x, y)| (x - a) * (y - b)).sum();
        let squares = |x: &[f64], m: f64| x.iter().map(|x| (x - m).powi(2)).sum::<f64>();
        let correlation = product / (squares(&got, a) * squares(&truth, b)).sqrt();
        println!("{basis:?}: correlation {correlation:.3}, {:?}", found.hyperparameters);
        assert!(correlation > 0.9, "{correlation}");
        let posterior = found.posterior.expect("a posterior");
        assert_eq!(posterior.low.len(), if basis == BasisKind::Features { 2 } else { n });
        assert_eq!(found.weights.len(), posterior.low.len());
        assert!(found.trace.windows(2).all(|pair| pair[1].objective >= pair[0].objective));
    }
}
