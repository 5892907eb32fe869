//! Whatever process, demonstrations, features and options: every method gives a fit of finite numbers or a clear error.
//!
//! Each case follows from its seed alone, and all that is wrong is reported at once, with the seed that shows it.

mod random;

use mazeway_learner::irl::{
    self, BasisKind, Fit, FitError, FitOptions, HorizonPrior, METHODS, MStep, Method, Penalty, PlannerKind,
    PosteriorKind, Problem, Responsibility, RewardPrior,
};
use mazeway_learner::mdp::{Features, Policy, TabularMdp};
use mazeway_learner::statistics::Statistics;
use mazeway_learner::trajectory::{Demonstrations, Trajectory};
use rand_pcg::Pcg64;
use random::{below, episodes, generator, uniform, vector};
use std::ops::ControlFlow;
use std::panic::{AssertUnwindSafe, catch_unwind};

const MAX_ITERATIONS: u32 = 25;

fn pick<T: Copy>(from: &[T], random: &mut Pcg64) -> T {
    from[below(from.len(), random)]
}

fn normalised(mut weights: Vec<f64>) -> Vec<f64> {
    let sum: f64 = weights.iter().sum();
    for w in &mut weights {
        *w /= sum;
    }
    weights
}

/// Dense rows with their zeros left out.
fn process(n_actions: usize, rows: &[Vec<f64>], initial: Vec<f64>) -> TabularMdp {
    let (mut offsets, mut next, mut probabilities) = (vec![0], Vec::new(), Vec::new());
    for row in rows {
        for (state, &p) in row.iter().enumerate().filter(|(_, p)| **p > 0.0) {
            next.push(state as u32);
            probabilities.push(p);
        }
        offsets.push(next.len());
    }
    TabularMdp::new(initial.len(), n_actions, offsets, next, probabilities, Some(initial)).expect("a model")
}

/// Random, deterministic, nearly deterministic and terminal dynamics; starts at all states or at few.
fn any_process(random: &mut Pcg64) -> TabularMdp {
    let n = pick(&[1, 1, 2, 3, 4, 6], random);
    let a = pick(&[1, 2, 3], random);
    let kind = below(4, random);
    let rows: Vec<Vec<f64>> = (0..n * a)
        .map(|pair| {
            let mut row = vec![0.0; n];
            match kind {
                // every action leads to where it leads
                0 => row[below(n, random)] = 1.0,
                // and next to never elsewhere
                1 => {
                    row[below(n, random)] = 1.0 - 1e-9;
                    row[below(n, random)] += 1e-9;
                }
                // the last state is terminal, the first a trap of its own
                2 if pair / a + 1 == n || pair / a == 0 => row[pair / a] = 1.0,
                _ => {
                    let weights: Vec<f64> = vector(n, random).iter().map(|w| (w - 0.4).max(0.0)).collect();
                    row = if weights.iter().all(|w| *w == 0.0) { vec![1.0; n] } else { weights };
                    row = normalised(row);
                }
            }
            row
        })
        .collect();
    let mut initial = vec![0.0; n];
    if below(2, random) == 0 {
        initial[below(n, random)] = 1.0;
    } else {
        initial = normalised(vector(n, random).iter().map(|w| w + 0.01).collect());
    }
    process(a, &rows, initial)
}

/// Episodes of unequal length, of one step, of one action alone, and of what the model cannot do.
fn any_demonstrations(mdp: &TabularMdp, random: &mut Pcg64) -> Demonstrations {
    let (n, a) = (mdp.n_states(), mdp.n_actions());
    let (longest, count) = (pick(&[1, 4, 12], random), pick(&[1, 2, 8], random));
    match below(4, random) {
        0 => {
            let only = below(a, random);
            let one = (0..n * a).map(|pair| f64::from(u8::from(pair % a == only))).collect();
            episodes(mdp, &Policy::new(a, one).expect("a policy"), count, longest, random)
        }
        1 => (0..count)
            .map(|_| {
                let steps = 1 + below(longest, random);
                let draw = |n: usize, random: &mut Pcg64| (0..steps).map(|_| below(n, random) as u32).collect();
                let (states, actions) = (draw(n, random), draw(a, random));
                Trajectory::new(states, actions, None, n as u32, a as u32).expect("a trajectory")
            })
            .collect(),
        _ => episodes(mdp, &random::policy(n, a, random), count, longest, random),
    }
}

/// Columns that vary, that do not, that repeat each other, that are zero, of any unit; on states or on pairs.
fn any_features(mdp: &TabularMdp, random: &mut Pcg64) -> Features {
    let on_pairs = below(2, random) == 0;
    let rows = if on_pairs { mdp.n_pairs() } else { mdp.n_states() };
    let columns: Vec<Vec<f64>> = (0..=below(4, random))
        .map(|_| match below(5, random) {
            0 => vec![1.0; rows],
            1 => vec![0.0; rows],
            2 => (0..rows).map(|row| row as f64).collect(),
            3 => (0..rows).map(|row| 2.0 * row as f64).collect(),
            _ => vector(rows, random),
        })
        .collect();
    let unit = pick(&[1.0, 1.0, 1e-9, 1e9, -1.0, 1e-100, 1e100], random);
    let table: Vec<f64> = (0..rows).flat_map(|row| columns.iter().map(move |column| unit * column[row])).collect();
    let names = (0..columns.len()).map(|f| format!("f{f}")).collect();
    if on_pairs {
        Features::of_pairs(rows, names, &table).expect("features")
    } else {
        Features::of_states(rows, mdp.n_actions(), names, &table).expect("features")
    }
}

fn any_options(random: &mut Pcg64) -> FitOptions {
    FitOptions {
        discount: pick(&[0.0, 0.5, 0.9, 0.99, 0.9999, 1.0], random),
        horizon: pick(&[None, Some(1), Some(3), Some(30)], random),
        horizon_prior: pick(&[HorizonPrior::Geometric, HorizonPrior::Uniform], random),
        basis: pick(&[BasisKind::State, BasisKind::StateAction, BasisKind::Features], random),
        m_step: pick(&[MStep::Nnls, MStep::Simplex], random),
        responsibility: pick(&[Responsibility::Approximate, Responsibility::Exact], random),
        planner: pick(
            &[
                PlannerKind::ValueIteration,
                PlannerKind::PolicyIteration,
                PlannerKind::SoftValueIteration,
                PlannerKind::ExpectationMaximization,
            ],
            random,
        ),
        penalty: pick(&[Penalty::L1, Penalty::L2, Penalty::None], random),
        penalty_strength: pick(&[None, Some(0.0), Some(1e-3), Some(1.0), Some(1e3)], random),
        posterior: pick(&[PosteriorKind::None, PosteriorKind::Laplace, PosteriorKind::Mcmc], random),
        reward_prior: pick(&[RewardPrior::Uniform, RewardPrior::Exponential, RewardPrior::Beta], random),
        rationality: pick(&[0.0, 1.0, 10.0, 1e3], random),
        chains: pick(&[1, 2], random),
        draws: Some(pick(&[1, 10], random)),
        warm_up: Some(pick(&[0, 10], random)),
        smoothing: pick(&[0.0, 1.0], random),
        max_iterations: MAX_ITERATIONS,
        ..FitOptions::default()
    }
}

fn counts(mdp: &TabularMdp, data: &Demonstrations) -> Statistics {
    let mut builder = Statistics::builder(mdp.n_states(), mdp.n_actions(), None);
    builder.extend(data).expect("within the process");
    builder.finish().expect("a trajectory")
}

fn run(method: &dyn Method, problem: &Problem<'_>) -> Result<Fit, FitError> {
    irl::fit(method, problem, &mut |_| ControlFlow::Continue(()))
}

/// Why a fit is not one, where it is not.
fn flaw(fit: &Fit, mdp: &TabularMdp) -> Option<String> {
    let (n_pairs, a) = (mdp.n_pairs(), mdp.n_actions());
    let finite = |values: &[f64]| values.iter().all(|x| x.is_finite());
    let numbers = [
        ("weights", &fit.weights),
        ("reward", &fit.reward),
        ("policy", &fit.policy),
        ("greedy_policy", &fit.greedy_policy),
        ("state_values", &fit.state_values),
    ];
    if let Some((name, values)) = numbers.iter().find(|(_, values)| !finite(values)) {
        return Some(format!("{name}: {values:?}"));
    }
    if (fit.reward.len(), fit.policy.len(), fit.greedy_policy.len()) != (n_pairs, n_pairs, n_pairs) {
        return Some("shapes".to_owned());
    }
    let row = |row: &[f64]| (row.iter().sum::<f64>() - 1.0).abs() < 1e-9 && row.iter().all(|p| *p >= 0.0);
    for (name, policy) in [("policy", &fit.policy), ("greedy_policy", &fit.greedy_policy)] {
        if let Some(wrong) = policy.chunks_exact(a).find(|r| !row(r)) {
            return Some(format!("{name}: {wrong:?}"));
        }
    }
    if let Some(entry) = fit.trace.iter().find(|t| !(t.objective.is_finite() && t.change.is_finite())) {
        return Some(format!("trace: {entry:?}"));
    }
    // an infinite standard error says "undetermined"
    if fit.standard_errors.iter().flatten().any(|e| e.is_nan() || *e < 0.0) {
        return Some(format!("standard errors: {:?}", fit.standard_errors));
    }
    if let Some(posterior) = &fit.posterior {
        let sane = posterior.standard_deviations.iter().all(|d| *d >= 0.0)
            && posterior.low.iter().zip(&posterior.high).all(|(low, high)| low <= high);
        if !sane || posterior.low.len() != fit.weights.len() {
            return Some(format!("posterior: {posterior:?}"));
        }
    }
    if let Some(wrong) = fit.hyperparameters.iter().find(|h| !h.value.is_finite()) {
        return Some(format!("hyperparameter: {wrong:?}"));
    }
    None
}

/// Errors that options or data call for.
fn called_for(error: &FitError, method: &dyn Method, options: &FitOptions) -> bool {
    match error {
        // an undiscounted sum over all time has no value; soft values of one policy need a discount
        FitError::InvalidOption { field: "discount", .. } => options.discount == 1.0,
        // rewards that must be probabilities, features that say nothing
        FitError::InvalidOption { field: "basis", .. } => options.basis == BasisKind::Features,
        FitError::InvalidOption { .. } => method.id() != "em" && method.id() != "em-tied" && method.id() != "bc",
        FitError::ImpossibleTransitions { .. } | FitError::NeedsActions { .. } => true,
        _ => false,
    }
}

/// Fits with every method and says what is wrong; counts the fits of each.
fn wrongs(seed: u64, problem: &Problem<'_>, fits: &mut [u32]) -> Vec<String> {
    let mut wrongs = Vec::new();
    for (method, fits) in METHODS.iter().zip(fits) {
        let outcome = catch_unwind(AssertUnwindSafe(|| run(*method, problem)));
        *fits += u32::from(matches!(outcome, Ok(Ok(_))));
        let wrong = match outcome {
            Ok(Ok(found)) => flaw(&found, problem.mdp),
            Ok(Err(error)) if called_for(&error, *method, problem.options) => None,
            Ok(Err(error)) => Some(error.to_string()),
            Err(_) => Some("a panic".to_owned()),
        };
        wrongs.extend(wrong.map(|wrong| format!("seed {seed}, {}: {wrong} with {:?}", method.id(), problem.options)));
    }
    wrongs
}

fn assert_none(wrongs: &[String]) {
    assert!(wrongs.is_empty(), "{} wrong, such as\n{}", wrongs.len(), wrongs[..wrongs.len().min(12)].join("\n"));
}

#[test]
fn every_method_fits_or_says_why_not() {
    let mut wrong = Vec::new();
    let mut fits = vec![0; METHODS.len()];
    let cases = 1500;
    for seed in 0..cases {
        let mut random = generator(seed);
        let mdp = any_process(&mut random);
        let data = any_demonstrations(&mdp, &mut random);
        let features = any_features(&mdp, &mut random);
        let options = any_options(&mut random);
        let statistics = counts(&mdp, &data).repeated(pick(&[1, 1, 1_000_000_000], &mut random));
        wrong.extend(wrongs(
            seed,
            &Problem {
                mdp: &mdp,
                options: &options,
                statistics: &statistics,
                demonstrations: Some(&data),
                features: Some(&features),
            },
            &mut fits,
        ));
    }
    assert_none(&wrong);
    for (method, &fits) in METHODS.iter().zip(&fits) {
        println!("{}: {fits} fits of {cases}", method.id());
        assert!(2 * u64::from(fits) > cases, "{} refused most cases: {fits} fits of {cases}", method.id());
    }
}

#[test]
fn states_alone_fit_or_say_why_not() {
    let mut wrong = Vec::new();
    let mut fits = vec![0; METHODS.len()];
    for seed in 10_000..10_500 {
        let mut random = generator(seed);
        let mdp = any_process(&mut random);
        let states_of = |t: &Trajectory| {
            let last = t.final_state().unwrap_or(t.states()[0]);
            Trajectory::states_only(t.states().to_vec(), Some(last), mdp.n_states() as u32).expect("a trajectory")
        };
        let data: Demonstrations = any_demonstrations(&mdp, &mut random)
            .iter()
            .map(|t| if uniform(&mut random) < 0.3 { t.clone() } else { states_of(t) })
            .collect();
        let features = any_features(&mdp, &mut random);
        let options = FitOptions { max_iterations: 5, posterior: PosteriorKind::None, ..any_options(&mut random) };
        let statistics = counts(&mdp, &data);
        wrong.extend(wrongs(
            seed,
            &Problem {
                mdp: &mdp,
                options: &options,
                statistics: &statistics,
                demonstrations: Some(&data),
                features: Some(&features),
            },
            &mut fits,
        ));
    }
    assert_none(&wrong);
}

#[test]
fn wrong_options_are_named() {
    for seed in 0..200 {
        wrong_options_of(seed);
    }
}

fn wrong_options_of(seed: u64) {
    let mut random = generator(seed);
    let mdp = any_process(&mut random);
    let data = any_demonstrations(&mdp, &mut random);
    let statistics = counts(&mdp, &data);
    let mut options =
        FitOptions { max_iterations: 2, chains: 1, draws: Some(2), warm_up: Some(2), ..FitOptions::default() };
    let wrong = [f64::NAN, f64::INFINITY, f64::NEG_INFINITY, -1.0, -1e-300];
    let mut fields = Vec::new();
    for field in [
        "discount",
        "horizon",
        "max_iterations",
        "chains",
        "draws",
        "penalty_strength",
        "rationality",
        "tolerance",
        "smoothing",
    ] {
        if below(4, &mut random) > 0 && !(fields.is_empty() && field == "smoothing") {
            continue;
        }
        fields.push(field);
        match field {
            "discount" => options.discount = pick(&[f64::NAN, f64::INFINITY, -0.1, 1.0 + 1e-9], &mut random),
            "horizon" => options.horizon = Some(0),
            "max_iterations" => options.max_iterations = 0,
            "chains" => options.chains = 0,
            "draws" => options.draws = Some(0),
            "penalty_strength" => options.penalty_strength = Some(pick(&wrong, &mut random)),
            "rationality" => options.rationality = pick(&wrong, &mut random),
            "tolerance" => options.tolerance = pick(&wrong, &mut random),
            _ => options.smoothing = pick(&wrong, &mut random),
        }
    }
    let problem =
        Problem { mdp: &mdp, options: &options, statistics: &statistics, demonstrations: Some(&data), features: None };
    for method in METHODS {
        match run(*method, &problem) {
            Err(FitError::InvalidOption { field, message }) => {
                assert!(fields.contains(&field), "{}: {field}: {message} for {fields:?}", method.id());
                assert!(message.starts_with("expected"), "{message}");
            }
            other => panic!("{} with {options:?}: {other:?}", method.id()),
        }
    }
}
