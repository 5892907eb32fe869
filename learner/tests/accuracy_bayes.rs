//! How well the Bayesian methods do on simulated demonstrations of the given maze, averaged over seeds.

mod maze;

use maze::{DISCOUNT, Maze, layout, simulate, statistics_in};
use mazeway_learner::irl::{self, FitOptions, Problem, RewardPrior};
use mazeway_learner::mdp::{Policy, evaluate_policy};
use std::ops::ControlFlow;
use std::time::Instant;

/// Mean agreement over seeds; prints it with the half-width of its 95% interval, the mean loss of value and the chains' worst.
fn mean_agreement(maze: &Maze, method: &str, options: &FitOptions, trajectories: usize, seeds: u64) -> f64 {
    let optimal = maze.optimal_policy();
    let (mut all, mut losses, mut secs) = (Vec::new(), 0.0, 0.0);
    let (mut rhat, mut effective) = (1.0_f64, f64::INFINITY);
    for seed in 0..seeds {
        let demonstrations = simulate(maze, trajectories, 50, seed);
        let statistics = statistics_in(maze.mdp.n_states(), &demonstrations);
        let problem = Problem {
            mdp: &maze.mdp,
            options,
            statistics: &statistics,
            demonstrations: Some(&demonstrations),
            features: None,
        };
        let begun = Instant::now();
        let method = irl::method(method).expect("a method");
        let fit = irl::fit(method, &problem, &mut |_| ControlFlow::Continue(())).expect("a fit");
        secs += begun.elapsed().as_secs_f64();
        all.push(maze::agreement(&fit.greedy_policy, &optimal));
        let policy = Policy::new(maze::N_ACTIONS, fit.greedy_policy).expect("a policy");
        let values = evaluate_policy(&maze.mdp, &policy, &maze.reward, DISCOUNT, None);
        let loss: f64 = maze.state_values.iter().zip(&values).map(|(best, got)| best - got).sum();
        losses += loss / values.len() as f64;
        if let Some(diagnostics) = fit.posterior.and_then(|posterior| posterior.diagnostics) {
            rhat = diagnostics.split_rhat.iter().copied().fold(rhat, f64::max);
            effective = diagnostics.effective_sample_size.iter().copied().fold(effective, f64::min);
        }
    }
    let n = seeds as f64;
    let mean = all.iter().sum::<f64>() / n;
    let spread = (all.iter().map(|a| (a - mean).powi(2)).sum::<f64>() / (n - 1.0)).sqrt();
    println!(
        "| {method} | {trajectories} | {mean:.3} ± {:.3} | {:.4} | {:.3} s | {rhat:.3} | {effective:.0} |",
        1.96 * spread / n.sqrt(),
        losses / n,
        secs / n
    );
    mean
}

// The bounds lie about two half-widths of four seeds below the means of twenty, which docs/methods states.
#[test]
fn agreement_on_the_given_maze() {
    let maze = layout("given", 0.3);
    let options = FitOptions { discount: DISCOUNT, ..FitOptions::default() };
    println!("| method | L | agreement | loss of value | time | largest R-hat | least effective draws |");
    for (method, bounds) in [("birl", [0.60, 0.88, 0.97]), ("gpirl", [0.60, 0.86, 0.97])] {
        for (trajectories, bound) in [5, 20, 100].into_iter().zip(bounds) {
            let mean = mean_agreement(&maze, method, &options, trajectories, 4);
            assert!(mean >= bound, "{method} with {trajectories} trajectories: {mean}");
        }
    }
}

#[test]
#[ignore = "a minute and more: prints what docs/methods quotes"]
fn the_tables_of_the_pages() {
    let maze = layout("given", 0.3);
    let options = FitOptions { discount: DISCOUNT, ..FitOptions::default() };
    println!("| method | L | agreement | loss of value | time | largest R-hat | least effective draws |");
    for method in ["birl", "gpirl"] {
        for trajectories in [5, 10, 20, 50, 100] {
            mean_agreement(&maze, method, &options, trajectories, 20);
        }
    }
    println!("birl with another rationality");
    for rationality in [0.3, 100.0] {
        mean_agreement(&maze, "birl", &FitOptions { rationality, ..options.clone() }, 20, 4);
    }
    println!("birl with another prior");
    for reward_prior in [RewardPrior::Uniform, RewardPrior::Exponential, RewardPrior::Beta] {
        mean_agreement(&maze, "birl", &FitOptions { reward_prior, ..options.clone() }, 5, 8);
    }
    println!("the large layout");
    let large = layout("large", 0.2);
    for method in ["birl", "gpirl"] {
        mean_agreement(&large, method, &options, 20, 2);
    }
}
