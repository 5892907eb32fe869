//! The tokens of a service, as its file says them now.
//!
//! The file is looked at every second or so: a token that is taken out is refused from then on, without a restart, and the
//! streams that it began end. A file that does not read any more changes nothing and is complained of in the log.

use crate::{grant::Grant, tokens};
use std::{
    fs::{self, Metadata},
    io::{self, Read as _},
    path::{Path, PathBuf},
    sync::{Arc, Mutex, PoisonError, RwLock},
    time::SystemTime,
};
use tokens::{MAX_FILE_BYTES, Tokens};

/// A file of tokens that does not serve.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
#[error("{path}: {message}")]
pub struct KeyringError {
    /// The file.
    pub path: PathBuf,
    /// What is wrong with it.
    pub message: String,
}

/// What tells whether a file has changed.
#[derive(Debug, PartialEq, Eq)]
struct Seen {
    modified: Option<SystemTime>,
    len: u64,
    /// Number of the file, which changes where another is put in its place.
    number: u64,
}

impl Seen {
    fn of(metadata: &Metadata) -> Self {
        #[cfg(unix)]
        let number = std::os::unix::fs::MetadataExt::ino(metadata);
        #[cfg(not(unix))]
        let number = 0;
        Self { modified: metadata.modified().ok(), len: metadata.len(), number }
    }
}

/// Finds out who holds a secret.
#[derive(Debug)]
pub struct Keyring {
    path: PathBuf,
    tokens: RwLock<Tokens>,
    seen: Mutex<Option<Seen>>,
}

impl Keyring {
    /// Reads a file of tokens.
    ///
    /// # Errors
    /// It cannot be read, others may write it, or it says what it should not.
    pub fn open(path: &Path) -> Result<Self, KeyringError> {
        let (tokens, seen) = read(path).map_err(|message| KeyringError { path: path.into(), message })?;
        Ok(Self { path: path.into(), tokens: RwLock::new(tokens), seen: Mutex::new(Some(seen)) })
    }

    /// Looks whether the file has changed, and takes over what it says.
    pub fn refresh(&self) {
        let mut seen = self.seen.lock().unwrap_or_else(PoisonError::into_inner);
        let now = fs::metadata(&self.path).ok().map(|metadata| Seen::of(&metadata));
        if now == *seen {
            return;
        }
        match read(&self.path) {
            Ok((mut tokens, read)) => {
                let mut present = self.tokens.write().unwrap_or_else(PoisonError::into_inner);
                tokens.succeed(&present);
                tracing::info!(tokens = tokens.len(), "the file of tokens was read again");
                *present = tokens;
                *seen = Some(read);
            }
            Err(message) => {
                tracing::error!(path = %self.path.display(), message, "the file of tokens does not read; the former ones hold");
                *seen = now;
            }
        }
    }

    /// The grant of whoever shows `secret`.
    pub fn find(&self, secret: &[u8]) -> Option<Arc<Grant>> {
        self.tokens.read().unwrap_or_else(PoisonError::into_inner).find(secret)
    }
}

fn read(path: &Path) -> Result<(Tokens, Seen), String> {
    let cannot = |error: io::Error| format!("the file of tokens cannot be read: {error}");
    let mut file = fs::File::open(path).map_err(cannot)?;
    let metadata = file.metadata().map_err(cannot)?;
    check_mode(path, &metadata)?;
    let mut text = String::new();
    (&mut file).take(MAX_FILE_BYTES + 1).read_to_string(&mut text).map_err(cannot)?;
    if text.len() as u64 > MAX_FILE_BYTES {
        return Err(format!("expected a file of tokens of at most {MAX_FILE_BYTES} bytes"));
    }
    Ok((Tokens::parse(&text)?, Seen::of(&metadata)))
}

/// Whoever may write the file may let himself in.
#[cfg(unix)]
fn check_mode(path: &Path, metadata: &Metadata) -> Result<(), String> {
    use std::os::unix::fs::MetadataExt as _;
    let mode = metadata.mode();
    if mode & 0o022 != 0 {
        return Err(format!(
            "others than its owner may write the file of tokens (mode {:o}): chmod 600 it",
            mode & 0o777
        ));
    }
    if mode & 0o044 != 0 {
        tracing::warn!(path = %path.display(), "others than its owner may read the file of tokens: chmod 600 it");
    }
    Ok(())
}

#[cfg(not(unix))]
fn check_mode(_: &Path, _: &Metadata) -> Result<(), String> {
    Ok(())
}

/// Appends an entry to a file of tokens, which its owner alone may read, and which is made where it is missing.
///
/// # Errors
/// The file does not read or the whole would not; it cannot be written.
pub fn append(path: &Path, entry: &str) -> Result<(), KeyringError> {
    let failed = |message: String| KeyringError { path: path.into(), message };
    let mut text = match fs::read_to_string(path) {
        Ok(text) => text,
        Err(error) if error.kind() == io::ErrorKind::NotFound => String::new(),
        Err(error) => return Err(failed(format!("the file of tokens cannot be read: {error}"))),
    };
    if !text.is_empty() {
        text.push_str(if text.ends_with('\n') { "\n" } else { "\n\n" });
    }
    text.push_str(entry);
    Tokens::parse(&text).map_err(failed)?;
    // A new file in place of the old one: a service never reads half of it.
    let cannot = |error: io::Error| failed(format!("the file of tokens cannot be written: {error}"));
    let mut beside = path.as_os_str().to_owned();
    beside.push(format!(".{}", std::process::id()));
    let beside = PathBuf::from(beside);
    let mut options = fs::OpenOptions::new();
    options.write(true).create_new(true);
    #[cfg(unix)]
    std::os::unix::fs::OpenOptionsExt::mode(&mut options, 0o600);
    let written = options.open(&beside).and_then(|mut file| {
        io::Write::write_all(&mut file, text.as_bytes())?;
        file.sync_all()?;
        fs::rename(&beside, path)
    });
    written.map_err(|error| {
        let _ = fs::remove_file(&beside);
        cannot(error)
    })
}

#[cfg(all(test, unix))]
mod tests {
    use super::*;
    use crate::grant::{Quotas, Scope};
    use std::os::unix::fs::PermissionsExt as _;

    fn minted(name: &str) -> tokens::Minted {
        tokens::mint(name, &[Scope::Act], &Quotas::default(), None).expect("a token")
    }

    #[test]
    fn a_file_is_private_and_followed() {
        let directory = tempfile::tempdir().expect("a directory");
        let path = directory.path().join("tokens.toml");
        let (one, two) = (minted("one"), minted("two"));
        append(&path, &one.entry).expect("a new file");
        assert_eq!(fs::metadata(&path).expect("a file").permissions().mode() & 0o777, 0o600);
        let keyring = Keyring::open(&path).expect("reads");
        assert!(keyring.find(two.secret.as_bytes()).is_none());
        append(&path, &two.entry).expect("a longer file");
        assert!(append(&path, &two.entry).expect_err("is there already").message.contains("\"two\""));
        keyring.refresh();
        let grant = keyring.find(one.secret.as_bytes()).expect("still known");
        assert!(keyring.find(two.secret.as_bytes()).is_some());
        // A slip of the pen lets nobody in and nobody out.
        fs::write(&path, "[[token]]").expect("writes");
        keyring.refresh();
        assert!(keyring.find(one.secret.as_bytes()).is_some() && grant.holds(SystemTime::now()));
        fs::write(&path, &two.entry).expect("writes");
        keyring.refresh();
        assert!(keyring.find(one.secret.as_bytes()).is_none() && !grant.holds(SystemTime::now()));
        // Who may write it may let himself in.
        fs::set_permissions(&path, fs::Permissions::from_mode(0o620)).expect("a mode");
        assert!(Keyring::open(&path).expect_err("refused").to_string().contains("chmod 600"));
    }
}
