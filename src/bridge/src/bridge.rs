//! State shared by all connections of one servant.

use std::sync::Arc;

use ros::bus::Bus;
use ros::schema::Registry;
use ros::sizes::SizeSummary;
use rosbridge::{Format, StatusLevel};
use tokio::io::{AsyncRead, AsyncWrite};
use tokio::sync::watch;

use crate::connection::BridgeConnection;
use crate::lease::Lease;
use crate::outbox::CloseReason;
use crate::session::{SessionCount, SessionEnd};
use crate::shared::BridgeShared;
use crate::waiting::WaitingConnection;
use crate::{BridgeOptions, Metrics, SessionOptions};

/// The bridge of one servant.
pub struct Bridge {
    shared: Arc<BridgeShared>,
}

impl Bridge {
    /// Creates a bridge between `bus` and the sockets passed to [`serve`](Self::serve). `registry` contains the
    /// definitions of the servant's types; types announced by publishers are added.
    pub fn new(bus: Arc<dyn Bus>, registry: Arc<Registry>, options: BridgeOptions) -> Arc<Self> {
        Arc::new(Self { shared: BridgeShared::new(bus, registry, options) })
    }

    /// Serves rosbridge on `io`, a connection after its WebSocket upgrade, until it ends.
    pub async fn serve<S>(self: &Arc<Self>, io: S, options: SessionOptions) -> SessionEnd
    where
        S: AsyncRead + AsyncWrite + Unpin + Send,
    {
        let waiting =
            WaitingConnection::new(io, &options.read_ahead, &self.shared.options).with_budget(&options.budget);
        self.serve_waiting(waiting, options).await
    }

    /// Serves rosbridge on a connection that has waited for this bridge, until it ends. Messages that the client sent
    /// meanwhile are executed first, in order.
    pub async fn serve_waiting<S>(
        self: &Arc<Self>,
        waiting: WaitingConnection<S>,
        options: SessionOptions,
    ) -> SessionEnd
    where
        S: AsyncRead + AsyncWrite + Unpin + Send,
    {
        let shared = &self.shared;
        let client = match shared.client_for(&options) {
            Ok(client) => client,
            Err(CloseReason { code, reason }) => {
                waiting.refuse(code, &reason).await;
                return SessionEnd::Closed { code, reason };
            }
        };
        let lease = Lease::take(shared.clone(), client.clone(), options.resume);
        tracing::debug!(client = %client.name, "session begins");
        let (socket, kept) = waiting.into_parts();
        let end = BridgeConnection::new(socket, kept, client.clone(), lease.socket, &options.budget).run().await;
        tracing::debug!(client = %client.name, ?end, "session ends");
        lease.leave(&end);
        end
    }

    /// Closes every session, connected or not, with this reason (a status message and a close frame with code 1012);
    /// later connections are refused the same way. Used when the servant ends or is replaced.
    pub fn close(&self, reason: &str) {
        let goodbye = CloseReason { code: 1012, reason: reason.to_owned() };
        for client in self.shared.close(&goodbye) {
            client.send_status(StatusLevel::Error, None, Format::Json, reason);
            client.outbox.request_close(goodbye.clone());
            client.end();
        }
    }

    /// Reports an error to every session, connected or not: a status message at level error.
    pub fn report(&self, what: &str) {
        for client in self.shared.clients() {
            client.send_status(StatusLevel::Error, None, Format::Json, what);
        }
    }

    /// Returns a receiver of the number of sessions.
    pub fn sessions(&self) -> watch::Receiver<SessionCount> {
        self.shared.sessions.subscribe()
    }

    /// Returns the sizes of the messages and requests that clients send to nodes, for each topic and service.
    pub fn inputs(&self) -> Vec<(String, SizeSummary)> {
        self.shared.inputs.summaries()
    }

    /// Returns the counters.
    pub fn metrics(&self) -> &Arc<Metrics> {
        &self.shared.metrics
    }
}

/// Refuses a connection after its WebSocket upgrade: a status message at level error, then a close frame. Used when
/// there is no bridge to serve it, because its client may not have one.
pub async fn refuse<S>(io: S, code: u16, reason: &str)
where
    S: AsyncRead + AsyncWrite + Unpin + Send,
{
    WaitingConnection::new(io, b"", &BridgeOptions::default()).refuse(code, reason).await;
}
