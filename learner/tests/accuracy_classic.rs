//! How well the classical methods do on simulated demonstrations of a maze with independent figures, averaged over seeds.

mod maze;

use maze::{Maze, N_ACTIONS, layout, simulate, statistics_in};
use mazeway_learner::eval::{mean_interval, state_agreement};
use mazeway_learner::irl::{self, FitOptions, Problem};
use std::ops::ControlFlow;
use std::time::Instant;

const SEEDS: u64 = 20;
const TRAJECTORIES: [usize; 5] = [5, 10, 20, 50, 100];

/// Agreement of each seed, and the mean seconds a fit.
fn agreements(maze: &Maze, method: &str, trajectories: usize) -> (Vec<f64>, f64) {
    let optimal = maze.optimal_policy();
    let options = FitOptions::default();
    let method = irl::method(method).expect("a method");
    let mut secs = 0.0;
    let all = (0..SEEDS)
        .map(|seed| {
            let demonstrations = simulate(maze, trajectories, 50, seed);
            let statistics = statistics_in(maze.mdp.n_states(), &demonstrations);
            let problem = Problem {
                mdp: &maze.mdp,
                options: &options,
                statistics: &statistics,
                demonstrations: Some(&demonstrations),
                features: None,
            };
            let begun = Instant::now();
            let fit = irl::fit(method, &problem, &mut |_| ControlFlow::Continue(())).expect("a fit");
            secs += begun.elapsed().as_secs_f64();
            state_agreement(&fit.greedy_policy, &optimal, N_ACTIONS)
        })
        .collect();
    (all, secs / SEEDS as f64)
}

/// Prints a method's row and asserts lower bounds: what was measured less about the half-width of its interval over seeds.
fn at_least(method: &str, bounds: [f64; 5]) {
    let maze = layout("given", 0.3);
    let mut cells = vec![format!("{method:15}")];
    let mut misses = Vec::new();
    for (trajectories, bound) in TRAJECTORIES.into_iter().zip(bounds) {
        let (all, secs) = agreements(&maze, method, trajectories);
        let interval = mean_interval(&all).expect("samples");
        cells.push(format!("{:.3} ± {:.3} ({:.1} ms)", interval.mean, interval.high - interval.mean, 1e3 * secs));
        if interval.mean < bound {
            misses.push(format!("L = {trajectories}: {:.3}, expected {bound}", interval.mean));
        }
    }
    println!("{}", cells.join("  "));
    assert!(misses.is_empty(), "{method}: {misses:?}");
}

#[test]
fn maximum_entropy_over_trajectories() {
    at_least("maxent", [0.71, 0.81, 0.91, 0.94, 0.95]);
}

#[test]
fn maximum_causal_entropy() {
    at_least("mce", [0.67, 0.78, 0.90, 0.95, 0.96]);
    at_least("mce-likelihood", [0.71, 0.81, 0.92, 0.97, 0.99]);
}

#[test]
fn apprenticeship_learning() {
    at_least("projection", [0.68, 0.78, 0.89, 0.94, 0.97]);
    at_least("max-margin", [0.66, 0.76, 0.87, 0.92, 0.94]);
}

#[test]
fn linear_programming() {
    at_least("lp", [0.75, 0.86, 0.97, 0.99, 0.99]);
}

#[test]
fn cloning_with_planning() {
    at_least("bc-planning", [0.65, 0.76, 0.88, 0.95, 0.98]);
}
