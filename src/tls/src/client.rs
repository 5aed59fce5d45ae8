//! The client's side: whom it trusts. A certificate is accepted whose fingerprint is known, or which an authority has signed that
//! the client trusts; that one has is remembered. One that signs itself, of a server of which nothing is known, is
//! remembered (trust on first use, as ssh(1) does).

use std::io;
use std::path::{Path, PathBuf};
use std::sync::{Arc, Mutex, PoisonError};

use tokio::io::{AsyncRead, AsyncWrite};
use tokio_rustls::TlsConnector;
use tokio_rustls::client::TlsStream;
use tokio_rustls::rustls::client::WebPkiServerVerifier;
use tokio_rustls::rustls::client::danger::{
    HandshakeSignatureValid, ServerCertVerified, ServerCertVerifier,
};
use tokio_rustls::rustls::crypto::{
    CryptoProvider, ring, verify_tls12_signature, verify_tls13_signature,
};
use tokio_rustls::rustls::pki_types::pem::PemObject;
use tokio_rustls::rustls::pki_types::{CertificateDer, PrivateKeyDer, ServerName, UnixTime};
use tokio_rustls::rustls::{
    CertificateError, ClientConfig, DigitallySignedStruct, Error, RootCertStore, SignatureScheme,
};

use crate::{Fingerprint, Known, KnownServers};

/// Whom a client trusts.
#[derive(Debug, Clone)]
pub struct Trust {
    /// PEM file with certificates of authorities; the system's where absent.
    pub authorities: Option<PathBuf>,
    /// The certificate that was named to the client.
    pub fingerprint: Option<Fingerprint>,
    /// Those that it has seen; of no account where `authorities` are named.
    pub known: Option<KnownServers>,
    /// The command that accepts another certificate, up to its fingerprint.
    pub accept: String,
    /// Where nobody is trusted yet: what to do.
    pub advice: &'static str,
    /// What the client shows of itself to a server that asks for it.
    pub identity: Option<Arc<Identity>>,
}

/// A certificate of the client, followed by those that lead from it to an authority, and its key.
pub struct Identity {
    /// The certificates.
    pub chain: Vec<CertificateDer<'static>>,
    /// The key of the first one.
    pub key: PrivateKeyDer<'static>,
}

impl std::fmt::Debug for Identity {
    fn fmt(&self, out: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        let shown = self.chain.first().map(Fingerprint::of);
        out.debug_tuple("Identity").field(&shown).finish()
    }
}

/// A connection whose other end is trusted.
pub struct Connected<S> {
    /// The connection.
    pub stream: TlsStream<S>,
    /// The certificate, where it was seen for the first time and is remembered from now on.
    pub first: Option<Fingerprint>,
}

impl Trust {
    /// Speaks TLS over a connection to `host`; `server` is its host and port, by which it is known.
    pub async fn connect<S: AsyncRead + AsyncWrite + Unpin>(
        &self,
        stream: S,
        host: &str,
        server: &str,
    ) -> io::Result<Connected<S>> {
        let name = ServerName::try_from(host.to_owned()).map_err(io::Error::other)?;
        let provider = Arc::new(ring::default_provider());
        // Who names a certificate or authorities has said whom to trust.
        let known = self.known.as_ref().filter(|_| self.fingerprint.is_none());
        let seen = known.map(|known| known.find(server)).transpose()?.flatten();
        let expected = match self.fingerprint {
            Some(named) => Some(Known::Certificate(named)),
            None if self.authorities.is_none() => seen,
            None => None,
        };
        let authorities = self.authorities.as_deref().map(read).transpose()?;
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
            Some(own) => builder
                .with_client_auth_cert(own.chain.clone(), own.key.clone_key())
                .map_err(io::Error::other)?,
        };
        let connected = TlsConnector::from(Arc::new(config))
            .connect(name, stream)
            .await;
        let outcome = verifier.outcome();
        let stream = connected.map_err(|error| match outcome.refused {
            Some(words) => io::Error::other(words),
            None => error,
        })?;
        if let (Some(first), Some(known)) = (outcome.first, known) {
            let kept = known.remember_first(server, Known::Certificate(first))?;
            if kept != Known::Certificate(first) {
                return Err(io::Error::other(changed(first, kept, &self.accept)));
            }
        }
        let is_new = outcome.by_authority && seen != Some(Known::ByAuthority);
        if let Some(known) = known.filter(|_| is_new) {
            // A home that cannot be written is no reason to refuse a server that an authority speaks for.
            let _ = known.remember(server, Known::ByAuthority);
        }
        Ok(Connected {
            stream,
            first: outcome.first,
        })
    }
}

fn changed(shown: Fingerprint, expected: Known, accept: &str) -> String {
    let known = match expected {
        Known::Certificate(expected) => format!("{expected} is the one that is known of it"),
        Known::ByAuthority => {
            "an authority spoke for the one that it had, and none does for this".to_owned()
        }
    };
    format!(
        "the server shows the certificate {shown}, and {known}: somebody may stand between; if its operator has replaced \
         it, accept it with: {accept} {shown}"
    )
}

/// The authorities of a PEM file.
fn read(path: &Path) -> io::Result<RootCertStore> {
    let unreadable = |error: &dyn std::fmt::Display| {
        io::Error::other(format!(
            "ca_file {} holds no certificate: {error}; it should be a PEM file",
            path.display()
        ))
    };
    let mut trusted = RootCertStore::empty();
    let certificates = CertificateDer::pem_file_iter(path).map_err(|error| unreadable(&error))?;
    for certificate in certificates {
        let certificate = certificate.map_err(|error| unreadable(&error))?;
        trusted
            .add(certificate)
            .map_err(|error| unreadable(&error))?;
    }
    if trusted.is_empty() {
        return Err(unreadable(&"it has no BEGIN CERTIFICATE"));
    }
    Ok(trusted)
}

/// Those of the system. One of many that is not understood is no reason to trust none.
fn of_system() -> RootCertStore {
    let mut trusted = RootCertStore::empty();
    trusted.add_parsable_certificates(rustls_native_certs::load_native_certs().certs);
    trusted
}

#[derive(Debug)]
struct Verifier {
    provider: Arc<CryptoProvider>,
    /// What is known of the server.
    expected: Option<Known>,
    /// Whether one that signs itself is accepted where nothing is known.
    first_use: bool,
    /// The system's where absent.
    authorities: Option<RootCertStore>,
    accept: String,
    advice: &'static str,
    outcome: Mutex<Outcome>,
}

#[derive(Debug, Clone, Default)]
struct Outcome {
    first: Option<Fingerprint>,
    by_authority: bool,
    refused: Option<String>,
}

impl Verifier {
    fn outcome(&self) -> Outcome {
        self.outcome
            .lock()
            .unwrap_or_else(PoisonError::into_inner)
            .clone()
    }

    fn note(&self, outcome: Outcome) {
        *self.outcome.lock().unwrap_or_else(PoisonError::into_inner) = outcome;
    }

    fn by_authorities(
        &self,
        certificate: &CertificateDer<'_>,
        intermediates: &[CertificateDer<'_>],
        name: &ServerName<'_>,
        ocsp: &[u8],
        now: UnixTime,
    ) -> Result<(), Refused> {
        let roots = self.authorities.clone().unwrap_or_else(of_system);
        if roots.is_empty() {
            return Err(Refused::NobodyTrusted);
        }
        let builder = WebPkiServerVerifier::builder_with_provider(
            Arc::new(roots),
            Arc::clone(&self.provider),
        );
        let verifier = builder
            .build()
            .map_err(|error| Refused::By(Error::General(error.to_string())))?;
        verifier
            .verify_server_cert(certificate, intermediates, name, ocsp, now)
            .map(|_| ())
            .map_err(Refused::By)
    }
}

/// Why no authority speaks for a certificate.
enum Refused {
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
        let shown = Fingerprint::of(certificate);
        if self.expected == Some(Known::Certificate(shown)) {
            return Ok(ServerCertVerified::assertion());
        }
        let refused = match self.by_authorities(certificate, intermediates, name, ocsp, now) {
            Ok(()) => {
                self.note(Outcome {
                    by_authority: true,
                    ..Outcome::default()
                });
                return Ok(ServerCertVerified::assertion());
            }
            Err(refused) => refused,
        };
        // Of one that was signed and has expired, say, its authority's reason says more.
        let about_itself = self.expected != Some(Known::ByAuthority) || signs_itself(certificate);
        if let Some(expected) = self.expected.filter(|_| about_itself) {
            self.note(Outcome {
                refused: Some(changed(shown, expected, &self.accept)),
                ..Outcome::default()
            });
            return Err(CertificateError::ApplicationVerificationFailure.into());
        }
        if self.first_use && signs_itself(certificate) {
            self.note(Outcome {
                first: Some(shown),
                ..Outcome::default()
            });
            return Ok(ServerCertVerified::assertion());
        }
        let (words, error) = match refused {
            Refused::NobodyTrusted => (
                Some(self.advice.to_owned()),
                CertificateError::UnknownIssuer.into(),
            ),
            Refused::By(error) => (None, error),
        };
        self.note(Outcome {
            refused: words,
            ..Outcome::default()
        });
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
        self.provider
            .signature_verification_algorithms
            .supported_schemes()
    }
}

/// Whether nobody but itself speaks for a certificate. That the server has its key, the handshake's signature shows.
pub fn signs_itself(certificate: &CertificateDer<'_>) -> bool {
    match webpki::EndEntityCert::try_from(certificate) {
        Ok(read) => read.issuer() == read.subject(),
        Err(_) => false,
    }
}

/// Whether a certificate is valid for the host of `HOST` or `HOST:PORT` (RFC 9525, section 6), by whomever it is signed.
pub fn speaks_for(certificate: &CertificateDer<'_>, authority: &str) -> bool {
    let host = match authority.rsplit_once(':') {
        Some((host, port)) if port.bytes().all(|digit| digit.is_ascii_digit()) => host,
        _ => authority,
    };
    let host = host.trim_matches(['[', ']']);
    let (Ok(read), Ok(name)) = (
        webpki::EndEntityCert::try_from(certificate),
        ServerName::try_from(host),
    ) else {
        return false;
    };
    read.verify_is_valid_for_subject_name(&name).is_ok()
}
