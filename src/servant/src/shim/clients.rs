//! Connections of daemons: usually one, none while the daemon is away.

use std::collections::BTreeMap;

use tokio::io::{AsyncBufReadExt, AsyncWriteExt, BufReader};
use tokio::net::{UnixListener, UnixStream};
use tokio::sync::mpsc;
use tokio::task::JoinHandle;

use super::input::Input;
use crate::protocol::{self, FromShim, Request};

/// Everybody who listens.
pub(super) struct Clients {
    inputs: mpsc::UnboundedSender<Input>,
    next: u64,
    /// Each with its queue and the task that writes it. The queue needs no bound: there is little to say, and only root
    /// can connect.
    connected: BTreeMap<u64, (mpsc::UnboundedSender<Vec<u8>>, JoinHandle<()>)>,
}

impl Clients {
    pub(super) fn new(inputs: mpsc::UnboundedSender<Input>) -> Self {
        Self {
            inputs,
            next: 0,
            connected: BTreeMap::new(),
        }
    }

    /// Accepts from now on.
    pub(super) fn accept(&self, listener: UnixListener) {
        let inputs = self.inputs.clone();
        tokio::task::spawn_local(async move {
            while let Ok((stream, _)) = listener.accept().await {
                // Also other users can reach a socket; nobody but root has anything to say.
                let root = stream.peer_cred().is_ok_and(|peer| peer.uid() == 0);
                if root && inputs.send(Input::Connected(stream)).is_err() {
                    return;
                }
            }
        });
    }

    /// Adds one and greets it.
    pub(super) fn add(&mut self, stream: UnixStream, hello: &FromShim) {
        let id = self.next;
        self.next += 1;
        let (read, mut write) = stream.into_split();
        let inputs = self.inputs.clone();
        tokio::task::spawn_local(async move {
            let mut lines = BufReader::with_capacity(1024, read).lines();
            while let Ok(Some(line)) = lines.next_line().await {
                if let Ok(request) = serde_json::from_str::<Request>(&line) {
                    let _ = inputs.send(Input::Request(id, request));
                }
            }
            let _ = inputs.send(Input::Disconnected(id));
        });
        let (queue, mut queued) = mpsc::unbounded_channel::<Vec<u8>>();
        let writer = tokio::task::spawn_local(async move {
            while let Some(line) = queued.recv().await {
                if write.write_all(&line).await.is_err() {
                    return;
                }
            }
        });
        let _ = queue.send(protocol::line(hello));
        self.connected.insert(id, (queue, writer));
    }

    pub(super) fn remove(&mut self, id: u64) {
        self.connected.remove(&id);
    }

    /// Tells everybody.
    pub(super) fn report(&self, message: &FromShim) {
        let line = protocol::line(message);
        for (queue, _) in self.connected.values() {
            let _ = queue.send(line.clone());
        }
    }

    /// Answers one.
    pub(super) fn answer(&self, client: u64, request: u64, outcome: Result<(), String>) {
        if let Some((queue, _)) = self.connected.get(&client) {
            let _ = queue.send(protocol::line(&FromShim::Reply {
                id: request,
                error: outcome.err(),
            }));
        }
    }

    /// Completes when everything said is written.
    pub(super) async fn flush(&mut self) {
        for (_, (queue, writer)) in std::mem::take(&mut self.connected) {
            drop(queue);
            let _ = writer.await;
        }
    }
}
