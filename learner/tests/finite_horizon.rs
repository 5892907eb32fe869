//! Laws of the methods where the discount is 1 and the horizon finite.

mod random;

use mazeway_learner::irl::em_tied::{FiniteLikelihood, Likelihood, fit_with_basis};
use mazeway_learner::irl::{self, Basis, FitError, FitOptions, Penalty, Problem, Stopped};
use mazeway_learner::mdp::{Features, PlanOptions, PlannerKind, Policy, TabularMdp, plan};
use mazeway_learner::trajectory::{Demonstrations, Trajectory};
use proptest::prelude::*;
use random::{below, episodes, generator, mdp, policy, statistics, uniform, vector};
use std::ops::ControlFlow;

fn bases(mdp: &TabularMdp, random: &mut rand_pcg::Pcg64) -> [Basis; 3] {
    let names = ["x", "y", "z"].map(str::to_owned).to_vec();
    let table: Vec<f64> = vector(mdp.n_pairs() * 3, random).iter().map(|x| 2.0 * x - 1.0).collect();
    let features = Features::of_pairs(mdp.n_pairs(), names, &table).expect("features");
    [Basis::state(mdp), Basis::state_action(mdp), Basis::features(&features)]
}

proptest! {
    #![proptest_config(ProptestConfig::with_cases(48))]

    #[test]
    fn gradient_and_hessian_match_differences(seed in 0_u64..1_000_000, n in 1_usize..7, a in 1_usize..4, beyond in 0_u32..4, kind in 0_usize..3) {
        let mut random = generator(seed);
        let mdp = mdp(n, a, 4, &mut random);
        let data = episodes(&mdp, &policy(n, a, &mut random), 10, 8, &mut random);
        let basis = &bases(&mdp, &mut random)[kind];
        let statistics = statistics(&mdp, &data);
        let horizon = statistics.longest() + beyond;
        let mut likelihood = FiniteLikelihood::new(&mdp, basis, &statistics, horizon).expect("small");
        let weights: Vec<f64> = vector(basis.len(), &mut random).iter().map(|w| 4.0 * w - 2.0).collect();
        let (value, gradient) = likelihood.value_and_gradient(&weights);
        prop_assert!(value <= 1e-9);
        // the first step plans like the planner does
        let options = PlanOptions { discount: 1.0, horizon: Some(horizon), ..PlanOptions::default() };
        let planned = plan(PlannerKind::SoftValueIteration, &mdp, &basis.reward(&weights), &options).expect("a plan");
        prop_assert!(planned.action_values.iter().zip(likelihood.action_values()).all(|(x, y)| (x - y).abs() < 1e-9));
        prop_assert!(planned.state_values.iter().zip(likelihood.state_values()).all(|(x, y)| (x - y).abs() < 1e-9));
        prop_assert!(planned.policy.probabilities().iter().zip(likelihood.policy()).all(|(x, y)| (x - y).abs() < 1e-9));
        let hessian = likelihood.hessian(&weights);
        let step = 1e-4;
        for b in 0..basis.len() {
            let mut moved = weights.clone();
            moved[b] += step;
            let (above, gradient_above) = likelihood.value_and_gradient(&moved);
            moved[b] -= 2.0 * step;
            let (below, gradient_below) = likelihood.value_and_gradient(&moved);
            let slope = (above - below) / (2.0 * step);
            prop_assert!((slope - gradient[b]).abs() < 1e-4 * (1.0 + gradient[b].abs()), "gradient {b}: {slope} and {}", gradient[b]);
            for c in 0..basis.len() {
                let curvature = (gradient_above[c] - gradient_below[c]) / (2.0 * step);
                let found = hessian[(b, c)];
                prop_assert!((curvature - found).abs() < 1e-3 * (1.0 + found.abs()), "hessian {b} {c}: {curvature} and {found}");
            }
        }
    }

    #[test]
    fn one_step_is_a_discount_of_0(seed in 0_u64..1_000_000, n in 1_usize..7, a in 1_usize..4) {
        let mut random = generator(seed);
        let mdp = mdp(n, a, 4, &mut random);
        let data = episodes(&mdp, &policy(n, a, &mut random), 10, 1, &mut random);
        let statistics = statistics(&mdp, &data);
        let first = statistics.counts(Some(1));
        let basis = &bases(&mdp, &mut random)[2];
        let weights: Vec<f64> = vector(3, &mut random);
        let data: Demonstrations = data.iter().map(|t| t.truncated(1)).collect();
        let cut = random::statistics(&mdp, &data);
        let (value, gradient) = FiniteLikelihood::new(&mdp, basis, &cut, 1).expect("small").value_and_gradient(&weights);
        let (other, other_gradient) = Likelihood::new(&mdp, basis, first, 0.0).value_and_gradient(&weights);
        prop_assert!((value - other).abs() < 1e-9);
        prop_assert!(gradient.iter().zip(&other_gradient).all(|(x, y)| (x - y).abs() < 1e-9));
    }
}

/// Episodes of `horizon` steps of the policy of each step.
fn simulate(mdp: &TabularMdp, reward: &[f64], horizon: u32, n: usize, random: &mut rand_pcg::Pcg64) -> Demonstrations {
    let policies: Vec<Policy> = (1..=horizon)
        .rev()
        .map(|to_go| {
            let options = PlanOptions { discount: 1.0, horizon: Some(to_go), ..PlanOptions::default() };
            plan(PlannerKind::SoftValueIteration, mdp, reward, &options).expect("a plan").policy
        })
        .collect();
    let draw = |distribution: &[f64], random: &mut rand_pcg::Pcg64| {
        let mut left = uniform(random);
        distribution.iter().position(|p| {
            left -= p;
            left < 0.0
        })
    };
    (0..n)
        .map(|_| {
            let mut state = below(mdp.n_states(), random);
            let (mut states, mut actions) = (Vec::new(), Vec::new());
            for policy in &policies {
                let action = draw(policy.row(state), random).unwrap_or(0);
                states.push(state as u32);
                actions.push(action as u32);
                let (next, p) = mdp.row(mdp.pair(state, action));
                state = next[draw(p, random).unwrap_or(0)] as usize;
            }
            Trajectory::new(states, actions, Some(state as u32), mdp.n_states() as u32, mdp.n_actions() as u32)
                .expect("a trajectory")
        })
        .collect()
}

#[test]
fn maximum_likelihood_recovers_an_undiscounted_reward() {
    let mut random = generator(4);
    let mdp = mdp(12, 3, 4, &mut random);
    let basis = &bases(&mdp, &mut random)[2];
    let truth = [1.5, -1.0, 0.5];
    let data = simulate(&mdp, &basis.reward(&truth), 10, 2000, &mut random);
    let statistics = statistics(&mdp, &data);
    let options = FitOptions { discount: 1.0, penalty: Penalty::None, ..FitOptions::default() };
    let problem =
        Problem { mdp: &mdp, options: &options, statistics: &statistics, demonstrations: None, features: None };
    let found = fit_with_basis(&problem, basis, &mut |_| ControlFlow::Continue(())).expect("a fit");
    assert_eq!(found.stopped, Stopped::Converged);
    let errors = found.standard_errors.expect("standard errors");
    println!("{:?} with standard errors {errors:?} for {truth:?}", found.weights);
    for b in 0..3 {
        assert!(errors[b] < 0.1, "{errors:?}");
        assert!((found.weights[b] - truth[b]).abs() < 4.0 * errors[b], "{:?} ± {errors:?}", found.weights);
    }
}

#[test]
fn every_method_learns_without_discount() {
    let mut random = generator(8);
    let mdp = mdp(6, 2, 3, &mut random);
    let data = episodes(&mdp, &policy(6, 2, &mut random), 10, 8, &mut random);
    let statistics = statistics(&mdp, &data);
    for horizon in [None, Some(1), Some(4), Some(50)] {
        let options = FitOptions { discount: 1.0, horizon, ..FitOptions::default() };
        for method in irl::METHODS {
            let problem = Problem {
                mdp: &mdp,
                options: &options,
                statistics: &statistics,
                demonstrations: Some(&data),
                features: None,
            };
            match irl::fit(*method, &problem, &mut |_| ControlFlow::Continue(())) {
                Ok(found) => assert!(found.policy.iter().all(|p| p.is_finite()), "{}", method.id()),
                Err(FitError::InvalidOption { field, message }) => {
                    println!("{}: {field}: {message}", method.id());
                    assert_eq!(field, "discount", "{}", method.id());
                }
                Err(error) => panic!("{}: {error}", method.id()),
            }
        }
    }
}
