//! How well Markov chains explored a posterior, after Vehtari, Gelman, Simpson, Carpenter & Bürkner (2021).
//!
//! R̂ here is their recommended one: the larger of the split-R̂ of the rank-normalised draws (do the chains agree on the
//! location?) and of the rank-normalised folded draws (on the spread?). The effective sample size is their bulk-ESS: that of
//! the rank-normalised split chains by Geyer's initial monotone sequence. Both look at one weight at a time.
//! Nothing here is ever NaN or infinite: a weight that never moved in any chain is known exactly (R̂ = 1, all draws count),
//! one that stands still at different places in different chains gets [`LARGEST_RHAT`], and so do chains of fewer than
//! [`SHORTEST`] draws, of which nothing can be said.

use super::{Diagnostics, Posterior};
use rayon::prelude::*;

/// Stands for an R̂ without bound.
pub(super) const LARGEST_RHAT: f64 = 1e6;
/// Draws a chain below which nothing is computed: both halves need a variance.
pub(super) const SHORTEST: usize = 4;
/// Largest R̂ of chains that agree (Vehtari et al. 2021 ask for 1.01 in a final analysis).
pub(super) const AGREEING_RHAT: f64 = 1.05;
/// Effective draws a chain below which R̂ itself is not to be trusted (Vehtari et al. 2021 §4: 50 for each split chain).
pub(super) const ENOUGH_DRAWS: f64 = 100.0;

/// Mean of each weight and the posterior, from the draws of all chains.
///
/// Every chain holds the same number of draws, at least one, flat and draw by draw: shape (`n_draws * n_weights`,).
/// `acceptance` is the share of proposals that were accepted.
pub(super) fn posterior_of_chains(n_weights: usize, chains: &[Vec<f64>], acceptance: f64) -> (Vec<f64>, Posterior) {
    let n_draws = chains[0].len() / n_weights;
    assert!(n_draws > 0 && chains.iter().all(|c| c.len() == n_draws * n_weights), "chains of equal length");
    let summaries: Vec<Summary> = (0..n_weights)
        .into_par_iter()
        .map(|weight| {
            let of_weight: Vec<Vec<f64>> =
                chains.iter().map(|chain| chain.iter().copied().skip(weight).step_by(n_weights).collect()).collect();
            Summary::new(&of_weight)
        })
        .collect();
    let posterior = Posterior {
        standard_deviations: summaries.iter().map(|s| s.standard_deviation).collect(),
        low: summaries.iter().map(|s| s.low).collect(),
        high: summaries.iter().map(|s| s.high).collect(),
        diagnostics: Some(Diagnostics {
            chains: chains.len() as u32,
            draws: n_draws as u32,
            acceptance,
            split_rhat: summaries.iter().map(|s| s.rhat).collect(),
            effective_sample_size: summaries.iter().map(|s| s.effective).collect(),
        }),
    };
    (summaries.iter().map(|s| s.mean).collect(), posterior)
}

/// What a careful reader should know of the chains; empty where there is nothing to say.
pub(super) fn warnings(diagnostics: &Diagnostics) -> Vec<String> {
    let mut warnings = Vec::new();
    let n = diagnostics.split_rhat.len();
    let apart = diagnostics.split_rhat.iter().filter(|&&r| r > AGREEING_RHAT).count();
    if apart > 0 {
        let worst = diagnostics.split_rhat.iter().copied().fold(0.0, f64::max);
        warnings.push(format!(
            "the chains do not agree on {apart} of {n} weights (split-R̂ above {AGREEING_RHAT}, at most {worst:.3}): more draws are needed"
        ));
    }
    let enough = ENOUGH_DRAWS * f64::from(diagnostics.chains);
    let poor = diagnostics.effective_sample_size.iter().filter(|&&e| e < enough).count();
    if poor > 0 {
        let least = diagnostics.effective_sample_size.iter().copied().fold(f64::INFINITY, f64::min);
        warnings.push(format!(
            "{poor} of {n} weights have fewer than {enough} effective draws (at least {least:.0}): their intervals are rough"
        ));
    }
    warnings
}

/// One weight over all chains.
struct Summary {
    mean: f64,
    standard_deviation: f64,
    low: f64,
    high: f64,
    rhat: f64,
    effective: f64,
}

impl Summary {
    fn new(chains: &[Vec<f64>]) -> Self {
        let mut sorted: Vec<f64> = chains.iter().flatten().copied().collect();
        sorted.sort_unstable_by(f64::total_cmp);
        let mean = mean(&sorted);
        let (rhat, effective) = rhat_and_effective_sample_size(chains);
        Self {
            mean,
            standard_deviation: if sorted.len() > 1 { variance(&sorted).sqrt() } else { 0.0 },
            low: quantile(&sorted, 0.025),
            high: quantile(&sorted, 0.975),
            rhat,
            effective,
        }
    }
}

/// The p-quantile of rising numbers, interpolated linearly between order statistics (type 7 of Hyndman & Fan 1996).
pub(super) fn quantile(sorted: &[f64], p: f64) -> f64 {
    let position = p * (sorted.len() - 1) as f64;
    let below = position as usize;
    let above = (below + 1).min(sorted.len() - 1);
    sorted[below] + (position - below as f64) * (sorted[above] - sorted[below])
}

/// Rank-normalised split-R̂ (the larger of bulk and folded) and bulk effective sample size of one weight, draws `[chain][draw]`.
pub(super) fn rhat_and_effective_sample_size(chains: &[Vec<f64>]) -> (f64, f64) {
    let n = chains.iter().map(Vec::len).sum::<usize>() as f64;
    let first = chains[0][0];
    if chains.iter().flatten().any(|x| !x.is_finite()) {
        return (LARGEST_RHAT, 1.0);
    }
    if chains.iter().map(Vec::len).min().unwrap_or(0) < SHORTEST {
        return (LARGEST_RHAT, 1.0);
    }
    if chains.iter().flatten().all(|&x| x == first) {
        return (1.0, n);
    }
    let halves = split(chains);
    let ranked = rank_normalised(&halves);
    let mut sorted: Vec<f64> = halves.iter().flatten().copied().collect();
    sorted.sort_unstable_by(f64::total_cmp);
    let median = quantile(&sorted, 0.5);
    let folded: Vec<Vec<f64>> = halves.iter().map(|c| c.iter().map(|x| (x - median).abs()).collect()).collect();
    let rhat = plain_rhat(&ranked).max(plain_rhat(&rank_normalised(&folded)));
    (rhat, plain_effective_sample_size(&ranked))
}

/// First and second halves; the middle draw of an odd number is left out.
fn split(chains: &[Vec<f64>]) -> Vec<Vec<f64>> {
    chains
        .iter()
        .flat_map(|chain| {
            let half = chain.len() / 2;
            [chain[..half].to_vec(), chain[chain.len() - half..].to_vec()]
        })
        .collect()
}

/// Vehtari et al. (2021) eq. 14: Φ⁻¹((rank − 3/8) / (n + 1/4)), ties sharing their mean rank.
fn rank_normalised(chains: &[Vec<f64>]) -> Vec<Vec<f64>> {
    let mut order: Vec<(f64, usize, usize)> = chains
        .iter()
        .enumerate()
        .flat_map(|(c, chain)| chain.iter().enumerate().map(move |(i, &x)| (x, c, i)))
        .collect();
    order.sort_unstable_by(|a, b| a.0.total_cmp(&b.0));
    let n = order.len() as f64;
    let mut scores: Vec<Vec<f64>> = chains.iter().map(|chain| vec![0.0; chain.len()]).collect();
    let mut begin = 0;
    while begin < order.len() {
        let mut end = begin + 1;
        while end < order.len() && order[end].0 == order[begin].0 {
            end += 1;
        }
        // ranks count from 1: those of begin..end have this mean
        let rank = 0.5 * (begin + end + 1) as f64;
        let score = normal_quantile((rank - 0.375) / (n + 0.25));
        for &(_, c, i) in &order[begin..end] {
            scores[c][i] = score;
        }
        begin = end;
    }
    scores
}

/// √(((N − 1)/N · W + B/N) / W) of chains of N draws, W the mean variance within chains and B/N the variance of their means.
fn plain_rhat(chains: &[Vec<f64>]) -> f64 {
    let n = chains[0].len() as f64;
    let within = mean(&chains.iter().map(|c| variance(c)).collect::<Vec<_>>());
    let between = variance(&chains.iter().map(|c| mean(c)).collect::<Vec<_>>());
    if within == 0.0 {
        return if between == 0.0 { 1.0 } else { LARGEST_RHAT };
    }
    ((n - 1.0) / n + between / within).sqrt().min(LARGEST_RHAT)
}

/// Vehtari et al. (2021) eq. 10–13, truncated by Geyer's (1992) initial monotone sequence; at most n log₁₀ n of n draws.
fn plain_effective_sample_size(chains: &[Vec<f64>]) -> f64 {
    let n = chains[0].len();
    let total = (n * chains.len()) as f64;
    let centred: Vec<Vec<f64>> = chains
        .iter()
        .map(|c| {
            let mean = mean(c);
            c.iter().map(|x| x - mean).collect()
        })
        .collect();
    let autocovariance = |lag: usize| -> f64 {
        let sum: f64 = centred.iter().map(|c| c[lag..].iter().zip(c).map(|(a, b)| a * b).sum::<f64>()).sum();
        sum / total
    };
    let within = autocovariance(0) * n as f64 / (n as f64 - 1.0);
    let between = variance(&chains.iter().map(|c| mean(c)).collect::<Vec<_>>());
    let pooled = within * (n as f64 - 1.0) / n as f64 + between;
    if pooled <= 0.0 {
        return total;
    }
    let correlation = |lag: usize| 1.0 - (within - autocovariance(lag)) / pooled;
    // sums of neighbouring correlations, positive and never rising
    let (mut sum, mut last) = (1.0 + correlation(1), f64::INFINITY);
    let mut time = -1.0;
    let mut lag = 0;
    while sum > 0.0 {
        last = f64::min(sum, last);
        time += 2.0 * last;
        lag += 2;
        if lag + 1 >= n {
            break;
        }
        sum = correlation(lag) + correlation(lag + 1);
    }
    total / time.max(1.0 / total.log10())
}

fn mean(x: &[f64]) -> f64 {
    x.iter().sum::<f64>() / x.len() as f64
}

/// With n − 1 in the denominator; 0 of a single number.
fn variance(x: &[f64]) -> f64 {
    if x.len() < 2 {
        return 0.0;
    }
    let mean = mean(x);
    x.iter().map(|x| (x - mean).powi(2)).sum::<f64>() / (x.len() - 1) as f64
}

/// Φ⁻¹(p) to seven digits: PPND7 of Wichura (1988), algorithm AS 241.
pub(super) fn normal_quantile(p: f64) -> f64 {
    let horner = |x: f64, coefficients: &[f64]| coefficients.iter().rev().fold(0.0, |sum, c| sum * x + c);
    let q = p - 0.5;
    if q.abs() <= 0.425 {
        let r = 0.180_625 - q * q;
        let above = horner(r, &[3.387_132_717_9, 50.434_271_938, 159.291_132_02, 59.109_374_72]);
        return q * above / horner(r, &[1.0, 17.895_169_469, 78.757_757_664, 67.187_563_6]);
    }
    let r = (-p.min(1.0 - p).max(f64::MIN_POSITIVE).ln()).sqrt();
    let size = if r <= 5.0 {
        let r = r - 1.6;
        let above = horner(r, &[1.423_437_277_7, 2.756_815_39, 1.306_728_481_6, 0.170_238_211_03]);
        above / horner(r, &[1.0, 0.737_001_642_5, 0.120_211_329_75])
    } else {
        let r = r - 5.0;
        let above = horner(r, &[6.657_905_115, 3.081_226_386, 0.428_682_943_37, 0.017_337_203_997]);
        above / horner(r, &[1.0, 0.241_978_947_25, 0.012_258_202_635])
    };
    if q < 0.0 { -size } else { size }
}

#[cfg(test)]
mod tests {
    use super::*;
    use rand_core::Rng;
    use rand_pcg::Pcg64;

    fn normal(random: &mut Pcg64) -> f64 {
        normal_quantile(((random.next_u64() >> 11) as f64 + 0.5) / (1_u64 << 53) as f64)
    }

    /// x' = φx + √(1 − φ²) ε about `centre`, from its stationary distribution on.
    fn autoregressive(phi: f64, centre: f64, n: usize, random: &mut Pcg64) -> Vec<f64> {
        let mut x = normal(random);
        let scale = (1.0 - phi * phi).sqrt();
        (0..n)
            .map(|_| {
                let now = centre + x;
                x = phi * x + scale * normal(random);
                now
            })
            .collect()
    }

    #[test]
    fn quantiles_of_the_normal_distribution() {
        for (p, x) in [(0.5, 0.0), (0.975, 1.959_963_985), (0.025, -1.959_963_985), (0.999_9, 3.719_016_485)] {
            assert!((normal_quantile(p) - x).abs() < 1e-6, "{p}");
        }
        assert!((normal_quantile(1e-20) + 9.262_340_09).abs() < 1e-5);
        assert!((quantile(&[1.0, 2.0, 4.0, 8.0], 0.5) - 3.0).abs() < 1e-15);
        assert!((quantile(&[1.0, 2.0, 4.0, 8.0], 0.9) - 6.8).abs() < 1e-12);
        assert_eq!(quantile(&[3.0], 0.025), 3.0);
    }

    #[test]
    fn plain_rhat_by_hand() {
        // variances 5/3 and 5/3, means 2.5 and 4.5: W = 5/3, B/N = 2, N = 4
        let chains = [vec![1.0, 2.0, 3.0, 4.0], vec![3.0, 4.0, 5.0, 6.0]];
        let want = (0.75_f64 + 2.0 / (5.0 / 3.0)).sqrt();
        assert!((plain_rhat(&chains) - want).abs() < 1e-12);
        // ranks 1, 2, 3.5, 5.5, 3.5, 5.5, 7, 8 of 8
        let ranked = rank_normalised(&chains);
        assert_eq!(ranked[0][2], ranked[1][0]);
        assert!((ranked[0][0] - normal_quantile(0.625 / 8.25)).abs() < 1e-15);
        assert!((ranked[0][2] - normal_quantile(3.125 / 8.25)).abs() < 1e-15);
        assert!((ranked[1][3] + ranked[0][0]).abs() < 1e-7);
    }

    #[test]
    fn plain_effective_sample_size_by_hand() {
        // one chain 0, 1, 2, 3, 4, 5: mean square 35/12, autocovariances c₁ = 35/24, c₂ = 1/12·…, by definition below
        let chain = vec![0.0, 1.0, 2.0, 3.0, 4.0, 5.0];
        let centred = [-2.5, -1.5, -0.5, 0.5, 1.5, 2.5];
        let c = |lag: usize| (lag..6).map(|i| centred[i] * centred[i - lag]).sum::<f64>() / 6.0;
        // within = c₀·6/5, pooled = c₀; ρ_t = 1 − (1.2 c₀ − c_t)/c₀ = c_t/c₀ − 0.2
        let rho = |lag: usize| c(lag) / c(0) - 0.2;
        assert!(1.0 + rho(1) > 0.0 && rho(2) + rho(3) < 0.0);
        let want = 6.0 / (-1.0 + 2.0 * (1.0 + rho(1)));
        assert!((plain_effective_sample_size(&[chain]) - want).abs() < 1e-12);
    }

    #[test]
    fn effective_sample_sizes_of_autoregressive_chains() {
        for (phi, seed) in [(0.0, 1), (0.5, 2), (0.9, 3), (-0.4, 4)] {
            let mut random = Pcg64::new(seed, 7);
            let n = 20_000;
            let chains: Vec<Vec<f64>> = (0..4).map(|_| autoregressive(phi, 0.0, n, &mut random)).collect();
            let (rhat, effective) = rhat_and_effective_sample_size(&chains);
            // the mean of n draws has the variance of n (1 − φ)/(1 + φ) independent ones
            let want = 4.0 * n as f64 * (1.0 - phi) / (1.0 + phi);
            assert!((effective / want - 1.0).abs() < 0.12, "φ = {phi}: {effective}, expected {want}");
            assert!((1.0..1.01).contains(&rhat), "φ = {phi}: {rhat}");
        }
    }

    #[test]
    fn rhat_sees_other_places_other_spreads_and_drift() {
        let mut random = Pcg64::new(5, 7);
        let mut chains: Vec<Vec<f64>> = (0..4).map(|_| autoregressive(0.3, 0.0, 1000, &mut random)).collect();
        let (rhat, all) = rhat_and_effective_sample_size(&chains);
        assert!(rhat < 1.01);
        // what the ranks do not change, R̂ does not see
        let cubes: Vec<Vec<f64>> = chains.iter().map(|c| c.iter().map(|x| x.powi(3)).collect()).collect();
        assert!((rhat_and_effective_sample_size(&cubes).1 / all - 1.0).abs() < 1e-9);
        let wide: Vec<Vec<f64>> = chains
            .iter()
            .enumerate()
            .map(|(i, c)| c.iter().map(|x| x * if i == 0 { 5.0 } else { 1.0 }).collect())
            .collect();
        assert!(rhat_and_effective_sample_size(&wide).0 > 1.1);
        let drift: Vec<Vec<f64>> =
            chains.iter().map(|c| c.iter().enumerate().map(|(i, x)| x + i as f64 * 2e-3).collect()).collect();
        assert!(rhat_and_effective_sample_size(&drift).0 > 1.1);
        chains[2] = autoregressive(0.3, 1.5, 1000, &mut random);
        let (rhat, fewer) = rhat_and_effective_sample_size(&chains);
        assert!(rhat > 1.1 && fewer < 0.1 * all, "{rhat}, {fewer}");
    }

    #[test]
    fn chains_that_tell_nothing() {
        assert_eq!(rhat_and_effective_sample_size(&[vec![2.0; 8], vec![2.0; 8]]), (1.0, 16.0));
        let (rhat, effective) = rhat_and_effective_sample_size(&[vec![2.0; 8], vec![3.0; 8]]);
        assert!(rhat == LARGEST_RHAT && effective.is_finite() && effective < 16.0);
        assert_eq!(rhat_and_effective_sample_size(&[vec![2.0, 1.0, 3.0]]), (LARGEST_RHAT, 1.0));
        assert_eq!(rhat_and_effective_sample_size(&[vec![f64::NAN; 8]]), (LARGEST_RHAT, 1.0));
    }

    #[test]
    fn a_posterior_of_chains() {
        let mut random = Pcg64::new(6, 7);
        // two weights: N(1, 1) and ten times that
        let chains: Vec<Vec<f64>> = (0..4)
            .map(|_| autoregressive(0.2, 1.0, 5000, &mut random).into_iter().flat_map(|x| [x, 10.0 * x]).collect())
            .collect();
        let (mean, posterior) = posterior_of_chains(2, &chains, 0.5);
        for (b, unit) in [(0, 1.0), (1, 10.0)] {
            assert!((mean[b] / unit - 1.0).abs() < 0.05);
            assert!((posterior.standard_deviations[b] / unit - 1.0).abs() < 0.05);
            assert!((posterior.low[b] / unit + 0.96).abs() < 0.1 && (posterior.high[b] / unit - 2.96).abs() < 0.1);
        }
        let diagnostics = posterior.diagnostics.expect("diagnostics");
        assert_eq!((diagnostics.chains, diagnostics.draws, diagnostics.acceptance), (4, 5000, 0.5));
        assert!(warnings(&diagnostics).is_empty());
        let poor = Diagnostics { split_rhat: vec![1.0, 1.2], effective_sample_size: vec![500.0, 20.0], ..diagnostics };
        let told = warnings(&poor);
        assert!(told[0].contains("1 of 2 weights") && told[0].contains("1.200"), "{told:?}");
        assert!(told[1].contains("fewer than 400 effective draws (at least 20)"), "{told:?}");
    }
}
