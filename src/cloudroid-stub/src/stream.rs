//! A connection to the portal: TCP, or TLS over it (TLS 1.2 and 1.3, by rustls).

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
pub enum Stream {
    /// TCP without TLS.
    Plain(TcpStream),
    /// Encrypted, and the portal has shown who it is.
    Tls(Box<TlsStream<TcpStream>>),
}

impl Stream {
    /// Over a connection that stands, to a portal that `trust` accepts.
    pub async fn over(tcp: TcpStream, address: &Address, trust: &Trust) -> io::Result<Self> {
        if !address.secure {
            return Ok(Self::Plain(tcp));
        }
        let connected = trust.connect(tcp, &address.host, &address.known_as()).await;
        let connected = connected.map_err(explained)?;
        if let (Some(first), Some(known)) = (connected.first, &trust.known) {
            tracing::warn!(
                "{} is new to this robot; its certificate {first} is remembered in {}: compare it with what the server's operator tells",
                address.authority,
                known.path().display()
            );
        }
        Ok(Self::Tls(Box::new(connected.stream)))
    }

    /// The fingerprint of the certificate that the portal has shown.
    pub fn fingerprint(&self) -> Option<Fingerprint> {
        match self {
            Self::Plain(_) => None,
            Self::Tls(tls) => {
                let shown = tls.get_ref().1.peer_certificates()?;
                shown.first().map(Fingerprint::of)
            }
        }
    }

    /// What it goes over.
    pub fn tcp(&self) -> &TcpStream {
        match self {
            Self::Plain(tcp) => tcp,
            Self::Tls(tls) => tls.get_ref().0,
        }
    }
}

/// With what to do, where it is known.
fn explained(error: io::Error) -> io::Error {
    use rustls::CertificateError as Certificate;
    let inner = error
        .get_ref()
        .and_then(|inner| inner.downcast_ref::<rustls::Error>());
    let next = match inner {
        Some(rustls::Error::InvalidCertificate(reason)) => match reason {
            // The second is another authority of the same name.
            Certificate::UnknownIssuer | Certificate::BadSignature => {
                "nobody whom this robot trusts has signed it; put the authority's certificate into a file and name it: install.sh --ca FILE"
            }
            Certificate::NotValidForName | Certificate::NotValidForNameContext { .. } => {
                "it is another server's; correct the address: install.sh --server"
            }
            Certificate::Expired
            | Certificate::ExpiredContext { .. }
            | Certificate::NotValidYet
            | Certificate::NotValidYetContext { .. } => {
                "look at this robot's clock (date) first, then at the certificate"
            }
            Certificate::Other(reason) if reason.to_string().contains("CaUsedAsEndEntity") => {
                "it is an authority's own, which servers must not show; have it sign one for the server"
            }
            _ => "have it made anew",
        },
        Some(rustls::Error::InvalidMessage(_)) => {
            "the server does not speak TLS there; try ws:// in place of wss://"
        }
        _ => return error,
    };
    io::Error::other(format!("{error}: {next}"))
}

/// Why a server refused the certificate that this robot shows, and what to do, where it said so by an alert (RFC 8446, section 6.2).
/// It comes with the first bytes that are read: in TLS 1.3 a client has done with the handshake before its certificate is looked at.
pub fn refused_certificate(error: &io::Error) -> Option<&'static str> {
    use rustls::AlertDescription as Alert;
    let rustls::Error::AlertReceived(alert) = error.get_ref()?.downcast_ref()? else {
        return None;
    };
    match alert {
        Alert::CertificateExpired => Some(
            "its certificate has expired, because it was off, or the server away, for longer than that is good; pair it again: on the \
             server cloudroidctl pair ROBOT, here cloudroid-stub pair 'LINE'",
        ),
        Alert::UnknownCA
        | Alert::BadCertificate
        | Alert::CertificateUnknown
        | Alert::DecryptError => Some(
            "no authority that the server trusts has signed its certificate, as when the server was set up anew; pair it again: on the \
             server cloudroidctl pair ROBOT, here cloudroid-stub pair 'LINE'",
        ),
        _ => None,
    }
}

impl AsyncRead for Stream {
    fn poll_read(
        self: Pin<&mut Self>,
        cx: &mut Context<'_>,
        buffer: &mut ReadBuf<'_>,
    ) -> Poll<io::Result<()>> {
        match self.get_mut() {
            Self::Plain(tcp) => Pin::new(tcp).poll_read(cx, buffer),
            Self::Tls(tls) => Pin::new(tls).poll_read(cx, buffer),
        }
    }
}

impl AsyncWrite for Stream {
    fn poll_write(
        self: Pin<&mut Self>,
        cx: &mut Context<'_>,
        bytes: &[u8],
    ) -> Poll<io::Result<usize>> {
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
