//! The Boltzmann policy that explains demonstrations best.
//!
//! A hard planner gives action values and no probabilities. π(a|s) ∝ exp(β Q(s,a)) makes them a policy; β ≥ 0 is the
//! maximum-likelihood one. The log-likelihood is concave in β, so Newton's method on its derivative, kept
//! within a bracket by bisection, finds the maximum.

use crate::mdp::Policy;

/// Largest β in units of 1 / (largest spread of action values within a state): beyond, nothing but ties is random.
const LARGEST: f64 = 1e6;

/// The policy and β. β = 0 (uniform) where the action values do not differ or speak against the demonstrations.
pub(super) fn most_likely_boltzmann(n_actions: usize, action_values: &[f64], counts: &[f64]) -> (Policy, f64) {
    let spread = action_values
        .chunks_exact(n_actions)
        .map(|q| {
            let (low, high) =
                q.iter().fold((f64::INFINITY, f64::NEG_INFINITY), |(low, high), &q| (low.min(q), high.max(q)));
            high - low
        })
        .fold(0.0, f64::max);
    // below this the differences are rounding of the planner
    let magnitude = action_values.iter().fold(0.0, |m: f64, q| m.max(q.abs()));
    if spread <= 1e-12 * magnitude || spread == 0.0 {
        return (Policy::boltzmann(n_actions, action_values, 0.0), 0.0);
    }
    // the derivative of the log-likelihood, how fast it falls, and the size of what it is the difference of
    let slope = |beta: f64| {
        let (mut slope, mut fall, mut size) = (0.0, 0.0, 0.0);
        for (q, n) in action_values.chunks_exact(n_actions).zip(counts.chunks_exact(n_actions)) {
            let visits: f64 = n.iter().sum();
            if visits > 0.0 {
                let largest = q.iter().copied().fold(f64::NEG_INFINITY, f64::max);
                let (mut mass, mut mean, mut square, mut seen) = (0.0, 0.0, 0.0, 0.0);
                for (&q, &n) in q.iter().zip(n) {
                    let gap = q - largest;
                    let weight = if gap == 0.0 { 1.0 } else { (beta * gap).exp() };
                    mass += weight;
                    mean += weight * gap;
                    square += weight * gap * gap;
                    seen += n * gap;
                }
                mean /= mass;
                slope += seen - visits * mean;
                size -= seen + visits * mean;
                fall += visits * (square / mass - mean * mean);
            }
        }
        (slope, fall, size)
    };
    let (mut low, mut high) = (0.0, LARGEST / spread);
    let (mut beta, mut at) = (low, slope(low));
    if at.0 <= 0.0 {
        return (Policy::boltzmann(n_actions, action_values, 0.0), 0.0);
    }
    if slope(high).0 >= 0.0 {
        return (Policy::boltzmann(n_actions, action_values, high), high);
    }
    let mut last = f64::INFINITY;
    for _ in 0..200 {
        let newton = beta + at.0 / at.1;
        // where steps gain too little, as from far up the flat end, halve the bracket: its ends lie decades apart
        let trusted = newton > low && newton < high && at.0.abs() <= 0.9 * last;
        let middle = if low > 1e-3 * high { 0.5 * (low + high) } else { (low.max(1e-9 * high) * high).sqrt() };
        let next = if trusted { newton } else { middle };
        if next == beta || next <= low || next >= high {
            break;
        }
        let step = (next - beta).abs();
        (last, beta) = (if trusted { at.0.abs() } else { f64::INFINITY }, next);
        at = slope(beta);
        if at.0 > 0.0 {
            low = beta;
        } else {
            high = beta;
        }
        if at.0.abs() <= 4.0 * f64::EPSILON * at.2 || (trusted && step <= 4.0 * f64::EPSILON * beta) {
            break;
        }
    }
    (Policy::boltzmann(n_actions, action_values, beta), beta)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn finds_the_temperature_that_made_the_counts() {
        let action_values = [1.0, 0.0, 0.5, 3.0, 3.2, 2.0];
        let truth = Policy::boltzmann(3, &action_values, 2.5);
        let counts: Vec<f64> = truth.probabilities().iter().map(|p| 1e6 * p).collect();
        let (policy, beta) = most_likely_boltzmann(3, &action_values, &counts);
        assert!((beta - 2.5).abs() < 1e-9);
        assert!(policy.probabilities().iter().zip(truth.probabilities()).all(|(a, b)| (a - b).abs() < 1e-9));
        // values in another unit change the temperature and not the policy
        let scaled: Vec<f64> = action_values.iter().map(|q| 1e-9 * q + 7e-9).collect();
        let (same, _) = most_likely_boltzmann(3, &scaled, &counts);
        assert!(policy.probabilities().iter().zip(same.probabilities()).all(|(a, b)| (a - b).abs() < 1e-6));
    }

    #[test]
    fn the_ends_of_the_scale() {
        let counts = [5.0, 0.0];
        let (sure, _) = most_likely_boltzmann(2, &[1.0, 0.0], &counts);
        assert_eq!(sure.probabilities(), [1.0, 0.0]);
        let (against, beta) = most_likely_boltzmann(2, &[0.0, 1.0], &counts);
        assert_eq!((against.probabilities(), beta), ([0.5, 0.5].as_slice(), 0.0));
        let (flat, beta) = most_likely_boltzmann(2, &[1e9, 1e9], &counts);
        assert_eq!((flat.probabilities(), beta), ([0.5, 0.5].as_slice(), 0.0));
    }
}
