//! What all sockets of one servant share.

use std::sync::Arc;

use bytes::Bytes;
use ros::bus::Bus;
use ros::schema::Registry;
use rosbridge::{Format, Level, Op, Status};
use tokio::io::{AsyncRead, AsyncWrite};
use tokio::sync::watch;

use crate::outbox::Goodbye;
use crate::seat::Seat;
use crate::session::Session;
use crate::shared::Shared;
use crate::{BridgeOptions, Metrics, SessionOptions};
use ws::{WebSocket, frame};

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
        let shared = &self.shared;
        let client = match shared.client_for(&options) {
            Ok(client) => client,
            Err(reason) => {
                refuse(io, 1012, &reason).await;
                return SessionEnd::Closed { code: 1012, reason };
            }
        };
        let seat = Seat::take(shared.clone(), client.clone(), options.resume);
        let limits = &shared.options;
        let socket = WebSocket::new(
            io,
            &options.read_ahead,
            limits.max_frame,
            limits.max_message,
        );
        tracing::debug!(client = %client.name, "session begins");
        let end = Session::new(socket, client.clone(), seat.socket)
            .run()
            .await;
        tracing::debug!(client = %client.name, ?end, "session ends");
        seat.leave(&end);
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

    /// How many sessions there are, now and later.
    pub fn sessions(&self) -> watch::Receiver<SessionCount> {
        self.shared.sessions.subscribe()
    }

    /// What was counted so far.
    pub fn metrics(&self) -> &Arc<Metrics> {
        &self.shared.metrics
    }
}

/// Refuses a connection behind its WebSocket upgrade: a status message at level error, then a close frame. For when
/// there is no bridge to serve it, because the servant could not be started (1013, "try again later").
pub async fn refuse<S>(io: S, code: u16, reason: &str)
where
    S: AsyncRead + AsyncWrite + Unpin + Send,
{
    let mut out = Vec::new();
    Op::from(Status {
        id: None,
        level: Level::Error,
        msg: reason.into(),
    })
    .print(&mut out, Format::Json);
    let mut socket = WebSocket::new(io, b"", 4096, 4096);
    socket.queue(frame::TEXT, Bytes::from(out));
    socket.queue_close(code, reason);
    // A client that does not take its leave in time, or is gone already, is left alone.
    let _ = tokio::time::timeout(BridgeOptions::default().close_timeout, socket.leave(true)).await;
}
