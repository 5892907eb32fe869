use super::*;
use crate::irl::test_cases::Case;
use crate::irl::{self, FitOptions, Method};
use std::ops::ControlFlow;

const BOTH: [&dyn Method; 2] = [&Projection, &MaxMargin];

fn fit(method: &dyn Method, case: &Case, options: &FitOptions) -> Fit {
    irl::fit(method, &case.problem(options), &mut |_| ControlFlow::Continue(())).expect("a fit")
}

#[test]
fn the_distance_to_the_hull_only_falls() {
    for seed in 0..10 {
        let case = Case::new(seed, 8, 3);
        for method in BOTH {
            for discount in [0.5, 0.9, 0.9999, 1.0] {
                let found = fit(method, &case, &FitOptions { discount, ..FitOptions::default() });
                let falls = found.trace.windows(2).all(|pair| pair[1].objective >= pair[0].objective);
                assert!(falls && found.trace.iter().all(|t| t.objective <= 0.0), "{}", method.id());
            }
        }
    }
}

#[test]
fn expectations_count_what_was_walked() {
    let case = Case::new(2, 6, 2);
    let options = FitOptions { discount: 1.0, ..FitOptions::default() };
    let problem = case.problem(&options);
    let basis = problem.basis();
    let expectations = Expectations::new(&problem, &basis);
    // a state basis counts time, and every policy walks as long as the demonstrations
    let walked: f64 = expectations.of(&Policy::uniform(6, 2)).iter().sum();
    assert!((walked - 1.0).abs() < 1e-12 && (expectations.demonstrated().iter().sum::<f64>() - 1.0).abs() < 1e-12);
}
