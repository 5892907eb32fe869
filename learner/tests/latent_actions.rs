//! Demonstrations whose actions were not seen.

mod maze;
mod random;

use mazeway_learner::irl::{self, Fit, FitError, FitOptions, LatentActions, Penalty, PosteriorKind, Problem};
use mazeway_learner::mdp::TabularMdp;
use mazeway_learner::statistics::Statistics;
use mazeway_learner::trajectory::{Demonstrations, Trajectory};
use proptest::prelude::*;
use random::{episodes, generator, mdp, permutation, permuted, policy};
use std::ops::ControlFlow;

fn without_actions(data: &Demonstrations, n_states: usize) -> Demonstrations {
    data.iter()
        .map(|t| Trajectory::states_only(t.states().to_vec(), t.final_state(), n_states as u32).expect("a trajectory"))
        .collect()
}

fn count(mdp: &TabularMdp, data: &Demonstrations) -> Statistics {
    let mut builder = Statistics::builder(mdp.n_states(), mdp.n_actions(), None);
    builder.extend(data).expect("within the process");
    builder.finish().expect("a trajectory")
}

fn fit(id: &str, mdp: &TabularMdp, data: &Demonstrations, options: &FitOptions) -> Result<Fit, FitError> {
    let statistics = count(mdp, data);
    let problem = Problem { mdp, options, statistics: &statistics, demonstrations: Some(data), features: None };
    irl::fit(irl::method(id).expect("a method"), &problem, &mut |_| ControlFlow::Continue(()))
}

/// One next state an action and state, all of them different: the transition tells the action.
fn telling(n: usize, a: usize) -> TabularMdp {
    let next: Vec<u32> = (0..n).flat_map(|s| (0..a).map(move |k| ((s + k + 1) % n) as u32)).collect();
    TabularMdp::new(n, a, (0..=n * a).collect(), next, vec![1.0; n * a], None).expect("a model")
}

proptest! {
    #![proptest_config(ProptestConfig::with_cases(24))]

    #[test]
    fn the_observed_likelihood_only_rises(seed in 0_u64..1_000_000, n in 2_usize..9, a in 2_usize..4, kind in 0_usize..5) {
        let mut random = generator(seed);
        let mdp = mdp(n, a, 3, &mut random);
        let data = without_actions(&episodes(&mdp, &policy(n, a, &mut random), 12, 10, &mut random), n);
        let (id, penalty, smoothing) = [
            ("em-tied", Penalty::L1, 0.0), ("em-tied", Penalty::L2, 0.0), ("mce-likelihood", Penalty::L2, 0.0),
            ("bc", Penalty::L1, 0.0), ("bc", Penalty::L1, 0.5),
        ][kind];
        if irl::method(id).is_none() {
            return Ok(());
        }
        let options = FitOptions {
            penalty, smoothing, penalty_strength: Some(0.5), posterior: PosteriorKind::None, max_iterations: 100, ..FitOptions::default()
        };
        let found = fit(id, &mdp, &data, &options).expect("a fit");
        for pair in found.trace.windows(2) {
            prop_assert!(pair[1].objective >= pair[0].objective - 1e-5, "{id}: {} after {}", pair[1].objective, pair[0].objective);
        }
        let statistics = count(&mdp, &data);
        let latent = LatentActions::new(&mdp, &statistics, None).expect("possible transitions");
        let completed = latent.complete(&found.policy);
        let visits = statistics.state_visits(None);
        let inferred = completed.state_visits(None);
        prop_assert!(visits.iter().zip(&inferred).all(|(x, y)| (x - y).abs() < 1e-9), "{visits:?} and {inferred:?}");
        prop_assert_eq!(statistics.n_steps(None), completed.n_steps(None));
        // a fixed point of the E-step and the M-step of behaviour cloning
        if id == "bc" && smoothing == 0.0 {
            let counts = completed.counts(None);
            for (s, (pi, n)) in found.policy.chunks_exact(a).zip(counts.chunks_exact(a)).enumerate() {
                if visits[s] > 0.0 {
                    prop_assert!(pi.iter().zip(n).all(|(p, n)| (p - n / visits[s]).abs() < 0.05), "{pi:?} and {n:?}");
                }
            }
        }
    }

    #[test]
    fn transitions_that_tell_the_action_lose_nothing(seed in 0_u64..1_000_000, n in 4_usize..9, a in 2_usize..4) {
        let mut random = generator(seed);
        let mdp = telling(n, a);
        let data = episodes(&mdp, &policy(n, a, &mut random), 8, 10, &mut random);
        let unseen = without_actions(&data, n);
        let (seen, unseen_counts) = (count(&mdp, &data), count(&mdp, &unseen));
        let uniform = vec![1.0 / a as f64; n * a];
        let completed = LatentActions::new(&mdp, &unseen_counts, None).expect("possible").complete(&uniform);
        for k in 0..seen.longest() as usize {
            prop_assert_eq!(seen.step_counts(k), completed.step_counts(k));
        }
        for method in irl::METHODS.iter().filter(|m| !m.needs_demonstrations() && !matches!(m.id(), "birl" | "gpirl")) {
            let options = FitOptions { posterior: PosteriorKind::None, max_iterations: 50, ..FitOptions::default() };
            let (full, blind) = (fit(method.id(), &mdp, &data, &options), fit(method.id(), &mdp, &unseen, &options));
            let (full, blind) = (full.expect("a fit"), blind.expect("a fit"));
            for (p, q) in full.policy.iter().zip(&blind.policy) {
                prop_assert!((p - q).abs() < 1e-2, "{}: {:?} and {:?}", method.id(), full.policy, blind.policy);
            }
        }
    }

    #[test]
    fn a_permutation_of_states_permutes_what_is_inferred(seed in 0_u64..1_000_000, n in 2_usize..8, a in 2_usize..4) {
        let mut random = generator(seed);
        let original = mdp(n, a, 3, &mut random);
        let data = without_actions(&episodes(&original, &policy(n, a, &mut random), 6, 8, &mut random), n);
        let order = permutation(n, &mut random);
        let renamed = permuted(&original, &order);
        let rename = |s: u32| order[s as usize] as u32;
        let moved: Demonstrations = data.iter().map(|t| {
            let states = t.states().iter().map(|&s| rename(s)).collect();
            Trajectory::states_only(states, t.final_state().map(rename), n as u32).expect("a trajectory")
        }).collect();
        let (here, there) = (count(&original, &data), count(&renamed, &moved));
        let uniform = vec![1.0 / a as f64; n * a];
        let here = LatentActions::new(&original, &here, None).expect("possible").complete(&uniform).counts(None);
        let there = LatentActions::new(&renamed, &there, None).expect("possible").complete(&uniform).counts(None);
        for (s, &to) in order.iter().enumerate() {
            for action in 0..a {
                prop_assert!((here[s * a + action] - there[to * a + action]).abs() < 1e-9);
            }
        }
    }
}

#[test]
fn what_cannot_be_is_said() {
    let mdp = telling(5, 2);
    let states = |states: &[u32]| Trajectory::states_only(states.to_vec(), None, 5).expect("a trajectory");
    // from 0 the actions lead to 1 and 2
    let data = Demonstrations::new(vec![states(&[0, 1, 1]), states(&[0, 2, 0]), states(&[0, 3])]);
    let error = fit("bc", &mdp, &data, &FitOptions::default()).expect_err("a refusal");
    assert_eq!(error, FitError::ImpossibleTransitions { count: 3, step: 0, state: 0, next_state: 3 });
    let data = Demonstrations::new(vec![states(&[0, 1])]);
    for method in irl::METHODS.iter().filter(|method| method.needs_demonstrations()) {
        let error = fit(method.id(), &mdp, &data, &FitOptions::default()).expect_err("a refusal");
        assert_eq!(error, FitError::NeedsActions { method: method.id() });
    }
    let error = fit("bc", &mdp, &data, &FitOptions { discount: 1.0, ..FitOptions::default() }).expect_err("a refusal");
    assert!(matches!(error, FitError::InvalidOption { field: "discount", .. }));
    let statistics = count(&mdp, &data);
    let options = FitOptions::default();
    let problem =
        Problem { mdp: &mdp, options: &options, statistics: &statistics, demonstrations: None, features: None };
    for method in irl::METHODS.iter().filter(|method| !method.needs_demonstrations()) {
        let error = method.fit(&problem, &mut |_| ControlFlow::Continue(())).expect_err("a refusal");
        assert_eq!(error, FitError::LatentActions { transitions: 1 }, "{}", method.id());
    }
}

#[test]
fn seen_and_unseen_actions_are_counted_together() {
    let mdp = telling(5, 2);
    let seen = Trajectory::new(vec![0, 1], vec![0, 1], None, 5, 2).expect("a trajectory");
    let unseen = Trajectory::states_only(vec![0, 2], Some(3), 5).expect("a trajectory");
    let found = fit("bc", &mdp, &Demonstrations::new(vec![seen, unseen]), &FitOptions::default()).expect("a fit");
    assert_eq!(found.policy[..6], [0.5, 0.5, 0.0, 1.0, 1.0, 0.0]);
    assert!(found.warnings.iter().any(|w| w.contains("actions of 2 of 4 steps")), "{:?}", found.warnings);
}

// What not seeing the actions costs on the maze, as printed with --nocapture and quoted in docs/methods/latent-actions.md.
#[test]
fn agreement_without_actions_nears_that_with_them() {
    let maze = maze::layout("given", 0.3);
    let (optimal, n) = (maze.optimal_policy(), maze.mdp.n_states());
    let seeds = 4;
    for trajectories in [5, 20, 100] {
        for id in ["em-tied", "em", "mce", "mce-likelihood", "bc"] {
            if irl::method(id).is_none() {
                continue;
            }
            // an iteration that gains less changes no greedy action that matters
            let options = FitOptions { posterior: PosteriorKind::None, tolerance: 1e-3, ..FitOptions::default() };
            let (mut with, mut without, mut iterations) = (0.0, 0.0, 0);
            for seed in 0..seeds {
                let data = maze::simulate(&maze, trajectories, 50, seed);
                let full = fit(id, &maze.mdp, &data, &options).expect("a fit");
                let blind = fit(id, &maze.mdp, &without_actions(&data, n), &options).expect("a fit");
                with += maze::agreement(&full.greedy_policy, &optimal) / seeds as f64;
                without += maze::agreement(&blind.greedy_policy, &optimal) / seeds as f64;
                iterations += blind.iterations;
            }
            println!(
                "L = {trajectories}, {id}: {with:.3} with actions, {without:.3} without, {:.0} iterations",
                f64::from(iterations) / seeds as f64
            );
            assert!(without > 0.4 && without > with - 0.25, "{id} at L = {trajectories}: {without} and {with}");
        }
    }
}
