//! Every number of the reference data, by the real planners and methods.

mod maze;

use maze::{DISCOUNT, agreement, cases, demonstrations, floats, maze, statistics};
use mazeway_learner::irl::{
    self, Fit, FitOptions, HorizonPrior, MStep, Penalty, PlannerKind, PosteriorKind, Problem, Stopped,
};
use mazeway_learner::mdp::{PlanOptions, plan};
use std::ops::ControlFlow;

#[test]
fn planners_reproduce_values_and_optimal_actions() {
    let maze = maze();
    for kind in [PlannerKind::ValueIteration, PlannerKind::PolicyIteration, PlannerKind::ExpectationMaximization] {
        let options = PlanOptions { discount: DISCOUNT, horizon: None, horizon_prior: HorizonPrior::Geometric };
        let planned = plan(kind, &maze.mdp, &maze.reward, &options).expect("a plan");
        assert!(planned.converged, "{kind:?}");
        for (state, (got, want)) in planned.state_values.iter().zip(&maze.state_values).enumerate() {
            assert!((got - want).abs() < 1e-9, "{kind:?}: V({state}) is {want}, got {got}");
        }
        assert_eq!(planned.policy.probabilities(), maze.optimal_policy(), "{kind:?}");
    }
}

fn fit(method: &str, options: &FitOptions) -> Fit {
    let maze = maze();
    let demonstrations = demonstrations();
    let statistics = statistics(&demonstrations);
    let problem = Problem {
        mdp: &maze.mdp,
        options,
        statistics: &statistics,
        demonstrations: Some(&demonstrations),
        features: None,
    };
    irl::method(method).expect("a method").fit(&problem, &mut |_| ControlFlow::Continue(())).expect("a fit")
}

#[test]
fn methods_reproduce_all_fits() {
    let maze = maze();
    let cases = cases();
    assert_eq!(cases.len(), 8);
    for case in cases {
        let method = case["method"].as_str().expect("a name");
        let mut options = FitOptions {
            discount: case["discount"].as_f64().expect("a number"),
            posterior: PosteriorKind::None,
            ..FitOptions::default()
        };
        options.horizon_prior = match case["horizon_prior"].as_str() {
            Some("uniform") => HorizonPrior::Uniform,
            _ => HorizonPrior::Geometric,
        };
        match case["m_step"].as_str() {
            Some("simplex") => options.m_step = MStep::Simplex,
            Some(_) => options.reference_basis = case["reference_basis"].as_u64().expect("an index") as u32,
            None => {}
        }
        if let Some(constraint) = case["weights_constraint"].as_str() {
            options.tolerance = 1e-10;
            if constraint.starts_with("free") {
                (options.penalty, options.penalty_strength) = (Penalty::L2, Some(0.1));
            }
        }
        if method == "em-mixture" {
            options.max_iterations = 200_000;
        }
        let fit = fit(method, &options);
        let name = format!("{method} {:?} {:?} {:?}", options.m_step, options.horizon_prior, options.penalty);
        println!("{name}: {} iterations, {:?}, {:?}", fit.iterations, fit.stopped, fit.trace.last());
        assert_eq!(fit.stopped, Stopped::Converged, "{name}");

        let tolerance = case["tolerance"].as_f64().unwrap_or(1e-6);
        let want = floats(&case["weights"]);
        assert_eq!(fit.weights.len(), want.len());
        for (state, (got, want)) in fit.weights.iter().zip(&want).enumerate() {
            assert!((got - want).abs() <= tolerance, "{name}: w({state}) is {want}, got {got}");
        }
        let objective = fit.trace.last().expect("a trace").objective;
        if let Some(want) = case["penalised_objective"].as_f64() {
            assert!((objective - want).abs() < 1e-4, "{name}: objective is {want}, got {objective}");
            let counts = statistics(&demonstrations()).counts(None);
            let log_likelihood: f64 =
                counts.iter().zip(&fit.policy).filter(|(n, _)| **n > 0.0).map(|(n, p)| n * p.ln()).sum();
            let want = case["log_likelihood"].as_f64().expect("a number");
            // free along the optimum: the weights' own tolerance times the slope of the penalty
            assert!((log_likelihood - want).abs() < 0.01, "{name}: likelihood is {want}, got {log_likelihood}");
        } else if let Some(want) = case["log_likelihood"].as_f64() {
            assert!((objective - want).abs() < 1e-4, "{name}: likelihood is {want}, got {objective}");
        }
        if let Some(want) = case["policy_agreement"].as_f64() {
            let got = agreement(&fit.greedy_policy, &maze.optimal_policy());
            assert!((got - want).abs() < 1e-12, "{name}: agreement is {want}, got {got}");
        }
        if let Some(want) = case["weighted_counts"].as_array() {
            let statistics = statistics(&demonstrations());
            let prior = options.horizon_prior.probabilities(options.discount, 50, 50);
            let counts = statistics.weighted_counts(50, |k| prior[k]);
            for (row, want) in counts.chunks_exact(maze::N_ACTIONS).zip(want) {
                assert!((row.iter().sum::<f64>() - want.as_f64().expect("a number")).abs() < 1e-12);
            }
        }
    }
}
