//! Client side of TLS: which servers are trusted. A certificate is accepted if its fingerprint is known, or if a
//! trusted authority has signed it, which is then remembered. A self-signed certificate of an unknown server is
//! remembered (trust on first use, as in ssh(1)).

use std::io;
use std::path::{Path, PathBuf};
use std::sync::{Arc, Mutex, PoisonError};

use tokio::io::{AsyncRead, AsyncWrite};
use tokio_rustls::TlsConnector;
use tokio_rustls::client::TlsStream;
use tokio_rustls::rustls::client::WebPkiServerVerifier;
use tokio_rustls::rustls::client::danger::{HandshakeSignatureValid, ServerCertVerified, ServerCertVerifier};
use tokio_rustls::rustls::crypto::{CryptoProvider, ring, verify_tls12_signature, verify_tls13_signature};
use tokio_rustls::rustls::pki_types::pem::PemObject;
use tokio_rustls::rustls::pki_types::{CertificateDer, PrivateKeyDer, ServerName, UnixTime};
use tokio_rustls::rustls::{
    CertificateError, ClientConfig, DigitallySignedStruct, Error, RootCertStore, SignatureScheme,
};

use crate::{Fingerprint, KnownIdentity, KnownServers};

/// Trust settings of a client.
#[derive(Debug, Clone)]
pub struct Trust {
    /// PEM file with the certificates of trusted authorities (default: the system's).
    pub authorities: Option<PathBuf>,
    /// Fingerprint of the server's certificate, given explicitly.
    pub fingerprint: Option<Fingerprint>,
    /// Certificates seen before; ignored if `authorities` is set.
    pub known: Option<KnownServers>,
    /// Command that accepts a changed certificate, without the fingerprint at its end.
    pub accept: String,
    /// Advice to the user if no authority is trusted.
    pub advice: &'static str,
    /// Certificate to present to servers that ask for one.
    pub identity: Option<Arc<ClientIdentity>>,
}

/// A client certificate, the chain from it to an authority, and its key.
pub struct ClientIdentity {
    /// Certificate chain, the client's own certificate first.
    pub chain: Vec<CertificateDer<'static>>,
    /// Private key of the first certificate.
    pub key: PrivateKeyDer<'static>,
}

impl std::fmt::Debug for ClientIdentity {
    fn fmt(&self, out: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        let shown = self.chain.first().map(Fingerprint::from_certificate);
        out.debug_tuple("Identity").field(&shown).finish()
    }
}

/// A TLS connection to a trusted server.
pub struct TrustedConnection<S> {
    /// The TLS stream.
    pub stream: TlsStream<S>,
    /// Fingerprint of the certificate if it was seen for the first time; it has been remembered.
    pub first: Option<Fingerprint>,
}

impl Trust {
    /// Performs the TLS handshake with `host`. `server` is its host and port, under which it is remembered.
    pub async fn connect<S: AsyncRead + AsyncWrite + Unpin>(
        &self,
        stream: S,
        host: &str,
        server: &str,
    ) -> io::Result<TrustedConnection<S>> {
        let name = ServerName::try_from(host.to_owned()).map_err(io::Error::other)?;
        let provider = Arc::new(ring::default_provider());
        // A given fingerprint or authority file overrides what was remembered.
        let known = self.known.as_ref().filter(|_| self.fingerprint.is_none());
        let seen = known.map(|known| known.find(server)).transpose()?.flatten();
        let expected = match self.fingerprint {
            Some(named) => Some(KnownIdentity::Certificate(named)),
            None if self.authorities.is_none() => seen,
            None => None,
        };
        let authorities = self.authorities.as_deref().map(read_authorities).transpose()?;
        let verifier = Arc::new(Verifier {
            provider: Arc::clone(&provider),
            expected,
            first_use: self.known.is_some() && self.authorities.is_none(),
            authorities,
            accept: self.accept.clone(),
            advice: self.advice,
            outcome: Mutex::default(),
        });
        let builder = ClientConfig::builder_with_provider(provider)
            .with_safe_default_protocol_versions()
            .map_err(io::Error::other)?
            .dangerous()
            .with_custom_certificate_verifier(Arc::clone(&verifier) as Arc<dyn ServerCertVerifier>);
        let config = match &self.identity {
            None => builder.with_no_client_auth(),
            Some(own) => {
                builder.with_client_auth_cert(own.chain.clone(), own.key.clone_key()).map_err(io::Error::other)?
            }
        };
        let connected = TlsConnector::from(Arc::new(config)).connect(name, stream).await;
        let outcome = verifier.outcome();
        let stream = connected.map_err(|error| match outcome.refused {
            Some(words) => io::Error::other(words),
            None => error,
        })?;
        if let (Some(first), Some(known)) = (outcome.first, known) {
            let kept = known.remember_first(server, KnownIdentity::Certificate(first))?;
            if kept != KnownIdentity::Certificate(first) {
                return Err(io::Error::other(describe_mismatch(first, kept, &self.accept)));
            }
        }
        let is_new = outcome.by_authority && seen != Some(KnownIdentity::ByAuthority);
        if let Some(known) = known.filter(|_| is_new) {
            // An unwritable home directory is no reason to refuse a server whose certificate an authority has signed.
            let _ = known.remember(server, KnownIdentity::ByAuthority);
        }
        Ok(TrustedConnection { stream, first: outcome.first })
    }
}

fn describe_mismatch(shown: Fingerprint, expected: KnownIdentity, accept: &str) -> String {
    let known = match expected {
        KnownIdentity::Certificate(expected) => {
            format!("the known one is {expected}")
        }
        KnownIdentity::ByAuthority => "the previous one was signed by an authority, and this one is not".to_owned(),
    };
    format!(
        "the server presents the certificate {shown}, but {known}: the connection may be intercepted; if its operator \
            has replaced the certificate, accept it with: {accept} {shown}"
    )
}

/// Reads the authorities of a PEM file.
fn read_authorities(path: &Path) -> io::Result<RootCertStore> {
    let unreadable = |error: &dyn std::fmt::Display| {
        io::Error::other(format!("ca_file {} holds no certificate: {error}; it should be a PEM file", path.display()))
    };
    let mut trusted = RootCertStore::empty();
    let certificates = CertificateDer::pem_file_iter(path).map_err(|error| unreadable(&error))?;
    for certificate in certificates {
        let certificate = certificate.map_err(|error| unreadable(&error))?;
        trusted.add(certificate).map_err(|error| unreadable(&error))?;
    }
    if trusted.is_empty() {
        return Err(unreadable(&"it has no BEGIN CERTIFICATE"));
    }
    Ok(trusted)
}

/// Loads the system's authorities, skipping those that cannot be parsed.
fn load_system_authorities() -> RootCertStore {
    let mut trusted = RootCertStore::empty();
    trusted.add_parsable_certificates(rustls_native_certs::load_native_certs().certs);
    trusted
}

#[derive(Debug)]
struct Verifier {
    provider: Arc<CryptoProvider>,
    /// Identity remembered for the server.
    expected: Option<KnownIdentity>,
    /// True if a self-signed certificate of an unknown server is accepted.
    first_use: bool,
    /// Trusted authorities (default: the system's).
    authorities: Option<RootCertStore>,
    accept: String,
    advice: &'static str,
    outcome: Mutex<VerifierOutcome>,
}

#[derive(Debug, Clone, Default)]
struct VerifierOutcome {
    first: Option<Fingerprint>,
    by_authority: bool,
    refused: Option<String>,
}

impl Verifier {
    fn outcome(&self) -> VerifierOutcome {
        self.outcome.lock().unwrap_or_else(PoisonError::into_inner).clone()
    }

    fn record(&self, outcome: VerifierOutcome) {
        *self.outcome.lock().unwrap_or_else(PoisonError::into_inner) = outcome;
    }

    fn verify_by_authorities(
        &self,
        certificate: &CertificateDer<'_>,
        intermediates: &[CertificateDer<'_>],
        name: &ServerName<'_>,
        ocsp: &[u8],
        now: UnixTime,
    ) -> Result<(), AuthorityRejection> {
        let roots = self.authorities.clone().unwrap_or_else(load_system_authorities);
        if roots.is_empty() {
            return Err(AuthorityRejection::NobodyTrusted);
        }
        let builder = WebPkiServerVerifier::builder_with_provider(Arc::new(roots), Arc::clone(&self.provider));
        let verifier = builder.build().map_err(|error| AuthorityRejection::By(Error::General(error.to_string())))?;
        verifier
            .verify_server_cert(certificate, intermediates, name, ocsp, now)
            .map(|_| ())
            .map_err(AuthorityRejection::By)
    }
}

/// Reason why no trusted authority vouches for a certificate.
enum AuthorityRejection {
    NobodyTrusted,
    By(Error),
}

impl ServerCertVerifier for Verifier {
    fn verify_server_cert(
        &self,
        certificate: &CertificateDer<'_>,
        intermediates: &[CertificateDer<'_>],
        name: &ServerName<'_>,
        ocsp: &[u8],
        now: UnixTime,
    ) -> Result<ServerCertVerified, Error> {
        let shown = Fingerprint::from_certificate(certificate);
        if self.expected == Some(KnownIdentity::Certificate(shown)) {
            return Ok(ServerCertVerified::assertion());
        }
        let refused = match self.verify_by_authorities(certificate, intermediates, name, ocsp, now) {
            Ok(()) => {
                self.record(VerifierOutcome { by_authority: true, ..VerifierOutcome::default() });
                return Ok(ServerCertVerified::assertion());
            }
            Err(refused) => refused,
        };
        // For example, the authority's reason tells more if a signed certificate has expired.
        let about_itself = self.expected != Some(KnownIdentity::ByAuthority) || is_self_signed(certificate);
        if let Some(expected) = self.expected.filter(|_| about_itself) {
            self.record(VerifierOutcome {
                refused: Some(describe_mismatch(shown, expected, &self.accept)),
                ..VerifierOutcome::default()
            });
            return Err(CertificateError::ApplicationVerificationFailure.into());
        }
        if self.first_use && is_self_signed(certificate) {
            self.record(VerifierOutcome { first: Some(shown), ..VerifierOutcome::default() });
            return Ok(ServerCertVerified::assertion());
        }
        let (words, error) = match refused {
            AuthorityRejection::NobodyTrusted => (Some(self.advice.to_owned()), CertificateError::UnknownIssuer.into()),
            AuthorityRejection::By(error) => (None, error),
        };
        self.record(VerifierOutcome { refused: words, ..VerifierOutcome::default() });
        Err(error)
    }

    fn verify_tls12_signature(
        &self,
        message: &[u8],
        certificate: &CertificateDer<'_>,
        signed: &DigitallySignedStruct,
    ) -> Result<HandshakeSignatureValid, Error> {
        let algorithms = &self.provider.signature_verification_algorithms;
        verify_tls12_signature(message, certificate, signed, algorithms)
    }

    fn verify_tls13_signature(
        &self,
        message: &[u8],
        certificate: &CertificateDer<'_>,
        signed: &DigitallySignedStruct,
    ) -> Result<HandshakeSignatureValid, Error> {
        let algorithms = &self.provider.signature_verification_algorithms;
        verify_tls13_signature(message, certificate, signed, algorithms)
    }

    fn supported_verify_schemes(&self) -> Vec<SignatureScheme> {
        self.provider.signature_verification_algorithms.supported_schemes()
    }
}

/// Returns true if the certificate is self-issued. The handshake's signature proves that the server holds its key.
pub fn is_self_signed(certificate: &CertificateDer<'_>) -> bool {
    match webpki::EndEntityCert::try_from(certificate) {
        Ok(read) => read.issuer() == read.subject(),
        Err(_) => false,
    }
}

/// Returns true if the certificate is valid for the host of `HOST` or `HOST:PORT` (RFC 9525, section 6), whoever
/// signed it.
pub fn is_valid_for_host(certificate: &CertificateDer<'_>, authority: &str) -> bool {
    let host = match authority.rsplit_once(':') {
        Some((host, port)) if port.bytes().all(|digit| digit.is_ascii_digit()) => host,
        _ => authority,
    };
    let host = host.trim_matches(['[', ']']);
    let (Ok(read), Ok(name)) = (webpki::EndEntityCert::try_from(certificate), ServerName::try_from(host)) else {
        return false;
    };
    read.verify_is_valid_for_subject_name(&name).is_ok()
}
