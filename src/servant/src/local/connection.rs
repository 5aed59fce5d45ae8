//! The daemon's end of a connection to a shim: keeps and passes on the shim's messages, and sends requests.

use std::collections::BTreeMap;
use std::io;
use std::os::fd::{AsRawFd, OwnedFd, RawFd};
use std::sync::atomic::{AtomicBool, AtomicI32, Ordering};
use std::sync::{Mutex, PoisonError};
use std::time::Duration;

use tokio::io::{AsyncBufReadExt, AsyncReadExt, AsyncWriteExt, BufReader, Interest};
use tokio::net::UnixStream;
use tokio::net::unix::{OwnedReadHalf, OwnedWriteHalf};
use tokio::sync::{Mutex as AsyncMutex, broadcast, oneshot, watch};

use crate::engine::{ContainerState, EnforcedLimits, NodeEvent};
use crate::protocol::{self, Command, NodeStatus, ShimMessage, ShimRequest, Snapshot};

/// Number of events that a slow listener may be behind.
const EVENTS: usize = 256;
/// Maximum number of requests not yet answered by a shim: few enough to fit into the socket's buffer, so that no caller
/// that gives up waiting leaves a partly written one.
const MAX_UNANSWERED: usize = 64;

/// Maximum length of a shim's message in bytes, far above what thousands of nodes take: nodes may have taken a shim
/// over, and its messages count in no budget.
const LONGEST_MESSAGE: u64 = 4 << 20;
/// Bytes of a message that is not understood that are logged.
const MAX_LOGGED: usize = 200;

/// State of a servant as reported by its shim.
#[derive(Debug)]
pub(super) struct ServantView {
    pub(super) state: watch::Sender<ContainerState>,
    /// Host pid of init; 0 if unknown.
    init: AtomicI32,
    can_exec: AtomicBool,
    /// True once the container has run, even if it has ended since.
    has_run: AtomicBool,
    pub(super) events: broadcast::Sender<NodeEvent>,
    pub(super) nodes: watch::Sender<BTreeMap<String, NodeStatus>>,
    pub(super) enforced: watch::Sender<EnforcedLimits>,
    /// True once the connection has ended.
    pub(super) closed: watch::Sender<bool>,
    waiting: Mutex<PendingRequests>,
}

#[derive(Debug, Default)]
struct PendingRequests {
    next: u64,
    answers: BTreeMap<u64, oneshot::Sender<Option<String>>>,
    closed: bool,
}

impl Default for ServantView {
    fn default() -> Self {
        Self {
            state: watch::Sender::new(ContainerState::Creating),
            init: AtomicI32::new(0),
            can_exec: AtomicBool::new(false),
            has_run: AtomicBool::new(false),
            events: broadcast::Sender::new(EVENTS),
            nodes: watch::Sender::default(),
            enforced: watch::Sender::default(),
            closed: watch::Sender::new(false),
            waiting: Mutex::default(),
        }
    }
}

impl ServantView {
    /// Applies the shim's messages until the connection ends, or a message is too long.
    pub(super) async fn read_messages(&self, read: OwnedReadHalf) {
        let mut reader = BufReader::new(read);
        while let Some(line) = read_message(&mut reader).await {
            match serde_json::from_slice(&line) {
                Ok(message) => self.apply_message(message),
                Err(error) => {
                    let begin = String::from_utf8_lossy(&line[..line.len().min(MAX_LOGGED)]);
                    tracing::warn!(%error, %begin, "a shim sent something unknown");
                }
            }
        }
        let mut waiting = self.waiting.lock().unwrap_or_else(PoisonError::into_inner);
        waiting.closed = true;
        waiting.answers.clear();
        drop(waiting);
        self.closed.send_replace(true);
    }

    fn apply_message(&self, message: ShimMessage) {
        match message {
            ShimMessage::Hello { state, nodes, enforced, can_exec, .. } => {
                self.can_exec.store(can_exec, Ordering::Release);
                self.enforced.send_replace(enforced);
                self.nodes.send_replace(nodes);
                self.set_state(state);
            }
            ShimMessage::State { state } => self.set_state(state),
            ShimMessage::Node { event, status } => {
                self.nodes.send_modify(|nodes| {
                    nodes.insert(event.node().to_owned(), status);
                });
                // An error means that nobody listens.
                let _ = self.events.send(event);
            }
            ShimMessage::Enforced { enforced } => {
                self.enforced.send_replace(enforced);
            }
            ShimMessage::Reply { id, error } => {
                let answer = self.waiting.lock().unwrap_or_else(PoisonError::into_inner).answers.remove(&id);
                if let Some(answer) = answer {
                    let _ = answer.send(error);
                }
            }
        }
    }

    fn set_state(&self, told: Snapshot) {
        if let Some(pid) = told.init_pid {
            self.init.store(pid, Ordering::Release);
        }
        if told.state == ContainerState::Running {
            self.has_run.store(true, Ordering::Release);
        }
        self.state.send_replace(told.state);
    }

    /// Returns whether the container has run, even if it has ended since.
    pub(super) fn has_run(&self) -> bool {
        self.has_run.load(Ordering::Acquire)
    }

    /// Returns the host pid of init.
    pub(super) fn init_pid(&self) -> Option<i32> {
        Some(self.init.load(Ordering::Acquire)).filter(|pid| *pid != 0)
    }

    /// Returns whether the shim can run programs beside the nodes; those of earlier versions cannot.
    pub(super) fn can_exec(&self) -> bool {
        self.can_exec.load(Ordering::Acquire)
    }

    /// Allocates the id of a request and the channel for its reply.
    fn register_request(&self) -> Result<(u64, oneshot::Receiver<Option<String>>), ShimRequestError> {
        let mut waiting = self.waiting.lock().unwrap_or_else(PoisonError::into_inner);
        if waiting.closed {
            return Err(ShimRequestError::Gone);
        }
        if waiting.answers.len() >= MAX_UNANSWERED {
            return Err(ShimRequestError::Silent);
        }
        let id = waiting.next;
        waiting.next += 1;
        let (sender, receiver) = oneshot::channel();
        waiting.answers.insert(id, sender);
        Ok((id, receiver))
    }
}

/// Sends requests.
#[derive(Debug)]
pub(super) struct RequestSender {
    write: AsyncMutex<OwnedWriteHalf>,
}

/// Reason why a request was not fulfilled.
#[derive(Debug)]
pub(super) enum ShimRequestError {
    /// The shim refused, with this reason.
    Refused(String),
    /// The connection to the shim has ended.
    Gone,
    /// The shim did not answer in time, or has too many unanswered requests.
    Silent,
}

impl RequestSender {
    pub(super) fn split(stream: UnixStream) -> (OwnedReadHalf, Self) {
        let (read, write) = stream.into_split();
        (read, Self { write: AsyncMutex::new(write) })
    }

    pub(super) async fn request(&self, known: &ServantView, command: Command) -> Result<(), ShimRequestError> {
        self.request_with_descriptors(known, command, Vec::new()).await
    }

    /// Sends a request with these descriptors attached, and closes them here.
    pub(super) async fn request_with_descriptors(
        &self,
        known: &ServantView,
        command: Command,
        descriptors: Vec<OwnedFd>,
    ) -> Result<(), ShimRequestError> {
        let (id, answer) = known.register_request()?;
        let line = protocol::to_line(&ShimRequest { id, command });
        self.write_line(&line, &descriptors).await.map_err(|_| ShimRequestError::Gone)?;
        drop(descriptors);
        match answer.await {
            Ok(None) => Ok(()),
            Ok(Some(reason)) => Err(ShimRequestError::Refused(reason)),
            Err(_) => Err(ShimRequestError::Gone),
        }
    }

    async fn write_line(&self, line: &[u8], descriptors: &[OwnedFd]) -> io::Result<()> {
        let mut write = self.write.lock().await;
        let mut sent = 0;
        if !descriptors.is_empty() {
            let descriptors: Vec<RawFd> = descriptors.iter().map(AsRawFd::as_raw_fd).collect();
            let stream: &UnixStream = write.as_ref();
            // They arrive with the first of these bytes, even if only some fit into the socket's buffer.
            let send = || init::socket::send(stream.as_raw_fd(), line, &descriptors);
            sent = stream.async_io(Interest::WRITABLE, send).await?;
        }
        write.write_all(&line[sent..]).await
    }

    /// Sends a request, waiting at most `patience` for the reply. The request may still be carried out later.
    pub(super) async fn request_with_timeout(
        &self,
        known: &ServantView,
        command: Command,
        patience: Duration,
    ) -> Result<(), ShimRequestError> {
        let asked = tokio::time::timeout(patience, self.request(known, command)).await;
        asked.unwrap_or(Err(ShimRequestError::Silent))
    }
}

/// Reads one line; `None` at the end of the connection, and if it is too long.
async fn read_message(reader: &mut BufReader<OwnedReadHalf>) -> Option<Vec<u8>> {
    let mut line = Vec::new();
    reader.take(LONGEST_MESSAGE).read_until(b'\n', &mut line).await.ok()?;
    if line.len() as u64 == LONGEST_MESSAGE {
        tracing::warn!("a shim sent a message of more than {LONGEST_MESSAGE} bytes; it is heard no longer");
        return None;
    }
    (!line.is_empty()).then_some(line)
}

#[cfg(test)]
mod tests {
    use std::sync::Arc;

    use tokio::task::JoinSet;

    use super::*;

    fn signal() -> Command {
        Command::SignalNode { node: "/a".to_owned(), signal: 9, last: false }
    }

    #[tokio::test]
    async fn a_shim_that_does_not_answer_is_asked_no_more_than_fits() {
        let (daemon, shim) = UnixStream::pair().expect("a socket");
        let (read, requests) = RequestSender::split(daemon);
        let (requests, known) = (Arc::new(requests), Arc::new(ServantView::default()));
        let listening = Arc::clone(&known);
        let listener = tokio::spawn(async move { listening.read_messages(read).await });
        let mut asks = JoinSet::new();
        for _ in 0..MAX_UNANSWERED {
            let (requests, known) = (Arc::clone(&requests), Arc::clone(&known));
            asks.spawn(async move { requests.request(&known, signal()).await });
        }
        let (from_daemon, mut to_daemon) = shim.into_split();
        let mut lines = BufReader::new(from_daemon).lines();
        let mut ids = Vec::new();
        for _ in 0..MAX_UNANSWERED {
            let line = lines.next_line().await.expect("read").expect("a line");
            let request: ShimRequest = serde_json::from_str(&line).expect("it is whole");
            ids.push(request.id);
        }
        let asked = requests.request(&known, signal()).await;
        assert!(matches!(asked, Err(ShimRequestError::Silent)), "{asked:?}");
        for id in ids {
            let answer = protocol::to_line(&ShimMessage::Reply { id, error: None });
            to_daemon.write_all(&answer).await.expect("answered");
        }
        for asked in asks.join_all().await {
            asked.expect("it answers after all");
        }
        let asked = requests.request_with_timeout(&known, signal(), Duration::ZERO).await;
        assert!(matches!(asked, Err(ShimRequestError::Silent)), "{asked:?}");
        listener.abort();
    }

    #[tokio::test]
    async fn a_shim_that_never_ends_a_message_is_heard_no_longer() {
        let (daemon, mut shim) = UnixStream::pair().expect("a socket");
        // Without this, what is not read would wait in the socket.
        let (read, requests) = RequestSender::split(daemon);
        drop(requests);
        let known = Arc::new(ServantView::default());
        let listening = Arc::clone(&known);
        let listener = tokio::spawn(async move { listening.read_messages(read).await });
        let answer = protocol::to_line(&ShimMessage::State { state: ContainerState::Running.into() });
        shim.write_all(&answer).await.expect("sent");
        let mut state = known.state.subscribe();
        state.wait_for(|state| *state == ContainerState::Running).await.expect("it is heard");
        let block = vec![b' '; 1 << 20];
        let mut sent = 0;
        while shim.write_all(&block).await.is_ok() {
            sent += block.len() as u64;
            assert!(sent <= 2 * LONGEST_MESSAGE, "it is heard without end");
        }
        listener.await.expect("it has ended");
        assert!(*known.closed.borrow());
    }
}
