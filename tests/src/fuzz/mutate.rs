//! Changes of bytes that decoders are known to stumble over.

use rand_core::Rng as _;
use rand_pcg::Pcg64Mcg;

/// Numbers at the edges of their types, as bytes.
const EDGES: [&[u8]; 10] = [
    &[0; 4],
    &[0xff; 4],
    &[0xff, 0xff, 0xff, 0x7f],
    &[0, 0, 0, 0x80],
    &[0xff; 8],
    &[0, 0, 0, 0, 0, 0, 0xf0, 0x7f],
    &[0xff, 0xff, 0xff, 0xff, 0xff, 0xff, 0xff, 0xff, 0xff, 0x01],
    &[0x80, 0x80, 0x80, 0x80, 0x08],
    &[0x7f],
    &[0x80],
];

/// Makes inputs of inputs.
#[derive(Debug)]
pub struct Mutator {
    rng: Pcg64Mcg,
    words: &'static [&'static [u8]],
}

impl Mutator {
    /// `words` are pieces of the format.
    pub fn new(rng: Pcg64Mcg, words: &'static [&'static [u8]]) -> Self {
        Self { rng, words }
    }

    /// Its source of randomness.
    pub fn rng(&mut self) -> &mut Pcg64Mcg {
        &mut self.rng
    }

    /// An input of the pool, changed at some places.
    pub fn mutate(&mut self, pool: &[Vec<u8>], max_bytes: usize) -> Vec<u8> {
        let mut bytes = pool[below(&mut self.rng, pool.len())].clone();
        for _ in 0..=self.rng.next_u32() % 6 {
            self.change(&mut bytes, pool);
        }
        bytes.truncate(max_bytes);
        bytes
    }

    fn change(&mut self, bytes: &mut Vec<u8>, pool: &[Vec<u8>]) {
        let rng = &mut self.rng;
        let at = below(rng, bytes.len() + 1);
        let piece = |rng: &mut Pcg64Mcg, from: &[u8]| {
            let start = below(rng, from.len() + 1);
            let length = below(rng, (from.len() - start).min(200) + 1);
            from[start..start + length].to_vec()
        };
        match rng.next_u32() % 12 {
            0 | 1 => {
                if let Some(byte) = bytes.get_mut(at) {
                    *byte ^= 1 << (rng.next_u32() % 8);
                }
            }
            2 => {
                if let Some(byte) = bytes.get_mut(at) {
                    *byte = rng.next_u32() as u8;
                }
            }
            3 => {
                if let Some(byte) = bytes.get_mut(at) {
                    *byte = byte.wrapping_add((rng.next_u32() % 7) as u8).wrapping_sub(3);
                }
            }
            4 => {
                let edge = EDGES[below(rng, EDGES.len())];
                let end = (at + edge.len()).min(bytes.len());
                bytes[at..end].copy_from_slice(&edge[..end - at]);
            }
            5 | 6 if !self.words.is_empty() => {
                let word = self.words[below(rng, self.words.len())];
                let gone = if rng.next_u32().is_multiple_of(2) { 0 } else { word.len().min(bytes.len() - at) };
                bytes.splice(at..at + gone, word.iter().copied());
            }
            7 => {
                let length = below(rng, (bytes.len() - at).min(64) + 1);
                bytes.drain(at..at + length);
            }
            8 => {
                let again = piece(rng, bytes);
                bytes.splice(at..at, again);
            }
            9 => {
                let other = &pool[below(rng, pool.len())];
                let other = piece(rng, other);
                bytes.splice(at..at, other);
            }
            10 => bytes.truncate(at),
            _ => {
                let random = (0..=rng.next_u32() % 8).map(|_| rng.next_u32() as u8).collect::<Vec<_>>();
                bytes.splice(at..at, random);
            }
        }
    }
}

/// A number below a limit, which is not 0.
pub fn below(rng: &mut Pcg64Mcg, limit: usize) -> usize {
    (rng.next_u64() % limit as u64) as usize
}
