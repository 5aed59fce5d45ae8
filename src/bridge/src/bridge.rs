//! What all sockets of one servant share.

use std::sync::Arc;

use ros::bus::Bus;
use ros::schema::Registry;
use tokio::io::{AsyncRead, AsyncWrite};
use tokio::sync::watch;

use crate::{BridgeOptions, Metrics, SessionOptions};

/// One servant's bridge.
pub struct Bridge {
    bus: Arc<dyn Bus>,
    registry: Arc<Registry>,
    options: BridgeOptions,
    metrics: Arc<Metrics>,
    sessions: watch::Sender<SessionCount>,
}

/// How many sessions a bridge has.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq)]
pub struct SessionCount {
    /// Connected now.
    pub connected: usize,
    /// Away, and still within their grace time.
    pub away: usize,
}

/// How a connection ended.
#[derive(Debug, Clone, PartialEq, Eq)]
pub enum SessionEnd {
    /// The client closed it.
    Client {
        /// WebSocket close code; 1005 where it gave none.
        code: u16,
        /// The client's words.
        reason: String,
    },
    /// The bridge closed it.
    Closed {
        /// WebSocket close code.
        code: u16,
        /// The words sent to the client.
        reason: String,
    },
    /// The socket failed or ended without goodbye.
    Lost(String),
}

impl Bridge {
    /// A bridge between `bus` and the sockets that [`serve`](Self::serve) will be given. `registry` holds the
    /// definitions of the servant's types; types that publishers announce are added.
    pub fn new(bus: Arc<dyn Bus>, registry: Arc<Registry>, options: BridgeOptions) -> Arc<Self> {
        Arc::new(Self {
            bus,
            registry,
            options,
            metrics: Arc::default(),
            sessions: watch::Sender::default(),
        })
    }

    /// Speaks rosbridge on `io`, a connection behind its WebSocket upgrade, until it ends.
    pub async fn serve<S>(self: &Arc<Self>, io: S, options: SessionOptions) -> SessionEnd
    where
        S: AsyncRead + AsyncWrite + Unpin + Send,
    {
        let _ = (&self.bus, &self.registry, &self.options, io, options);
        SessionEnd::Lost(String::new())
    }

    /// Tells every session, connected or away, why it ends (a status message and a close frame with code 1012) and
    /// ends it; later connections are refused the same way. For when the servant dies or is replaced.
    pub fn close(&self, reason: &str) {
        let _ = reason;
    }

    /// How many sessions there are, now and later.
    pub fn sessions(&self) -> watch::Receiver<SessionCount> {
        self.sessions.subscribe()
    }

    /// What was counted so far.
    pub fn metrics(&self) -> &Arc<Metrics> {
        &self.metrics
    }
}

/// Refuses a connection behind its WebSocket upgrade: a status message at level error, then a close frame. For when
/// there is no bridge to serve it, because the servant could not be started (1013, "try again later").
pub async fn refuse<S>(io: S, code: u16, reason: &str)
where
    S: AsyncRead + AsyncWrite + Unpin + Send,
{
    let _ = (io, code, reason);
}
