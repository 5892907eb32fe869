//! How well the Bayesian methods do on simulated demonstrations of the given maze, averaged over seeds.

mod maze;

use maze::{DISCOUNT, Maze, layout, simulate, statistics_in};
use mazeway_learner::irl::{self, FitOptions, Problem};
use std::ops::ControlFlow;
use std::time::Instant;

fn env(name: &str, default: f64) -> f64 {
    std::env::var(name).ok().and_then(|v| v.parse().ok()).unwrap_or(default)
}

fn row(maze: &Maze, method: &str, trajectories: usize, seeds: u64) {
    let optimal = maze.optimal_policy();
    let mut options = FitOptions { discount: DISCOUNT, ..FitOptions::default() };
    options.draws = std::env::var("DRAWS").ok().and_then(|v| v.parse().ok());
    options.warm_up = std::env::var("WARM").ok().and_then(|v| v.parse().ok());
    let mut all = Vec::new();
    let (mut secs, mut rhat, mut ess, mut acc, mut over) = (0.0, 0.0_f64, f64::INFINITY, 0.0, 0);
    let mut hyper = String::new();
    let mut n = 0;
    for seed in 0..seeds {
        let demonstrations = simulate(maze, trajectories, 50, seed);
        let statistics = statistics_in(maze.mdp.n_states(), &demonstrations);
        let problem = Problem { mdp: &maze.mdp, options: &options, statistics: &statistics, demonstrations: Some(&demonstrations), features: None };
        let begun = Instant::now();
        let fit = irl::fit(irl::method(method).expect("a method"), &problem, &mut |_| ControlFlow::Continue(())).expect("a fit");
        secs += begun.elapsed().as_secs_f64();
        all.push(maze::agreement(&fit.greedy_policy, &optimal));
        n = fit.iterations;
        hyper = fit.hyperparameters.iter().map(|h| format!("{} {:.3} ", h.name, h.value)).collect();
        if let Some(d) = fit.posterior.and_then(|p| p.diagnostics) {
            rhat = d.split_rhat.iter().copied().fold(rhat, f64::max);
            over += d.split_rhat.iter().filter(|r| **r > 1.05).count();
            ess = d.effective_sample_size.iter().copied().fold(ess, f64::min);
            acc += d.acceptance;
        }
    }
    let k = all.len() as f64;
    let mean = all.iter().sum::<f64>() / k;
    let sd = (all.iter().map(|a| (a - mean).powi(2)).sum::<f64>() / (k - 1.0)).sqrt();
    println!("{method} L {trajectories}: {mean:.3} ± {:.3}, {:.3} s, rhat {rhat:.3} ({over} over), ess {ess:.0}, acc {:.2}, it {n} {hyper}", 1.96 * sd / k.sqrt(), secs / k, acc / k);
}

#[test]
fn table() {
    let maze = layout(&std::env::var("LAYOUT").unwrap_or("given".into()), env("SLIP", 0.3));
    let method = std::env::var("METHOD").unwrap_or("birl".into());
    for l in std::env::var("LS").unwrap_or("5 10 20 50 100".into()).split(' ') {
        row(&maze, &method, l.parse().expect("a number"), env("SEEDS", 20.0) as u64);
    }
}
