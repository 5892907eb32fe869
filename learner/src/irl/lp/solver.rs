//! The interior point method of clarabel, told of and stopped by the caller at every iteration.

use super::programme::Programme;
use crate::irl::{FitError, FitOptions, Stopped};
use clarabel::algebra::CscMatrix;
use clarabel::solver::{
    DefaultInfo, DefaultSettingsBuilder, DefaultSolver, IPSolver, NonnegativeConeT, SolverStatus, ZeroConeT,
};
use std::sync::{Mutex, mpsc};

/// Where it ended; no variables where it failed.
pub(super) struct Solution {
    pub(super) x: Vec<f64>,
    pub(super) stopped: Stopped,
}

/// Solves; `record` is told what is maximised and the duality gap. An interior point method approaches from outside the
/// constraints, so the objective need not rise.
///
/// The solver's callback may borrow nothing, so it runs beside and asks before every iteration whether to go on.
pub(super) fn solve(
    programme: &Programme,
    options: &FitOptions,
    mut record: impl FnMut(f64, f64) -> Result<(), FitError>,
) -> Result<Solution, FitError> {
    std::thread::scope(|scope| {
        let (tell, told) = mpsc::channel();
        let (answer, answered) = mpsc::channel();
        let answered = Mutex::new(answered);
        let worker = scope.spawn(move || {
            run(programme, options, move |info| {
                let answer = || answered.lock().ok().and_then(|answered| answered.recv().ok());
                tell.send((-info.cost_primal, info.gap_abs)).is_err() || answer().unwrap_or(true)
            })
        });
        let mut outcome = Ok(());
        for (objective, gap) in told {
            if outcome.is_ok() && f64::is_finite(objective) && f64::is_finite(gap) {
                outcome = record(objective, gap);
            }
            if answer.send(outcome.is_err()).is_err() {
                break;
            }
        }
        let solution = worker.join().ok().flatten();
        outcome.map(|()| solution.unwrap_or(Solution { x: Vec::new(), stopped: Stopped::Stalled }))
    })
}

fn run(
    programme: &Programme,
    options: &FitOptions,
    stop: impl FnMut(&DefaultInfo<f64>) -> bool + Send + Sync + 'static,
) -> Option<Solution> {
    let (n, n_rows) = (programme.n_variables, programme.rows.len());
    let entries: Vec<(usize, usize, f64)> =
        programme.rows.iter().enumerate().flat_map(|(i, row)| row.iter().map(move |&(j, v)| (i, j, v))).collect();
    let constraints = CscMatrix::new_from_triplets(
        n_rows,
        n,
        entries.iter().map(|e| e.0).collect(),
        entries.iter().map(|e| e.1).collect(),
        entries.iter().map(|e| e.2).collect(),
    );
    let curved: Vec<usize> = (0..n).filter(|&j| programme.quadratic[j] > 0.0).collect();
    let values = curved.iter().map(|&j| programme.quadratic[j]).collect();
    let quadratic = CscMatrix::new_from_triplets(n, n, curved.clone(), curved, values);
    let settings =
        DefaultSettingsBuilder::default().verbose(false).max_iter(options.max_iterations.min(1000)).build().ok()?;
    let cones = [ZeroConeT(programme.n_equal), NonnegativeConeT(n_rows - programme.n_equal)];
    let mut solver =
        DefaultSolver::new(&quadratic, &programme.linear, &constraints, &programme.right, &cones, settings).ok()?;
    solver.set_termination_callback(stop);
    solver.solve();
    let stopped = match solver.solution.status {
        SolverStatus::Solved => Stopped::Converged,
        SolverStatus::MaxIterations => Stopped::MaxIterations,
        _ => Stopped::Stalled,
    };
    let x = std::mem::take(&mut solver.solution.x);
    x.iter().all(|x| x.is_finite()).then_some(Solution { x, stopped })
}
