//! Messages as they are kept: behind a byte that tells the version of what follows, and their SHA-256, so that a damaged one is
//! not taken for another.

use bytes::Bytes;
use sha2::{Digest as _, Sha256};

/// Bytes of a hash.
const HASH_BYTES: usize = 32;

/// SHA-256 of some bytes.
pub fn hash(bytes: &[u8]) -> [u8; HASH_BYTES] {
    Sha256::digest(bytes).into()
}

/// A message behind its version and its hash.
pub fn seal(version: u8, message: &[u8]) -> Vec<u8> {
    [&[version][..], &hash(message), message].concat()
}

/// The message of a document whose version says that there is a hash.
///
/// # Errors
/// It is not what was stored.
pub fn unseal(document: &Bytes) -> Result<Bytes, &'static str> {
    let (hash_there, message) = document[1..].split_at_checked(HASH_BYTES).ok_or("it is cut off")?;
    if hash(message) != *hash_there {
        return Err("its content is not what was stored: the hashes differ");
    }
    Ok(document.slice(1 + HASH_BYTES..))
}

/// A hash and what follows it.
///
/// # Errors
/// It is too short.
pub fn split_hash(message: &Bytes) -> Result<([u8; HASH_BYTES], Bytes), &'static str> {
    let (hash, _) = message.split_first_chunk().ok_or("it is cut off")?;
    Ok((*hash, message.slice(HASH_BYTES..)))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn what_is_sealed_comes_out_and_what_is_damaged_does_not() {
        let sealed = seal(7, b"a message");
        assert_eq!(sealed[0], 7);
        assert_eq!(unseal(&sealed.clone().into()).unwrap(), &b"a message"[..]);
        for at in 1..sealed.len() {
            let mut damaged = sealed.clone();
            damaged[at] ^= 4;
            assert!(unseal(&damaged.into()).is_err());
            assert!(unseal(&Bytes::copy_from_slice(&sealed[..at])).is_err());
        }
    }
}
