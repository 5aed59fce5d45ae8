//! A connection to the portal: TCP, or TLS over it (TLS 1.2 and 1.3, with rustls).

use std::io;
use std::pin::Pin;
use std::task::{Context, Poll};

use tls::{Fingerprint, Trust};
use tokio::io::{AsyncRead, AsyncWrite, ReadBuf};
use tokio::net::TcpStream;
use tokio_rustls::client::TlsStream;
use tokio_rustls::rustls;

use crate::address::Address;

/// A TCP connection, with or without TLS.
pub enum PortalStream {
    /// TCP without TLS.
    Plain(TcpStream),
    /// TLS; the portal is authenticated.
    Tls(Box<TlsStream<TcpStream>>),
}

impl PortalStream {
    /// Performs the TLS handshake on an established connection, if the address requires it, with a portal that `trust`
    /// accepts.
    pub async fn connect(tcp: TcpStream, address: &Address, trust: &Trust) -> io::Result<Self> {
        if !address.secure {
            return Ok(Self::Plain(tcp));
        }
        let connected = trust.connect(tcp, &address.host, &address.known_server_name()).await;
        let connected = connected.map_err(explain_error)?;
        if let (Some(first), Some(known)) = (connected.first, &trust.known) {
            tracing::warn!(
                "first connection to {}; its certificate's fingerprint {first} is stored in {}: compare it with the \
                    one from the server's operator",
                address.authority,
                known.path().display()
            );
        }
        Ok(Self::Tls(Box::new(connected.stream)))
    }

    /// Returns the fingerprint of the certificate that the portal has presented.
    pub fn fingerprint(&self) -> Option<Fingerprint> {
        match self {
            Self::Plain(_) => None,
            Self::Tls(tls) => {
                let shown = tls.get_ref().1.peer_certificates()?;
                shown.first().map(Fingerprint::from_certificate)
            }
        }
    }

    /// Returns the underlying TCP connection.
    pub fn tcp(&self) -> &TcpStream {
        match self {
            Self::Plain(tcp) => tcp,
            Self::Tls(tls) => tls.get_ref().0,
        }
    }
}

/// Adds advice to an error, if there is any.
fn explain_error(error: io::Error) -> io::Error {
    use rustls::CertificateError as Certificate;
    let inner = error.get_ref().and_then(|inner| inner.downcast_ref::<rustls::Error>());
    let next = match inner {
        Some(rustls::Error::InvalidCertificate(reason)) => match reason {
            // `BadSignature` is reported for another authority of the same name.
            Certificate::UnknownIssuer | Certificate::BadSignature => {
                "it is not signed by an authority that this robot trusts; put the authority's certificate into a file \
                    and run: install.sh --ca FILE"
            }
            Certificate::NotValidForName | Certificate::NotValidForNameContext { .. } => {
                "it belongs to another server; correct the address: install.sh --server"
            }
            Certificate::Expired
            | Certificate::ExpiredContext { .. }
            | Certificate::NotValidYet
            | Certificate::NotValidYetContext { .. } => "check this robot's clock (date) first, then the certificate",
            Certificate::Other(reason) if reason.to_string().contains("CaUsedAsEndEntity") => {
                "it is a CA certificate, which servers must not use; issue a server certificate with it"
            }
            _ => "replace it",
        },
        Some(rustls::Error::InvalidMessage(_)) => "the server does not use TLS there; try ws:// instead of wss://",
        _ => return error,
    };
    io::Error::other(format!("{error}: {next}"))
}

/// Returns the reason why a server refused this robot's certificate, with advice, if it sent an alert (RFC 8446,
/// section 6.2). The alert comes with the first data that is read: in TLS 1.3 a client has completed the handshake
/// before its certificate is checked.
pub fn certificate_refusal(error: &io::Error) -> Option<&'static str> {
    use rustls::AlertDescription as Alert;
    let rustls::Error::AlertReceived(alert) = error.get_ref()?.downcast_ref()? else {
        return None;
    };
    match alert {
        Alert::CertificateExpired => Some(
            "its certificate has expired, because the robot or the server was off for too long; pair it again: on the \
                server cloudroidctl pair ROBOT, here cloudroid-stub pair 'LINE'",
        ),
        Alert::UnknownCA | Alert::BadCertificate | Alert::CertificateUnknown | Alert::DecryptError => Some(
            "its certificate is not signed by an authority that the server trusts, for example because the server was \
                set up again; pair it again: on the server cloudroidctl pair ROBOT, here cloudroid-stub pair 'LINE'",
        ),
        _ => None,
    }
}

impl AsyncRead for PortalStream {
    fn poll_read(self: Pin<&mut Self>, cx: &mut Context<'_>, buffer: &mut ReadBuf<'_>) -> Poll<io::Result<()>> {
        match self.get_mut() {
            Self::Plain(tcp) => Pin::new(tcp).poll_read(cx, buffer),
            Self::Tls(tls) => Pin::new(tls).poll_read(cx, buffer),
        }
    }
}

impl AsyncWrite for PortalStream {
    fn poll_write(self: Pin<&mut Self>, cx: &mut Context<'_>, bytes: &[u8]) -> Poll<io::Result<usize>> {
        match self.get_mut() {
            Self::Plain(tcp) => Pin::new(tcp).poll_write(cx, bytes),
            Self::Tls(tls) => Pin::new(tls).poll_write(cx, bytes),
        }
    }

    fn poll_write_vectored(
        self: Pin<&mut Self>,
        cx: &mut Context<'_>,
        slices: &[io::IoSlice<'_>],
    ) -> Poll<io::Result<usize>> {
        match self.get_mut() {
            Self::Plain(tcp) => Pin::new(tcp).poll_write_vectored(cx, slices),
            Self::Tls(tls) => Pin::new(tls).poll_write_vectored(cx, slices),
        }
    }

    fn is_write_vectored(&self) -> bool {
        true
    }

    fn poll_flush(self: Pin<&mut Self>, cx: &mut Context<'_>) -> Poll<io::Result<()>> {
        match self.get_mut() {
            Self::Plain(tcp) => Pin::new(tcp).poll_flush(cx),
            Self::Tls(tls) => Pin::new(tls).poll_flush(cx),
        }
    }

    fn poll_shutdown(self: Pin<&mut Self>, cx: &mut Context<'_>) -> Poll<io::Result<()>> {
        match self.get_mut() {
            Self::Plain(tcp) => Pin::new(tcp).poll_shutdown(cx),
            Self::Tls(tls) => Pin::new(tls).poll_shutdown(cx),
        }
    }
}
