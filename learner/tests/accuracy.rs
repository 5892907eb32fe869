//! How well the methods do on simulated demonstrations of the maze, averaged over seeds.

mod maze;

use maze::{Maze, N_ACTIONS, maze, simulate, statistics};
use mazeway_learner::eval::state_agreement;
use mazeway_learner::irl::{self, FitOptions, Problem};
use std::ops::ControlFlow;

const SEEDS: u64 = 8;

fn mean_agreement(maze: &Maze, method: &str, trajectories: usize) -> f64 {
    let optimal = maze.optimal_policy();
    let options = FitOptions::default();
    let total: f64 = (0..SEEDS)
        .map(|seed| {
            let demonstrations = simulate(maze, trajectories, 50, seed);
            let statistics = statistics(&demonstrations);
            let problem = Problem {
                mdp: &maze.mdp,
                options: &options,
                statistics: &statistics,
                demonstrations: Some(&demonstrations),
                features: None,
            };
            let fit = irl::method(method)
                .expect("a method")
                .fit(&problem, &mut |_| ControlFlow::Continue(()))
                .expect("a fit");
            state_agreement(&fit.greedy_policy, &optimal, N_ACTIONS)
        })
        .sum();
    total / SEEDS as f64
}

// The bounds leave about the spread of a mean over eight seeds below what an independent implementation measured: 0.83,
// 0.99 and 1.00 for em-tied; 0.65, 0.89 and 0.88 for em; 0.58, 0.86 and 0.99 for bc.
#[test]
fn em_tied_is_the_most_accurate() {
    let maze = maze();
    for (trajectories, tied_at_least, em_at_least) in [(5, 0.78, 0.55), (20, 0.95, 0.78), (100, 0.99, 0.80)] {
        let [tied, em, bc] = ["em-tied", "em", "bc"].map(|method| mean_agreement(&maze, method, trajectories));
        let mixture = mean_agreement(&maze, "em-mixture", trajectories);
        println!("L = {trajectories}: em-tied {tied:.3}, em {em:.3}, em-mixture {mixture:.3}, bc {bc:.3}");
        assert!(tied >= tied_at_least, "em-tied at L = {trajectories}: {tied}");
        assert!(em >= em_at_least, "em at L = {trajectories}: {em}");
        assert!(tied > bc, "em-tied {tied} must beat bc {bc} at L = {trajectories}");
    }
}
