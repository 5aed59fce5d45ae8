//! Connections of daemons: usually one, none while the daemon is not running.

use std::collections::{BTreeMap, VecDeque};
use std::os::fd::{AsRawFd, FromRawFd, OwnedFd};

use init::socket::{self, MAX_FDS};
use tokio::io::{AsyncWriteExt, Interest};
use tokio::net::unix::OwnedReadHalf;
use tokio::net::{UnixListener, UnixStream};
use tokio::sync::mpsc;
use tokio::task::JoinHandle;

use super::command_error::CommandError;
use super::input::ShimEvent;
use crate::protocol::{self, ShimMessage, ShimRequest};

/// Reads requests, one a line, and the descriptors attached to them.
struct RequestReader {
    stream: OwnedReadHalf,
    read: Vec<u8>,
    /// Descriptors of the requests in `read`, in their order.
    attached: VecDeque<OwnedFd>,
}

impl RequestReader {
    fn new(stream: OwnedReadHalf) -> Self {
        Self { stream, read: Vec::new(), attached: VecDeque::new() }
    }

    /// Returns the next request and its descriptors; `None` when the daemon has disconnected. Lines that are not
    /// understood are passed over.
    async fn next(&mut self) -> Option<(ShimRequest, Vec<OwnedFd>)> {
        loop {
            while let Some(end) = self.read.iter().position(|byte| *byte == b'\n') {
                let line: Vec<u8> = self.read.drain(..=end).collect();
                if let Ok(request) = serde_json::from_slice::<ShimRequest>(&line) {
                    let count = request.command.descriptor_count().min(self.attached.len());
                    return Some((request, self.attached.drain(..count).collect()));
                }
            }
            self.receive().await?;
        }
    }

    /// Receives more; `None` when the daemon has disconnected.
    async fn receive(&mut self) -> Option<()> {
        let stream: &UnixStream = self.stream.as_ref();
        let mut block = [0; 1024];
        let receive = || {
            let mut fds = [-1; MAX_FDS];
            let (length, count) = socket::receive(stream.as_raw_fd(), &mut block, &mut fds)?;
            // SAFETY: just received, owned by nobody else.
            let owned = fds[..count].iter().map(|fd| unsafe { OwnedFd::from_raw_fd(*fd) });
            Ok((length, owned.collect::<Vec<_>>()))
        };
        let (length, fds) = stream.async_io(Interest::READABLE, receive).await.ok()?;
        self.read.extend_from_slice(&block[..length]);
        self.attached.extend(fds);
        (length > 0).then_some(())
    }
}

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
            let mut requests = RequestReader::new(read);
            while let Some((request, descriptors)) = requests.next().await {
                let _ = inputs.send(ShimEvent::Request(id, request, descriptors));
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

#[cfg(test)]
mod tests {
    use std::fs::File;

    use crate::exec::ExecSpec;
    use crate::protocol::Command;

    use super::*;

    #[tokio::test]
    async fn each_request_gets_the_descriptors_that_were_sent_with_it() {
        let (daemon, shim) = UnixStream::pair().unwrap();
        let (read, _write) = shim.into_split();
        let mut requests = RequestReader::new(read);
        let files: Vec<File> = (0..6).map(|_| File::open("/dev/null").unwrap()).collect();
        let fds: Vec<_> = files.iter().map(AsRawFd::as_raw_fd).collect();
        let exec = |id, terminal| {
            // Longer than what is read at once.
            let argv = vec!["x".repeat(4000)];
            let spec = ExecSpec { argv, environment: BTreeMap::new(), terminal };
            protocol::to_line(&ShimRequest { id, command: Command::Exec(spec) })
        };
        let stop = protocol::to_line(&ShimRequest { id: 1, command: Command::Stop });
        let unknown = b"{\"id\":9,\"command\":\"of a later version\"}\n".to_vec();
        for (line, fds) in
            [(stop, &fds[..0]), (exec(2, false), &fds[..4]), (unknown, &fds[..0]), (exec(3, true), &fds[4..])]
        {
            assert_eq!(socket::send(daemon.as_raw_fd(), &line, fds).unwrap(), line.len());
        }
        drop(daemon);
        let mut told = Vec::new();
        while let Some((request, descriptors)) = requests.next().await {
            told.push((request.id, descriptors.len()));
        }
        assert_eq!(told, [(1, 0), (2, 4), (3, 2)]);
    }
}
