//! Small numerical helpers that several planners share.

/// log Σ exp(x), without overflow; −∞ for no term.
pub(crate) fn log_sum_exp(values: &[f64]) -> f64 {
    let largest = values.iter().copied().fold(f64::NEG_INFINITY, f64::max);
    if !largest.is_finite() {
        return largest;
    }
    largest + values.iter().map(|&x| (x - largest).exp()).sum::<f64>().ln()
}

/// Largest absolute value; 0 for no entry.
pub(crate) fn max_abs(values: &[f64]) -> f64 {
    values.iter().fold(0.0, |largest, &x| f64::max(largest, x.abs()))
}

/// Largest entry; −∞ for no entry.
pub(crate) fn max(values: &[f64]) -> f64 {
    values.iter().copied().fold(f64::NEG_INFINITY, f64::max)
}

/// Scalar product.
pub(crate) fn dot(a: &[f64], b: &[f64]) -> f64 {
    a.iter().zip(b).map(|(x, y)| x * y).sum()
}
