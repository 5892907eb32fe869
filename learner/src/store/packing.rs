//! How arrays lie on the disk: in the fewest bytes that give every value back, bit for bit.
//!
//! A state or an action takes one, two or four bytes, as the size of its set asks; a reward one (an integer from −128 to
//! 127), four (IEEE 754 single) or eight, as the widest of its trajectory asks. Everywhere else arrays are four bytes an
//! index and eight a reward: what a hash is taken of does not depend on how things are stored.

use super::{Arrays, StoreError, unpack_f64, unpack_u32};
use crate::statistics::PackedIndices;
use bytes::Bytes;
use std::borrow::Cow;

/// Bytes that the values of a trajectory's arrays take.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) struct Packing {
    state: u8,
    action: u8,
    reward: u8,
}

/// A trajectory's arrays as they are stored.
pub(super) struct PackedArrays<'a> {
    pub(super) packing: Packing,
    pub(super) states: Cow<'a, [u8]>,
    pub(super) actions: Cow<'a, [u8]>,
    pub(super) rewards: Cow<'a, [u8]>,
}

impl Packing {
    /// How schema 1 stored everything.
    #[cfg(test)]
    const WIDE: Self = Self { state: 4, action: 4, reward: 8 };

    /// As it is stored: four bits each.
    pub(super) fn code(self) -> i64 {
        i64::from(self.state) | i64::from(self.action) << 4 | i64::from(self.reward) << 8
    }

    /// The packing that a code stands for; `None` for one that was never written.
    pub(super) fn of_code(code: i64) -> Option<Self> {
        let packing = Self { state: (code & 15) as u8, action: (code >> 4 & 15) as u8, reward: (code >> 8 & 15) as u8 };
        let known = matches!(packing.state, 1 | 2 | 4) && matches!(packing.action, 1 | 2 | 4);
        (known && matches!(packing.reward, 1 | 4 | 8) && packing.code() == code).then_some(packing)
    }

    /// Stored states, to be read where they lie; `None` where they are torn.
    pub(super) fn states(self, stored: &[u8]) -> Option<PackedIndices<'_>> {
        indices(self.state, stored)
    }

    /// Stored actions, to be read where they lie; `None` where they are torn.
    pub(super) fn actions(self, stored: &[u8]) -> Option<PackedIndices<'_>> {
        indices(self.action, stored)
    }

    /// Stored rewards of eight bytes each; `None` where they are torn.
    fn rewards(self, stored: &[u8]) -> Option<Bytes> {
        Some(match self.reward {
            1 => stored.iter().flat_map(|&byte| f64::from(byte.cast_signed()).to_le_bytes()).collect(),
            4 => match stored.as_chunks() {
                (singles, []) => singles.iter().flat_map(|&b| f64::from(f32::from_le_bytes(b)).to_le_bytes()).collect(),
                _ => return None,
            },
            _ => Bytes::copy_from_slice(stored),
        })
    }
}

/// Packs the arrays of a trajectory of so many states and actions.
pub(super) fn pack(arrays: &Arrays, n_states: u32, n_actions: u32) -> PackedArrays<'_> {
    let (state, states) = narrowed(&arrays.states, n_states);
    let (action, actions) = narrowed(&arrays.actions, n_actions);
    let (reward, rewards) = narrowed_rewards(&arrays.rewards);
    PackedArrays { packing: Packing { state, action, reward }, states, actions, rewards }
}

fn narrowed(wide: &[u8], size: u32) -> (u8, Cow<'_, [u8]>) {
    // Checked against their size before: nothing is cut off.
    match size {
        0..=0x100 => (1, unpack_u32(wide).map(|index| index as u8).collect()),
        0x101..=0x1_0000 => (2, unpack_u32(wide).flat_map(|index| (index as u16).to_le_bytes()).collect()),
        _ => (4, Cow::Borrowed(wide)),
    }
}

fn narrowed_rewards(wide: &[u8]) -> (u8, Cow<'_, [u8]>) {
    // By their bits: a negative zero is another number than zero.
    let same = |reward: f64, narrow: f64| reward.to_bits() == narrow.to_bits();
    if unpack_f64(wide).all(|reward| same(reward, f64::from(reward as i8))) {
        return (1, unpack_f64(wide).map(|reward| (reward as i8).cast_unsigned()).collect());
    }
    if unpack_f64(wide).all(|reward| same(reward, f64::from(reward as f32))) {
        return (4, unpack_f64(wide).flat_map(|reward| (reward as f32).to_le_bytes()).collect());
    }
    (8, Cow::Borrowed(wide))
}

fn indices(width: u8, stored: &[u8]) -> Option<PackedIndices<'_>> {
    Some(match width {
        1 => PackedIndices::U8(stored),
        2 => match stored.as_chunks() {
            (whole, []) => PackedIndices::U16(whole),
            _ => return None,
        },
        _ => match stored.as_chunks() {
            (whole, []) => PackedIndices::U32(whole),
            _ => return None,
        },
    })
}

/// Stored states, actions and rewards as they are everywhere else; `None` where they are torn.
pub(super) fn unpack(code: i64, [states, actions, rewards]: [&[u8]; 3]) -> Option<[Bytes; 3]> {
    let packing = Packing::of_code(code)?;
    Some([widened(packing.states(states)?), widened(packing.actions(actions)?), packing.rewards(rewards)?])
}

/// Indices of four bytes each.
pub(super) fn widened(indices: PackedIndices<'_>) -> Bytes {
    match indices {
        PackedIndices::U8(bytes) => bytes.iter().flat_map(|&byte| u32::from(byte).to_le_bytes()).collect(),
        PackedIndices::U16(pairs) => {
            pairs.iter().flat_map(|&pair| u32::from(u16::from_le_bytes(pair)).to_le_bytes()).collect()
        }
        PackedIndices::U32(whole) => Bytes::copy_from_slice(whole.as_flattened()),
    }
}

/// What a packing that was never written, or an array that is torn, is called.
pub(super) fn torn(what: String) -> StoreError {
    StoreError::Corrupt { what, message: "expected whole values in a packing that is known".into() }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::store::{pack_f64, pack_u32};
    use proptest::prelude::*;

    fn there_and_back(arrays: &Arrays, n_states: u32, n_actions: u32) -> (Packing, Arrays) {
        let stored = pack(arrays, n_states, n_actions);
        let code = stored.packing.code();
        let [states, actions, rewards] =
            unpack(code, [&stored.states, &stored.actions, &stored.rewards]).expect("the arrays");
        (stored.packing, Arrays { states, actions, rewards, ..arrays.clone() })
    }

    proptest! {
        #[test]
        fn every_value_comes_back(
            steps in prop::collection::vec((any::<u32>(), any::<u32>(), any::<f64>(), any::<i8>(), any::<f32>()), 0..20),
            n_states in prop_oneof![Just(1), Just(256), Just(257), Just(65_536), Just(65_537), 1..u32::MAX],
            n_actions in prop_oneof![1_u32..300, 1..u32::MAX],
            kind in 0..4,
        ) {
            let rewards: Vec<f64> = steps.iter().map(|s| match kind {
                1 => f64::from(s.4),
                2 if s.3 == 0 => -0.0,
                3 => s.2,
                _ => f64::from(s.3),
            }).collect();
            let arrays = Arrays {
                states: pack_u32(&steps.iter().map(|s| s.0 % n_states).collect::<Vec<_>>()),
                actions: pack_u32(&steps.iter().map(|s| s.1 % n_actions).collect::<Vec<_>>()),
                rewards: pack_f64(&rewards),
                ..Arrays::default()
            };
            let (packing, back) = there_and_back(&arrays, n_states, n_actions);
            prop_assert_eq!(back, arrays);
            let width = |size: u32| if size <= 256 { 1 } else if size <= 65_536 { 2 } else { 4 };
            prop_assert_eq!((packing.state, packing.action), (width(n_states), width(n_actions)));
            prop_assert!(kind != 0 || packing.reward == 1);
        }
    }

    #[test]
    fn what_was_never_written_is_not_read() {
        assert_eq!(Packing::of_code(Packing::WIDE.code()), Some(Packing::WIDE));
        for code in [0, 3, -1, 0x113, 0x131, 0x211, 0x1111, i64::MAX] {
            assert_eq!(Packing::of_code(code), None, "{code:#x}");
        }
        let narrow = Packing { state: 2, action: 4, reward: 4 };
        assert!(narrow.states(&[0; 3]).is_none() && narrow.actions(&[0; 6]).is_none());
        assert!(narrow.rewards(&[0; 6]).is_none());
    }
}
