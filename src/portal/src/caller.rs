//! The peer of a connection and the caller of a request.

use std::fmt;
use std::net::{IpAddr, Ipv4Addr, SocketAddr};
use std::sync::Arc;
use std::sync::atomic::{AtomicU64, Ordering};

use access::Principal;
use tokio_rustls::rustls::pki_types::CertificateDer;
use tracing::Span;

use crate::principals::identity::{CallerIdentity, Credential};
use crate::strangers::Stranger;

/// The peer of a connection.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum ConnectionPeer {
    /// A TCP address.
    Tcp(SocketAddr),
    /// A user of this machine, on the Unix socket.
    Unix(User),
}

/// A user of this machine, identified by the kernel.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct User {
    /// User id.
    pub uid: u32,
    /// True if the process was in the admin group when it connected.
    pub is_member: bool,
}

impl fmt::Display for ConnectionPeer {
    fn fmt(&self, out: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            ConnectionPeer::Tcp(address) => address.fmt(out),
            ConnectionPeer::Unix(user) => write!(out, "user {}", user.uid),
        }
    }
}

impl ConnectionPeer {
    /// Returns the IP address; loopback for users of this machine.
    pub fn ip(&self) -> IpAddr {
        match self {
            ConnectionPeer::Tcp(address) => address.ip(),
            ConnectionPeer::Unix(_) => Ipv4Addr::LOCALHOST.into(),
        }
    }

    /// Returns the name of the memory budget: the IP address or, for connections from this machine (such as a
    /// proxy's), the robot's name.
    pub fn budget_name(&self, robot: Option<&str>) -> String {
        match (self, robot) {
            (ConnectionPeer::Tcp(address), _) if !address.ip().is_loopback() => address.ip().to_string(),
            (_, Some(robot)) => robot.to_owned(),
            (ConnectionPeer::Tcp(address), None) => address.ip().to_string(),
            (ConnectionPeer::Unix(user), None) => format!("user {}", user.uid),
        }
    }
}

/// Properties of a connection before its first request.
#[derive(Debug, Clone)]
pub struct PortalConnection {
    /// The peer.
    pub peer: ConnectionPeer,
    /// True if the connection cannot be intercepted: it uses TLS, or this machine's own socket.
    pub secure: bool,
    /// True if a trusted proxy forwards for a client, whose address the peer then is.
    pub forwarded: bool,
    /// Client certificates presented in TLS, the client's own first; empty if there were none.
    pub certificates: Arc<[CertificateDer<'static>]>,
    /// Slot among the unauthenticated connections; `None` for users of this machine, whom the kernel identifies.
    pub stranger: Option<Arc<Stranger>>,
}

impl PortalConnection {
    /// Creates a connection without TLS.
    pub fn without_tls(peer: ConnectionPeer) -> PortalConnection {
        PortalConnection {
            peer,
            secure: matches!(peer, ConnectionPeer::Unix(_)),
            forwarded: false,
            certificates: Arc::default(),
            stranger: None,
        }
    }

    /// Removes it from the unauthenticated connections.
    pub(crate) fn admit(&self) {
        if let Some(stranger) = &self.stranger {
            stranger.admit();
        }
    }

    /// Waits until the connection must make way for newer unauthenticated ones.
    pub(crate) async fn wait_until_dropped(&self) {
        match &self.stranger {
            Some(stranger) => stranger.wait_until_dropped().await,
            None => std::future::pending().await,
        }
    }
}

/// The caller of a request.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Caller {
    /// The peer.
    pub peer: ConnectionPeer,
    /// True if the connection cannot be intercepted.
    pub secure: bool,
    /// True if a trusted proxy forwards the request.
    pub forwarded: bool,
    /// Identity of the caller. Without one, only the page, `/healthz` and a WebSocket that must first send `auth` are
    /// available.
    pub who: CallerIdentity,
}

impl Caller {
    /// Returns true if the caller is identified, where that is required.
    pub fn is_known(&self) -> bool {
        !self.who.principal.roles.is_empty()
    }

    /// Creates the span of the log of a connection that this caller's request becomes. The principal is recorded later
    /// if it is not known yet.
    pub(crate) fn connection_span(&self) -> Span {
        static NEXT: AtomicU64 = AtomicU64::new(1);
        let (id, peer) = (NEXT.fetch_add(1, Ordering::Relaxed), &self.peer);
        let principal = self.is_known().then_some(&*self.who.principal.name);
        tracing::error_span!(parent: None, "connection", id, %peer, principal)
    }

    pub(crate) fn new(connection: &PortalConnection, principal: Principal, shown: Credential) -> Caller {
        let who = CallerIdentity { principal: Arc::new(principal), shown, token: None, owner: None };
        Caller::from_identity(connection, who)
    }

    pub(super) fn from_identity(connection: &PortalConnection, who: CallerIdentity) -> Caller {
        Caller { peer: connection.peer, secure: connection.secure, forwarded: connection.forwarded, who }
    }
}
