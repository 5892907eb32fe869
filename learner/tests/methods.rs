//! Laws of the learning methods on random processes and demonstrations.

mod random;

use mazeway_learner::irl::em_tied::{Likelihood, fit_with_basis};
use mazeway_learner::irl::{
    self, Basis, BasisKind, Fit, FitError, FitOptions, HorizonPrior, METHODS, MStep, Penalty, PlannerKind,
    PosteriorKind, Problem, Responsibility, RewardPrior, Stopped,
};
use mazeway_learner::mdp::{Features, TabularMdp};
use mazeway_learner::statistics::Statistics;
use mazeway_learner::trajectory::{Demonstrations, Trajectory};
use proptest::prelude::*;
use random::{below, episodes, generator, mdp, permutation, permuted, policy, statistics, vector};
use std::ops::ControlFlow;

fn table(mdp: &TabularMdp, n_features: usize, values: &[f64]) -> Features {
    let names = (0..n_features).map(|f| format!("f{f}")).collect();
    Features::of_pairs(mdp.n_pairs(), names, values).expect("features")
}

fn fit(id: &str, mdp: &TabularMdp, data: &Demonstrations, options: &FitOptions) -> Result<Fit, FitError> {
    let statistics = statistics(mdp, data);
    let problem = Problem { mdp, options, statistics: &statistics, demonstrations: Some(data), features: None };
    irl::method(id).expect("a method").fit(&problem, &mut |_| ControlFlow::Continue(()))
}

fn pick<T: Copy>(from: &[T], random: &mut rand_pcg::Pcg64) -> T {
    from[below(from.len(), random)]
}

fn random_options(random: &mut rand_pcg::Pcg64) -> FitOptions {
    FitOptions {
        discount: pick(&[0.0, 0.5, 0.9, 0.99, 0.9999], random),
        horizon: pick(&[None, Some(1), Some(3), Some(100)], random),
        horizon_prior: pick(&[HorizonPrior::Geometric, HorizonPrior::Uniform], random),
        basis: pick(&[BasisKind::State, BasisKind::StateAction], random),
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
        penalty_strength: Some(pick(&[0.0, 0.01, 1.0, 100.0], random)),
        smoothing: pick(&[0.0, 1.0], random),
        max_iterations: 200,
        reward_prior: pick(&[RewardPrior::Uniform, RewardPrior::Exponential, RewardPrior::Beta], random),
        rationality: pick(&[0.0, 1.0, 10.0, 1e4], random),
        chains: 2,
        draws: Some(pick(&[1, 10], random)),
        warm_up: Some(pick(&[0, 10], random)),
        ..FitOptions::default()
    }
}

proptest! {
    #![proptest_config(ProptestConfig { cases: 100, failure_persistence: None, ..ProptestConfig::default() })]

    #[test]
    fn no_fit_holds_a_number_that_is_none(seed in 0_u64..1_000_000, n in 1_usize..20, a in 1_usize..5, l in 1_usize..30) {
        let mut random = generator(seed);
        let mdp = mdp(n, a, 4, &mut random);
        let data = episodes(&mdp, &policy(n, a, &mut random), l, 12, &mut random);
        let options = random_options(&mut random);
        for method in METHODS {
            let found = fit(method.id(), &mdp, &data, &options);
            let found = found.unwrap_or_else(|error| panic!("{} with {options:?}: {error}", method.id()));
            let all = [&found.weights, &found.reward, &found.policy, &found.greedy_policy, &found.state_values];
            prop_assert!(all.iter().all(|v| v.iter().all(|x| x.is_finite())), "{} with {options:?}: {found:?}", method.id());
            prop_assert!(found.trace.iter().all(|t| t.objective.is_finite() && t.change.is_finite()), "{}: {:?}", method.id(), found.trace);
            prop_assert!(found.standard_errors.iter().flatten().all(|e| *e >= 0.0), "{:?}", found.standard_errors);
            prop_assert_eq!((found.reward.len(), found.policy.len(), found.state_values.len()), (n * a, n * a, n));
            for row in found.policy.chunks_exact(a).chain(found.greedy_policy.chunks_exact(a)) {
                prop_assert!((row.iter().sum::<f64>() - 1.0).abs() < 1e-9 && row.iter().all(|p| *p >= 0.0));
            }
            prop_assert_eq!(found.iterations as usize, found.trace.len());
        }
    }

    #[test]
    fn gradient_and_hessian_match_differences(seed in 0_u64..1_000_000, n in 1_usize..8, a in 2_usize..4, d in 0_usize..4, kind in 0_usize..3) {
        let mut random = generator(seed);
        let mdp = mdp(n, a, 4, &mut random);
        let discount = [0.0, 0.5, 0.9, 0.99][d];
        let data = episodes(&mdp, &policy(n, a, &mut random), 10, 10, &mut random);
        let basis = match kind {
            0 => Basis::state(&mdp),
            1 => Basis::state_action(&mdp),
            _ => Basis::features(&table(&mdp, 3, &vector(n * a * 3, &mut random))),
        };
        let counts = statistics(&mdp, &data).counts(None);
        let mut likelihood = Likelihood::new(&mdp, &basis, counts, discount);
        let weights: Vec<f64> = vector(basis.len(), &mut random).iter().map(|w| 4.0 * w - 2.0).collect();
        let (value, gradient) = likelihood.value_and_gradient(&weights);
        prop_assert!(value <= 0.0);
        let hessian = likelihood.hessian(&weights);
        let step = 1e-4;
        for b in 0..basis.len() {
            let mut moved = weights.clone();
            moved[b] += step;
            let (above, gradient_above) = likelihood.value_and_gradient(&moved);
            moved[b] -= 2.0 * step;
            let (below, gradient_below) = likelihood.value_and_gradient(&moved);
            let slope = (above - below) / (2.0 * step);
            // the error of central differences grows with the third derivative, hence with the effective horizon
            let tolerance = 1e-5 * (1.0 + gradient[b].abs()) / (1.0 - discount);
            prop_assert!((slope - gradient[b]).abs() < tolerance, "gradient {b}: {slope} and {}", gradient[b]);
            for c in 0..basis.len() {
                let curvature = (gradient_above[c] - gradient_below[c]) / (2.0 * step);
                let tolerance = 1e-4 * (1.0 + hessian[(b, c)].abs()) / (1.0 - discount).powi(2);
                prop_assert!((curvature - hessian[(b, c)]).abs() < tolerance, "hessian {b} {c}: {curvature} and {}", hessian[(b, c)]);
            }
        }
    }

    #[test]
    fn a_permutation_of_states_permutes_the_answer(seed in 0_u64..1_000_000, n in 2_usize..12, a in 1_usize..4) {
        let mut random = generator(seed);
        let original = mdp(n, a, 4, &mut random);
        let data = episodes(&original, &policy(n, a, &mut random), 12, 10, &mut random);
        let order = permutation(n, &mut random);
        let renamed = permuted(&original, &order);
        let renamed_data: Demonstrations = data.iter().map(|t| {
            let states = t.states().iter().map(|&s| order[s as usize] as u32).collect();
            Trajectory::new(states, t.actions().to_vec(), None, n as u32, a as u32).expect("a trajectory")
        }).collect();
        let reference = below(n, &mut random);
        for (id, m_step) in [("em", MStep::Nnls), ("em", MStep::Simplex), ("em-mixture", MStep::Nnls), ("em-tied", MStep::Nnls), ("bc", MStep::Nnls)] {
            let options = FitOptions { m_step, reference_basis: reference as u32, tolerance: 1e-9, penalty_strength: Some(0.5), posterior: PosteriorKind::None, ..FitOptions::default() };
            let found = fit(id, &original, &data, &options).expect("a fit");
            let options = FitOptions { reference_basis: order[reference] as u32, ..options };
            let moved = fit(id, &renamed, &renamed_data, &options).expect("a fit");
            for (s, &to) in order.iter().enumerate() {
                for action in 0..a {
                    let (p, q) = (found.policy[s * a + action], moved.policy[to * a + action]);
                    prop_assert!((p - q).abs() < 1e-3, "{id} {m_step:?}: {p} and {q}");
                }
                if id != "bc" && id != "em-mixture" {
                    let (w, v) = (found.weights[s], moved.weights[to]);
                    prop_assert!((w - v).abs() < 1e-3 * (1.0 + w.abs()), "{id} {m_step:?}: {w} and {v}");
                }
            }
        }
    }

    #[test]
    fn em_solves_its_stationarity_conditions(seed in 0_u64..1_000_000, n in 2_usize..15, l in 1_usize..20) {
        let mut random = generator(seed);
        let mdp = mdp(n, 2, 4, &mut random);
        let data = episodes(&mdp, &policy(n, 2, &mut random), l, 10, &mut random);
        let options = FitOptions { m_step: MStep::Simplex, ..FitOptions::default() };
        let found = fit("em", &mdp, &data, &options).expect("a fit");
        prop_assert!((found.weights.iter().sum::<f64>() - 1.0).abs() < 1e-9);
        let statistics = statistics(&mdp, &data);
        let prior = HorizonPrior::Geometric.probabilities(0.9, statistics.longest(), statistics.longest() as usize);
        let counts = statistics.weighted_counts(usize::MAX, |k| prior[k]);
        // c − C w = λ where w > 0, and no more than λ elsewhere
        let slopes: Vec<f64> = (0..n).map(|s| (counts[2 * s] + counts[2 * s + 1]) * (1.0 - found.weights[s])).collect();
        let active: Vec<f64> = (0..n).filter(|&s| found.weights[s] > 1e-12).map(|s| slopes[s]).collect();
        let multiplier = active.iter().sum::<f64>() / active.len() as f64;
        prop_assert!(active.iter().all(|s| (s - multiplier).abs() < 1e-9));
        prop_assert!(slopes.iter().all(|s| *s <= multiplier + 1e-9));
    }

    #[test]
    fn tied_weights_satisfy_their_optimality_conditions(seed in 0_u64..1_000_000, n in 2_usize..12, a in 2_usize..4) {
        let mut random = generator(seed);
        let mdp = mdp(n, a, 4, &mut random);
        let data = episodes(&mdp, &policy(n, a, &mut random), 20, 10, &mut random);
        let options = FitOptions { tolerance: 1e-12, posterior: PosteriorKind::None, ..FitOptions::default() };
        let found = fit("em-tied", &mdp, &data, &options).expect("a fit");
        prop_assert_eq!(found.stopped, Stopped::Converged);
        let basis = Basis::state(&mdp);
        let counts = statistics(&mdp, &data).counts(None);
        let (_, gradient) = Likelihood::new(&mdp, &basis, counts, options.discount).value_and_gradient(&found.weights);
        for (w, g) in found.weights.iter().zip(gradient) {
            prop_assert!(g <= 1.0 + 1e-3, "slope {g} beyond the penalty's");
            prop_assert!(*w == 0.0 || (g - 1.0).abs() < 1e-3, "slope {g} at weight {w}");
        }
        prop_assert!(found.trace.windows(2).all(|pair| pair[1].objective >= pair[0].objective - 1e-9));
    }

    #[test]
    fn the_mixture_likelihood_only_rises(seed in 0_u64..1_000_000, n in 2_usize..12) {
        let mut random = generator(seed);
        let mdp = mdp(n, 2, 4, &mut random);
        let data = episodes(&mdp, &policy(n, 2, &mut random), 15, 10, &mut random);
        let found = fit("em-mixture", &mdp, &data, &FitOptions::default()).expect("a fit");
        prop_assert!(found.trace.windows(2).all(|pair| pair[1].objective >= pair[0].objective - 1e-9));
        prop_assert!((found.weights.iter().sum::<f64>() - 1.0).abs() < 1e-9);
    }
}

/// A bus engine (Rust 1987): mileage grows at random, keeping costs with mileage, replacing costs once and starts anew.
fn bus(bins: usize) -> (TabularMdp, Basis) {
    let grow = [0.35, 0.6, 0.05];
    let (mut offsets, mut next, mut probabilities) = (vec![0], Vec::new(), Vec::new());
    for mileage in 0..bins {
        for from in [mileage, 0] {
            for (step, p) in grow.iter().enumerate() {
                let to = (from + step).min(bins - 1) as u32;
                if next.len() > *offsets.last().expect("an offset") && next.last() == Some(&to) {
                    *probabilities.last_mut().expect("an entry") += p;
                } else {
                    next.push(to);
                    probabilities.push(*p);
                }
            }
            offsets.push(next.len());
        }
    }
    let mdp = TabularMdp::new(bins, 2, offsets, next, probabilities, None).expect("a model");
    let features: Vec<f64> = (0..bins).flat_map(|m| [-0.001 * m as f64, 0.0, 0.0, -1.0]).collect();
    let basis = Basis::features(&table(&mdp, 2, &features));
    (mdp, basis)
}

#[test]
fn dynamic_discrete_choice_is_recovered_at_a_discount_of_0_9999() {
    let (mdp, basis) = bus(90);
    // cost of 1,000 times the mileage bin, and of a replacement: Rust's own order of magnitude
    let truth = [2.6, 9.8];
    let discount = 0.9999;
    let mut soft = mazeway_learner::mdp::SoftSolver::new(&mdp, discount);
    soft.solve(&basis.reward(&truth));
    let policy = mazeway_learner::mdp::Policy::new(2, soft.policy().to_vec()).expect("a policy");
    let options = FitOptions { discount, penalty: Penalty::None, ..FitOptions::default() };
    let (mut covered, mut squares) = ([0; 2], [0.0; 2]);
    let seeds = 20;
    for seed in 0..seeds {
        let mut random = generator(seed);
        let data: Demonstrations =
            (0..60).flat_map(|_| episodes(&mdp, &policy, 1, 400, &mut random).trajectories().to_vec()).collect();
        let statistics = statistics(&mdp, &data);
        let problem =
            Problem { mdp: &mdp, options: &options, statistics: &statistics, demonstrations: None, features: None };
        let found = fit_with_basis(&problem, &basis, &mut |_| ControlFlow::Continue(())).expect("a fit");
        assert_eq!(found.stopped, Stopped::Converged);
        assert!(found.warnings.is_empty(), "{:?}", found.warnings);
        let errors = found.standard_errors.expect("standard errors");
        let (_, gradient) =
            Likelihood::new(&mdp, &basis, statistics.counts(None), discount).value_and_gradient(&found.weights);
        for b in 0..2 {
            let z = (found.weights[b] - truth[b]) / errors[b];
            covered[b] += usize::from(z.abs() < 1.96);
            squares[b] += z * z;
            // a maximum: moving by a standard error along the slope would gain next to nothing
            assert!((gradient[b] * errors[b]).abs() < 1e-2, "slope {} at {:?}", gradient[b], found.weights);
        }
    }
    println!("within 1.96 standard errors: {covered:?} of {seeds}; mean square of z: {squares:?}");
    for b in 0..2 {
        assert!(covered[b] >= 16, "weight {b} lies within its interval in {} of {seeds} fits", covered[b]);
        assert!((0.4..2.0).contains(&(squares[b] / seeds as f64)), "weight {b}: {}", squares[b] / seeds as f64);
    }
}

#[test]
fn an_undetermined_weight_has_an_infinite_standard_error() {
    let (mdp, _) = bus(20);
    // a constant changes no choice; the cost of a replacement does
    let features: Vec<f64> = (0..20).flat_map(|_| [1.0, 0.0, 1.0, -1.0]).collect();
    let basis = Basis::features(&table(&mdp, 2, &features));
    let mut random = generator(3);
    let data = episodes(&mdp, &policy(20, 2, &mut random), 40, 50, &mut random);
    let statistics = statistics(&mdp, &data);
    let options = FitOptions { penalty: Penalty::None, ..FitOptions::default() };
    let problem =
        Problem { mdp: &mdp, options: &options, statistics: &statistics, demonstrations: None, features: None };
    let found = fit_with_basis(&problem, &basis, &mut |_| ControlFlow::Continue(())).expect("a fit");
    let errors = found.standard_errors.expect("standard errors");
    assert!(errors[0].is_infinite() && errors[1].is_finite() && errors[1] > 0.0, "{errors:?}");
    assert!(found.warnings.iter().any(|w| w.contains("do not determine 1 of 2 weights")), "{:?}", found.warnings);
    // Dirac on states holds the constant: none of the weights is determined on its own, though for states that were next
    // to never passed rounding cannot tell no information from next to none
    let found = fit("em-tied", &mdp, &data, &options).expect("a fit");
    let errors = found.standard_errors.expect("standard errors");
    assert!(errors.iter().all(|e| *e > 1e6), "{errors:?} at {:?}", found.weights);
}

#[test]
fn unvisited_pairs_get_no_reward_and_their_states_a_sensible_policy() {
    let mut random = generator(11);
    let mdp = mdp(12, 3, 4, &mut random);
    let expert = policy(12, 3, &mut random);
    let data = episodes(&mdp, &expert, 3, 4, &mut random);
    let options = FitOptions { basis: BasisKind::StateAction, posterior: PosteriorKind::None, ..FitOptions::default() };
    let found = fit("em-tied", &mdp, &data, &options).expect("a fit");
    let counts = statistics(&mdp, &data).counts(None);
    for (pair, (w, n)) in found.weights.iter().zip(&counts).enumerate() {
        assert!(*n > 0.0 || *w == 0.0, "pair {pair} was never seen and has weight {w}");
    }
    assert!(found.policy.iter().all(|p| *p > 0.0));
}

#[test]
fn the_exact_product_says_that_it_lost_its_data() {
    let mut random = generator(5);
    let mdp = mdp(10, 2, 4, &mut random);
    let expert = policy(10, 2, &mut random);
    let few = episodes(&mdp, &expert, 1, 5, &mut random);
    let many = episodes(&mdp, &expert, 200, 5, &mut random);
    let options = FitOptions { responsibility: Responsibility::Exact, ..FitOptions::default() };
    assert!(fit("em", &mdp, &few, &options).expect("a fit").warnings.is_empty());
    // every state visited: then the weights follow 1/counts
    let found = fit("em", &mdp, &many, &FitOptions { horizon_prior: HorizonPrior::Uniform, ..options }).expect("a fit");
    assert!(found.warnings.iter().any(|w| w.contains("exact product")), "{:?}", found.warnings);
    let visits = statistics(&mdp, &many).state_visits(None);
    let products: Vec<f64> = found.weights.iter().zip(&visits).filter(|(_, n)| **n > 0.0).map(|(w, n)| w * n).collect();
    if visits.iter().all(|n| *n > 0.0) {
        assert!(products.iter().all(|p| (p / products[0] - 1.0).abs() < 1e-6), "{products:?}");
    }
}

#[test]
fn cloning_counts_and_smooths() {
    let mdp = mdp(3, 2, 2, &mut generator(2));
    let data = Demonstrations::new(vec![
        Trajectory::new(vec![0, 0, 0, 1], vec![0, 0, 1, 1], None, 3, 2).expect("a trajectory"),
    ]);
    let plain = fit("bc", &mdp, &data, &FitOptions::default()).expect("a fit");
    assert_eq!(plain.policy, [2.0 / 3.0, 1.0 / 3.0, 0.0, 1.0, 0.5, 0.5]);
    assert_eq!(plain.greedy_policy, [1.0, 0.0, 0.0, 1.0, 0.5, 0.5]);
    let smooth = fit("bc", &mdp, &data, &FitOptions { smoothing: 1.0, ..FitOptions::default() }).expect("a fit");
    assert_eq!(smooth.policy, [0.6, 0.4, 1.0 / 3.0, 2.0 / 3.0, 0.5, 0.5]);
    let short = fit("bc", &mdp, &data, &FitOptions { horizon: Some(1), ..FitOptions::default() }).expect("a fit");
    assert_eq!(short.policy, [1.0, 0.0, 0.5, 0.5, 0.5, 0.5]);
}

#[test]
fn undiscounted_learning_plans_over_the_horizon() {
    let mut random = generator(8);
    let mdp = mdp(6, 2, 3, &mut random);
    let data = episodes(&mdp, &policy(6, 2, &mut random), 10, 8, &mut random);
    let options = FitOptions { discount: 1.0, ..FitOptions::default() };
    for id in ["em", "em-mixture", "em-tied", "bc"] {
        let found = fit(id, &mdp, &data, &options).expect("a fit");
        assert!(found.policy.iter().all(|p| p.is_finite()));
    }
}

#[test]
fn wrong_options_are_named() {
    let mut random = generator(9);
    let mdp = mdp(4, 2, 3, &mut random);
    let data = episodes(&mdp, &policy(4, 2, &mut random), 3, 5, &mut random);
    let base = FitOptions::default();
    let wrong = [
        ("discount", FitOptions { discount: 1.5, ..base.clone() }),
        ("discount", FitOptions { discount: f64::NAN, ..base.clone() }),
        ("horizon", FitOptions { horizon: Some(0), ..base.clone() }),
        ("max_iterations", FitOptions { max_iterations: 0, ..base.clone() }),
        ("tolerance", FitOptions { tolerance: f64::NAN, ..base.clone() }),
        ("penalty_strength", FitOptions { penalty_strength: Some(-1.0), ..base.clone() }),
        ("smoothing", FitOptions { smoothing: f64::INFINITY, ..base.clone() }),
    ];
    for (name, options) in &wrong {
        for method in METHODS {
            let error = fit(method.id(), &mdp, &data, options).expect_err("a refusal");
            assert!(
                matches!(&error, FitError::InvalidOption { field, .. } if field == name),
                "{}: {error}",
                method.id()
            );
        }
    }
    let options = FitOptions { reference_basis: 4, ..base.clone() };
    assert!(matches!(fit("em", &mdp, &data, &options), Err(FitError::InvalidOption { field: "reference_basis", .. })));
    assert!(irl::method("nothing").is_none());

    let statistics = Statistics::builder(4, 3, None);
    let mut other = statistics.clone();
    other.extend(&data).expect("within four states and three actions");
    let other = other.finish().expect("counts");
    assert!(statistics.finish().is_err());
    for method in METHODS {
        let problem = Problem { mdp: &mdp, options: &base, statistics: &other, demonstrations: None, features: None };
        let error = method.fit(&problem, &mut |_| ControlFlow::Continue(())).expect_err("a refusal");
        assert!(matches!(error, FitError::Mismatch { .. }), "{}: {error}", method.id());
    }
}

#[test]
fn the_caller_can_cancel() {
    let mut random = generator(10);
    let mdp = mdp(8, 2, 3, &mut random);
    let data = episodes(&mdp, &policy(8, 2, &mut random), 5, 5, &mut random);
    let statistics = statistics(&mdp, &data);
    let options = FitOptions::default();
    for method in METHODS {
        let problem = Problem {
            mdp: &mdp,
            options: &options,
            statistics: &statistics,
            demonstrations: Some(&data),
            features: None,
        };
        let mut calls = 0;
        let cancelled = method.fit(&problem, &mut |_| {
            calls += 1;
            ControlFlow::Break(())
        });
        assert_eq!(cancelled, Err(FitError::Cancelled), "{}", method.id());
        assert_eq!(calls, 1, "{}", method.id());
    }
    let problem =
        Problem { mdp: &mdp, options: &options, statistics: &statistics, demonstrations: None, features: None };
    let mut go_on = |_: &irl::TraceEntry| ControlFlow::Continue(());
    let error = irl::method("em-mixture").expect("a method").fit(&problem, &mut go_on).expect_err("a refusal");
    assert!(matches!(error, FitError::NeedsDemonstrations { .. }));
}

#[test]
fn fits_repeat_to_the_bit() {
    let mut random = generator(12);
    let mdp = mdp(15, 3, 4, &mut random);
    let data = episodes(&mdp, &policy(15, 3, &mut random), 20, 10, &mut random);
    // the order in which trajectories come does not matter to what only counts
    let mut turned: Vec<Trajectory> = data.trajectories().to_vec();
    turned.reverse();
    let turned = Demonstrations::new(turned);
    for id in ["em", "em-tied", "bc"] {
        let once = fit(id, &mdp, &data, &FitOptions::default()).expect("a fit");
        let again = fit(id, &mdp, &turned, &FitOptions::default()).expect("a fit");
        assert_eq!(
            (once.weights, once.policy, once.iterations),
            (again.weights, again.policy, again.iterations),
            "{id}"
        );
    }
}
