//! Separable quadratic programmes on the simplex, in closed form.

/// Minimises Σ ½ `curvature`_i w_i² − `linear`_i w_i over w ≥ 0, Σ w = 1, by sorting: O(B log B).
///
/// With both equal to the counts c this is w_i = max(0, 1 − λ/c_i), λ = (m − 1) / Σ_{i≤m} 1/c_(i) over the m largest counts
/// with c_(m) > λ. A function without curvature (never demonstrated) must have no linear term either; it gets weight only
/// where the others do not want the whole mass, and then an even share.
pub(super) fn minimise(linear: &[f64], curvature: &[f64]) -> Vec<f64> {
    let mut curved: Vec<usize> = (0..linear.len()).filter(|&i| curvature[i] > 0.0).collect();
    curved.sort_by(|&i, &j| linear[j].total_cmp(&linear[i]));
    let free = linear.len() - curved.len();
    let (mut ratios, mut inverses) = (0.0, 0.0);
    let mut multiplier = f64::NEG_INFINITY;
    for &i in &curved {
        if linear[i] <= multiplier {
            break;
        }
        ratios += linear[i] / curvature[i];
        inverses += 1.0 / curvature[i];
        multiplier = (ratios - 1.0) / inverses;
    }
    if free > 0 {
        multiplier = multiplier.max(0.0);
    }
    let mut weights = vec![0.0; linear.len()];
    for &i in &curved {
        weights[i] = ((linear[i] - multiplier) / curvature[i]).max(0.0);
    }
    if free > 0 && multiplier == 0.0 {
        let share = (1.0 - weights.iter().sum::<f64>()).max(0.0) / free as f64;
        for (w, &c) in weights.iter_mut().zip(curvature) {
            if c <= 0.0 {
                *w = share;
            }
        }
    }
    weights
}
