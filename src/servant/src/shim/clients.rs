//! Connections of daemons: usually one, none while the daemon is not running.

use std::collections::BTreeMap;

use tokio::io::{AsyncBufReadExt, AsyncWriteExt, BufReader};
use tokio::net::{UnixListener, UnixStream};
use tokio::sync::mpsc;
use tokio::task::JoinHandle;

use super::command_error::CommandError;
use super::input::ShimEvent;
use crate::protocol::{self, ShimMessage, ShimRequest};

/// All connected daemons.
pub(super) struct DaemonConnections {
    inputs: mpsc::UnboundedSender<ShimEvent>,
    next: u64,
    /// Queue and writer task of each connection. The queue needs no bound: there are few messages, and only root can
    /// connect.
    connected: BTreeMap<u64, (mpsc::UnboundedSender<Vec<u8>>, JoinHandle<()>)>,
}

impl DaemonConnections {
    pub(super) fn new(inputs: mpsc::UnboundedSender<ShimEvent>) -> Self {
        Self { inputs, next: 0, connected: BTreeMap::new() }
    }

    /// Accepts connections from now on.
    pub(super) fn accept(&self, listener: UnixListener) {
        let inputs = self.inputs.clone();
        tokio::task::spawn_local(async move {
            while let Ok((stream, _)) = listener.accept().await {
                // Other users can reach a socket, too; only root is accepted.
                let root = stream.peer_cred().is_ok_and(|peer| peer.uid() == 0);
                if root && inputs.send(ShimEvent::Connected(stream)).is_err() {
                    return;
                }
            }
        });
    }

    /// Adds a connection and greets it.
    pub(super) fn add(&mut self, stream: UnixStream, hello: &ShimMessage) {
        let id = self.next;
        self.next += 1;
        let (read, mut write) = stream.into_split();
        let inputs = self.inputs.clone();
        tokio::task::spawn_local(async move {
            let mut lines = BufReader::with_capacity(1024, read).lines();
            while let Ok(Some(line)) = lines.next_line().await {
                if let Ok(request) = serde_json::from_str::<ShimRequest>(&line) {
                    let _ = inputs.send(ShimEvent::Request(id, request));
                }
            }
            let _ = inputs.send(ShimEvent::Disconnected(id));
        });
        let (queue, mut queued) = mpsc::unbounded_channel::<Vec<u8>>();
        let writer = tokio::task::spawn_local(async move {
            while let Some(line) = queued.recv().await {
                if write.write_all(&line).await.is_err() {
                    return;
                }
            }
        });
        let _ = queue.send(protocol::to_line(hello));
        self.connected.insert(id, (queue, writer));
    }

    pub(super) fn remove(&mut self, id: u64) {
        self.connected.remove(&id);
    }

    /// Sends a message to all connections.
    pub(super) fn report(&self, message: &ShimMessage) {
        let line = protocol::to_line(message);
        for (queue, _) in self.connected.values() {
            let _ = queue.send(line.clone());
        }
    }

    /// Sends a reply to one connection.
    pub(super) fn answer(&self, client: u64, request: u64, outcome: Result<(), CommandError>) {
        if let Some((queue, _)) = self.connected.get(&client) {
            let _ = queue.send(protocol::to_line(&ShimMessage::Reply {
                id: request,
                error: outcome.err().map(|error| error.to_string()),
            }));
        }
    }

    /// Completes when all messages are written.
    pub(super) async fn flush(&mut self) {
        for (_, (queue, writer)) in std::mem::take(&mut self.connected) {
            drop(queue);
            let _ = writer.await;
        }
    }
}
