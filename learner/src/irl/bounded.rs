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
