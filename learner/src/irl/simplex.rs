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

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    proptest! {
        #[test]
        fn satisfies_the_optimality_conditions(
            terms in proptest::collection::vec((0.0..5.0_f64, 0.0..5.0_f64, any::<bool>()), 1..20)
        ) {
            // a function that was never demonstrated has neither term
            let linear: Vec<f64> = terms.iter().map(|t| if t.2 { t.0 } else { 0.0 }).collect();
            let curvature: Vec<f64> = terms.iter().map(|t| if t.2 { t.1 + 1e-3 } else { 0.0 }).collect();
            let w = minimise(&linear, &curvature);
            prop_assert!((w.iter().sum::<f64>() - 1.0).abs() < 1e-9, "{w:?}");
            let slopes: Vec<f64> = w.iter().zip(&linear).zip(&curvature).map(|((w, l), c)| l - c * w).collect();
            let active = w.iter().zip(&slopes).filter(|(w, _)| **w > 1e-9).map(|(_, s)| *s);
            let multiplier = active.clone().fold(f64::NEG_INFINITY, f64::max);
            prop_assert!(active.clone().all(|s| (s - multiplier).abs() < 1e-7), "{w:?} {slopes:?}");
            prop_assert!(w.iter().zip(&slopes).all(|(w, s)| *w >= 0.0 && *s <= multiplier + 1e-7), "{w:?} {slopes:?}");
        }

        #[test]
        fn counts_follow_the_closed_form(counts in proptest::collection::vec(0.01..50.0_f64, 1..20)) {
            let w = minimise(&counts, &counts);
            let mut sorted = counts.clone();
            sorted.sort_by(|a, b| b.total_cmp(a));
            let mut multipliers = (1..=sorted.len()).map(|m| {
                (m, (m as f64 - 1.0) / sorted[..m].iter().map(|c| 1.0 / c).sum::<f64>())
            });
            let (_, multiplier) = multipliers.rfind(|&(m, l)| sorted[m - 1] > l).expect("the first always counts");
            for (w, c) in w.iter().zip(&counts) {
                prop_assert!((w - (1.0 - multiplier / c).max(0.0)).abs() < 1e-9);
            }
        }
    }

    #[test]
    fn what_nobody_wants_goes_to_what_was_never_shown() {
        assert_eq!(minimise(&[0.5, 0.0, 0.0], &[1.0, 0.0, 0.0]), [0.5, 0.25, 0.25]);
        assert_eq!(minimise(&[0.0, 0.0], &[0.0, 0.0]), [0.5, 0.5]);
        // no data left at all: weights follow 1/counts
        assert_eq!(minimise(&[0.0, 0.0], &[1.0, 3.0]), [0.75, 0.25]);
    }
}
