//! The file of tokens: who may call, what for and how much.
//!
//! A token is 256 random bits, so its hash is stored under plain SHA-256: slow hashes make passwords expensive to guess,
//! and there is nothing to guess here, while every call would pay for the slowness. Invariants: no two tokens share a name
//! or a hash; the secret itself is nowhere but in the hands of its holder. Names are short and plain, for they go into
//! logs, spans and the store.

use crate::grant::{Grant, Quotas, Scope};
use base64::{Engine as _, prelude::BASE64_URL_SAFE_NO_PAD};
use serde::Deserialize;
use sha2::{Digest as _, Sha256};
use std::{
    fmt::{self, Write as _},
    sync::Arc,
    time::SystemTime,
};
use subtle::{Choice, ConditionallySelectable as _, ConstantTimeEq as _};

/// Largest file of tokens, in bytes.
pub const MAX_FILE_BYTES: u64 = 1 << 20;
/// Longest secret that is looked at, in bytes.
const MAX_SECRET_BYTES: usize = 512;
/// What every secret begins with, so that scanners for leaked ones can tell.
const PREFIX: &str = "mzw_";

/// SHA-256 of a secret.
type Hash = [u8; 32];

/// What a file of tokens says.
#[derive(Debug, Default)]
pub struct Tokens {
    entries: Vec<(Hash, Arc<Grant>)>,
}

#[derive(Deserialize)]
#[serde(deny_unknown_fields)]
struct File {
    #[serde(default)]
    token: Vec<Entry>,
}

#[derive(Deserialize)]
#[serde(deny_unknown_fields)]
struct Entry {
    name: String,
    sha256: String,
    scopes: Vec<String>,
    expires: Option<toml::value::Datetime>,
    max_sessions: Option<u64>,
    max_envs: Option<u64>,
    max_recorded_bytes: Option<u64>,
    max_fits: Option<u64>,
}

impl Tokens {
    /// Reads the text of a file.
    ///
    /// # Errors
    /// What is wrong, and with which token.
    pub fn parse(text: &str) -> Result<Self, String> {
        let file: File = toml::from_str(text).map_err(|error| one_line(text, &error))?;
        let mut tokens = Self::default();
        for (index, entry) in file.token.into_iter().enumerate() {
            let (hash, grant) = entry.read().map_err(|message| format!("token {}: {message}", index + 1))?;
            for (known, other) in &tokens.entries {
                if other.name == grant.name || *known == hash {
                    return Err(format!("token {}: token {:?} is there already", index + 1, other.name));
                }
            }
            tokens.entries.push((hash, Arc::new(grant)));
        }
        Ok(tokens)
    }

    /// The grant of whoever shows `secret`. Takes the same time whichever token it is, and whether it is any.
    pub fn find(&self, secret: &[u8]) -> Option<Arc<Grant>> {
        if secret.len() > MAX_SECRET_BYTES {
            return None;
        }
        let hash: Hash = Sha256::digest(secret).into();
        let mut found = u32::MAX;
        for (index, (known, _)) in (0..).zip(&self.entries) {
            let same: Choice = known.ct_eq(&hash);
            found = u32::conditional_select(&found, &index, same);
        }
        self.entries.get(found as usize).map(|(_, grant)| Arc::clone(grant))
    }

    /// Takes over the grants of `before` that are the same, so that what they began goes on, and revokes the others.
    pub fn succeed(&mut self, before: &Self) {
        for (hash, old) in &before.entries {
            let same = |(known, new): &&mut (Hash, Arc<Grant>)| {
                known == hash && new.name == old.name && new.expires == old.expires && new.scopes == old.scopes
            };
            match self.entries.iter_mut().find(same) {
                Some((_, new)) if new.quotas == old.quotas => *new = Arc::clone(old),
                Some(_) => {}
                None => old.revoke(),
            }
        }
    }

    /// How many there are.
    pub fn len(&self) -> usize {
        self.entries.len()
    }

    /// True where nobody has one.
    pub fn is_empty(&self) -> bool {
        self.entries.is_empty()
    }
}

impl Entry {
    fn read(self) -> Result<(Hash, Grant), String> {
        check_name(&self.name)?;
        let mut hash = Hash::default();
        let digits = self.sha256.as_bytes();
        let plain = digits.len() == 64 && digits.iter().all(u8::is_ascii_hexdigit);
        if !plain {
            return Err(format!("sha256: expected 64 hexadecimal digits, got {} bytes", digits.len()));
        }
        for (byte, pair) in hash.iter_mut().zip(digits.chunks_exact(2)) {
            *byte = pair.iter().fold(0, |byte, digit| byte << 4 | (*digit as char).to_digit(16).unwrap_or(0) as u8);
        }
        let scopes: Vec<Scope> = self
            .scopes
            .iter()
            .map(|scope| scope.parse())
            .collect::<Result<_, _>>()
            .map_err(|e| format!("scopes: {e}"))?;
        if scopes.is_empty() {
            return Err("scopes: expected at least one of act, record, fit and admin, got none".into());
        }
        let expires = self.expires.map(|at| utc(&at.to_string())).transpose()?;
        let quotas = Quotas {
            max_sessions: self.max_sessions.map(size),
            max_envs: self.max_envs.map(size),
            max_recorded_bytes: self.max_recorded_bytes,
            max_fits: self.max_fits.map(size),
        };
        Ok((hash, Grant::new(self.name, scopes, quotas, expires)))
    }
}

fn size(number: u64) -> usize {
    usize::try_from(number).unwrap_or(usize::MAX)
}

/// A time in UTC.
///
/// # Errors
/// It is none.
pub fn utc(text: &str) -> Result<SystemTime, String> {
    humantime::parse_rfc3339_weak(text)
        .map_err(|_| format!("expires: expected a date or a time in UTC, such as 2027-01-31T00:00:00Z, got {text}"))
}

/// A name that can go everywhere.
///
/// # Errors
/// It cannot.
pub fn check_name(name: &str) -> Result<(), String> {
    let plain = |byte: u8| byte.is_ascii_alphanumeric() || matches!(byte, b'.' | b'_' | b'-' | b'@');
    if (1..=64).contains(&name.len()) && name.bytes().all(plain) {
        Ok(())
    } else {
        Err("name: expected 1 to 64 letters, digits, or any of . _ - @".into())
    }
}

/// The first line of what is wrong with a file, and where. What stands there is not repeated.
pub(crate) fn one_line(text: &str, error: &toml::de::Error) -> String {
    let line = error.span().map_or(0, |span| text.as_bytes().iter().take(span.start).filter(|b| **b == b'\n').count());
    format!("line {}: {}", line + 1, error.message().lines().next().unwrap_or_default())
}

/// A new token: the secret for its holder, the entry for the file.
pub struct Minted {
    /// What its holder shows. Seen once and stored nowhere.
    pub secret: String,
    /// What the file says of it.
    pub entry: String,
}

impl fmt::Debug for Minted {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.debug_struct("Minted").field("entry", &self.entry).finish_non_exhaustive()
    }
}

/// Makes a token.
///
/// # Errors
/// The name is not plain; the operating system gives no randomness.
pub fn mint(name: &str, scopes: &[Scope], quotas: &Quotas, expires: Option<SystemTime>) -> Result<Minted, String> {
    check_name(name)?;
    let mut bits = [0; 32];
    getrandom::fill(&mut bits).map_err(|error| format!("no randomness from the operating system: {error}"))?;
    let secret = format!("{PREFIX}{}", BASE64_URL_SAFE_NO_PAD.encode(bits));
    let mut hash = String::with_capacity(64);
    for byte in Sha256::digest(secret.as_bytes()) {
        let _ = write!(hash, "{byte:02x}");
    }
    let scopes: Vec<_> = scopes.iter().map(|scope| format!("\"{scope}\"")).collect();
    let mut entry = format!("[[token]]\nname = \"{name}\"\nsha256 = \"{hash}\"\nscopes = [{}]\n", scopes.join(", "));
    if let Some(expires) = expires {
        let _ = writeln!(entry, "expires = {}", humantime::format_rfc3339_seconds(expires));
    }
    let quotas = [
        ("max_sessions", quotas.max_sessions.map(|n| n as u64)),
        ("max_envs", quotas.max_envs.map(|n| n as u64)),
        ("max_recorded_bytes", quotas.max_recorded_bytes),
        ("max_fits", quotas.max_fits.map(|n| n as u64)),
    ];
    for (key, quota) in quotas {
        if let Some(quota) = quota {
            let _ = writeln!(entry, "{key} = {quota}");
        }
    }
    Ok(Minted { secret, entry })
}

#[cfg(test)]
mod tests {
    use super::*;
    use std::time::Duration;

    fn minted(name: &str) -> Minted {
        let quotas = Quotas { max_sessions: Some(2), max_fits: Some(1), ..Quotas::default() };
        let expires = SystemTime::UNIX_EPOCH + Duration::from_secs(2_000_000_000);
        mint(name, &[Scope::Act, Scope::Fit], &quotas, Some(expires)).expect("a token")
    }

    #[test]
    fn what_is_minted_is_found_by_its_secret_alone() {
        let (one, two) = (minted("one"), minted("two"));
        assert_ne!(one.secret, two.secret);
        assert_eq!(one.secret.len(), 47);
        let file = format!("{}\n{}", one.entry, two.entry);
        assert!(!file.contains(&one.secret) && !format!("{one:?}").contains(&one.secret));
        let tokens = Tokens::parse(&file).expect("reads");
        let grant = tokens.find(two.secret.as_bytes()).expect("is known");
        assert_eq!((grant.name.as_str(), &grant.scopes[..]), ("two", &[Scope::Act, Scope::Fit][..]));
        assert_eq!((grant.quotas.max_sessions, grant.quotas.max_envs), (Some(2), None));
        let expires = grant.expires.expect("expires");
        assert!(grant.holds(expires - Duration::from_secs(1)) && !grant.holds(expires));
        for wrong in ["", "mzw_", &one.secret[1..], &one.secret.to_lowercase(), &"a".repeat(10_000)] {
            assert!(tokens.find(wrong.as_bytes()).is_none(), "{wrong}");
        }
    }

    #[test]
    fn a_file_that_is_wrong_is_refused_by_line_or_token() {
        let good = minted("one").entry;
        let cases = [
            ("token = 1".to_owned(), "line 1"),
            (format!("{good}max_session = 1\n"), "max_session"),
            (format!("{good}max_envs = -1\n"), "line"),
            (good.replace("\"fit\"", "\"all\""), "token 1: scopes"),
            (good.replace("[\"act\", \"fit\"]", "[]"), "token 1: scopes"),
            (good.replace("one", "o n e"), "token 1: name"),
            (good.replace("sha256 = \"", "sha256 = \"x"), "token 1: sha256"),
            (good.replace("Z\n", "+01:00\n"), "token 1: expires"),
            (format!("{good}\n{}", good.replace("one", "two")), "token 2: token \"one\""),
            (format!("{good}\n{}", minted("one").entry), "token 2: token \"one\""),
        ];
        for (text, expected) in cases {
            let message = Tokens::parse(&text).expect_err(&text);
            assert!(message.contains(expected), "{message:?} for {text}");
            assert!(!message.contains('\n'), "{message}");
        }
        assert!(Tokens::parse("").expect("nobody").is_empty());
    }

    #[test]
    fn what_is_gone_is_revoked_and_what_stays_goes_on() {
        let (one, two) = (minted("one"), minted("two"));
        let before = Tokens::parse(&format!("{}\n{}", one.entry, two.entry)).expect("reads");
        let grants: Vec<_> = [&one, &two].iter().filter_map(|m| before.find(m.secret.as_bytes())).collect();
        let mut after = Tokens::parse(&one.entry).expect("reads");
        after.succeed(&before);
        let now = SystemTime::UNIX_EPOCH;
        assert!(grants[0].holds(now) && !grants[1].holds(now));
        assert!(Arc::ptr_eq(&grants[0], &after.find(one.secret.as_bytes()).expect("is known")));
        // Less than before is another grant.
        let mut less = Tokens::parse(&one.entry.replace(", \"fit\"", "")).expect("reads");
        less.succeed(&after);
        assert!(!grants[0].holds(now));
        assert!(less.find(one.secret.as_bytes()).expect("is known").holds(now));
    }
}
