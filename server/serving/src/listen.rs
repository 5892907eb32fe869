//! Where a server listens: an address of TCP or the path of a Unix socket.
//!
//! Invariants: a Unix socket admits its owner alone from the moment that it is there; one that a dead server left behind is
//! replaced, one that somebody listens on, or a file that is none, never; it goes with its listener.

use crate::{socket::Socket, telemetry::Connections};
use std::{fmt, io, net::SocketAddr, path::PathBuf, str::FromStr};
use tokio::net::{TcpListener, TcpStream};
#[cfg(unix)]
use tokio::net::{UnixListener, UnixStream};
use tokio_util::either::Either;

/// An address to listen on: `127.0.0.1:50051` or `unix:/run/user/1000/mazeway.sock`.
#[derive(Debug, Clone, PartialEq, Eq)]
pub enum ListenAddress {
    /// Address and port; port 0 takes a free one.
    Tcp(SocketAddr),
    /// Path of a Unix socket.
    Unix(PathBuf),
}

impl ListenAddress {
    /// True where no other machine reaches it.
    pub fn is_local(&self) -> bool {
        match self {
            Self::Tcp(address) => address.ip().is_loopback(),
            Self::Unix(_) => true,
        }
    }

    /// What to do where nobody can listen there.
    pub fn otherwise(&self) -> &'static str {
        match self {
            Self::Tcp(_) => "take a free port: --listen 127.0.0.1:0",
            Self::Unix(_) => "take a short path that is free, in a directory of yours",
        }
    }
}

impl From<SocketAddr> for ListenAddress {
    fn from(address: SocketAddr) -> Self {
        Self::Tcp(address)
    }
}

impl FromStr for ListenAddress {
    type Err = String;

    fn from_str(text: &str) -> Result<Self, String> {
        match text.strip_prefix("unix:") {
            Some(path) => match path.strip_prefix("//").unwrap_or(path) {
                "" => Err("expected a path after unix:".into()),
                path => Ok(Self::Unix(path.into())),
            },
            None => text.parse().map(Self::Tcp).map_err(|_| "expected IP:PORT or unix:PATH".into()),
        }
    }
}

impl fmt::Display for ListenAddress {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Self::Tcp(address) => address.fmt(f),
            Self::Unix(path) => write!(f, "unix:{}", path.display()),
        }
    }
}

/// Takes connections.
#[derive(Debug)]
pub enum Listener {
    /// Over TCP.
    Tcp(TcpListener),
    /// Over a Unix socket.
    #[cfg(unix)]
    Unix(UnixSocket),
}

impl Listener {
    /// Listens; a Unix socket is readable and writable by its owner alone.
    ///
    /// # Errors
    /// The address is taken or none of this machine's; the path is too long, taken or in no directory.
    pub async fn bind(address: &ListenAddress) -> io::Result<Self> {
        match address {
            ListenAddress::Tcp(address) => TcpListener::bind(address).await.map(Self::Tcp),
            #[cfg(unix)]
            ListenAddress::Unix(path) => UnixSocket::bind(path).map(Self::Unix),
            #[cfg(not(unix))]
            ListenAddress::Unix(_) => Err(io::Error::new(io::ErrorKind::Unsupported, "no Unix sockets here")),
        }
    }

    /// Where it listens: the port that was taken, the absolute path.
    ///
    /// # Errors
    /// The operating system does not say.
    pub fn address(&self) -> io::Result<ListenAddress> {
        match self {
            Self::Tcp(listener) => listener.local_addr().map(ListenAddress::Tcp),
            #[cfg(unix)]
            Self::Unix(socket) => Ok(ListenAddress::Unix(socket.path.clone())),
        }
    }

    /// The next connection.
    ///
    /// # Errors
    /// The operating system gives none: there are too many open files, or the peer has gone again.
    pub async fn accept(&self) -> io::Result<Accepted> {
        match self {
            Self::Tcp(listener) => {
                let (stream, _) = listener.accept().await?;
                stream.set_nodelay(true)?;
                stream.into_std().map(Stream::Tcp).map(Accepted::from)
            }
            #[cfg(unix)]
            Self::Unix(socket) => socket.listener.accept().await?.0.into_std().map(Stream::Unix).map(Accepted::from),
        }
    }
}

impl From<TcpListener> for Listener {
    fn from(listener: TcpListener) -> Self {
        Self::Tcp(listener)
    }
}

/// A connection that belongs to no runtime yet.
#[derive(Debug)]
pub struct Accepted {
    stream: Stream,
    numbers: Connections,
}

/// What the operating system gave.
#[derive(Debug)]
enum Stream {
    /// Over TCP.
    Tcp(std::net::TcpStream),
    /// Over a Unix socket.
    #[cfg(unix)]
    Unix(std::os::unix::net::UnixStream),
}

impl From<Stream> for Accepted {
    fn from(stream: Stream) -> Self {
        Self { stream, numbers: Connections::nobodys() }
    }
}

impl From<std::net::TcpStream> for Accepted {
    fn from(stream: std::net::TcpStream) -> Self {
        Stream::Tcp(stream).into()
    }
}

impl Accepted {
    /// Its bytes are counted there.
    #[must_use]
    pub fn counted(self, numbers: Connections) -> Self {
        Self { numbers, ..self }
    }

    /// Hands the connection to the present runtime, and to the lane of the present thread if it has one.
    ///
    /// # Errors
    /// The runtime cannot watch it.
    pub fn into_socket(self) -> io::Result<Socket> {
        let stream = match self.stream {
            Stream::Tcp(stream) => TcpStream::from_std(stream).map(Either::Left),
            #[cfg(unix)]
            Stream::Unix(stream) => UnixStream::from_std(stream).map(Either::Right),
        };
        Ok(Socket::new(stream?, self.numbers))
    }
}

/// A listening Unix socket that removes its file when it is dropped.
#[cfg(unix)]
#[derive(Debug)]
pub struct UnixSocket {
    listener: UnixListener,
    path: PathBuf,
    /// Device and number of the file: what has taken its place meanwhile is not ours to remove.
    file: (u64, u64),
}

#[cfg(unix)]
impl UnixSocket {
    fn bind(path: &std::path::Path) -> io::Result<Self> {
        use std::{
            fs,
            os::unix::fs::{FileTypeExt as _, MetadataExt as _, PermissionsExt as _},
        };
        let path = std::path::absolute(path)?;
        match fs::symlink_metadata(&path) {
            Ok(found) if !found.file_type().is_socket() => {
                return Err(io::Error::new(io::ErrorKind::AlreadyExists, "a file that is no socket is there"));
            }
            Ok(_) if std::os::unix::net::UnixStream::connect(&path).is_ok() => {
                return Err(io::Error::new(io::ErrorKind::AddrInUse, "somebody listens there"));
            }
            // Free, or left behind.
            Ok(_) => {}
            Err(error) if error.kind() == io::ErrorKind::NotFound => {}
            Err(error) => return Err(error),
        }
        // Under another name until only its owner may connect; renaming puts it in place of a dead one in one step.
        let mut beside = path.clone().into_os_string();
        beside.push(format!(".{}", std::process::id()));
        let beside = PathBuf::from(beside);
        let listener = UnixListener::bind(&beside)?;
        let placed = fs::set_permissions(&beside, fs::Permissions::from_mode(0o600))
            .and_then(|()| fs::symlink_metadata(&beside))
            .and_then(|file| fs::rename(&beside, &path).map(|()| (file.dev(), file.ino())));
        match placed {
            Ok(file) => Ok(Self { listener, path, file }),
            Err(error) => {
                let _ = fs::remove_file(&beside);
                Err(error)
            }
        }
    }
}

#[cfg(unix)]
impl Drop for UnixSocket {
    fn drop(&mut self) {
        use std::os::unix::fs::MetadataExt as _;
        let ours = std::fs::symlink_metadata(&self.path).is_ok_and(|file| (file.dev(), file.ino()) == self.file);
        if ours && let Err(error) = std::fs::remove_file(&self.path) {
            tracing::warn!(path = %self.path.display(), %error, "the socket stays behind");
        }
    }
}

#[cfg(all(test, unix))]
mod tests {
    use super::*;
    use std::{fs, os::unix::fs::PermissionsExt as _};

    #[test]
    fn addresses_are_read_and_written() {
        for (text, written) in [
            ("127.0.0.1:50051", "127.0.0.1:50051"),
            ("[::1]:0", "[::1]:0"),
            ("unix:/tmp/a.sock", "unix:/tmp/a.sock"),
            ("unix:///tmp/a.sock", "unix:/tmp/a.sock"),
            ("unix:a b", "unix:a b"),
        ] {
            let address: ListenAddress = text.parse().expect(text);
            assert_eq!(address.to_string(), written);
        }
        for wrong in ["", "unix:", "unix://", "localhost", "127.0.0.1", "/tmp/a.sock"] {
            assert!(wrong.parse::<ListenAddress>().is_err(), "{wrong}");
        }
        let local = |text: &str| text.parse::<ListenAddress>().expect(text).is_local();
        assert!(local("[::1]:1") && local("unix:a") && !local("0.0.0.0:1"));
    }

    #[tokio::test]
    async fn a_socket_comes_private_and_goes_with_its_listener() {
        let directory = std::env::temp_dir().join(format!("mazeway-listen-{}", std::process::id()));
        fs::create_dir_all(&directory).expect("a directory");
        let path = directory.join("a.sock");
        let address = ListenAddress::Unix(path.clone());
        let listener = Listener::bind(&address).await.expect("listens");
        assert_eq!(listener.address().expect("an address"), address);
        assert_eq!(fs::metadata(&path).expect("a file").permissions().mode() & 0o777, 0o600);
        let error = Listener::bind(&address).await.expect_err("it is taken");
        assert_eq!(error.kind(), io::ErrorKind::AddrInUse);
        drop(listener);
        assert_eq!(fs::read_dir(&directory).expect("a directory").count(), 0);

        // Left behind by a server that was killed.
        drop(std::os::unix::net::UnixListener::bind(&path).expect("binds"));
        let listener = Listener::bind(&address).await.expect("replaces it");
        // Whatever takes the place meanwhile stays.
        fs::remove_file(&path).expect("removes");
        fs::write(&path, "mine").expect("writes");
        drop(listener);
        assert_eq!(fs::read(&path).expect("still there"), b"mine");
        let error = Listener::bind(&address).await.expect_err("it is a file");
        assert_eq!(error.kind(), io::ErrorKind::AlreadyExists);
        fs::remove_dir_all(&directory).expect("removes");
    }
}
