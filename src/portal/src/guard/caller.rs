//! The other end of a connection, and who asks there.

use std::fmt;
use std::net::{IpAddr, Ipv4Addr, SocketAddr};
use std::sync::Arc;

use access::Principal;
use tokio_rustls::rustls::pki_types::CertificateDer;

use crate::principals::{Identity, Shown};
use crate::strangers::Stranger;

/// The other end of a connection.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Peer {
    /// An address.
    Tcp(SocketAddr),
    /// A user of this machine.
    Unix(User),
}

/// A user of this machine, by the kernel's word.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct User {
    /// The number.
    pub uid: u32,
    /// Whether the process was in the group whose members are admins when it connected.
    pub is_member: bool,
}

impl fmt::Display for Peer {
    fn fmt(&self, out: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Peer::Tcp(address) => address.fmt(out),
            Peer::Unix(user) => write!(out, "user {}", user.uid),
        }
    }
}

impl Peer {
    /// Its address; users of this machine are at its own.
    pub fn ip(&self) -> IpAddr {
        match self {
            Peer::Tcp(address) => address.ip(),
            Peer::Unix(_) => Ipv4Addr::LOCALHOST.into(),
        }
    }

    /// The name of its memory budget: its IP address or, for connections from this machine (a proxy's), its robot's name.
    pub fn client(&self, robot: Option<&str>) -> String {
        match (self, robot) {
            (Peer::Tcp(address), _) if !address.ip().is_loopback() => address.ip().to_string(),
            (_, Some(robot)) => robot.to_owned(),
            (Peer::Tcp(address), None) => address.ip().to_string(),
            (Peer::Unix(user), None) => format!("user {}", user.uid),
        }
    }
}

/// What is known of a connection before its first request.
#[derive(Debug, Clone)]
pub struct Connection {
    /// The other end.
    pub peer: Peer,
    /// Whether nobody on the way can overhear or change what is sent: through TLS, or on this machine's own socket.
    pub secure: bool,
    /// Whether a proxy that the operator named asks for somebody else, whose address the peer is then.
    pub forwarded: bool,
    /// The certificates that the client has shown in TLS, its own first; none where it showed none.
    pub certificates: Arc<[CertificateDer<'static>]>,
    /// Its place among those on which nobody has shown who asks; none for users of this machine, who are told apart by the kernel.
    pub stranger: Option<Arc<Stranger>>,
}

impl Connection {
    /// One without TLS.
    pub fn plain(peer: Peer) -> Connection {
        Connection {
            peer,
            secure: matches!(peer, Peer::Unix(_)),
            forwarded: false,
            certificates: Arc::default(),
            stranger: None,
        }
    }

    /// Counts it among strangers no more.
    pub(crate) fn admit(&self) {
        if let Some(stranger) = &self.stranger {
            stranger.admit();
        }
    }

    /// Comes back when newer connections of strangers need its place.
    pub(crate) async fn dropped(&self) {
        match &self.stranger {
            Some(stranger) => stranger.dropped().await,
            None => std::future::pending().await,
        }
    }
}

/// Who asks.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Caller {
    /// From where.
    pub peer: Peer,
    /// Whether nobody on the way can overhear or change what is sent.
    pub secure: bool,
    /// Whether a proxy that the operator named asks for it.
    pub forwarded: bool,
    /// Who. Nobody gets the page, `/healthz`, and a WebSocket on which it must first send `auth`.
    pub who: Identity,
}

impl Caller {
    /// Whether it has said who it is, where that is asked for.
    pub fn is_known(&self) -> bool {
        !self.who.principal.roles.is_empty()
    }

    pub(crate) fn new(connection: &Connection, principal: Principal, shown: Shown) -> Caller {
        let who = Identity {
            principal: Arc::new(principal),
            shown,
            token: None,
            owner: None,
        };
        Caller::by(connection, who)
    }

    pub(super) fn by(connection: &Connection, who: Identity) -> Caller {
        Caller {
            peer: connection.peer,
            secure: connection.secure,
            forwarded: connection.forwarded,
            who,
        }
    }
}
