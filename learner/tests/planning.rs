//! Laws of planners, policy evaluation and occupancies on random processes.

mod random;

use mazeway_learner::mdp::{
    HorizonPrior, PlanError, PlanOptions, PlannerKind, Policy, SoftSolver, TabularMdp, discounted_occupancy,
    evaluate_policy, finite_horizon_occupancy, plan, state_action_occupancy, state_occupancies_by_step,
};
use proptest::prelude::*;
use random::{generator, mdp, policy, vector};

const DISCOUNTS: [f64; 6] = [0.0, 0.5, 0.9, 0.99, 0.999, 0.9999];

fn geometric(discount: f64) -> PlanOptions {
    PlanOptions { discount, horizon: None, horizon_prior: HorizonPrior::Geometric }
}

fn value(mdp: &TabularMdp, values: &[f64]) -> f64 {
    mdp.initial_distribution().iter().zip(values).map(|(p, v)| p * v).sum()
}

fn close(a: f64, b: f64, relative: f64) -> bool {
    (a - b).abs() <= relative * (1.0 + a.abs().max(b.abs()))
}

proptest! {
    #![proptest_config(ProptestConfig { cases: 64, failure_persistence: None, ..ProptestConfig::default() })]

    #[test]
    fn planners_agree_and_satisfy_bellman(seed in 0_u64..1_000_000, n in 1_usize..30, a in 1_usize..5, d in 0_usize..6) {
        let mut random = generator(seed);
        let mdp = mdp(n, a, 5, &mut random);
        let reward: Vec<f64> = vector(n * a, &mut random).iter().map(|r| 3.0 * r - 1.0).collect();
        let discount = DISCOUNTS[d];
        let plans = [PlannerKind::ValueIteration, PlannerKind::PolicyIteration, PlannerKind::ExpectationMaximization]
            .map(|kind| plan(kind, &mdp, &reward, &geometric(discount)).expect("a plan"));
        for found in &plans {
            prop_assert!(found.converged);
            for s in 0..n {
                let best = found.action_values[s * a..(s + 1) * a].iter().copied().fold(f64::NEG_INFINITY, f64::max);
                prop_assert!(close(best, found.state_values[s], 1e-9), "{best} and {}", found.state_values[s]);
                prop_assert!(close(found.state_values[s], plans[0].state_values[s], 1e-9));
            }
            // what is greedy is worth what the planner says
            let worth = evaluate_policy(&mdp, &found.policy, &reward, discount, None);
            for (w, v) in worth.iter().zip(&found.state_values) {
                prop_assert!(close(*w, *v, 1e-8), "{w} and {v}");
            }
        }
    }

    #[test]
    fn soft_values_satisfy_their_equation(seed in 0_u64..1_000_000, n in 1_usize..30, a in 1_usize..5, d in 0_usize..6) {
        let mut random = generator(seed);
        let mdp = mdp(n, a, 5, &mut random);
        let discount = DISCOUNTS[d];
        let mut solver = SoftSolver::new(&mdp, discount);
        // a second reward starts from the first one's values
        for scale in [1.0, -30.0] {
            let reward: Vec<f64> = vector(n * a, &mut random).iter().map(|r| scale * r).collect();
            solver.solve(&reward);
            prop_assert!(solver.converged());
            let q = mdp.action_values(&reward, discount, solver.state_values());
            for s in 0..n {
                let row = &q[s * a..(s + 1) * a];
                let largest = row.iter().copied().fold(f64::NEG_INFINITY, f64::max);
                let soft = largest + row.iter().map(|q| (q - largest).exp()).sum::<f64>().ln();
                prop_assert!(close(soft, solver.state_values()[s], 1e-11));
                let sum: f64 = solver.policy()[s * a..(s + 1) * a].iter().sum();
                prop_assert!((sum - 1.0).abs() < 1e-9);
            }
        }
    }

    #[test]
    fn sharp_soft_values_are_hard_ones(seed in 0_u64..1_000_000, n in 1_usize..20, a in 1_usize..5) {
        let mut random = generator(seed);
        let mdp = mdp(n, a, 5, &mut random);
        let sharpness = 1e6;
        let reward = vector(n * a, &mut random);
        let scaled: Vec<f64> = reward.iter().map(|r| sharpness * r).collect();
        let hard = plan(PlannerKind::PolicyIteration, &mdp, &reward, &geometric(0.9)).expect("a plan");
        let soft = plan(PlannerKind::SoftValueIteration, &mdp, &scaled, &geometric(0.9)).expect("a plan");
        let entropy = (a as f64).ln() / (1.0 - 0.9) / sharpness;
        for (h, s) in hard.state_values.iter().zip(&soft.state_values) {
            prop_assert!(s / sharpness >= h - 1e-9 && s / sharpness <= h + entropy + 1e-9);
        }
    }

    #[test]
    fn occupancies_sum_to_the_effective_horizon(seed in 0_u64..1_000_000, n in 1_usize..30, a in 1_usize..5, d in 0_usize..6, steps in 1_u32..60) {
        let mut random = generator(seed);
        let mdp = mdp(n, a, 5, &mut random);
        let policy = policy(n, a, &mut random);
        let reward = vector(n * a, &mut random);
        let discount = DISCOUNTS[d];
        let all = discounted_occupancy(&mdp, &policy, discount);
        prop_assert!(close(all.iter().sum(), 1.0 / (1.0 - discount), 1e-9));
        prop_assert!(all.iter().all(|d| *d >= -1e-9));
        let pairs = state_action_occupancy(&policy, &all);
        let worth: f64 = pairs.iter().zip(&reward).map(|(d, r)| d * r).sum();
        prop_assert!(close(worth, value(&mdp, &evaluate_policy(&mdp, &policy, &reward, discount, None)), 1e-9));

        for discount in [discount, 1.0] {
            let finite = finite_horizon_occupancy(&mdp, &policy, discount, steps);
            let want = if discount == 1.0 {
                f64::from(steps)
            } else {
                (1.0 - discount.powi(steps as i32)) / (1.0 - discount)
            };
            prop_assert!(close(finite.iter().sum(), want, 1e-10));
            let worth: f64 = state_action_occupancy(&policy, &finite).iter().zip(&reward).map(|(d, r)| d * r).sum();
            let values = evaluate_policy(&mdp, &policy, &reward, discount, Some(steps));
            prop_assert!(close(worth, value(&mdp, &values), 1e-10));
        }
    }

    #[test]
    fn undiscounted_plans_are_the_best_of_finitely_many_steps(seed in 0_u64..1_000_000, n in 1_usize..15, a in 1_usize..4, steps in 1_u32..20) {
        let mut random = generator(seed);
        let mdp = mdp(n, a, 4, &mut random);
        let reward = vector(n * a, &mut random);
        let options = PlanOptions { discount: 1.0, horizon: Some(steps), horizon_prior: HorizonPrior::Uniform };
        let best = plan(PlannerKind::ValueIteration, &mdp, &reward, &options).expect("a plan");
        for _ in 0..5 {
            let other = evaluate_policy(&mdp, &policy(n, a, &mut random), &reward, 1.0, Some(steps));
            prop_assert!(best.state_values.iter().zip(&other).all(|(b, o)| *b >= o - 1e-9));
        }
        // one step more: the best action, then the best of what is left
        let longer = plan(PlannerKind::PolicyIteration, &mdp, &reward, &PlanOptions { horizon: Some(steps + 1), ..options }).expect("a plan");
        let q = mdp.action_values(&reward, 1.0, &best.state_values);
        for (x, y) in q.iter().zip(&longer.action_values) {
            prop_assert!(close(*x, *y, 1e-12));
        }
    }

    #[test]
    fn planning_by_inference_over_finite_horizons_never_loses(seed in 0_u64..1_000_000, n in 1_usize..12, a in 1_usize..4, steps in 1_u32..20) {
        let mut random = generator(seed);
        let mdp = mdp(n, a, 4, &mut random);
        let reward: Vec<f64> = vector(n * a, &mut random).iter().map(|r| 2.0 * r - 1.0).collect();
        let options = PlanOptions { discount: 0.9, horizon: Some(steps), horizon_prior: HorizonPrior::Uniform };
        let found = plan(PlannerKind::ExpectationMaximization, &mdp, &reward, &options).expect("a plan");
        // expected reward at the end of 1..=steps steps, all equally likely
        let mean_reward = |policy: &Policy| -> f64 {
            let total: f64 = state_occupancies_by_step(&mdp, policy)
                .take(steps as usize)
                .map(|now| state_action_occupancy(policy, &now).iter().zip(&reward).map(|(d, r)| d * r).sum::<f64>())
                .sum();
            total / f64::from(steps)
        };
        prop_assert!(mean_reward(&found.policy) >= mean_reward(&Policy::uniform(n, a)) - 1e-9);
        prop_assert!(found.state_values.iter().chain(&found.action_values).all(|v| (-1.0 - 1e-9..=1.0 + 1e-9).contains(v)));
        for row in found.policy.probabilities().chunks_exact(a) {
            prop_assert!((row.iter().sum::<f64>() - 1.0).abs() < 1e-9);
        }
    }
}

#[test]
fn inference_over_a_finite_horizon_finds_the_best_stationary_policy() {
    // three states in a line, action 1 goes right and falls off to the start from the end; reward for being at the end
    let rows = [0_u32, 1, 1, 2, 2, 0];
    let mdp = TabularMdp::new(3, 2, (0..=6).collect(), rows.to_vec(), vec![1.0; 6], Some(vec![1.0, 0.0, 0.0]))
        .expect("a model");
    let reward = [0.0, 0.0, 0.0, 0.0, 1.0, 1.0];
    let options = PlanOptions { discount: 1.0, horizon: Some(10), horizon_prior: HorizonPrior::Uniform };
    let found = plan(PlannerKind::ExpectationMaximization, &mdp, &reward, &options).expect("a plan");
    assert_eq!(found.policy.probabilities(), [0.0, 1.0, 0.0, 1.0, 1.0, 0.0]);
    assert!((value(&mdp, &found.state_values) - 0.8).abs() < 1e-12, "{:?}", found.state_values);
}

#[test]
fn large_sparse_processes_are_solved_as_exactly_as_small_ones() {
    let mut random = generator(7);
    let (n, a) = (1500, 4);
    let mdp = mdp(n, a, 6, &mut random);
    let reward = vector(n * a, &mut random);
    for discount in [0.9, 0.9999] {
        let found = plan(PlannerKind::ValueIteration, &mdp, &reward, &geometric(discount)).expect("a plan");
        let soft = plan(PlannerKind::SoftValueIteration, &mdp, &reward, &geometric(discount)).expect("a plan");
        assert!(found.converged && soft.converged);
        for s in 0..n {
            let best = found.action_values[s * a..(s + 1) * a].iter().copied().fold(f64::NEG_INFINITY, f64::max);
            assert!(close(best, found.state_values[s], 1e-10));
        }
        let occupancy = discounted_occupancy(&mdp, &found.policy, discount);
        assert!(close(occupancy.iter().sum(), 1.0 / (1.0 - discount), 1e-9));
    }
}

#[test]
fn wrong_questions_are_refused() {
    let mdp = mdp(3, 2, 3, &mut generator(1));
    let reward = vec![0.0; 6];
    let ask = |kind, reward: &[f64], options| plan(kind, &mdp, reward, &options);
    let undiscounted = PlanOptions { discount: 1.0, ..geometric(0.9) };
    assert_eq!(ask(PlannerKind::ValueIteration, &reward, undiscounted), Err(PlanError::Horizon));
    let uniform = PlanOptions { horizon_prior: HorizonPrior::Uniform, ..geometric(0.9) };
    assert_eq!(ask(PlannerKind::ExpectationMaximization, &reward, uniform), Err(PlanError::Horizon));
    for discount in [-0.1, 1.1, f64::INFINITY] {
        assert_eq!(
            ask(PlannerKind::PolicyIteration, &reward, geometric(discount)),
            Err(PlanError::Discount { discount })
        );
    }
    assert!(matches!(ask(PlannerKind::ValueIteration, &reward, geometric(f64::NAN)), Err(PlanError::Discount { .. })));
    assert!(matches!(ask(PlannerKind::ValueIteration, &reward[..5], geometric(0.9)), Err(PlanError::Reward { .. })));
    assert!(matches!(ask(PlannerKind::ValueIteration, &[f64::NAN; 6], geometric(0.9)), Err(PlanError::Reward { .. })));
    let endless = PlanOptions { horizon: Some(u32::MAX), ..uniform };
    assert!(matches!(ask(PlannerKind::ExpectationMaximization, &reward, endless), Err(PlanError::TooLarge { .. })));
}
