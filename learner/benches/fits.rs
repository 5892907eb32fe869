//! How long a fit takes, without reading the data: 100 demonstrations of 50 steps in the maze.
//!
//! `cargo bench -p mazeway-learner --no-default-features --bench fits`
#![allow(missing_docs, reason = "criterion's macros make public items")]

#[path = "../tests/maze/mod.rs"]
mod maze;

use criterion::{Criterion, criterion_group, criterion_main};
use mazeway_learner::irl::{self, FitOptions, Problem};
use std::ops::ControlFlow;

fn fits(criterion: &mut Criterion) {
    let maze = maze::maze();
    let demonstrations = maze::simulate(&maze, 100, 50, 0);
    let statistics = maze::statistics(&demonstrations);
    let options = FitOptions::default();
    let problem = Problem {
        mdp: &maze.mdp,
        options: &options,
        statistics: &statistics,
        demonstrations: Some(&demonstrations),
        features: None,
    };
    for id in ["em", "em-tied", "bc"] {
        let method = irl::method(id).expect("a method");
        criterion.bench_function(&format!("maze/{id}"), |bencher| {
            bencher.iter(|| method.fit(&problem, &mut |_| ControlFlow::Continue(())).expect("a fit"));
        });
    }
    criterion.bench_function("maze/statistics", |bencher| bencher.iter(|| maze::statistics(&demonstrations)));
}

criterion_group!(benches, fits);
criterion_main!(benches);
