//! Packed arrays as they travel: little-endian, row-major, without padding; viewed in place, never copied to be read.

use crate::ClientError;
use bytes::Bytes;
use std::marker::PhantomData;

mod sealed {
    pub trait Sealed {}
}

/// Element of a packed array.
pub trait Element: sealed::Sealed + Copy + std::fmt::Debug + PartialEq + 'static {
    /// Bytes of one element.
    const SIZE: usize;
    /// Reads one element; `bytes` has [`Self::SIZE`] of them.
    fn read(bytes: &[u8]) -> Self;
    /// Appends one element.
    fn write(self, out: &mut Vec<u8>);
}

macro_rules! element {
    ($($name:ty),*) => {$(
        impl sealed::Sealed for $name {}
        impl Element for $name {
            const SIZE: usize = size_of::<$name>();
            #[inline]
            fn read(bytes: &[u8]) -> Self {
                let mut raw = [0; size_of::<$name>()];
                raw.copy_from_slice(bytes);
                Self::from_le_bytes(raw)
            }
            #[inline]
            fn write(self, out: &mut Vec<u8>) {
                out.extend_from_slice(&self.to_le_bytes());
            }
        }
    )*};
}

element!(u8, u16, i32, u32, i64, u64, f32, f64);

/// A view of a packed array.
#[derive(Clone, PartialEq, Eq)]
pub struct Packed<T> {
    bytes: Bytes,
    element: PhantomData<T>,
}

impl<T> Default for Packed<T> {
    fn default() -> Self {
        Self { bytes: Bytes::new(), element: PhantomData }
    }
}

impl<T: Element> std::fmt::Debug for Packed<T> {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.debug_list().entries(self.iter()).finish()
    }
}

impl<T: Element> Packed<T> {
    /// Views `bytes`; `None` where they are no whole number of elements.
    pub fn new(bytes: Bytes) -> Option<Self> {
        bytes.len().is_multiple_of(T::SIZE).then_some(Self { bytes, element: PhantomData })
    }

    /// Views an answer's `bytes` and checks that there are `len` elements.
    pub(crate) fn of_len(bytes: Bytes, len: usize, what: &str) -> Result<Self, ClientError> {
        let got = bytes.len();
        Self::new(bytes)
            .filter(|packed| packed.len() == len)
            .ok_or_else(|| ClientError::protocol(format!("expected {} bytes of {what}, got {got}", len * T::SIZE)))
    }

    /// Number of elements.
    pub fn len(&self) -> usize {
        self.bytes.len() / T::SIZE
    }

    /// True where there is no element.
    pub fn is_empty(&self) -> bool {
        self.bytes.is_empty()
    }

    /// Element `index`; `None` beyond the end.
    pub fn get(&self, index: usize) -> Option<T> {
        self.bytes.get(index * T::SIZE..(index + 1) * T::SIZE).map(T::read)
    }

    /// The elements in order.
    pub fn iter(&self) -> impl ExactSizeIterator<Item = T> + '_ {
        self.bytes.chunks_exact(T::SIZE).map(T::read)
    }

    /// The elements, copied.
    pub fn to_vec(&self) -> Vec<T> {
        self.iter().collect()
    }

    /// Writes the elements over the first of `out`, and says how many there are.
    pub fn copy_to(&self, out: &mut [T]) -> usize {
        out.iter_mut().zip(self.iter()).map(|(slot, value)| *slot = value).count()
    }

    /// The bytes as they travelled.
    pub fn as_bytes(&self) -> &Bytes {
        &self.bytes
    }
}

/// Packs values.
pub fn pack<T: Element>(values: impl IntoIterator<Item = T>) -> Bytes {
    let values = values.into_iter();
    let mut out = Vec::with_capacity(values.size_hint().0 * T::SIZE);
    for value in values {
        value.write(&mut out);
    }
    out.into()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn packing_and_viewing_are_inverse() {
        let values = [0.0, -1.5, f64::MAX, f64::MIN_POSITIVE];
        let packed = Packed::<f64>::new(pack(values)).expect("whole elements");
        assert_eq!(packed.to_vec(), values);
        assert_eq!((packed.len(), packed.get(1), packed.get(4)), (4, Some(-1.5), None));
        assert_eq!(pack([1_i32, -2]).as_ref(), [1, 0, 0, 0, 0xfe, 0xff, 0xff, 0xff]);
    }

    #[test]
    fn a_torn_element_is_refused() {
        assert!(Packed::<i32>::new(Bytes::from_static(&[0; 7])).is_none());
        let error = Packed::<i32>::of_len(Bytes::from_static(&[0; 8]), 3, "actions").expect_err("too short");
        assert!(error.to_string().ends_with("expected 12 bytes of actions, got 8"), "{error}");
    }
}
