//! Minimisation of a smooth function under lower bounds: projected L-BFGS.
//!
//! A variable at its bound whose gradient pushes outward is held; the others take the two-loop L-BFGS direction (Nocedal
//! 1980) restricted to them (two-metric projection, Bertsekas 1982; Schmidt, Kim & Sra 2011), and the step is searched along
//! the projected path (Armijo). Deliberately absent: upper bounds and equality constraints, which no method here has.

use super::{FitError, Stopped};

/// How to minimise.
pub(super) struct Settings {
    /// Lower bound of every variable; −∞ for none.
    pub lower: f64,
    /// Decrease over the last few iterations below which it has converged.
    pub tolerance: f64,
    /// Iterations after which it stops all the same.
    pub max_iterations: u32,
}

/// Where it ended.
pub(super) struct Minimum {
    pub x: Vec<f64>,
    pub stopped: Stopped,
}

/// Pairs of steps and gradient changes kept.
const MEMORY: usize = 20;
/// Iterations over which the decrease is watched: a single short step is no convergence.
const WINDOW: usize = 5;
const ARMIJO: f64 = 1e-4;
const MAX_HALVINGS: u32 = 40;

/// Minimises `value_and_gradient` from `x` on; `record` is told the value and the decrease after every iteration.
pub(super) fn minimise(
    settings: &Settings,
    mut x: Vec<f64>,
    mut value_and_gradient: impl FnMut(&[f64]) -> (f64, Vec<f64>),
    mut record: impl FnMut(f64, f64) -> Result<(), FitError>,
) -> Result<Minimum, FitError> {
    for v in &mut x {
        *v = v.max(settings.lower);
    }
    let (mut value, mut gradient) = value_and_gradient(&x);
    let mut history: Vec<Pair> = Vec::new();
    let mut values = vec![value];
    for iteration in 1..=settings.max_iterations {
        let free: Vec<bool> = x.iter().zip(&gradient).map(|(&x, &g)| x > settings.lower || g < 0.0).collect();
        let steepest: Vec<f64> = gradient.iter().zip(&free).map(|(&g, &f)| if f { -g } else { 0.0 }).collect();
        let steepness = max_abs(&steepest);
        // the rounding of the value hides anything below
        if steepness == 0.0 {
            record(value, 0.0)?;
            return Ok(Minimum { x, stopped: Stopped::Converged });
        }
        let mut accepted = None;
        for attempt in 0..2 {
            if attempt == 1 {
                history.clear();
            }
            let mut direction = two_loop(&steepest, &free, &history);
            let mut slope = dot(&gradient, &direction);
            if slope.is_nan() || slope >= -1e-12 * norm(&gradient) * norm(&direction) {
                direction.clone_from(&steepest);
                slope = dot(&gradient, &direction);
            }
            let first = if history.is_empty() { (1.0 / norm(&steepest)).min(1.0) } else { 1.0 };
            accepted = search(settings, &x, value, &gradient, &direction, slope, first, &mut value_and_gradient);
            if accepted.is_some() {
                break;
            }
        }
        let Some((next, next_value, next_gradient)) = accepted else {
            record(value, 0.0)?;
            // no decrease can be seen any more: at the minimum this is how precision ends
            let small = steepness <= 1e-6 * (1.0 + value.abs());
            return Ok(Minimum { x, stopped: if small { Stopped::Converged } else { Stopped::Stalled } });
        };
        let step: Vec<f64> = next.iter().zip(&x).map(|(n, x)| n - x).collect();
        let change: Vec<f64> = next_gradient.iter().zip(&gradient).map(|(n, g)| n - g).collect();
        let decrease = value - next_value;
        (x, value, gradient) = (next, next_value, next_gradient);
        if dot(&step, &change) > 1e-12 * dot(&change, &change).max(f64::MIN_POSITIVE) {
            if history.len() == MEMORY {
                history.remove(0);
            }
            history.push((step, change));
        }
        record(value, decrease)?;
        values.push(value);
        let before = values[values.len().saturating_sub(WINDOW + 1)];
        if iteration as usize >= WINDOW && before - value <= settings.tolerance {
            return Ok(Minimum { x, stopped: Stopped::Converged });
        }
    }
    Ok(Minimum { x, stopped: Stopped::MaxIterations })
}

/// x, value and gradient.
type Point = (Vec<f64>, f64, Vec<f64>);
/// A step and the change of the gradient along it.
type Pair = (Vec<f64>, Vec<f64>);

/// Steps back along the projected path until the value falls enough.
#[expect(clippy::too_many_arguments, reason = "the state of the iteration; private to this file")]
fn search(
    settings: &Settings,
    x: &[f64],
    value: f64,
    gradient: &[f64],
    direction: &[f64],
    slope: f64,
    first: f64,
    value_and_gradient: &mut impl FnMut(&[f64]) -> (f64, Vec<f64>),
) -> Option<Point> {
    let mut length = first;
    for _ in 0..MAX_HALVINGS {
        let next: Vec<f64> = x.iter().zip(direction).map(|(x, d)| (x + length * d).max(settings.lower)).collect();
        let promised: f64 = next.iter().zip(x).zip(gradient).map(|((n, x), g)| g * (n - x)).sum();
        if next == x {
            return None;
        }
        let (next_value, next_gradient) = value_and_gradient(&next);
        let fine = next_value.is_finite() && next_gradient.iter().all(|g| g.is_finite());
        if fine && next_value <= value + ARMIJO * promised {
            return Some((next, next_value, next_gradient));
        }
        // the minimum of the parabola through both values and the slope, kept within reason
        let parabola = -slope * length * length / (2.0 * (next_value - value - slope * length));
        length = if parabola.is_finite() { parabola.clamp(0.1 * length, 0.5 * length) } else { 0.1 * length };
    }
    None
}

/// −H g on the free variables.
fn two_loop(steepest: &[f64], free: &[bool], history: &[Pair]) -> Vec<f64> {
    let masked = |a: &[f64], b: &[f64]| -> f64 {
        a.iter().zip(b).zip(free).map(|((a, b), &f)| if f { a * b } else { 0.0 }).sum()
    };
    let mut direction = steepest.to_vec();
    let usable: Vec<(&Pair, f64)> = history
        .iter()
        .map(|pair| (pair, masked(&pair.0, &pair.1)))
        .filter(|&(pair, curvature)| curvature > 1e-12 * masked(&pair.1, &pair.1).max(f64::MIN_POSITIVE))
        .collect();
    let mut alphas = Vec::with_capacity(usable.len());
    for ((step, change), curvature) in usable.iter().rev() {
        let alpha = masked(step, &direction) / curvature;
        for (d, y) in direction.iter_mut().zip(change) {
            *d -= alpha * y;
        }
        alphas.push(alpha);
    }
    if let Some(((_, change), curvature)) = usable.last() {
        let scale = curvature / masked(change, change);
        for d in &mut direction {
            *d *= scale;
        }
    }
    for (((step, change), curvature), alpha) in usable.iter().zip(alphas.iter().rev()) {
        let beta = masked(change, &direction) / curvature;
        for (d, s) in direction.iter_mut().zip(step) {
            *d += (alpha - beta) * s;
        }
    }
    for (d, &f) in direction.iter_mut().zip(free) {
        if !f {
            *d = 0.0;
        }
    }
    direction
}

fn dot(a: &[f64], b: &[f64]) -> f64 {
    a.iter().zip(b).map(|(a, b)| a * b).sum()
}

fn norm(a: &[f64]) -> f64 {
    dot(a, a).sqrt()
}

fn max_abs(a: &[f64]) -> f64 {
    a.iter().fold(0.0, |m, x| f64::max(m, x.abs()))
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    fn run(lower: f64, x: Vec<f64>, f: impl FnMut(&[f64]) -> (f64, Vec<f64>)) -> Minimum {
        minimise(&Settings { lower, tolerance: 1e-14, max_iterations: 2000 }, x, f, |_, _| Ok(())).expect("a minimum")
    }

    #[test]
    fn the_banana_with_and_without_a_bound() {
        let banana = |x: &[f64]| {
            let (a, b) = (1.0 - x[0], x[1] - x[0] * x[0]);
            (a * a + 100.0 * b * b, vec![-2.0 * a - 400.0 * x[0] * b, 200.0 * b])
        };
        let found = run(f64::NEG_INFINITY, vec![-1.2, 1.0], banana);
        assert_eq!(found.stopped, Stopped::Converged);
        assert!(found.x.iter().all(|x| (x - 1.0).abs() < 1e-5), "{:?}", found.x);
        // with x ≥ 1.5 the best is x₀ = 1.5 and x₁ = 2.25
        let found = run(1.5, vec![3.0, 3.0], banana);
        assert!((found.x[0] - 1.5).abs() < 1e-9 && (found.x[1] - 2.25).abs() < 1e-6, "{:?}", found.x);
    }

    #[test]
    fn badly_scaled_bowls() {
        let found = run(f64::NEG_INFINITY, vec![0.0, 0.0], |x| {
            let (a, b) = (x[0] - 3.0, 1e4 * (x[1] - 2e-4));
            (a * a + b * b, vec![2.0 * a, 2e4 * b])
        });
        assert!((found.x[0] - 3.0).abs() < 1e-6 && (found.x[1] - 2e-4).abs() < 1e-9, "{:?}", found.x);
    }

    #[test]
    fn a_lying_gradient_stalls_and_a_call_back_cancels() {
        let uphill = |x: &[f64]| (x[0], vec![-1.0]);
        assert_eq!(run(f64::NEG_INFINITY, vec![0.0], uphill).stopped, Stopped::Stalled);
        let settings = Settings { lower: 0.0, tolerance: 0.0, max_iterations: 10 };
        let bowl = |x: &[f64]| (x[0] * x[0], vec![2.0 * x[0]]);
        let cancelled = minimise(&settings, vec![5.0], bowl, |_, _| Err(FitError::Cancelled));
        assert!(matches!(cancelled, Err(FitError::Cancelled)));
        let one = Settings { max_iterations: 1, ..settings };
        assert_eq!(minimise(&one, vec![5.0], bowl, |_, _| Ok(())).expect("a point").stopped, Stopped::MaxIterations);
    }

    proptest! {
        #[test]
        fn convex_quadratics_under_bounds(
            factor in proptest::collection::vec(-1.0..1.0_f64, 36),
            linear in proptest::collection::vec(-3.0..3.0_f64, 6),
        ) {
            // ½ xᵀ(FᵀF + 0.1 I)x − lᵀx over x ≥ 0
            let gradient = |x: &[f64]| -> Vec<f64> {
                let fx: Vec<f64> = (0..6).map(|i| dot(&factor[6 * i..6 * i + 6], x)).collect();
                (0..6).map(|j| (0..6).map(|i| factor[6 * i + j] * fx[i]).sum::<f64>() + 0.1 * x[j] - linear[j]).collect()
            };
            let found = run(0.0, vec![1.0; 6], |x| {
                let g = gradient(x);
                (0.5 * (dot(&g, x) - dot(&linear, x)), g)
            });
            for (x, g) in found.x.iter().zip(gradient(&found.x)) {
                prop_assert!(*x >= 0.0 && g >= -1e-5 && (*x == 0.0 || g.abs() < 1e-5), "slope {g} at {x}");
            }
        }
    }
}
