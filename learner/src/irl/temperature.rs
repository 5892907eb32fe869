//! The Boltzmann policy that explains demonstrations best.
//!
//! A hard planner gives action values and no probabilities. π(a|s) ∝ exp(β Q(s,a)) makes them a policy; β ≥ 0 is the
//! maximum-likelihood one. The log-likelihood is concave in β, so bisection on its derivative finds the maximum.

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
    let slope = |beta: f64| {
        let mut slope = 0.0;
        for (q, n) in action_values.chunks_exact(n_actions).zip(counts.chunks_exact(n_actions)) {
            let visits: f64 = n.iter().sum();
            if visits > 0.0 {
                let largest = q.iter().copied().fold(f64::NEG_INFINITY, f64::max);
                let (mut mass, mut mean, mut seen) = (0.0, 0.0, 0.0);
                for (&q, &n) in q.iter().zip(n) {
                    let weight = (beta * (q - largest)).exp();
                    mass += weight;
                    mean += weight * (q - largest);
                    seen += n * (q - largest);
                }
                slope += seen - visits * mean / mass;
            }
        }
        slope
    };
    let (mut low, mut high) = (0.0, LARGEST / spread);
    if slope(low) <= 0.0 {
        return (Policy::boltzmann(n_actions, action_values, 0.0), 0.0);
    }
    if slope(high) >= 0.0 {
        return (Policy::boltzmann(n_actions, action_values, high), high);
    }
    for _ in 0..200 {
        let middle = 0.5 * (low + high);
        if middle <= low || middle >= high {
            break;
        }
        if slope(middle) > 0.0 {
            low = middle;
        } else {
            high = middle;
        }
    }
    (Policy::boltzmann(n_actions, action_values, low), low)
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
