//! `em` and `em-mixture` with a user's features.

mod random;

use mazeway_learner::irl::{self, BasisKind, Fit, FitError, FitOptions, HorizonPrior, MStep, Problem, Responsibility};
use mazeway_learner::mdp::{Features, TabularMdp};
use mazeway_learner::trajectory::Demonstrations;
use proptest::prelude::*;
use random::{episodes, generator, mdp, policy, statistics, vector};
use std::ops::ControlFlow;

fn fit(
    id: &str,
    mdp: &TabularMdp,
    features: Option<&Features>,
    data: &Demonstrations,
    options: &FitOptions,
) -> Result<Fit, FitError> {
    let statistics = statistics(mdp, data);
    let problem = Problem { mdp, options, statistics: &statistics, demonstrations: Some(data), features };
    irl::fit(irl::method(id).expect("a method"), &problem, &mut |_| ControlFlow::Continue(()))
}

fn names(n: usize) -> Vec<String> {
    (0..n).map(|f| format!("f{f}")).collect()
}

proptest! {
    #![proptest_config(ProptestConfig::with_cases(48))]

    #[test]
    fn a_table_of_ones_is_the_dirac_basis(seed in 0_u64..1_000_000, n in 2_usize..10, exact in any::<bool>(), simplex in any::<bool>()) {
        let mut random = generator(seed);
        let mdp = mdp(n, 2, 4, &mut random);
        let data = episodes(&mdp, &policy(n, 2, &mut random), 6, 8, &mut random);
        let table: Vec<f64> = (0..n * n).map(|i| f64::from(u8::from(i / n == i % n))).collect();
        let features = Features::of_states(n, 2, names(n), &table).expect("features");
        let options = FitOptions {
            m_step: if simplex { MStep::Simplex } else { MStep::Nnls },
            responsibility: if exact { Responsibility::Exact } else { Responsibility::Approximate },
            reference_basis: 1,
            max_iterations: 3,
            ..FitOptions::default()
        };
        for id in ["em", "em-mixture"] {
            let dirac = fit(id, &mdp, None, &data, &options).expect("a fit");
            let options = FitOptions { basis: BasisKind::Features, ..options.clone() };
            let table = fit(id, &mdp, Some(&features), &data, &options).expect("a fit");
            for (w, v) in dirac.weights.iter().zip(&table.weights) {
                prop_assert!((w - v).abs() < 1e-6, "{id}: {:?} and {:?}", dirac.weights, table.weights);
            }
            for (t, u) in dirac.trace.iter().zip(&table.trace) {
                prop_assert!((t.objective - u.objective).abs() < 1e-6 * (1.0 + t.objective.abs()));
            }
        }
    }

    #[test]
    fn the_simplex_step_maximises_q(seed in 0_u64..1_000_000, n in 2_usize..10, b in 1_usize..8, scale in -3_i32..4) {
        let mut random = generator(seed);
        let mdp = mdp(n, 2, 4, &mut random);
        let data = episodes(&mdp, &policy(n, 2, &mut random), 6, 8, &mut random);
        let table: Vec<f64> = vector(2 * n * b, &mut random).iter().map(|x| x * 10_f64.powi(scale)).collect();
        let features = Features::of_pairs(2 * n, names(b), &table).expect("features");
        let options = FitOptions { m_step: MStep::Simplex, basis: BasisKind::Features, ..FitOptions::default() };
        let found = fit("em", &mdp, Some(&features), &data, &options).expect("a fit");
        prop_assert!((found.weights.iter().sum::<f64>() - 1.0).abs() < 1e-9, "{:?}", found.weights);
        let statistics = statistics(&mdp, &data);
        let longest = statistics.longest();
        let prior = HorizonPrior::Geometric.probabilities(0.9, longest, longest as usize);
        let counts = statistics.weighted_counts(usize::MAX, |k| prior[k]);
        // c − C w = λ where w > 0, and no more than λ elsewhere
        let mut slopes = vec![0.0; b];
        let mut size: f64 = 0.0;
        for (pair, count) in counts.iter().enumerate() {
            let phi = &table[pair * b..][..b];
            let reward: f64 = phi.iter().zip(&found.weights).map(|(x, w)| x * w).sum();
            for (slope, x) in slopes.iter_mut().zip(phi) {
                *slope += count * x * (1.0 - reward);
                size += count * x * (1.0 + reward);
            }
        }
        let multiplier = slopes.iter().copied().fold(f64::NEG_INFINITY, f64::max);
        for (w, slope) in found.weights.iter().zip(&slopes) {
            prop_assert!(*w >= 0.0 && (*w < 1e-9 || multiplier - slope < 1e-7 * size), "{:?} {slopes:?}", found.weights);
        }
    }

    #[test]
    fn the_unit_of_features_does_not_change_the_mixture(seed in 0_u64..1_000_000, n in 2_usize..8, b in 1_usize..5) {
        let mut random = generator(seed);
        let mdp = mdp(n, 2, 4, &mut random);
        let data = episodes(&mdp, &policy(n, 2, &mut random), 6, 8, &mut random);
        let table = vector(2 * n * b, &mut random);
        let options = FitOptions { basis: BasisKind::Features, ..FitOptions::default() };
        let fits = [1.0, 1e-200, 1e200].map(|unit| {
            let table: Vec<f64> = table.iter().map(|x| x * unit).collect();
            let features = Features::of_pairs(2 * n, names(b), &table).expect("features");
            fit("em-mixture", &mdp, Some(&features), &data, &options).expect("a fit")
        });
        for other in &fits[1..] {
            prop_assert!(fits[0].weights.iter().zip(&other.weights).all(|(w, v)| (w - v).abs() < 1e-6));
        }
    }
}

#[test]
fn what_is_no_probability_is_refused_or_said() {
    let mut random = generator(1);
    let mdp = mdp(3, 2, 2, &mut random);
    let data = episodes(&mdp, &policy(3, 2, &mut random), 4, 5, &mut random);
    let options = FitOptions { basis: BasisKind::Features, ..FitOptions::default() };
    let with = |table: [f64; 6]| Features::of_states(3, 2, ["speed", "risk"].map(str::to_owned).to_vec(), &table);
    let negative = with([0.5, 0.0, 0.0, 0.0, 1.0, -2.0]).expect("features");
    for id in ["em", "em-mixture"] {
        let error = fit(id, &mdp, Some(&negative), &data, &options).expect_err("a refusal").to_string();
        assert_eq!(
            error,
            "basis: expected features that are not negative, for the method takes rewards as probabilities, got -2 of risk at \
             state 2, action 0"
        );
    }
    let large = with([0.5, 0.0, 7.0, 0.0, 1.0, 0.0]).expect("features");
    let found = fit("em", &mdp, Some(&large), &data, &options).expect("a fit");
    assert!(found.warnings.iter().any(|w| w.contains("a feature reaches 7")), "{:?}", found.warnings);
    assert!(found.warnings.iter().any(|w| w.contains("1 of 2 features are 0 wherever")), "{:?}", found.warnings);
    let nothing = with([0.0; 6]).expect("features");
    assert_eq!(fit("em", &mdp, Some(&nothing), &data, &options).expect("a fit").weights, [0.5, 0.5]);
    let error = fit("em-mixture", &mdp, Some(&nothing), &data, &options).expect_err("a refusal");
    assert!(matches!(error, FitError::InvalidOption { field: "basis", .. }), "{error}");
    let huge = with([1e200; 6]).expect("features");
    let error = fit("em", &mdp, Some(&huge), &data, &options).expect_err("a refusal");
    assert!(matches!(error, FitError::InvalidOption { field: "basis", .. }), "{error}");
}
