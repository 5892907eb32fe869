//! Distinct rewards by rank, so that a step's reward takes one byte.
//!
//! Invariants: a reward comes back to the last bit; ranks follow the first appearance. Deliberately absent: rounding.

/// Ranks that a byte tells apart.
const MAX_VALUES: usize = 256;
/// Places of the hash table: twice the values, so that it never fills up.
const PLACES: usize = 2 * MAX_VALUES;

/// The distinct rewards of some steps.
#[derive(Debug, Clone)]
pub(super) struct RewardTable {
    values: Vec<f64>,
    /// Rank + 1 of the value that hashes to this place, or the next ones; 0 where there is none.
    ranks: [u16; PLACES],
}

impl RewardTable {
    pub fn new() -> Self {
        Self { values: Vec::with_capacity(MAX_VALUES), ranks: [0; PLACES] }
    }

    pub fn values(&self) -> &[f64] {
        &self.values
    }

    /// Rank of a reward; `None` for one too many.
    #[inline]
    pub fn rank(&mut self, value: f64) -> Option<u8> {
        let mut place = (value.to_bits().wrapping_mul(0x9E37_79B9_7F4A_7C15) >> 55) as usize;
        loop {
            match self.ranks[place % PLACES] {
                0 => return self.insert(value, place % PLACES),
                rank if self.values[usize::from(rank) - 1].to_bits() == value.to_bits() => {
                    return Some((rank - 1) as u8);
                }
                _ => place += 1,
            }
        }
    }

    #[cold]
    fn insert(&mut self, value: f64, place: usize) -> Option<u8> {
        if self.values.len() == MAX_VALUES {
            return None;
        }
        self.values.push(value);
        self.ranks[place] = self.values.len() as u16;
        Some((self.values.len() - 1) as u8)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn ranks_follow_the_first_appearance_and_keep_every_bit() {
        let mut table = RewardTable::new();
        let ranks: Vec<_> = [0.5, -0.0, 0.0, 0.5, f64::MIN_POSITIVE].iter().map(|&value| table.rank(value)).collect();
        assert_eq!(ranks, [Some(0), Some(1), Some(2), Some(0), Some(3)]);
        assert!(table.values()[1].is_sign_negative() && !table.values()[2].is_sign_negative());
    }

    #[test]
    fn the_257th_value_is_one_too_many() {
        let mut table = RewardTable::new();
        for value in 0..256 {
            assert_eq!(table.rank(f64::from(value)), Some(value as u8));
        }
        assert_eq!(table.rank(0.5), None);
        assert_eq!(table.rank(255.0), Some(255));
    }
}
