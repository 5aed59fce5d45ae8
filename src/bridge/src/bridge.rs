//! What all sockets of one servant share.

use std::sync::Arc;

use ros::bus::Bus;
use ros::schema::Registry;
use ros::sizes::Seen;
use rosbridge::{Format, Level};
use tokio::io::{AsyncRead, AsyncWrite};
use tokio::sync::watch;

use crate::connection::Connection;
use crate::lease::Lease;
use crate::outbox::Goodbye;
use crate::shared::Shared;
use crate::waiting::Waiting;
use crate::{BridgeOptions, Metrics, SessionOptions};

/// One servant's bridge.
pub struct Bridge {
    shared: Arc<Shared>,
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
            shared: Shared::new(bus, registry, options),
        })
    }

    /// Speaks rosbridge on `io`, a connection behind its WebSocket upgrade, until it ends.
    pub async fn serve<S>(self: &Arc<Self>, io: S, options: SessionOptions) -> SessionEnd
    where
        S: AsyncRead + AsyncWrite + Unpin + Send,
    {
        let waiting =
            Waiting::new(io, &options.read_ahead, &self.shared.options).within(&options.budget);
        self.serve_waiting(waiting, options).await
    }

    /// Speaks rosbridge on a connection that has waited for this bridge, until it ends. What the client sent meanwhile
    /// is carried out first, in order.
    pub async fn serve_waiting<S>(
        self: &Arc<Self>,
        waiting: Waiting<S>,
        options: SessionOptions,
    ) -> SessionEnd
    where
        S: AsyncRead + AsyncWrite + Unpin + Send,
    {
        let shared = &self.shared;
        let client = match shared.client_for(&options) {
            Ok(client) => client,
            Err(reason) => {
                waiting.refuse(1012, &reason).await;
                return SessionEnd::Closed { code: 1012, reason };
            }
        };
        let lease = Lease::take(shared.clone(), client.clone(), options.resume);
        tracing::debug!(client = %client.name, "session begins");
        let (socket, kept) = waiting.into_parts();
        let end = Connection::new(socket, kept, client.clone(), lease.socket, &options.budget)
            .run()
            .await;
        tracing::debug!(client = %client.name, ?end, "session ends");
        lease.leave(&end);
        end
    }

    /// Tells every session, connected or away, why it ends (a status message and a close frame with code 1012) and
    /// ends it; later connections are refused the same way. For when the servant dies or is replaced.
    pub fn close(&self, reason: &str) {
        let clients = self.shared.close(reason);
        for client in clients {
            client.status(Level::Error, None, Format::Json, reason);
            client.outbox.say_goodbye(Goodbye {
                code: 1012,
                reason: reason.to_owned(),
            });
            client.end();
        }
    }

    /// Tells every session, connected or away, of something that is wrong: a status message at level error.
    pub fn report(&self, what: &str) {
        for client in self.shared.clients() {
            client.status(Level::Error, None, Format::Json, what);
        }
    }

    /// How many sessions there are, now and later.
    pub fn sessions(&self) -> watch::Receiver<SessionCount> {
        self.shared.sessions.subscribe()
    }

    /// How large the messages and requests of each topic and service are that clients send to nodes.
    pub fn inputs(&self) -> Vec<(String, Seen)> {
        self.shared.inputs.seen()
    }

    /// What was counted so far.
    pub fn metrics(&self) -> &Arc<Metrics> {
        &self.shared.metrics
    }
}

/// Refuses a connection behind its WebSocket upgrade: a status message at level error, then a close frame. For when
/// there is no bridge to serve it, because its client may not have one.
pub async fn refuse<S>(io: S, code: u16, reason: &str)
where
    S: AsyncRead + AsyncWrite + Unpin + Send,
{
    Waiting::new(io, b"", &BridgeOptions::default())
        .refuse(code, reason)
        .await;
}
