use super::*;
use crate::irl::{self, BasisKind, FitOptions};
use crate::mdp::TabularMdp;
use crate::statistics::Statistics;
use crate::trajectory::Trajectory;
use std::ops::ControlFlow;

/// Three states in a row; action 0 goes left, action 1 right, both stay at the walls.
fn corridor() -> TabularMdp {
    TabularMdp::new(3, 2, (0..=6).collect(), vec![0, 1, 0, 2, 1, 2], vec![1.0; 6], None).expect("a model")
}

fn fit(options: &FitOptions) -> Fit {
    let mdp = corridor();
    let mut builder = Statistics::builder(3, 2, None);
    builder.add(&Trajectory::new(vec![0, 1, 2, 2], vec![1; 4], None, 3, 2).expect("a trajectory")).expect("counted");
    let statistics = builder.finish().expect("counts");
    let problem = Problem { mdp: &mdp, options, statistics: &statistics, demonstrations: None, features: None };
    irl::fit(&Lp, &problem, &mut |_| ControlFlow::Continue(())).expect("a fit")
}

/// Always to the right: V = (w₀ + γ V₁, w₁ + γ V₂, w₂ / (1 − γ)). The margins of right over left are γ (V₁ − V₀), γ (V₂ − V₀) and
/// γ (V₂ − V₁), with one visit to states 0 and 1 and two to state 2. In V their weighted sum is γ (−2 V₀ − V₁ + 3 V₂), and in
/// w, −2γ w₀ − γ (1 + 2γ) w₁ + γ (3 − γ − 2γ²) / (1 − γ) w₂: one at the right wall, nothing elsewhere.
#[test]
fn the_optimum_of_a_hand_made_case() {
    for discount in [0.5, 0.9, 0.9999] {
        for (penalty, strength) in [(Penalty::L1, 0.1), (Penalty::L1, 0.0)] {
            let options = FitOptions { discount, penalty, penalty_strength: Some(strength), ..FitOptions::default() };
            let found = fit(&options);
            assert_eq!(found.stopped, Stopped::Converged, "{discount}");
            assert!((found.weights[2] - 1.0).abs() < 1e-6, "{:?}", found.weights);
            assert_eq!(found.weights[..2], [0.0, 0.0]);
            assert_eq!(found.greedy_policy, [0.0, 1.0, 0.0, 1.0, 0.0, 1.0]);
            let slope = discount * (3.0 - discount - 2.0 * discount * discount) / (1.0 - discount) - strength;
            let objective = found.trace.last().expect("an entry").objective;
            assert!((objective - slope).abs() < 1e-6 * slope, "{objective} and {slope}");
        }
    }
    // a penalty beyond the slope leaves nothing
    let none = fit(&FitOptions { discount: 0.5, penalty_strength: Some(3.0), ..FitOptions::default() });
    assert_eq!(none.weights, [0.0; 3]);
    assert!(none.warnings.iter().any(|w| w.contains("no reward")), "{:?}", none.warnings);
    // free weights also punish what is left behind
    let free = fit(&FitOptions { penalty: Penalty::None, ..FitOptions::default() });
    assert!(free.weights.iter().zip([-1.0, -1.0, 1.0]).all(|(w, want)| (w - want).abs() < 1e-6), "{:?}", free.weights);
}

#[test]
fn over_a_finite_horizon() {
    // two steps: the margins look one step ahead, w₁ − w₀, w₂ − w₀ and twice w₂ − w₁
    let found =
        fit(&FitOptions { discount: 1.0, horizon: Some(2), penalty_strength: Some(0.1), ..FitOptions::default() });
    assert_eq!(found.stopped, Stopped::Converged);
    // the horizon leaves one visit to 0 and one to 1: margins w₁ − w₀ and w₂ − w₀
    let want = [0.0, 1.0, 1.0];
    assert!(found.weights.iter().zip(want).all(|(w, want)| (w - want).abs() < 1e-6), "{:?}", found.weights);
    // one step: state rewards tell nothing, those of actions do
    let blind = fit(&FitOptions { discount: 1.0, horizon: Some(1), ..FitOptions::default() });
    assert_eq!(blind.weights, [0.0; 3]);
    let options = FitOptions {
        discount: 1.0,
        horizon: Some(1),
        basis: BasisKind::StateAction,
        penalty_strength: Some(0.1),
        ..FitOptions::default()
    };
    let pairs = fit(&options).weights;
    assert!((pairs[1] - 1.0).abs() < 1e-6 && pairs.iter().sum::<f64>() < 1.0 + 1e-6, "{pairs:?}");
}
