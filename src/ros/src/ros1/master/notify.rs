//! Calls from the Master to nodes: in order per node, concurrently between nodes, newest wins.
//!
//! A node that hangs keeps its own news waiting and nobody else's; it gets the newest state once it answers
//! again, or is forgotten with its registrations. What values of parameters take while they wait is bounded: the oldest
//! of a node's are left out beyond, for a node that does not listen must not fill its Master's memory.

use std::collections::{HashMap, VecDeque};
use std::io::ErrorKind;
use std::sync::Arc;
use std::time::Duration;

use parking_lot::Mutex;
use tokio::sync::Notify;
use tokio::time::timeout;

use super::Inner;
use crate::ros1::xmlrpc::{Client, Error, Value};

/// How the Master signs its calls.
const CALLER: &str = "/master";
/// For one attempt.
const ANSWER: Duration = Duration::from_secs(10);
/// After a node did not answer in time.
const PAUSE: Duration = Duration::from_secs(2);
/// Bytes of parameters' values that may wait for one node; the newest may, whatever its size.
const WAITING: usize = 1 << 20;
/// A value is in memory as such and as text that grows.
const FORMS: usize = 3;
/// How long the connection to a node is kept after the last news.
const LINGER: Duration = Duration::from_secs(2);

/// Something one node must be told.
#[derive(Debug, Clone, PartialEq)]
pub(super) struct Notice {
    /// The node's XML-RPC address.
    pub(super) api: String,
    subject: Subject,
    params: Vec<Value>,
    /// About how many bytes the value of a parameter takes.
    size: usize,
}

/// What a notice is about; a newer notice of the same subject replaces an older one.
#[derive(Debug, Clone, PartialEq, Eq)]
enum Subject {
    Publishers(String),
    Parameter(String),
    Shutdown,
}

impl Subject {
    fn method(&self) -> &'static str {
        match self {
            Subject::Publishers(_) => "publisherUpdate",
            Subject::Parameter(_) => "paramUpdate",
            Subject::Shutdown => "shutdown",
        }
    }
}

impl Notice {
    pub(super) fn publishers(api: &str, topic: &str, publishers: &[String]) -> Self {
        Self {
            api: api.to_owned(),
            subject: Subject::Publishers(topic.to_owned()),
            params: vec![
                CALLER.into(),
                topic.into(),
                Value::strings(publishers.iter().cloned()),
            ],
            size: 0,
        }
    }

    pub(super) fn parameter(api: String, key: String, value: Value) -> Self {
        Self {
            api,
            subject: Subject::Parameter(key.clone()),
            size: value.size(),
            params: vec![CALLER.into(), key.into(), value],
        }
    }

    pub(super) fn shutdown(api: &str, reason: &str) -> Self {
        Self {
            api: api.to_owned(),
            subject: Subject::Shutdown,
            params: vec![CALLER.into(), reason.into()],
            size: 0,
        }
    }
}

/// The queues; a node with an entry has a task that works it off.
#[derive(Debug, Default)]
pub(super) struct Notifier {
    queues: Mutex<HashMap<String, Queue>>,
}

#[derive(Debug, Default)]
struct Queue {
    notices: VecDeque<Notice>,
    more: Arc<Notify>,
}

impl Queue {
    fn push(&mut self, notice: Notice) {
        self.notices.retain(|older| older.subject != notice.subject);
        let is_value = |notice: &Notice| matches!(notice.subject, Subject::Parameter(_));
        while is_value(&notice)
            && notice.size + self.notices.iter().map(|n| n.size).sum::<usize>() > WAITING
        {
            let Some(oldest) = self.notices.iter().position(is_value) else {
                break;
            };
            if let Some(lost) = self.notices.remove(oldest) {
                tracing::warn!(api = lost.api, subject = ?lost.subject, "the node is too slow to be told");
            }
        }
        self.notices.push_back(notice);
        self.more.notify_one();
    }
}

impl Notifier {
    /// Queues the notices, in this order, and starts the tasks that are missing.
    pub(super) fn send(master: &Arc<Inner>, notices: Vec<Notice>) {
        let mut queues = master.notifier.queues.lock();
        for notice in notices {
            let queue = queues.entry(notice.api.clone()).or_insert_with(|| {
                let queue = Queue::default();
                let more = queue.more.clone();
                tokio::spawn(work(master.clone(), notice.api.clone(), more));
                queue
            });
            queue.push(notice);
        }
    }

    /// How many notices the node's task has not taken up.
    #[cfg(test)]
    pub(super) fn waiting(&self, api: &str) -> usize {
        self.queues
            .lock()
            .get(api)
            .map_or(0, |queue| queue.notices.len())
    }

    fn next(&self, api: &str) -> Option<Notice> {
        self.queues.lock().get_mut(api)?.notices.pop_front()
    }

    /// Puts a notice back unless a newer one of its subject came meanwhile.
    fn retry(&self, notice: Notice) {
        if let Some(queue) = self.queues.lock().get_mut(&notice.api) {
            let notices = &mut queue.notices;
            if notices.iter().all(|newer| newer.subject != notice.subject) {
                notices.push_front(notice);
            }
        }
    }

    /// Ends the node's queue if it is empty, or whatever it holds.
    fn finish(&self, api: &str, even_if_full: bool) -> bool {
        let mut queues = self.queues.lock();
        let done = even_if_full || queues.get(api).is_none_or(|queue| queue.notices.is_empty());
        if done {
            queues.remove(api);
        }
        done
    }
}

async fn work(master: Arc<Inner>, api: String, more: Arc<Notify>) {
    let notifier = &master.notifier;
    let Ok(client) = Client::new(master.sockets(), &api) else {
        notifier.finish(&api, true);
        return;
    };
    let budget = &master.limits.budget;
    let client = client.within(budget);
    let mut recovering = false;
    loop {
        let Some(notice) = notifier.next(&api) else {
            // News come in bursts: the connection is worth keeping for a moment.
            if timeout(LINGER, more.notified()).await.is_err() && notifier.finish(&api, false) {
                return;
            }
            continue;
        };
        let method = notice.subject.method();
        let weight = notice.size.saturating_mul(FORMS);
        let _permit = match budget.wait(weight, ANSWER).await {
            Ok(permit) => permit,
            Err(full) => {
                tracing::warn!(%api, method, %full, "the node was not told");
                continue;
            }
        };
        match client.call(method, &notice.params, ANSWER).await {
            Ok(_) if recovering => {
                // It may yet take up older calls that timed out: make this the last word.
                recovering = false;
                tokio::time::sleep(PAUSE).await;
                notifier.retry(notice);
            }
            Ok(_) => {}
            Err(Error::Timeout { .. }) if notice.subject != Subject::Shutdown => {
                tracing::warn!(%api, method, "the node does not answer; trying again");
                recovering = true;
                tokio::time::sleep(PAUSE).await;
                if master.is_known(&api) {
                    notifier.retry(notice);
                }
            }
            Err(Error::Io { source, .. })
                if notice.subject == Subject::Shutdown
                    && source.kind() == ErrorKind::ConnectionRefused =>
            {
                // Nobody is left who could register once more: a successor may be given the same port.
                master.state.lock().registry.address_is_free(&api);
            }
            Err(error) => {
                // Nobody is there (process_exited will see to that), or it does not want to know.
                tracing::debug!(%api, method, %error, "the node was not told");
            }
        }
    }
}
