//! The footer of a Parquet file, walked before the library reads it: that makes room for as many things as a footer claims, and
//! a process that cannot have so much room ends.
//!
//! A footer is a structure in Thrift's compact protocol. What its fields mean is left to the library, but for the counts of
//! children in its schema.

/// Structures within structures, at most.
const MAX_DEPTH: u32 = 32;
/// The list of the schema's elements in a footer, and the count of children in an element.
const SCHEMA: i16 = 2;
const N_CHILDREN: i16 = 5;
/// Kinds of the fields of a footer and of an element, from 1 on. The library reads a field as what it should be, whatever the
/// file says that it is.
const FOOTER: &[u8] = &[I32, LIST, I64, LIST, LIST, BINARY, LIST, STRUCT, BINARY];
const ELEMENT: &[u8] = &[I32, I32, I32, BINARY, I32, I32, I32, I32, I32, STRUCT];

/// Kinds of values.
const TRUE: u8 = 1;
const FALSE: u8 = 2;
const BYTE: u8 = 3;
const I16: u8 = 4;
const I32: u8 = 5;
const I64: u8 = 6;
const DOUBLE: u8 = 7;
const BINARY: u8 = 8;
const LIST: u8 = 9;
const SET: u8 = 10;
const MAP: u8 = 11;
const STRUCT: u8 = 12;

/// Whether a footer is one structure whose lists are no longer than the bytes that follow, and whose schema's elements have no
/// more children than there are elements.
pub fn is_plausible(footer: &[u8]) -> bool {
    Walk { rest: footer }.structure(0, FOOTER, None).is_some()
}

struct Walk<'a> {
    rest: &'a [u8],
}

impl Walk<'_> {
    fn byte(&mut self) -> Option<u8> {
        let (&byte, rest) = self.rest.split_first()?;
        self.rest = rest;
        Some(byte)
    }

    fn varint(&mut self) -> Option<u64> {
        varint(|| self.byte())
    }

    /// A number with a sign.
    fn number(&mut self) -> Option<i64> {
        self.varint().map(|zigzag| (zigzag >> 1).cast_signed() ^ -(zigzag & 1).cast_signed())
    }

    fn skip(&mut self, bytes: u64) -> Option<()> {
        self.rest = self.rest.get(usize::try_from(bytes).ok()?..)?;
        Some(())
    }

    /// Each field of a structure, whose first have these kinds; no field [`N_CHILDREN`] may be more than `most`.
    fn structure(&mut self, depth: u32, kinds: &[u8], most: Option<u64>) -> Option<()> {
        let mut field = 0_i16;
        loop {
            let header = self.byte()?;
            if header == 0 {
                return Some(());
            }
            let kind = header & 15;
            field = match header >> 4 {
                0 => i16::try_from(self.number()?).ok()?,
                further => field.checked_add(further.into())?,
            };
            let expected = usize::try_from(field).ok().and_then(|field| kinds.get(field.checked_sub(1)?));
            if expected.is_some_and(|expected| *expected != kind) {
                return None;
            }
            match (kind, most) {
                // The value is in the header.
                (TRUE | FALSE, _) => {}
                (I32, Some(most)) if field == N_CHILDREN => {
                    u64::try_from(self.number()?).ok().filter(|children| *children <= most)?;
                }
                (LIST, _) if depth == 0 && field == SCHEMA => self.list(depth, true)?,
                _ => self.value(kind, depth)?,
            }
        }
    }

    fn list(&mut self, depth: u32, is_schema: bool) -> Option<()> {
        let header = self.byte()?;
        let (kind, size) = (header & 15, if header >> 4 == 15 { self.varint()? } else { u64::from(header >> 4) });
        if size > self.rest.len() as u64 {
            return None;
        }
        for _ in 0..size {
            match kind {
                STRUCT if is_schema => self.structure(depth + 1, ELEMENT, Some(size))?,
                kind => self.value(kind, depth)?,
            }
        }
        Some(())
    }

    fn value(&mut self, kind: u8, depth: u32) -> Option<()> {
        if depth > MAX_DEPTH {
            return None;
        }
        match kind {
            TRUE | FALSE | BYTE => self.skip(1),
            I16 | I32 | I64 => self.varint().map(drop),
            DOUBLE => self.skip(8),
            BINARY => {
                let length = self.varint()?;
                self.skip(length)
            }
            LIST | SET => self.list(depth + 1, false),
            MAP => {
                let size = self.varint()?;
                if size == 0 {
                    return Some(());
                }
                let kinds = self.byte()?;
                if size > self.rest.len() as u64 {
                    return None;
                }
                (0..size).try_for_each(|_| {
                    self.value(kinds >> 4, depth + 1)?;
                    self.value(kinds & 15, depth + 1)
                })
            }
            STRUCT => self.structure(depth + 1, &[], None),
            _ => None,
        }
    }
}

/// A number of seven bits a byte, the lowest first.
pub fn varint(mut byte: impl FnMut() -> Option<u8>) -> Option<u64> {
    let mut number = 0_u64;
    for shift in (0..64).step_by(7) {
        let byte = byte()?;
        number |= u64::from(byte & 0x7f) << shift;
        if byte < 0x80 {
            return Some(number);
        }
    }
    None
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn what_claims_more_than_there_is_is_refused() {
        // Field 1 (i32 2), field 2: a list of two elements, the first with one child.
        let good = [0x15, 4, 0x19, 0x2c, 0x55, 2, 0, 0x15, 4, 0, 0];
        assert!(is_plausible(&good));
        for cut in 0..good.len() {
            assert!(!is_plausible(&good[..cut]), "{cut}");
        }
        // Children that are no number; three children of two elements; a list longer than the file; a text longer than the file; depths without end.
        assert!(!is_plausible(&[0x29, 0x2c, 0x56, 2, 0, 0, 0]));
        assert!(!is_plausible(&[0x29, 0x2c, 0x55, 6, 0, 0, 0]));
        assert!(!is_plausible(&[0x29, 0xfc, 0xff, 0xff, 0xff, 0x0f, 0, 0]));
        assert!(!is_plausible(&[0x18, 0x7f, 0, 0]));
        assert!(!is_plausible(&[0x1c; 100]));
        assert!(!is_plausible(&[0x19].repeat(100)));
    }
}
