//! The name of a call, by which a line of a log, a span and an error that a client saw are brought together.

use http::{HeaderMap, HeaderName, HeaderValue};
use std::sync::{
    LazyLock,
    atomic::{AtomicU64, Ordering::Relaxed},
};

/// Metadata that carries it, in requests and in answers.
pub const HEADER: HeaderName = HeaderName::from_static("x-request-id");
/// Longest one that is taken over.
const MAX_BYTES: usize = 64;

/// The caller's own name for the call if it serves as one, or a new one. What comes from outside is written into logs: it may
/// hold nothing but letters, digits and a few signs.
pub fn of(headers: &HeaderMap) -> HeaderValue {
    let sane = |value: &&HeaderValue| {
        let plain = |byte: &u8| byte.is_ascii_alphanumeric() || b"-_.:/+=".contains(byte);
        (1..=MAX_BYTES).contains(&value.len()) && value.as_bytes().iter().all(plain)
    };
    headers.get(HEADER).filter(sane).cloned().unwrap_or_else(new)
}

/// A name that no other call has: it is no secret, so a random number a process and a count are enough.
fn new() -> HeaderValue {
    static PROCESS: LazyLock<u64> = LazyLock::new(|| {
        // Without randomness the process number tells processes apart.
        getrandom::u64().unwrap_or_else(|_| u64::from(std::process::id()))
    });
    static NEXT: AtomicU64 = AtomicU64::new(1);
    let name = format!("{:016x}-{:x}", *PROCESS, NEXT.fetch_add(1, Relaxed));
    HeaderValue::from_str(&name).unwrap_or_else(|_| HeaderValue::from_static("none"))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_sane_name_is_kept_and_any_other_replaced() {
        let of = |value: &[u8]| {
            let value = HeaderValue::from_bytes(value).expect("a header");
            let headers = HeaderMap::from_iter([(HEADER, value.clone())]);
            super::of(&headers) == value
        };
        assert!(of(b"b3c1-77/a_b.c:d+e=") && of(&[b'x'; MAX_BYTES]));
        for wrong in [&b""[..], b"a b", b"a\"b", b"a,b", "é".as_bytes(), &[b'x'; MAX_BYTES + 1]] {
            assert!(!of(wrong), "{wrong:?}");
        }
        assert_ne!(super::of(&HeaderMap::new()), super::of(&HeaderMap::new()));
    }
}
