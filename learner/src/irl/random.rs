//! Randomness of methods that sample: one portable stream for every (seed, index).
//!
//! Invariant: a stream depends on its seed and index alone, never on threads or on what other streams drew.

use rand_core::Rng as _;
use rand_pcg::Pcg64;

/// Increment of splitmix64: 2⁶⁴ divided by the golden ratio.
const GOLDEN: u64 = 0x9E37_79B9_7F4A_7C15;

/// Draws of one stream.
#[derive(Debug, Clone)]
pub(super) struct Stream {
    generator: Pcg64,
    /// The second of a pair of normal draws.
    spare: Option<f64>,
}

impl Stream {
    /// State and increment of PCG XSL RR 128/64 are four words of splitmix64.
    pub(super) fn new(seed: u64, index: u64) -> Self {
        let mut counter =
            mix(seed.wrapping_add(GOLDEN)) ^ mix(index.wrapping_add(1).wrapping_mul(0xD6E8_FEB8_6659_FD93));
        let mut word = || {
            counter = counter.wrapping_add(GOLDEN);
            u128::from(mix(counter))
        };
        let state = (word() << 64) | word();
        let increment = (word() << 64) | word();
        Self { generator: Pcg64::new(state, increment), spare: None }
    }

    /// Uniform in [0, 1).
    pub(super) fn uniform(&mut self) -> f64 {
        (self.generator.next_u64() >> 11) as f64 * (1.0 / 9_007_199_254_740_992.0)
    }

    /// Standard normal, by Marsaglia's polar method.
    pub(super) fn normal(&mut self) -> f64 {
        if let Some(spare) = self.spare.take() {
            return spare;
        }
        loop {
            let (u, v) = (2.0 * self.uniform() - 1.0, 2.0 * self.uniform() - 1.0);
            let square = u * u + v * v;
            if square < 1.0 && square > 0.0 {
                let scale = (-2.0 * square.ln() / square).sqrt();
                self.spare = Some(v * scale);
                return u * scale;
            }
        }
    }
}

/// The finaliser of splitmix64 (Steele, Lea & Flood, 2014).
const fn mix(value: u64) -> u64 {
    let value = (value ^ (value >> 30)).wrapping_mul(0xBF58_476D_1CE4_E5B9);
    let value = (value ^ (value >> 27)).wrapping_mul(0x94D0_49BB_1331_11EB);
    value ^ (value >> 31)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn moments_and_separate_streams() {
        let draws = |seed, index| {
            let mut stream = Stream::new(seed, index);
            (0..20_000).map(|_| stream.normal()).collect::<Vec<f64>>()
        };
        let (a, b, c) = (draws(0, 0), draws(0, 1), draws(1, 0));
        let mean = |x: &mut dyn Iterator<Item = f64>| x.sum::<f64>() / 20_000.0;
        for x in [&a, &b, &c] {
            assert!(mean(&mut x.iter().copied()).abs() < 0.03);
            assert!((mean(&mut x.iter().map(|x| x * x)) - 1.0).abs() < 0.05);
            assert!((mean(&mut x.iter().map(|x| x.powi(4))) - 3.0).abs() < 0.3);
        }
        for (x, y) in [(&a, &b), (&a, &c), (&b, &c)] {
            assert!(mean(&mut x.iter().zip(y).map(|(x, y)| x * y)).abs() < 0.03);
        }
        assert_eq!(a, draws(0, 0));
        let mut stream = Stream::new(3, 5);
        let uniforms: Vec<f64> = (0..1000).map(|_| stream.uniform()).collect();
        assert!(uniforms.iter().all(|u| (0.0..1.0).contains(u)));
    }
}
