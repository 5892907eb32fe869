//! TLS 1.2 and 1.3 at the door, and certificates of clients where they are asked for.

use crate::{caller::Caller, grant::Grant, tokens::check_name};
use rustls::{
    RootCertStore, ServerConfig,
    crypto::ring,
    pki_types::{CertificateDer, PrivateKeyDer, pem::PemObject as _},
    server::WebPkiClientVerifier,
};
use sha2::{Digest as _, Sha256};
use std::{
    fmt::Write as _,
    path::{Path, PathBuf},
    sync::Arc,
};
use tokio_rustls::TlsAcceptor;

/// Files, in PEM, of a service that speaks TLS.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct TlsFiles {
    /// Its certificate, then those between it and a root.
    pub cert: PathBuf,
    /// The key of the certificate.
    pub key: PathBuf,
    /// Certificates of those who sign clients; with it, clients must show one.
    pub client_ca: Option<PathBuf>,
}

/// A file that does not serve.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
#[error("{path}: {message}")]
pub struct TlsError {
    /// Which.
    pub path: PathBuf,
    /// What is wrong with it.
    pub message: String,
}

impl TlsFiles {
    /// What takes connections over TLS, with HTTP/2 inside.
    ///
    /// # Errors
    /// A file does not read or does not fit the others.
    pub fn acceptor(&self) -> Result<TlsAcceptor, TlsError> {
        let fails = |path: &Path, message: String| TlsError { path: path.to_owned(), message };
        let provider = Arc::new(ring::default_provider());
        let chain = certificates(&self.cert)?;
        let key = PrivateKeyDer::from_pem_file(&self.key)
            .map_err(|error| fails(&self.key, format!("expected a private key in PEM: {error}")))?;
        let builder = ServerConfig::builder_with_provider(Arc::clone(&provider))
            .with_safe_default_protocol_versions()
            .map_err(|error| fails(&self.cert, error.to_string()))?;
        let builder = match &self.client_ca {
            None => builder.with_no_client_auth(),
            Some(path) => {
                let mut roots = RootCertStore::empty();
                for certificate in certificates(path)? {
                    roots.add(certificate).map_err(|error| fails(path, error.to_string()))?;
                }
                let verifier = WebPkiClientVerifier::builder_with_provider(Arc::new(roots), provider);
                builder.with_client_cert_verifier(verifier.build().map_err(|error| fails(path, error.to_string()))?)
            }
        };
        let mut config = builder
            .with_single_cert(chain, key)
            .map_err(|error| fails(&self.key, format!("certificate and key do not fit: {error}")))?;
        config.alpn_protocols = vec![b"h2".to_vec()];
        Ok(TlsAcceptor::from(Arc::new(config)))
    }
}

fn certificates(path: &Path) -> Result<Vec<CertificateDer<'static>>, TlsError> {
    let fails = |message: String| TlsError { path: path.to_owned(), message };
    let found = CertificateDer::pem_file_iter(path)
        .and_then(Iterator::collect::<Result<Vec<_>, _>>)
        .map_err(|error| fails(format!("expected certificates in PEM: {error}")))?;
    if found.is_empty() {
        return Err(fails("expected certificates in PEM, found none".into()));
    }
    Ok(found)
}

/// Who shows a certificate that was found good: the common name of its subject, or, where that is no plain name, `sha256-`
/// and the beginning of the certificate's hash. Whoever signs certificates says what names mean.
pub fn certified(certificate: &CertificateDer<'_>) -> Caller {
    let parsed = x509_parser::parse_x509_certificate(certificate);
    let name = parsed.ok().and_then(|(_, certificate)| {
        let name = certificate.subject().iter_common_name().next()?.as_str().ok()?.to_owned();
        check_name(&name).is_ok().then_some(name)
    });
    let name = name.unwrap_or_else(|| {
        Sha256::digest(certificate).iter().take(16).fold("sha256-".to_owned(), |mut name, byte| {
            let _ = write!(name, "{byte:02x}");
            name
        })
    });
    Arc::new(Grant::unlimited(name)).into()
}

#[cfg(test)]
mod tests {
    use super::*;
    use rcgen::{CertificateParams, DnType, KeyPair};
    use std::fs;

    fn named(name: &str) -> (CertificateDer<'static>, String, String) {
        let mut params = CertificateParams::new(vec!["localhost".to_owned()]).expect("a name");
        params.distinguished_name.push(DnType::CommonName, name);
        let key = KeyPair::generate().expect("a key");
        let certificate = params.self_signed(&key).expect("a certificate");
        (certificate.der().clone(), certificate.pem(), key.serialize_pem())
    }

    #[test]
    fn a_certificate_names_its_holder() {
        assert_eq!(certified(&named("alice@example.org").0).name(), "alice@example.org");
        let odd = named("line\nfeed").0;
        let caller = certified(&odd);
        assert!(caller.name().starts_with("sha256-") && caller.name().len() == 39, "{}", caller.name());
        assert_eq!(certified(&odd), caller);
    }

    #[test]
    fn files_that_do_not_serve_are_named() {
        let directory = tempfile::tempdir().expect("a directory");
        let file = |name: &str, text: &str| {
            let path = directory.path().join(name);
            fs::write(&path, text).expect("writes");
            path
        };
        let ((_, cert, key), (_, other, other_key)) = (named("a"), named("b"));
        let (cert, key) = (file("cert.pem", &cert), file("key.pem", &key));
        let (empty, other_key) = (file("empty.pem", ""), file("other-key.pem", &other_key));
        let (other, missing) = (file("other.pem", &other), directory.path().join("missing.pem"));
        let files = |cert: &PathBuf, key: &PathBuf, ca: Option<&PathBuf>| TlsFiles {
            cert: cert.clone(),
            key: key.clone(),
            client_ca: ca.cloned(),
        };
        files(&cert, &key, Some(&other)).acceptor().expect("they fit");
        for (wrong, named) in [
            (files(&missing, &key, None), &missing),
            (files(&empty, &key, None), &empty),
            (files(&key, &key, None), &key),
            (files(&cert, &missing, None), &missing),
            (files(&cert, &cert, None), &cert),
            (files(&cert, &other_key, None), &other_key),
            (files(&cert, &key, Some(&empty)), &empty),
        ] {
            assert_eq!(&wrong.acceptor().err().expect("refused").path, named);
        }
    }
}
