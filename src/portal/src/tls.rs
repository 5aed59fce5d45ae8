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
use tokio_rustls::rustls::pki_types::{
    CertificateDer, CertificateRevocationListDer, PrivateKeyDer,
};
use tokio_rustls::rustls::server::{ClientHello, ResolvesServerCert, WebPkiClientVerifier};
use tokio_rustls::rustls::sign::CertifiedKey;
use tokio_rustls::rustls::{self, RootCertStore, ServerConfig};
use tokio_rustls::server::TlsStream;

use crate::errors::Error;

/// The first byte of a TLS connection: a record with a handshake message (RFC 8446, section 5.1).
const HANDSHAKE: u8 = 22;
/// How long a client may take to read why its certificate is refused, and how many bytes it may send meanwhile.
const LINGER: Duration = Duration::from_secs(1);
const UNREAD: u64 = 64 << 10;
/// What is spoken through TLS (RFC 7301).
const HTTP_1_1: &[u8] = b"http/1.1";
/// What an authority says that looks whether a name leads here (RFC 8737).
const ACME_TLS_1: &[u8] = b"acme-tls/1";

/// Why a certificate and a key cannot be used.
#[derive(Debug, thiserror::Error)]
#[error("the certificate and its key cannot be used: {0}")]
pub struct TlsError(#[from] rustls::Error);

/// TLS as the portal speaks it. What it shows can be replaced while it listens.
pub struct Tls {
    config: RwLock<Arc<ServerConfig>>,
    shown: Arc<Shown>,
    /// Authorities that sign robots' certificates.
    roots: Arc<RootCertStore>,
    trusts_others: bool,
}

/// The certificate that is shown, and its key.
#[derive(Debug)]
struct Shown {
    current: RwLock<Arc<CertifiedKey>>,
    /// What authorities are shown instead, by name in lower case.
    challenges: RwLock<HashMap<String, Arc<CertifiedKey>>>,
}

impl ResolvesServerCert for Shown {
    fn resolve(&self, hello: ClientHello<'_>) -> Option<Arc<CertifiedKey>> {
        if is_challenge(hello.alpn()) {
            let name = hello.server_name()?.to_ascii_lowercase();
            return self.challenges.read().get(&name).map(Arc::clone);
        }
        Some(Arc::clone(&self.current.read()))
    }
}

/// Whether the protocols that are offered are those of an authority's look (RFC 8737, section 3: that one alone).
fn is_challenge<'a>(offered: Option<impl Iterator<Item = &'a [u8]>>) -> bool {
    offered
        .is_some_and(|mut offered| offered.next() == Some(ACME_TLS_1) && offered.next().is_none())
}

/// What an authority is shown that looks whether a name leads here.
pub struct Challenge {
    /// The name.
    pub name: String,
    /// The certificate (RFC 8737, section 3).
    pub certificate: CertificateDer<'static>,
    /// Its key.
    pub key: PrivateKeyDer<'static>,
}

impl fmt::Debug for Tls {
    fn fmt(&self, out: &mut fmt::Formatter<'_>) -> fmt::Result {
        out.debug_tuple("Tls").field(&self.fingerprint()).finish()
    }
}

/// What came of a connection to a port where TLS is spoken.
pub enum Accepted {
    /// TLS.
    Tls(Box<TlsStream<TcpStream>>),
    /// Something else: nothing has been read of it.
    Plain(TcpStream),
    /// An authority that has seen what it looked for. Nothing else is said to it (RFC 8737, section 3).
    Challenge,
}

fn checked(
    chain: Vec<CertificateDer<'static>>,
    key: PrivateKeyDer<'static>,
) -> Result<Arc<CertifiedKey>, TlsError> {
    let key = CertifiedKey::from_der(chain, key, &ring::default_provider())?;
    Ok(Arc::new(key))
}

/// Asks clients for certificates that one of `roots` has signed and no list names.
fn configure(
    roots: &Arc<RootCertStore>,
    shown: &Arc<Shown>,
    lists: Vec<CertificateRevocationListDer<'static>>,
) -> Result<Arc<ServerConfig>, TlsError> {
    let provider = Arc::new(ring::default_provider());
    let clients =
        WebPkiClientVerifier::builder_with_provider(Arc::clone(roots), Arc::clone(&provider))
            .with_crls(lists)
            // The daemon's own authority has no list: whom it has signed is unpaired.
            .allow_unknown_revocation_status()
            .allow_unauthenticated()
            .build()
            .map_err(|error| rustls::Error::General(error.to_string()))?;
    let builder =
        ServerConfig::builder_with_provider(provider).with_safe_default_protocol_versions()?;
    let mut config = builder
        .with_client_cert_verifier(clients)
        .with_cert_resolver(Arc::clone(shown) as Arc<dyn ResolvesServerCert>);
    config.alpn_protocols = vec![HTTP_1_1.to_vec(), ACME_TLS_1.to_vec()];
    Ok(Arc::new(config))
}

impl Tls {
    /// Shows a certificate, followed by those that lead from it to an authority. Asks clients for one, and takes those that the
    /// daemon's authority for robots has signed, or one of `others`; who has none is let in without.
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
        let shown = Arc::new(Shown {
            current: RwLock::new(checked(chain, key)?),
            challenges: RwLock::default(),
        });
        Ok(Tls {
            config: RwLock::new(configure(&roots, &shown, Vec::new())?),
            shown,
            roots,
            trusts_others,
        })
    }

    /// Refuses from now on certificates that these lists name, and no others any more. Nobody goes on with a session of TLS that was begun
    /// before. A list whose time is over counts on: an authority that is late lets nobody in again.
    pub fn revoke(
        &self,
        lists: Vec<CertificateRevocationListDer<'static>>,
    ) -> Result<(), TlsError> {
        let config = configure(&self.roots, &self.shown, lists)?;
        *self.config.write() = config;
        Ok(())
    }

    /// Shows another from now on. Connections that stand go on.
    pub fn show(
        &self,
        chain: Vec<CertificateDer<'static>>,
        key: PrivateKeyDer<'static>,
    ) -> Result<(), TlsError> {
        *self.shown.current.write() = checked(chain, key)?;
        Ok(())
    }

    /// Shows these to authorities that look for them, and no others any more.
    pub fn answer(&self, challenges: Vec<Challenge>) -> Result<(), TlsError> {
        let answers = challenges.into_iter().map(|challenge| {
            // Its extension, which only an authority understands, is critical: checked it would be refused.
            let key = ring::default_provider()
                .key_provider
                .load_private_key(challenge.key)?;
            let shown = CertifiedKey::new(vec![challenge.certificate], key);
            Ok((challenge.name.to_ascii_lowercase(), Arc::new(shown)))
        });
        let answers = answers.collect::<Result<HashMap<_, _>, TlsError>>()?;
        *self.shown.challenges.write() = answers;
        Ok(())
    }

    /// The fingerprint of what is shown.
    pub fn fingerprint(&self) -> Fingerprint {
        let shown = self.shown.current.read();
        // rustls takes no key without a certificate.
        Fingerprint::of(shown.cert.first().unwrap_or(&CertificateDer::from(&[][..])))
    }

    /// When what is shown ends.
    pub(crate) fn end(&self) -> Option<Millis> {
        let shown = self.shown.current.read();
        let period = shown.cert.first().map(authority::period)?;
        period.ok().map(|period| period.until)
    }

    /// Whether no authority has signed what is shown.
    pub(crate) fn signs_itself(&self) -> bool {
        let shown = self.shown.current.read();
        shown.cert.first().is_some_and(::tls::signs_itself)
    }

    /// Whether what is shown is valid for a host, which may have a port behind it.
    pub fn speaks_for(&self, authority: &str) -> bool {
        let shown = self.shown.current.read();
        shown
            .cert
            .first()
            .is_some_and(|certificate| ::tls::speaks_for(certificate, authority))
    }

    /// Whether another authority than the daemon's signs robots' certificates, too.
    pub(crate) fn trusts_others(&self) -> bool {
        self.trusts_others
    }

    /// Makes a TLS connection of a TCP one.
    pub(crate) async fn accept(&self, stream: TcpStream) -> io::Result<Accepted> {
        let mut first = [0];
        if stream.peek(&mut first).await? == 0 {
            return Err(io::ErrorKind::UnexpectedEof.into());
        }
        if first[0] != HANDSHAKE {
            return Ok(Accepted::Plain(stream));
        }
        let acceptor = TlsAcceptor::from(Arc::clone(&self.config.read()));
        match acceptor.accept(stream).into_fallible().await {
            Ok(mut stream) if stream.get_ref().1.alpn_protocol() == Some(ACME_TLS_1) => {
                let _ = tokio::time::timeout(LINGER, stream.shutdown()).await;
                Ok(Accepted::Challenge)
            }
            Ok(stream) => Ok(Accepted::Tls(Box::new(stream))),
            Err((error, stream)) => {
                if refused_certificate(&error).is_some() {
                    let _ = tokio::time::timeout(LINGER, linger(stream)).await;
                }
                Err(error)
            }
        }
    }
}

/// Lets a client read the alert that it was sent: it has gone on to its request, and closing the connection before that is read would
/// reset it (RFC 1122, section 4.2.2.13).
async fn linger(mut stream: TcpStream) {
    if stream.shutdown().await.is_ok() {
        let _ = tokio::io::copy(&mut stream.take(UNREAD), &mut tokio::io::sink()).await;
    }
}

/// What the client has shown.
pub(crate) fn certificates(stream: &TlsStream<TcpStream>) -> Arc<[CertificateDer<'static>]> {
    let (_, connection) = stream.get_ref();
    let shown = connection.peer_certificates().unwrap_or_default();
    shown.iter().map(|one| one.clone().into_owned()).collect()
}

/// Why a client's certificate was refused, where that ended a handshake; the client is told the same by an alert (RFC 8446, section
/// 6.2).
pub(crate) fn refused_certificate(error: &io::Error) -> Option<String> {
    match error.get_ref()?.downcast_ref()? {
        rustls::Error::InvalidCertificate(why) => Some(why.to_string()),
        _ => None,
    }
}

/// Answers each request that comes in plain text with what is spoken here.
pub(crate) fn refusing() -> Router {
    Router::new().fallback(refuse)
}

async fn refuse(uri: Uri, headers: HeaderMap) -> Response {
    let host = headers
        .get(header::HOST)
        .and_then(|host| host.to_str().ok())
        .unwrap_or("HOST:PORT");
    let scheme = match crate::guard::is_upgrade(&headers) {
        true => "wss",
        false => "https",
    };
    let instead = format!("{scheme}://{host}{}", uri.path());
    let mut response = Error::PlainText { instead }.into_response();
    let close = HeaderValue::from_static("close");
    response.headers_mut().insert(header::CONNECTION, close);
    response
}

#[cfg(test)]
mod tests;
