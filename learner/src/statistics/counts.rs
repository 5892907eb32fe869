//! How often each state-action pair was seen in one step.
//!
//! A hash table while few pairs were seen, so that long trajectories through a large model cost what they visit; a plain
//! array of all pairs once that takes no more memory, so that counting costs one addition. Deliberately absent: a hasher of
//! the standard library, whose resistance to chosen keys costs several times the count itself; crowded keys only slow it.

/// Counts of one step. Invariant of a sparse table: a power of two of slots, at most half of them taken, a taken one holds
/// at least 1.
#[derive(Debug, Clone)]
pub(super) enum Counts {
    Sparse { pairs: Vec<u32>, counts: Vec<u64>, taken: usize },
    Dense(Vec<u64>),
}

const FIRST_SLOTS: usize = 8;
/// Bytes of a slot: a pair and its count.
const SLOT_BYTES: usize = 12;

impl Default for Counts {
    fn default() -> Self {
        Self::Sparse { pairs: Vec::new(), counts: Vec::new(), taken: 0 }
    }
}

impl Counts {
    /// Counts a pair below `n_pairs` once.
    #[inline]
    pub(super) fn add(&mut self, pair: u32, n_pairs: usize) {
        if let Self::Dense(counts) = self {
            counts[pair as usize] += 1;
        } else {
            self.add_sparse(pair, n_pairs);
        }
    }

    fn add_sparse(&mut self, pair: u32, n_pairs: usize) {
        if let Self::Sparse { pairs, counts, taken } = self {
            if !counts.is_empty() {
                let slot = find(pairs, counts, pair);
                if counts[slot] > 0 {
                    counts[slot] += 1;
                    return;
                }
                if 2 * (*taken + 1) <= counts.len() {
                    (pairs[slot], counts[slot]) = (pair, 1);
                    *taken += 1;
                    return;
                }
            }
            self.grow(n_pairs);
            self.add(pair, n_pairs);
        }
    }

    /// Twice the slots, or the plain array where that is no larger.
    fn grow(&mut self, n_pairs: usize) {
        let Self::Sparse { pairs, counts, taken } = self else { return };
        let slots = (2 * counts.len()).max(FIRST_SLOTS);
        let seen = pairs.iter().zip(counts.iter()).filter(|&(_, &n)| n > 0);
        if slots * SLOT_BYTES >= n_pairs.saturating_mul(size_of::<u64>()) {
            let mut dense = vec![0; n_pairs];
            for (&pair, &n) in seen {
                dense[pair as usize] = n;
            }
            *self = Self::Dense(dense);
        } else {
            let (mut new_pairs, mut new_counts) = (vec![0; slots], vec![0; slots]);
            for (&pair, &n) in seen {
                let slot = find(&new_pairs, &new_counts, pair);
                (new_pairs[slot], new_counts[slot]) = (pair, n);
            }
            *self = Self::Sparse { pairs: new_pairs, counts: new_counts, taken: *taken };
        }
    }

    /// Rising pairs that were seen and how often.
    pub(super) fn into_sorted(self) -> Vec<(u32, f64)> {
        match self {
            Self::Dense(counts) => {
                let seen = counts.iter().zip(0_u32..).filter(|&(&n, _)| n > 0);
                seen.map(|(&n, pair)| (pair, n as f64)).collect()
            }
            Self::Sparse { pairs, counts, .. } => {
                let seen = pairs.iter().zip(&counts).filter(|&(_, &n)| n > 0);
                let mut seen: Vec<(u32, f64)> = seen.map(|(&pair, &n)| (pair, n as f64)).collect();
                seen.sort_unstable_by_key(|&(pair, _)| pair);
                seen
            }
        }
    }

    /// Bytes that the counts take.
    #[cfg(test)]
    pub(super) fn bytes(&self) -> usize {
        match self {
            Self::Dense(counts) => counts.len() * size_of::<u64>(),
            Self::Sparse { counts, .. } => counts.len() * SLOT_BYTES,
        }
    }
}

/// The slot of a pair, or the free one where it belongs.
fn find(pairs: &[u32], counts: &[u64], pair: u32) -> usize {
    let mask = counts.len() - 1;
    // Fibonacci hashing: the upper bits of the product are well mixed
    let mut slot = (u64::from(pair).wrapping_mul(0x9e37_79b9_7f4a_7c15) >> 32) as usize & mask;
    while counts[slot] > 0 && pairs[slot] != pair {
        slot = (slot + 1) & mask;
    }
    slot
}
