//! TLS of the TCP listener, by rustls (TLS 1.2 and 1.3; docs/adr/080).

use std::collections::HashMap;
use std::fmt;
use std::io;
use std::sync::Arc;
use std::time::Duration;

use ::tls::Fingerprint;
use api::Millis;
use axum::Router;
use axum::http::{HeaderMap, HeaderValue, Uri, header};
use axum::response::{IntoResponse, Response};
use parking_lot::RwLock;
use tokio::io::{AsyncReadExt, AsyncWriteExt};
use tokio::net::TcpStream;
use tokio_rustls::TlsAcceptor;
use tokio_rustls::rustls::crypto::ring;
use tokio_rustls::rustls::pki_types::{CertificateDer, CertificateRevocationListDer, PrivateKeyDer};
use tokio_rustls::rustls::server::{ClientHello, ResolvesServerCert, WebPkiClientVerifier};
use tokio_rustls::rustls::sign::CertifiedKey;
use tokio_rustls::rustls::{self, RootCertStore, ServerConfig};
use tokio_rustls::server::TlsStream;

use crate::errors::Error;

/// First byte of a TLS connection: a record with a handshake message (RFC 8446, section 5.1).
const HANDSHAKE: u8 = 22;
/// Time that a client gets to read why its certificate is refused, and the number of bytes that it may send
/// meanwhile.
const LINGER: Duration = Duration::from_secs(1);
const UNREAD: u64 = 64 << 10;
/// Protocol negotiated by ALPN (RFC 7301).
const HTTP_1_1: &[u8] = b"http/1.1";
/// ALPN protocol of an authority that validates a domain name (RFC 8737).
const ACME_TLS_1: &[u8] = b"acme-tls/1";

/// Error for an unusable certificate or key.
#[derive(Debug, thiserror::Error)]
#[error("the certificate and its key cannot be used: {0}")]
pub struct TlsError(#[from] rustls::Error);

/// TLS server of the portal. Its certificate can be replaced while it listens.
pub struct Tls {
    config: RwLock<Arc<ServerConfig>>,
    shown: Arc<CertificateResolver>,
    /// Authorities that sign robots' certificates.
    roots: Arc<RootCertStore>,
    trusts_others: bool,
}

/// Certificates to present, with their keys.
#[derive(Debug)]
struct CertificateResolver {
    current: RwLock<Arc<CertifiedKey>>,
    /// Certificates presented to authorities instead, by name in lower case.
    challenges: RwLock<HashMap<String, Arc<CertifiedKey>>>,
}

impl ResolvesServerCert for CertificateResolver {
    fn resolve(&self, hello: ClientHello<'_>) -> Option<Arc<CertifiedKey>> {
        if is_challenge(hello.alpn()) {
            let name = hello.server_name()?.to_ascii_lowercase();
            return self.challenges.read().get(&name).map(Arc::clone);
        }
        Some(Arc::clone(&self.current.read()))
    }
}

/// Returns true if the offered protocols are those of an authority's validation (RFC 8737, section 3: exactly one).
fn is_challenge<'a>(offered: Option<impl Iterator<Item = &'a [u8]>>) -> bool {
    offered.is_some_and(|mut offered| offered.next() == Some(ACME_TLS_1) && offered.next().is_none())
}

/// Certificate for an authority's validation of a domain name.
pub struct Challenge {
    /// The domain name.
    pub name: String,
    /// The certificate (RFC 8737, section 3).
    pub certificate: CertificateDer<'static>,
    /// Private key of the certificate.
    pub key: PrivateKeyDer<'static>,
}

impl fmt::Debug for Tls {
    fn fmt(&self, out: &mut fmt::Formatter<'_>) -> fmt::Result {
        out.debug_tuple("Tls").field(&self.fingerprint()).finish()
    }
}

/// Result of accepting a connection.
pub enum AcceptedConnection {
    /// A TLS connection.
    Tls(Box<TlsStream<TcpStream>>),
    /// A connection with another protocol, of which nothing has been read.
    Plain(TcpStream),
    /// A completed validation by an authority. Nothing else is sent (RFC 8737, section 3).
    Challenge,
}

fn load_certified_key(
    chain: Vec<CertificateDer<'static>>,
    key: PrivateKeyDer<'static>,
) -> Result<Arc<CertifiedKey>, TlsError> {
    let key = CertifiedKey::from_der(chain, key, &ring::default_provider())?;
    Ok(Arc::new(key))
}

/// Builds a configuration that requests client certificates signed by one of `roots` and not revoked by `lists`.
fn build_config(
    roots: &Arc<RootCertStore>,
    shown: &Arc<CertificateResolver>,
    lists: Vec<CertificateRevocationListDer<'static>>,
) -> Result<Arc<ServerConfig>, TlsError> {
    let provider = Arc::new(ring::default_provider());
    let clients = WebPkiClientVerifier::builder_with_provider(Arc::clone(roots), Arc::clone(&provider))
        .with_crls(lists)
        // The daemon's own authority has no list: its robots are unpaired instead.
        .allow_unknown_revocation_status()
        .allow_unauthenticated()
        .build()
        .map_err(|error| rustls::Error::General(error.to_string()))?;
    let builder = ServerConfig::builder_with_provider(provider).with_safe_default_protocol_versions()?;
    let mut config =
        builder.with_client_cert_verifier(clients).with_cert_resolver(Arc::clone(shown) as Arc<dyn ResolvesServerCert>);
    config.alpn_protocols = vec![HTTP_1_1.to_vec(), ACME_TLS_1.to_vec()];
    Ok(Arc::new(config))
}

impl Tls {
    /// Creates a server that presents this certificate chain. Clients are asked for a certificate; accepted are those
    /// signed by the daemon's authority for robots or by one of `others`. Clients without one are admitted.
    pub fn new(
        chain: Vec<CertificateDer<'static>>,
        key: PrivateKeyDer<'static>,
        robots: &CertificateDer<'static>,
        others: Vec<CertificateDer<'static>>,
    ) -> Result<Tls, TlsError> {
        let trusts_others = !others.is_empty();
        let mut roots = RootCertStore::empty();
        for root in others.into_iter().chain([robots.clone()]) {
            roots.add(root)?;
        }
        let roots = Arc::new(roots);
        let shown = Arc::new(CertificateResolver {
            current: RwLock::new(load_certified_key(chain, key)?),
            challenges: RwLock::default(),
        });
        Ok(Tls { config: RwLock::new(build_config(&roots, &shown, Vec::new())?), shown, roots, trusts_others })
    }

    /// Replaces the revocation lists: the certificates they name are refused from now on. TLS sessions cannot be
    /// resumed across this change. Expired lists remain in force, so that an authority that is late readmits nobody.
    pub fn set_revocation_lists(&self, lists: Vec<CertificateRevocationListDer<'static>>) -> Result<(), TlsError> {
        let config = build_config(&self.roots, &self.shown, lists)?;
        *self.config.write() = config;
        Ok(())
    }

    /// Replaces the certificate. Open connections are not affected.
    pub fn replace_certificate(
        &self,
        chain: Vec<CertificateDer<'static>>,
        key: PrivateKeyDer<'static>,
    ) -> Result<(), TlsError> {
        *self.shown.current.write() = load_certified_key(chain, key)?;
        Ok(())
    }

    /// Replaces the certificates for validations by authorities.
    pub fn set_challenges(&self, challenges: Vec<Challenge>) -> Result<(), TlsError> {
        let answers = challenges.into_iter().map(|challenge| {
            // Not checked, because its critical extension is understood only by authorities.
            let key = ring::default_provider().key_provider.load_private_key(challenge.key)?;
            let shown = CertifiedKey::new(vec![challenge.certificate], key);
            Ok((challenge.name.to_ascii_lowercase(), Arc::new(shown)))
        });
        let answers = answers.collect::<Result<HashMap<_, _>, TlsError>>()?;
        *self.shown.challenges.write() = answers;
        Ok(())
    }

    /// Returns the fingerprint of the current certificate.
    pub fn fingerprint(&self) -> Fingerprint {
        let shown = self.shown.current.read();
        // rustls accepts no key without a certificate.
        Fingerprint::from_certificate(shown.cert.first().unwrap_or(&CertificateDer::from(&[][..])))
    }

    /// Returns when the current certificate expires.
    pub(crate) fn expiry(&self) -> Option<Millis> {
        let shown = self.shown.current.read();
        let period = shown.cert.first().map(authority::read_validity)?;
        period.ok().map(|period| period.until)
    }

    /// Returns true if the current certificate is self-signed.
    pub(crate) fn is_self_signed(&self) -> bool {
        let shown = self.shown.current.read();
        shown.cert.first().is_some_and(::tls::is_self_signed)
    }

    /// Returns true if the current certificate is valid for a host, optionally followed by a port.
    pub fn is_valid_for_host(&self, authority: &str) -> bool {
        let shown = self.shown.current.read();
        shown.cert.first().is_some_and(|certificate| ::tls::is_valid_for_host(certificate, authority))
    }

    /// Returns true if authorities other than the daemon's may sign robots' certificates.
    pub(crate) fn has_other_authorities(&self) -> bool {
        self.trusts_others
    }

    /// Performs the TLS handshake on a TCP connection.
    pub(crate) async fn accept(&self, stream: TcpStream) -> io::Result<AcceptedConnection> {
        let mut first = [0];
        if stream.peek(&mut first).await? == 0 {
            return Err(io::ErrorKind::UnexpectedEof.into());
        }
        if first[0] != HANDSHAKE {
            return Ok(AcceptedConnection::Plain(stream));
        }
        let acceptor = TlsAcceptor::from(Arc::clone(&self.config.read()));
        match acceptor.accept(stream).into_fallible().await {
            Ok(mut stream) if stream.get_ref().1.alpn_protocol() == Some(ACME_TLS_1) => {
                let _ = tokio::time::timeout(LINGER, stream.shutdown()).await;
                Ok(AcceptedConnection::Challenge)
            }
            Ok(stream) => Ok(AcceptedConnection::Tls(Box::new(stream))),
            Err((error, stream)) => {
                if refused_certificate(&error).is_some() {
                    let _ = tokio::time::timeout(LINGER, linger(stream)).await;
                }
                Err(error)
            }
        }
    }
}

/// Lets a client read the alert: it has already sent its request, and closing the connection before that is read
/// would reset it (RFC 1122, section 4.2.2.13).
async fn linger(mut stream: TcpStream) {
    if stream.shutdown().await.is_ok() {
        let _ = tokio::io::copy(&mut stream.take(UNREAD), &mut tokio::io::sink()).await;
    }
}

/// Returns the certificates presented by the client.
pub(crate) fn peer_certificates(stream: &TlsStream<TcpStream>) -> Arc<[CertificateDer<'static>]> {
    let (_, connection) = stream.get_ref();
    let shown = connection.peer_certificates().unwrap_or_default();
    shown.iter().map(|one| one.clone().into_owned()).collect()
}

/// Returns why the client's certificate was refused, if that ended the handshake; an alert tells the client the same
/// (RFC 8446, section 6.2).
pub(crate) fn refused_certificate(error: &io::Error) -> Option<String> {
    match error.get_ref()?.downcast_ref()? {
        rustls::Error::InvalidCertificate(why) => Some(why.to_string()),
        _ => None,
    }
}

/// Builds a router that answers plain-text requests with the URL to use instead.
pub(crate) fn plain_text_router() -> Router {
    Router::new().fallback(refuse)
}

async fn refuse(uri: Uri, headers: HeaderMap) -> Response {
    let host = headers.get(header::HOST).and_then(|host| host.to_str().ok()).unwrap_or("HOST:PORT");
    let scheme = if crate::headers::is_upgrade(&headers) { "wss" } else { "https" };
    let instead = format!("{scheme}://{host}{}", uri.path());
    let mut response = Error::PlainText { instead }.into_response();
    let close = HeaderValue::from_static("close");
    response.headers_mut().insert(header::CONNECTION, close);
    response
}

#[cfg(test)]
mod tests;
