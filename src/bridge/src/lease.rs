//! A connection's place at the bridge.

use std::sync::Arc;

use crate::SessionEnd;
use crate::client::Client;
use crate::shared::Shared;

/// A connection's place: counted and seen by others until it is given up, by [`leave`](Self::leave) or by dropping the
/// future that serves it.
pub(crate) struct Lease {
    shared: Arc<Shared>,
    client: Arc<Client>,
    token: Option<String>,
    /// Which of the client's sockets it is.
    pub(crate) socket: u64,
    present: u64,
    /// Whether the client may come back.
    over: bool,
}

impl Lease {
    pub(crate) fn take(shared: Arc<Shared>, client: Arc<Client>, token: Option<String>) -> Self {
        shared.metrics.sessions.add(1);
        shared.sessions.send_modify(|count| count.connected += 1);
        let present = shared.next_number();
        shared.presence.enter(present, &client.name);
        shared.report_presence();
        let socket = client.outbox.attach();
        Self {
            shared,
            client,
            token,
            socket,
            present,
            over: false,
        }
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
                runtime.spawn(wait(
                    shared.clone(),
                    self.client.clone(),
                    self.socket,
                    token,
                ));
            }
            _ => shared.forget_client(&self.client, &token),
        }
    }
}

/// Keeps a client that is away until it comes back or its time is over.
async fn wait(shared: Arc<Shared>, client: Arc<Client>, socket: u64, token: String) {
    tokio::select! {
        () = tokio::time::sleep(shared.options.resume_grace) => {}
        () = client.outbox.taken_over(socket) => {}
        () = client.ended() => {}
    }
    shared.sessions.send_modify(|count| count.away -= 1);
    if client.outbox.is_attached(socket) {
        shared.forget_client(&client, &token);
    }
}
