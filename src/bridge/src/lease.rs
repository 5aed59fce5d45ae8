//! Registration of a connection with the bridge.

use std::sync::Arc;

use crate::SessionEnd;
use crate::client::BridgeClient;
use crate::shared::BridgeShared;

/// A connection's registration: it is counted and visible to others until it ends, by [`leave`](Self::leave) or by
/// dropping the future that serves it.
pub(crate) struct Lease {
    shared: Arc<BridgeShared>,
    client: Arc<BridgeClient>,
    token: Option<String>,
    /// Number of the socket among the client's.
    pub(crate) socket: u64,
    present: u64,
    /// True if the client must not come back.
    over: bool,
}

impl Lease {
    pub(crate) fn take(shared: Arc<BridgeShared>, client: Arc<BridgeClient>, token: Option<String>) -> Self {
        shared.metrics.sessions.add(1);
        shared.sessions.send_modify(|count| count.connected += 1);
        let present = shared.next_number();
        shared.presence.enter(present, &client.name);
        shared.report_presence();
        let socket = client.outbox.attach();
        Self { shared, client, token, socket, present, over: false }
    }

    pub(crate) fn leave(mut self, end: &SessionEnd) {
        self.over = matches!(end, SessionEnd::Closed { code, .. } if *code != 1001);
    }
}

impl Drop for Lease {
    fn drop(&mut self) {
        let shared = &self.shared;
        shared.sessions.send_modify(|count| count.connected -= 1);
        shared.presence.leave(self.present);
        shared.report_presence();
        let Some(token) = self.token.take() else {
            return self.client.end();
        };
        if !self.client.outbox.is_attached(self.socket) {
            // A newer connection has taken over.
            return;
        }
        let runtime = tokio::runtime::Handle::try_current();
        match runtime {
            Ok(runtime) if !self.over && !shared.options.resume_grace.is_zero() => {
                shared.sessions.send_modify(|count| count.away += 1);
                runtime.spawn(wait_for_return(shared.clone(), self.client.clone(), self.socket, token));
            }
            _ => shared.forget_client(&self.client, &token),
        }
    }
}

/// Keeps a disconnected client until it comes back or its grace period is over.
async fn wait_for_return(shared: Arc<BridgeShared>, client: Arc<BridgeClient>, socket: u64, token: String) {
    tokio::select! {
        () = tokio::time::sleep(shared.options.resume_grace) => {}
        () = client.outbox.wait_for_takeover(socket) => {}
        () = client.wait_ended() => {}
    }
    shared.sessions.send_modify(|count| count.away -= 1);
    if client.outbox.is_attached(socket) {
        shared.forget_client(&client, &token);
    }
}
