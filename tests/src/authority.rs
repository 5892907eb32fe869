//! Certificates and tokens for the tests, made anew each time.

use mazeway_serving::{
    DoorConfig,
    grant::{Quotas, Scope},
    keyring, tokens,
};
use rcgen::{BasicConstraints, CertificateParams, DnType, IsCa, Issuer, KeyPair};
use std::{fs, path::PathBuf};
use tempfile::TempDir;
use tonic::{
    Status,
    metadata::MetadataValue,
    service::{Interceptor, interceptor::InterceptedService},
    transport::{Certificate, Channel, ClientTlsConfig, Endpoint, Identity},
};

/// Signs certificates, and keeps the files of a service in a directory of its own.
#[derive(Debug)]
pub struct Authority {
    issuer: Issuer<'static, KeyPair>,
    root: String,
    directory: TempDir,
}

impl Default for Authority {
    fn default() -> Self {
        Self::new()
    }
}

impl Authority {
    /// A new one, which nobody trusts yet.
    ///
    /// # Panics
    /// No certificate or directory can be made.
    pub fn new() -> Self {
        let mut params = CertificateParams::new(Vec::new()).expect("no names");
        params.is_ca = IsCa::Ca(BasicConstraints::Unconstrained);
        params.distinguished_name.push(DnType::CommonName, "Mazeway's test authority");
        let key = KeyPair::generate().expect("a key");
        let root = params.self_signed(&key).expect("a certificate").pem();
        Self { issuer: Issuer::new(params, key), root, directory: tempfile::tempdir().expect("a directory") }
    }

    /// Certificate and key, in PEM, of somebody of that name on this machine.
    ///
    /// # Panics
    /// They cannot be made.
    pub fn sign(&self, name: &str) -> (String, String) {
        let names = vec!["localhost".to_owned(), "127.0.0.1".to_owned()];
        let mut params = CertificateParams::new(names).expect("plain names");
        params.distinguished_name.push(DnType::CommonName, name);
        let key = KeyPair::generate().expect("a key");
        (params.signed_by(&key, &self.issuer).expect("a certificate").pem(), key.serialize_pem())
    }

    /// A file of its directory.
    ///
    /// # Panics
    /// It cannot be written.
    pub fn file(&self, name: &str, text: &str) -> PathBuf {
        let path = self.path(name);
        fs::write(&path, text).expect("writes");
        path
    }

    /// The path of a file of its directory.
    pub fn path(&self, name: &str) -> PathBuf {
        self.directory.path().join(name)
    }

    /// Settings of a service that speaks TLS.
    pub fn tls(&self) -> DoorConfig {
        let (cert, key) = self.sign("a service");
        DoorConfig {
            tls_cert: Some(self.file("cert.pem", &cert)),
            tls_key: Some(self.file("key.pem", &key)),
            ..DoorConfig::default()
        }
    }

    /// Settings of a service that asks for tokens.
    pub fn tokens(&self) -> DoorConfig {
        DoorConfig { tokens: Some(self.path("tokens.toml")), ..DoorConfig::default() }
    }

    /// The file with its root.
    pub fn root_file(&self) -> PathBuf {
        self.file("root.pem", &self.root)
    }

    /// What a client needs that trusts it.
    pub fn trusting(&self) -> ClientTlsConfig {
        ClientTlsConfig::new().ca_certificate(Certificate::from_pem(&self.root)).domain_name("localhost")
    }

    /// What a client of that name needs that trusts it.
    pub fn known_as(&self, name: &str) -> ClientTlsConfig {
        let (cert, key) = self.sign(name);
        self.trusting().identity(Identity::from_pem(cert, key))
    }

    /// A new token in the file of tokens; gives its secret.
    ///
    /// # Panics
    /// It cannot be written.
    pub fn token(&self, name: &str, scopes: &[Scope], quotas: &Quotas) -> String {
        let minted = tokens::mint(name, scopes, quotas, None).expect("a token");
        keyring::append(&self.path("tokens.toml"), &minted.entry).expect("a file of tokens");
        minted.secret
    }
}

/// A channel over TLS.
///
/// # Errors
/// The handshake fails, or nobody answers.
pub async fn secure_channel(address: &str, tls: ClientTlsConfig) -> Result<Channel, tonic::transport::Error> {
    Endpoint::from_shared(format!("https://{address}"))?.tls_config(tls)?.connect().await
}

/// Shows a token with every call.
#[derive(Debug, Clone)]
pub struct Bearer(MetadataValue<tonic::metadata::Ascii>);

impl Interceptor for Bearer {
    fn call(&mut self, mut request: tonic::Request<()>) -> Result<tonic::Request<()>, Status> {
        request.metadata_mut().insert("authorization", self.0.clone());
        Ok(request)
    }
}

/// A channel that shows a token with every call.
///
/// # Panics
/// No token can look like that.
pub fn bearing(channel: Channel, secret: &str) -> InterceptedService<Channel, Bearer> {
    InterceptedService::new(channel, Bearer(format!("Bearer {secret}").parse().expect("plain letters")))
}
