use super::*;
use crate::irl::test_cases::{Case, gradient_error};
use crate::irl::{self, FitOptions, Penalty};
use crate::mdp::{TabularMdp, discounted_occupancy, state_action_occupancy};
use std::ops::ControlFlow;

fn fit(case: &Case, options: &FitOptions) -> Fit {
    irl::fit(&Mce, &case.problem(options), &mut |_| ControlFlow::Continue(())).expect("a fit")
}

#[test]
fn the_gradient_is_the_gap_of_the_visits() {
    for seed in 0..8 {
        let case = Case::new(seed, 6, 3);
        for basis in case.bases() {
            for discount in [0.0, 0.5, 0.9, 1.0] {
                let options = FitOptions { discount, ..FitOptions::default() };
                let visits = Visits::new(&case.problem(&options));
                let error = if discount < 1.0 {
                    let mut dual = Dual::new(&case.mdp, &basis, &visits, discount);
                    gradient_error(basis.len(), seed, |w| dual.value_and_gradient(w))
                } else {
                    let mut dual = FiniteDual::new(&case.mdp, &basis, &visits).expect("small");
                    gradient_error(basis.len(), seed, |w| dual.value_and_gradient(w))
                };
                assert!(error < 1e-5, "discount {discount}: {error}");
            }
        }
    }
}

/// Long walks of equal length from the demonstrated starts: at the optimum under ½|w|² the visits differ by w.
#[test]
fn visits_match_at_the_optimum() {
    let case = Case::with_lengths(4, 5, 2, &[200]);
    let options =
        FitOptions { penalty: Penalty::L2, penalty_strength: Some(1.0), tolerance: 1e-12, ..FitOptions::default() };
    let found = fit(&case, &options);
    let problem = case.problem(&options);
    let visits = Visits::new(&problem);
    let starts = visits.starts();
    let total: f64 = starts.iter().sum();
    let m = &case.mdp;
    let (offsets, next, p) = (m.row_offsets().to_vec(), m.next_states().to_vec(), m.probabilities().to_vec());
    let initial = Some(starts.iter().map(|n| n / total).collect());
    let started = TabularMdp::new(m.n_states(), m.n_actions(), offsets, next, p, initial).expect("the same model");
    let policy = Policy::new(2, found.policy.clone()).expect("a policy");
    let expected = state_action_occupancy(&policy, &discounted_occupancy(&started, &policy, 0.9));
    let basis = problem.basis();
    let demonstrated = basis.project(&visits.discounted_counts());
    for ((want, got), w) in demonstrated.iter().zip(basis.project(&expected)).zip(&found.weights) {
        assert!((want - total * got - w).abs() < 1e-3, "{want} less {} is not {w}", total * got);
    }
    assert!(found.trace.windows(2).all(|pair| pair[1].objective >= pair[0].objective - 1e-9));
}

#[test]
fn visits_that_no_policy_reaches_leave_a_finite_reward() {
    for seed in 0..5 {
        let case = Case::new(seed, 6, 2);
        for penalty in [Penalty::None, Penalty::L1, Penalty::L2] {
            for discount in [0.5, 0.9999, 1.0] {
                let options = FitOptions { penalty, penalty_strength: Some(0.0), discount, ..FitOptions::default() };
                let found = fit(&case, &options);
                let all = [&found.weights, &found.policy, &found.state_values];
                assert!(all.iter().all(|v| v.iter().all(|x| x.is_finite())), "{penalty:?} {discount}");
            }
        }
    }
}
