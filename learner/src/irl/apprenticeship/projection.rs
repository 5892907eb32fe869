//! `projection`: Abbeel & Ng (2004) §3.1.

use super::learn;
use crate::irl::{Fit, FitError, Method, Problem, Progress};

/// The projection method, reporting its best iterate.
pub(in crate::irl) struct Projection;

impl Method for Projection {
    fn id(&self) -> &'static str {
        "projection"
    }

    fn description(&self) -> &'static str {
        "apprenticeship learning by projection, best iterate, Abbeel & Ng (2004)"
    }

    fn fit(&self, problem: &Problem<'_>, progress: Progress<'_>) -> Result<Fit, FitError> {
        learn(problem, progress, |demonstrated, mean, found| project(demonstrated, mean, &found))
    }
}

/// Moves the mean to the point nearest to the demonstrated expectations on the way to the ones found.
fn project(demonstrated: &[f64], mean: &mut [f64], found: &[f64]) {
    let (mut along, mut length) = (0.0, 0.0);
    for ((d, m), f) in demonstrated.iter().zip(mean.iter()).zip(found) {
        along += (f - m) * (d - m);
        length += (f - m).powi(2);
    }
    if length > 0.0 {
        let share = (along / length).clamp(0.0, 1.0);
        for (m, f) in mean.iter_mut().zip(found) {
            *m += share * (f - *m);
        }
    }
}

#[cfg(test)]
mod tests {
    use super::project;

    #[test]
    fn goes_to_the_nearest_point_of_the_way_and_not_beyond() {
        let moved = |from: [f64; 2], to: [f64; 2]| {
            let mut mean = from;
            project(&[1.0, 1.0], &mut mean, &to);
            mean
        };
        assert_eq!(moved([0.0, 0.0], [4.0, 0.0]), [1.0, 0.0]);
        assert_eq!(moved([0.0, 0.0], [0.5, 0.5]), [0.5, 0.5]);
        assert_eq!(moved([0.0, 0.0], [-1.0, -1.0]), [0.0, 0.0]);
        assert_eq!(moved([0.0, 0.0], [0.0, 0.0]), [0.0, 0.0]);
    }
}
