//! Laws of the classical methods on random processes and demonstrations.

mod random;

use mazeway_learner::irl::{self, BasisKind, Fit, FitError, FitOptions, Penalty, Problem, Stopped};
use mazeway_learner::mdp::{Features, TabularMdp};
use mazeway_learner::trajectory::{Demonstrations, Trajectory};
use proptest::prelude::*;
use random::{below, episodes, generator, mdp, permutation, permuted, policy, statistics, vector};
use std::ops::ControlFlow;

const METHODS: [&str; 7] = ["maxent", "mce", "mce-likelihood", "projection", "max-margin", "lp", "bc-planning"];

fn fit(id: &str, mdp: &TabularMdp, data: &Demonstrations, options: &FitOptions) -> Result<Fit, FitError> {
    let statistics = statistics(mdp, data);
    let values = vector(2 * mdp.n_pairs(), &mut generator(3));
    let names = vec!["x".to_owned(), "y".to_owned()];
    let features = Features::of_pairs(mdp.n_pairs(), names, &values).expect("features");
    let problem =
        Problem { mdp, options, statistics: &statistics, demonstrations: Some(data), features: Some(&features) };
    irl::fit(irl::method(id).expect("a method"), &problem, &mut |_| ControlFlow::Continue(()))
}

fn finite(fit: &Fit) -> bool {
    let all = [&fit.weights, &fit.reward, &fit.policy, &fit.greedy_policy, &fit.state_values];
    all.iter().all(|v| v.iter().all(|x| x.is_finite()))
}

proptest! {
    #![proptest_config(ProptestConfig { cases: 30, failure_persistence: None, ..ProptestConfig::default() })]

    #[test]
    fn any_discount_basis_and_length(seed in 0_u64..1_000_000, n in 1_usize..12, a in 1_usize..4, l in 1_usize..10) {
        let mut random = generator(seed);
        let mdp = mdp(n, a, 4, &mut random);
        let data = episodes(&mdp, &policy(n, a, &mut random), l, 9, &mut random);
        for id in METHODS {
            let options = FitOptions {
                discount: [0.0, 0.9, 0.9999, 1.0][below(4, &mut random)],
                basis: [BasisKind::State, BasisKind::StateAction, BasisKind::Features][below(3, &mut random)],
                penalty: [Penalty::L1, Penalty::L2, Penalty::None][below(3, &mut random)],
                horizon: [None, Some(1), Some(4), Some(30)][below(4, &mut random)],
                max_iterations: 200,
                ..FitOptions::default()
            };
            let found = fit(id, &mdp, &data, &options).unwrap_or_else(|error| panic!("{id} with {options:?}: {error}"));
            prop_assert!(finite(&found), "{id} with {options:?}: {found:?}");
        }
    }

    #[test]
    fn a_permutation_of_states_permutes_the_answer(seed in 0_u64..1_000_000, n in 2_usize..10, a in 1_usize..4) {
        let mut random = generator(seed);
        let original = mdp(n, a, 4, &mut random);
        let data = episodes(&original, &policy(n, a, &mut random), 12, 10, &mut random);
        let order = permutation(n, &mut random);
        let renamed = permuted(&original, &order);
        let renamed_data: Demonstrations = data.iter().map(|t| {
            let states = t.states().iter().map(|&s| order[s as usize] as u32).collect();
            Trajectory::new(states, t.actions().to_vec(), None, n as u32, a as u32).expect("a trajectory")
        }).collect();
        // projection, max-margin and lp may choose between answers that are equally good
        for id in ["maxent", "mce", "mce-likelihood", "bc-planning"] {
            // strictly concave, so that the best weights are one point
            let options = FitOptions {
                tolerance: 1e-10,
                penalty: Penalty::L2,
                penalty_strength: Some(1.0),
                ..FitOptions::default()
            };
            let found = fit(id, &original, &data, &options).expect("a fit");
            let moved = fit(id, &renamed, &renamed_data, &options).expect("a fit");
            for (s, &to) in order.iter().enumerate() {
                if id == "bc-planning" {
                    for action in 0..a {
                        let (p, q) = (found.policy[s * a + action], moved.policy[to * a + action]);
                        prop_assert!((p - q).abs() < 1e-9, "{id}: {p} and {q}");
                    }
                } else {
                    let (w, v) = (found.weights[s], moved.weights[to]);
                    prop_assert!((w - v).abs() < 1e-2 * (1.0 + w.abs()), "{id}: {w} and {v}");
                }
            }
        }
    }

    #[test]
    fn what_is_maximised_only_rises(seed in 0_u64..1_000_000, n in 2_usize..12) {
        let mut random = generator(seed);
        let mdp = mdp(n, 2, 4, &mut random);
        let data = episodes(&mdp, &policy(n, 2, &mut random), 15, 10, &mut random);
        // an interior point method approaches from outside its constraints: lp is not among these
        for id in ["maxent", "mce", "mce-likelihood", "projection", "max-margin"] {
            let found = fit(id, &mdp, &data, &FitOptions::default()).expect("a fit");
            let rises = found.trace.windows(2).all(|pair| pair[1].objective >= pair[0].objective - 1e-9);
            prop_assert!(rises, "{id}: {:?}", found.trace);
        }
    }
}

/// A fit that takes several iterations with every method that iterates.
fn long_fit(id: &str, max_iterations: u32, progress: irl::Progress<'_>) -> Result<Fit, FitError> {
    let mut random = generator(4);
    let mdp = mdp(10, 3, 4, &mut random);
    let data = episodes(&mdp, &policy(10, 3, &mut random), 20, 10, &mut random);
    let statistics = statistics(&mdp, &data);
    let options =
        FitOptions { penalty: Penalty::L2, penalty_strength: Some(0.01), max_iterations, ..FitOptions::default() };
    let problem =
        Problem { mdp: &mdp, options: &options, statistics: &statistics, demonstrations: None, features: None };
    irl::fit(irl::method(id).expect("a method"), &problem, progress)
}

const ITERATE: [&str; 6] = ["maxent", "mce", "mce-likelihood", "projection", "max-margin", "lp"];

#[test]
fn every_iteration_can_be_the_last() {
    for id in ITERATE {
        let mut calls = 0;
        let cancelled = long_fit(id, 1000, &mut |_| {
            calls += 1;
            if calls == 2 { ControlFlow::Break(()) } else { ControlFlow::Continue(()) }
        });
        assert_eq!((cancelled, calls), (Err(FitError::Cancelled), 2), "{id}");
    }
}

#[test]
fn few_iterations_are_reported_as_such() {
    for id in ITERATE {
        let found = long_fit(id, 2, &mut |_| ControlFlow::Continue(())).expect("a fit");
        assert_eq!(found.stopped, Stopped::MaxIterations, "{id}");
        assert!(finite(&found));
    }
}
