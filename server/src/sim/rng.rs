//! Portable randomness: PCG XSL RR 128/64 seeded through splitmix64, with draws fixed for ever.
//!
//! Invariants: a stream depends only on its seed and its purpose; a draw takes exactly one 64-bit word, so that a simulator's
//! stream never depends on what was drawn before. Golden values in the tests pin every number.
//! Deliberately absent: distributions that need transcendental functions, whose last bits differ between platforms.

use rand_core::Rng as _;

use super::Rng;

/// What a stream of random numbers is for. Streams of one seed and different purposes are independent.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash)]
pub enum Purpose {
    /// The simulator's own: resets and steps.
    Dynamics,
    /// Whoever acts: a scripted driver or a drawn policy.
    Controller,
    /// Estimation of a tabular model.
    Model,
}

impl Purpose {
    /// Never change a tag: it would change every number of its streams.
    const fn tag(self) -> u64 {
        match self {
            Self::Dynamics => 1,
            Self::Controller => 2,
            Self::Model => 3,
        }
    }
}

/// The finaliser of splitmix64 (Steele, Lea & Flood, 2014): a bijection that spreads near-by seeds.
const fn mix(value: u64) -> u64 {
    let value = (value ^ (value >> 30)).wrapping_mul(0xBF58_476D_1CE4_E5B9);
    let value = (value ^ (value >> 27)).wrapping_mul(0x94D0_49BB_1331_11EB);
    value ^ (value >> 31)
}

/// Increment of splitmix64: 2⁶⁴ divided by the golden ratio.
const GOLDEN: u64 = 0x9E37_79B9_7F4A_7C15;

/// The generator for `seed` and `purpose`: state and increment are four words of splitmix64.
pub fn stream(seed: u64, purpose: Purpose) -> Rng {
    let mut counter = mix(seed.wrapping_add(GOLDEN)) ^ purpose.tag().wrapping_mul(0xD6E8_FEB8_6659_FD93);
    let mut word = || {
        counter = counter.wrapping_add(GOLDEN);
        u128::from(mix(counter))
    };
    let state = (word() << 64) | word();
    let increment = (word() << 64) | word();
    Rng::new(state, increment)
}

/// Uniform in [0, 1): the 53 high bits of one word.
#[inline]
pub fn uniform(rng: &mut Rng) -> f64 {
    (rng.next_u64() >> 11) as f64 * (1.0 / 9_007_199_254_740_992.0)
}

/// Uniform in `0..n` by the high half of a product; `n` is at least 1. The bias is below n / 2⁶⁴.
#[inline]
pub fn below(rng: &mut Rng, n: u32) -> u32 {
    ((u128::from(rng.next_u64()) * u128::from(n)) >> 64) as u32
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn streams_have_their_golden_values() {
        let words = |seed, purpose| {
            let mut rng = stream(seed, purpose);
            [rng.next_u64(), rng.next_u64(), rng.next_u64()]
        };
        assert_eq!(words(0, Purpose::Dynamics), [0xb4d8_697c_c9ab_923e, 0x877d_14a8_7951_0cd3, 0x3d00_c481_bc6a_b879]);
        assert_eq!(
            words(0, Purpose::Controller),
            [0x0eb2_970a_1dd4_76f1, 0x5a7e_c009_a7eb_94ad, 0xc793_fc20_94e5_b40f]
        );
        assert_eq!(words(1, Purpose::Dynamics), [0x1b29_018b_22a0_a22d, 0x8e28_f3ff_8f6f_f984, 0x0066_6b99_57eb_b57a]);
        assert_eq!(
            words(u64::MAX, Purpose::Model),
            [0x95be_f411_115f_dc44, 0x8e44_8488_1206_d855, 0xc142_0384_3ea6_0784]
        );
    }

    #[test]
    fn draws_have_their_golden_values() {
        let mut rng = stream(42, Purpose::Dynamics);
        let uniforms: Vec<f64> = (0..3).map(|_| uniform(&mut rng)).collect();
        let integers: Vec<u32> = (0..12).map(|_| below(&mut rng, 57)).collect();
        assert_eq!(uniforms, [0.528_906_521_491_306_5, 0.177_335_678_565_869_74, 0.690_797_722_475_335_2]);
        assert_eq!(integers, [24, 26, 21, 37, 46, 2, 30, 1, 15, 14, 16, 23]);
    }

    #[test]
    fn draws_stay_in_range_and_reach_every_value() {
        let mut rng = stream(7, Purpose::Controller);
        let mut seen = [0u32; 5];
        let mut sum = 0.0;
        for _ in 0..10_000 {
            seen[below(&mut rng, 5) as usize] += 1;
            let value = uniform(&mut rng);
            assert!((0.0..1.0).contains(&value));
            sum += value;
        }
        assert!(seen.iter().all(|&n| (1_800..2_200).contains(&n)), "{seen:?}");
        assert!((sum / 10_000.0 - 0.5).abs() < 0.01);
    }
}
