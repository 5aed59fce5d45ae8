//! The daemon's end of a connection to a shim: what the shim tells is kept and passed on, what is asked is sent.

use std::collections::BTreeMap;
use std::sync::atomic::{AtomicI32, Ordering};
use std::sync::{Mutex, PoisonError};
use std::time::Duration;

use tokio::io::{AsyncBufReadExt, AsyncWriteExt, BufReader};
use tokio::net::UnixStream;
use tokio::net::unix::{OwnedReadHalf, OwnedWriteHalf};
use tokio::sync::{Mutex as AsyncMutex, broadcast, oneshot, watch};

use crate::engine::{ContainerState, Enforced, NodeEvent};
use crate::protocol::{self, Command, FromShim, NodeStatus, Request, Snapshot};

/// Events that a slow listener may be behind.
const EVENTS: usize = 256;
/// Requests that a shim may not have answered: so few that they fit into the socket, and none is left half written there by
/// somebody who has waited long enough.
const UNANSWERED: usize = 64;

/// What is known of a servant.
#[derive(Debug)]
pub(super) struct Known {
    pub(super) state: watch::Sender<ContainerState>,
    /// Init's pid on the host; 0: not known.
    init: AtomicI32,
    pub(super) events: broadcast::Sender<NodeEvent>,
    pub(super) nodes: watch::Sender<BTreeMap<String, NodeStatus>>,
    pub(super) enforced: watch::Sender<Enforced>,
    /// Nothing more comes.
    pub(super) closed: watch::Sender<bool>,
    waiting: Mutex<Waiting>,
}

#[derive(Debug, Default)]
struct Waiting {
    next: u64,
    answers: BTreeMap<u64, oneshot::Sender<Option<String>>>,
    closed: bool,
}

impl Default for Known {
    fn default() -> Self {
        Self {
            state: watch::Sender::new(ContainerState::Creating),
            init: AtomicI32::new(0),
            events: broadcast::Sender::new(EVENTS),
            nodes: watch::Sender::default(),
            enforced: watch::Sender::default(),
            closed: watch::Sender::new(false),
            waiting: Mutex::default(),
        }
    }
}

impl Known {
    /// Takes in what the shim says until it says no more.
    pub(super) async fn listen(&self, read: OwnedReadHalf) {
        let mut lines = BufReader::new(read).lines();
        while let Ok(Some(line)) = lines.next_line().await {
            match serde_json::from_str(&line) {
                Ok(message) => self.take_in(message),
                Err(error) => tracing::warn!(%error, line, "a shim says something unknown"),
            }
        }
        let mut waiting = self.waiting.lock().unwrap_or_else(PoisonError::into_inner);
        waiting.closed = true;
        waiting.answers.clear();
        drop(waiting);
        self.closed.send_replace(true);
    }

    fn take_in(&self, message: FromShim) {
        match message {
            FromShim::Hello {
                state,
                nodes,
                enforced,
                ..
            } => {
                self.enforced.send_replace(enforced);
                self.nodes.send_replace(nodes);
                self.enter(state);
            }
            FromShim::State { state } => self.enter(state),
            FromShim::Node { event, status } => {
                self.nodes.send_modify(|nodes| {
                    nodes.insert(event.node().to_owned(), status);
                });
                // Nobody listens: nobody is told.
                let _ = self.events.send(event);
            }
            FromShim::Enforced { enforced } => {
                self.enforced.send_replace(enforced);
            }
            FromShim::Reply { id, error } => {
                let answer = self
                    .waiting
                    .lock()
                    .unwrap_or_else(PoisonError::into_inner)
                    .answers
                    .remove(&id);
                if let Some(answer) = answer {
                    let _ = answer.send(error);
                }
            }
        }
    }

    fn enter(&self, told: Snapshot) {
        if let Some(pid) = told.init_pid {
            self.init.store(pid, Ordering::Release);
        }
        self.state.send_replace(told.state);
    }

    /// Init's pid on the host.
    pub(super) fn init(&self) -> Option<i32> {
        Some(self.init.load(Ordering::Acquire)).filter(|pid| *pid != 0)
    }

    /// A number for a request, and where its answer will come.
    fn expect_answer(&self) -> Result<(u64, oneshot::Receiver<Option<String>>), Unfulfilled> {
        let mut waiting = self.waiting.lock().unwrap_or_else(PoisonError::into_inner);
        if waiting.closed {
            return Err(Unfulfilled::Gone);
        }
        if waiting.answers.len() >= UNANSWERED {
            return Err(Unfulfilled::Silent);
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
pub(super) struct Requests {
    write: AsyncMutex<OwnedWriteHalf>,
}

/// Why a request was not fulfilled.
#[derive(Debug)]
pub(super) enum Unfulfilled {
    /// The shim's words.
    Refused(String),
    /// It does not answer any more.
    Gone,
    /// It has not answered in time, or too many earlier ones.
    Silent,
}

impl Requests {
    pub(super) fn split(stream: UnixStream) -> (OwnedReadHalf, Self) {
        let (read, write) = stream.into_split();
        (
            read,
            Self {
                write: AsyncMutex::new(write),
            },
        )
    }

    pub(super) async fn ask(&self, known: &Known, command: Command) -> Result<(), Unfulfilled> {
        let (id, answer) = known.expect_answer()?;
        let line = protocol::line(&Request { id, command });
        self.write
            .lock()
            .await
            .write_all(&line)
            .await
            .map_err(|_| Unfulfilled::Gone)?;
        match answer.await {
            Ok(None) => Ok(()),
            Ok(Some(reason)) => Err(Unfulfilled::Refused(reason)),
            Err(_) => Err(Unfulfilled::Gone),
        }
    }

    /// The same, waiting no longer than `patience`. What was asked may be done later all the same.
    pub(super) async fn ask_within(
        &self,
        known: &Known,
        command: Command,
        patience: Duration,
    ) -> Result<(), Unfulfilled> {
        let asked = tokio::time::timeout(patience, self.ask(known, command)).await;
        asked.unwrap_or(Err(Unfulfilled::Silent))
    }
}

#[cfg(test)]
mod tests {
    use std::sync::Arc;

    use tokio::task::JoinSet;

    use super::*;

    fn signal() -> Command {
        Command::SignalNode {
            node: "/a".to_owned(),
            signal: 9,
            last: false,
        }
    }

    #[tokio::test]
    async fn a_shim_that_does_not_answer_is_asked_no_more_than_fits() {
        let (daemon, shim) = UnixStream::pair().expect("a socket");
        let (read, requests) = Requests::split(daemon);
        let (requests, known) = (Arc::new(requests), Arc::new(Known::default()));
        let listening = Arc::clone(&known);
        let listener = tokio::spawn(async move { listening.listen(read).await });
        let mut asks = JoinSet::new();
        for _ in 0..UNANSWERED {
            let (requests, known) = (Arc::clone(&requests), Arc::clone(&known));
            asks.spawn(async move { requests.ask(&known, signal()).await });
        }
        let (from_daemon, mut to_daemon) = shim.into_split();
        let mut lines = BufReader::new(from_daemon).lines();
        let mut ids = Vec::new();
        for _ in 0..UNANSWERED {
            let line = lines.next_line().await.expect("read").expect("a line");
            let request: Request = serde_json::from_str(&line).expect("it is whole");
            ids.push(request.id);
        }
        let asked = requests.ask(&known, signal()).await;
        assert!(matches!(asked, Err(Unfulfilled::Silent)), "{asked:?}");
        for id in ids {
            let answer = protocol::line(&FromShim::Reply { id, error: None });
            to_daemon.write_all(&answer).await.expect("answered");
        }
        for asked in asks.join_all().await {
            asked.expect("it answers after all");
        }
        let asked = requests.ask_within(&known, signal(), Duration::ZERO).await;
        assert!(matches!(asked, Err(Unfulfilled::Silent)), "{asked:?}");
        listener.abort();
    }
}
