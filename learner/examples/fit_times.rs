//! Times of this crate's fits on the reference maze and demonstrations (on the clock), and of one gradient in grids
//! (processor time, from cold and from near by), as JSON: what
//! `tests/bench/irl.py` sets beside its peers.
//!
//! `cargo run --release -p mazeway-learner --no-default-features --example fit_times -- [ROUNDS [METHOD…]]`

#[path = "../benches/grid/mod.rs"]
mod grid;
#[path = "../tests/maze/mod.rs"]
mod maze;

use mazeway_learner::irl::em_tied::Likelihood;
use mazeway_learner::irl::{self, Basis, FitOptions, PosteriorKind, Problem};
use serde_json::{Map, Value, json};
use std::ops::ControlFlow;
use std::sync::OnceLock;
use std::time::Instant;

/// Seconds of each of `rounds` calls.
fn times(rounds: usize, mut run: impl FnMut()) -> Value {
    let once = |_| {
        let begun = Instant::now();
        run();
        begun.elapsed().as_secs_f64()
    };
    (0..rounds).map(once).collect::<Vec<f64>>().into()
}

/// Seconds for which this thread held a processor, in ticks of some milliseconds; on the clock where Linux does not say.
fn processor_secs() -> f64 {
    static START: OnceLock<Instant> = OnceLock::new();
    let on_the_clock = || START.get_or_init(Instant::now).elapsed().as_secs_f64();
    let schedule = std::fs::read_to_string("/proc/thread-self/schedstat").unwrap_or_default();
    let nanoseconds = schedule.split(' ').next().and_then(|first| first.parse::<u64>().ok());
    nanoseconds.map_or_else(on_the_clock, |ns| ns as f64 * 1e-9)
}

fn main() {
    let mut arguments = std::env::args().skip(1);
    let rounds = arguments.next().map_or(15, |rounds| rounds.parse().expect("a number of rounds"));
    let methods: Vec<String> = arguments.collect();
    let methods =
        if methods.is_empty() { vec!["em".to_owned(), "em-tied".to_owned(), "mce".to_owned()] } else { methods };

    let maze = maze::maze();
    let demonstrations = maze::demonstrations();
    let statistics = maze::statistics(&demonstrations);
    let options = FitOptions { posterior: PosteriorKind::None, ..FitOptions::default() };
    let problem = Problem {
        mdp: &maze.mdp,
        options: &options,
        statistics: &statistics,
        demonstrations: Some(&demonstrations),
        features: None,
    };
    let (mut fits, mut agreement) = (Map::new(), Map::new());
    for method in methods.iter().filter_map(|id| irl::method(id)) {
        let fit = || irl::fit(method, &problem, &mut |_| ControlFlow::Continue(())).expect("a fit");
        let found = fit();
        agreement.insert(method.id().into(), maze::agreement(&found.greedy_policy, &maze.optimal_policy()).into());
        fits.insert(method.id().into(), times(rounds, || drop(fit())));
    }
    let mut gradients = Map::new();
    for side in [50, 316] {
        let mut grid = grid::grid(side);
        let basis = Basis::state(&grid.mdp);
        let steps = grid.steps(rounds + 1);
        let mut likelihood = Likelihood::new(&grid.mdp, &basis, grid.counts.clone(), 0.9);
        let begun = processor_secs();
        likelihood.value_and_gradient(&steps[0]);
        let cold = processor_secs() - begun;
        let begun = processor_secs();
        for weights in &steps[1..] {
            likelihood.value_and_gradient(weights);
        }
        let warm = json!([(processor_secs() - begun) / rounds as f64]);
        let residual = likelihood.residual().max(likelihood.solver().residual());
        gradients.insert((side * side).to_string(), json!({ "cold": cold, "warm": warm, "residual": residual }));
    }
    println!("{}", json!({ "fits": fits, "agreement": agreement, "gradients": gradients }));
}
