//! How a client reaches a service: addresses, TLS, tokens, and how long it waits.
//!
//! Invariants: a token is seen by nobody but the service that it is sent to, and leaves the machine unencrypted only where
//! that was asked for by name; a connection finds out within [`PING_INTERVAL`] + [`PING_TIMEOUT`] that its peer is gone; no
//! call waits without an end. A connection that broke is opened anew by the next call.

use crate::{ClientError, error::causes};
use std::{
    env, fmt, fs,
    future::Future,
    path::{Path, PathBuf},
    task::{Context, Poll},
    time::Duration,
};
use tokio::time::timeout;
use tonic::{
    Status,
    body::Body,
    codegen::{
        Service,
        http::{self, HeaderValue, header::AUTHORIZATION},
    },
    transport::{Certificate, Channel, ClientTlsConfig, Endpoint, Identity},
};

/// Bytes of a stream that may wait for their reader.
const STREAM_WINDOW_BYTES: u32 = 4 << 20;
/// Bytes of all streams that may wait: so many that a stream nobody reads never holds up the others.
const CONNECTION_WINDOW_BYTES: u32 = 1 << 30;
/// Largest frame taken in: an answer comes in few.
const FRAME_BYTES: u32 = 1 << 20;
/// Silence after which the peer is asked whether it is there.
const PING_INTERVAL: Duration = Duration::from_secs(10);
/// Time it has to say so.
const PING_TIMEOUT: Duration = Duration::from_secs(10);

/// What a service knows its caller by. Shows itself to nobody.
#[derive(Clone, PartialEq, Eq)]
pub struct Token(HeaderValue);

impl Token {
    /// Takes a token as it was handed out; white space around it is no part of it.
    ///
    /// # Errors
    /// It is empty, or holds what no token holds.
    pub fn new(text: &str) -> Result<Self, ClientError> {
        let wrong = || ClientError::Argument {
            field: "token",
            message: "expected a token of visible ASCII characters, got something else".into(),
        };
        let text = text.trim();
        if text.is_empty() || !text.bytes().all(|byte| byte.is_ascii_graphic()) {
            return Err(wrong());
        }
        let mut header = HeaderValue::try_from(format!("Bearer {text}")).map_err(|_| wrong())?;
        header.set_sensitive(true);
        Ok(Self(header))
    }

    /// Reads a token from a file that holds nothing else.
    ///
    /// # Errors
    /// No such file; no token in it.
    pub fn read(path: &Path) -> Result<Self, ClientError> {
        Self::new(&String::from_utf8_lossy(&read(path, "token_file")?))
    }
}

impl fmt::Debug for Token {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str("Token(…)")
    }
}

/// A client's own certificate, for services that ask for one.
#[derive(Clone, PartialEq, Eq)]
pub struct ClientCertificate {
    /// The certificate and those that lead to its issuer, in PEM.
    pub chain: Vec<u8>,
    /// Its private key, in PEM.
    pub key: Vec<u8>,
}

impl fmt::Debug for ClientCertificate {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str("ClientCertificate(…)")
    }
}

/// How to connect. The default is without a token, and over `https://` with the system's authorities.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct ConnectOptions {
    /// Sent with every call.
    pub token: Option<Token>,
    /// Authorities that may vouch for the service, in PEM, instead of the system's. Over `https://` alone.
    pub ca: Option<Vec<u8>>,
    /// Shown to a service that asks for it. Over `https://` alone.
    pub certificate: Option<ClientCertificate>,
    /// Name that the service's certificate must hold, where it is not the host of the address.
    pub server_name: Option<String>,
    /// Send the token although the connection is not encrypted and leaves the machine.
    pub insecure: bool,
    /// Longest time until a connection stands.
    pub connect_timeout: Duration,
    /// Longest wait for any one answer.
    pub deadline: Duration,
    /// Longest wait for the next message of a fit, a roll-out or a model, which may wait for its turn or be silent for long.
    pub work_deadline: Duration,
    /// How long the answer to a step is looked for before its caller sleeps, on a runtime of a single thread and where that
    /// has paid before; zero: never.
    pub spin: Duration,
}

impl Default for ConnectOptions {
    fn default() -> Self {
        Self {
            token: None,
            ca: None,
            certificate: None,
            server_name: None,
            insecure: false,
            connect_timeout: Duration::from_secs(5),
            deadline: Duration::from_mins(1),
            work_deadline: Duration::from_mins(10),
            spin: Duration::from_micros(100),
        }
    }
}

/// Where the files of TLS and the token are. What is not given is looked up in the environment: files of TLS for an address
/// that begins with `https://`.
#[derive(Debug, Clone, Default, PartialEq, Eq)]
pub struct ConnectFiles {
    /// Holds the token; else `MAZEWAY_TOKEN_FILE`, or the token itself in `MAZEWAY_TOKEN`.
    pub token: Option<PathBuf>,
    /// Holds the authorities; else `MAZEWAY_TLS_CA`.
    pub ca: Option<PathBuf>,
    /// Holds the client's certificate; else `MAZEWAY_TLS_CERT`.
    pub cert: Option<PathBuf>,
    /// Holds its key; else `MAZEWAY_TLS_KEY`.
    pub key: Option<PathBuf>,
}

impl ConnectFiles {
    /// Reads them, to connect to `address`.
    ///
    /// # Errors
    /// A file that cannot be read; a certificate without its key.
    pub fn read(&self, address: &str) -> Result<ConnectOptions, ClientError> {
        let set = |variable: &str| env::var_os(variable).filter(|value| !value.is_empty()).map(PathBuf::from);
        let named = |given: &Option<PathBuf>, variable: &str| {
            given.clone().or_else(|| if address.starts_with("https://") { set(variable) } else { None })
        };
        let token = match (&self.token, env::var("MAZEWAY_TOKEN").ok().filter(|token| !token.is_empty())) {
            (None, Some(token)) => Some(Token::new(&token)?),
            (path, _) => {
                let path = path.clone().or_else(|| set("MAZEWAY_TOKEN_FILE"));
                path.map(|path| Token::read(&path)).transpose()?
            }
        };
        let ca = named(&self.ca, "MAZEWAY_TLS_CA").map(|path| read(&path, "tls_ca")).transpose()?;
        let certificate = match (named(&self.cert, "MAZEWAY_TLS_CERT"), named(&self.key, "MAZEWAY_TLS_KEY")) {
            (None, None) => None,
            (Some(cert), Some(key)) => {
                Some(ClientCertificate { chain: read(&cert, "tls_cert")?, key: read(&key, "tls_key")? })
            }
            (cert, _) => {
                let (field, message) = match cert {
                    Some(_) => ("tls_key", "expected the key of the client's certificate, got none"),
                    None => ("tls_cert", "expected the certificate of the client's key, got none"),
                };
                return Err(ClientError::Argument { field, message: message.into() });
            }
        };
        Ok(ConnectOptions { token, ca, certificate, ..ConnectOptions::default() })
    }
}

fn read(path: &Path, field: &'static str) -> Result<Vec<u8>, ClientError> {
    fs::read(path).map_err(|error| ClientError::Argument { field, message: format!("{}: {error}", path.display()) })
}

/// Connects to a server at `address`, such as `127.0.0.1:50051`, `http://[::1]:50051`, `https://robots.example:50051` or
/// `unix:/run/mazeway.sock`.
///
/// # Errors
/// An address that is none; nobody answers.
pub async fn channel(address: &str) -> Result<Channel, ClientError> {
    let options = ConnectOptions::default();
    open(address, &options).await
}

async fn open(address: &str, options: &ConnectOptions) -> Result<Channel, ClientError> {
    endpoint(address, options)?
        .connect()
        .await
        .map_err(|error| ClientError::Connect { address: address.into(), message: causes(&error) })
}

fn endpoint(address: &str, options: &ConnectOptions) -> Result<Endpoint, ClientError> {
    let wrong = |message: String| ClientError::Address { address: address.into(), message };
    let whole = address.contains("://") || address.starts_with("unix:");
    let uri = if whole { address.to_owned() } else { format!("http://{address}") };
    let encrypted = uri.starts_with("https://");
    let local = uri.starts_with("unix:");
    let mut endpoint = Endpoint::from_shared(uri).map_err(|error| wrong(error.to_string()))?;
    if encrypted {
        endpoint = endpoint.tls_config(tls(options)?).map_err(|error| ClientError::Argument {
            field: "tls",
            message: format!("expected certificates and a key in PEM: {}", causes(&error)),
        })?;
    } else {
        let unused = [("tls_ca", options.ca.is_some()), ("tls_cert", options.certificate.is_some())];
        if let Some((field, _)) = unused.into_iter().find(|(_, given)| *given) {
            let message = format!("expected an address that begins with https://, got {address:?}");
            return Err(ClientError::Argument { field, message });
        }
        if options.token.is_some() && !options.insecure && !local && !is_loopback(endpoint.uri()) {
            let message =
                format!("expected an address that begins with https://, for {address:?} would send it unencrypted");
            return Err(ClientError::Argument { field: "token", message });
        }
    }
    Ok(endpoint
        .connect_timeout(options.connect_timeout)
        .tcp_nodelay(true)
        .http2_keep_alive_interval(PING_INTERVAL)
        .keep_alive_timeout(PING_TIMEOUT)
        .keep_alive_while_idle(true)
        .initial_stream_window_size(STREAM_WINDOW_BYTES)
        .initial_connection_window_size(CONNECTION_WINDOW_BYTES)
        .max_frame_size(FRAME_BYTES))
}

fn tls(options: &ConnectOptions) -> Result<ClientTlsConfig, ClientError> {
    let mut config = match &options.ca {
        Some(ca) if !holds(ca, "CERTIFICATE") => {
            let message = "expected certificates in PEM, got none".into();
            return Err(ClientError::Argument { field: "tls_ca", message });
        }
        Some(ca) => ClientTlsConfig::new().ca_certificate(Certificate::from_pem(ca)),
        None => ClientTlsConfig::new().with_native_roots(),
    };
    if let Some(ClientCertificate { chain, key }) = &options.certificate {
        config = config.identity(Identity::from_pem(chain, key));
    }
    if let Some(name) = &options.server_name {
        config = config.domain_name(name);
    }
    Ok(config)
}

fn holds(pem: &[u8], what: &str) -> bool {
    String::from_utf8_lossy(pem).contains(&format!("-----BEGIN {what}-----"))
}

/// True where what is sent does not leave the machine.
fn is_loopback(uri: &http::Uri) -> bool {
    let host = uri.host().unwrap_or_default().trim_start_matches('[').trim_end_matches(']');
    host == "localhost" || host.parse::<std::net::IpAddr>().is_ok_and(|address| address.is_loopback())
}

/// A connection with what goes along with every call. Cloning shares it.
#[derive(Debug, Clone)]
pub struct Wire {
    channel: Channel,
    token: Option<Token>,
    pub(crate) deadline: Duration,
    pub(crate) work_deadline: Duration,
    pub(crate) spin: Duration,
}

impl Wire {
    /// Connects.
    ///
    /// # Errors
    /// An address that is none, options that do not go with it; nobody answers.
    pub async fn open(address: &str, options: &ConnectOptions) -> Result<Self, ClientError> {
        Ok(Self::over(open(address, options).await?, options))
    }

    fn over(channel: Channel, options: &ConnectOptions) -> Self {
        let ConnectOptions { token, deadline, work_deadline, spin, .. } = options.clone();
        Self { channel, token, deadline, work_deadline, spin }
    }

    /// Waits for the answer to a call.
    pub(crate) async fn within<T>(
        &self,
        call: impl Future<Output = Result<tonic::Response<T>, Status>>,
    ) -> Result<T, ClientError> {
        within(self.deadline, call).await.map(tonic::Response::into_inner)
    }
}

/// Waits that long.
pub(crate) async fn within<T>(
    deadline: Duration,
    call: impl Future<Output = Result<T, Status>>,
) -> Result<T, ClientError> {
    match timeout(deadline, call).await {
        Ok(outcome) => Ok(outcome?),
        Err(_) => Err(ClientError::Late { secs: deadline.as_secs_f64() }),
    }
}

impl From<Channel> for Wire {
    /// Without a token, with the default deadlines.
    fn from(channel: Channel) -> Self {
        Self::over(channel, &ConnectOptions::default())
    }
}

impl Service<http::Request<Body>> for Wire {
    type Response = http::Response<Body>;
    type Error = <Channel as Service<http::Request<Body>>>::Error;
    type Future = <Channel as Service<http::Request<Body>>>::Future;

    fn poll_ready(&mut self, cx: &mut Context<'_>) -> Poll<Result<(), Self::Error>> {
        Service::poll_ready(&mut self.channel, cx)
    }

    fn call(&mut self, mut request: http::Request<Body>) -> Self::Future {
        if let Some(Token(header)) = &self.token {
            request.headers_mut().insert(AUTHORIZATION, header.clone());
        }
        self.channel.call(request)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_token_shows_itself_to_nobody() {
        let token = Token::new(" s3cret\n").expect("a token");
        let options = ConnectOptions { token: Some(token.clone()), ..ConnectOptions::default() };
        assert!(!format!("{token:?} {options:?} {:?}", token.0).contains("s3cret"));
        assert_eq!(token.0.as_bytes(), b"Bearer s3cret");
        for wrong in ["", " ", "two words", "schlüssel", "a\r\nb"] {
            let error = Token::new(wrong).expect_err("no token");
            assert_eq!(error.field(), Some("token"));
            assert!(wrong.trim().is_empty() || !error.to_string().contains(wrong));
        }
    }

    #[test]
    fn a_token_leaves_the_machine_encrypted_or_by_request() {
        let with_token =
            ConnectOptions { token: Some(Token::new("s3cret").expect("a token")), ..ConnectOptions::default() };
        for address in ["127.0.0.1:1", "localhost:1", "http://[::1]:1", "unix:/run/x.sock", "https://example.org:1"] {
            assert!(endpoint(address, &with_token).is_ok(), "{address}");
        }
        for address in ["10.0.0.1:1", "http://example.org:1", "localhost.example.org:1"] {
            let error = endpoint(address, &with_token).expect_err("refused");
            assert_eq!(error.field(), Some("token"), "{address}: {error}");
            assert!(!error.to_string().contains("s3cret"));
            assert!(endpoint(address, &ConnectOptions { insecure: true, ..with_token.clone() }).is_ok());
        }
    }

    #[test]
    fn certificates_go_with_https_and_are_pem() {
        let ca = ConnectOptions { ca: Some(b"nonsense".to_vec()), ..ConnectOptions::default() };
        assert_eq!(endpoint("https://localhost:1", &ca).expect_err("no PEM").field(), Some("tls_ca"));
        assert_eq!(endpoint("localhost:1", &ca).expect_err("no https").field(), Some("tls_ca"));
        let certificate = ClientCertificate { chain: b"nonsense".to_vec(), key: b"nonsense".to_vec() };
        let certificate = ConnectOptions { certificate: Some(certificate), ..ConnectOptions::default() };
        assert_eq!(endpoint("https://localhost:1", &certificate).expect_err("no PEM").field(), Some("tls"));
        assert_eq!(endpoint("localhost:1", &certificate).expect_err("no https").field(), Some("tls_cert"));
    }
}
