//! Calls from the Master to nodes: in order per node, concurrently across nodes, newer notices replace older ones.
//!
//! A node that hangs delays only its own notices; it gets the newest state once it answers again, or is forgotten with
//! its registrations. The memory for queued parameter values is bounded: beyond the limit a node's oldest ones are
//! dropped, because a node that does not listen must not fill its Master's memory.

use std::collections::{HashMap, VecDeque};
use std::io::ErrorKind;
use std::sync::Arc;
use std::time::Duration;

use parking_lot::Mutex;
use tokio::sync::Notify;
use tokio::time::timeout;

use super::MasterCore;
use crate::xmlrpc::{Error, Value, XmlRpcClient};

/// Caller id of the Master's calls.
const CALLER: &str = "/master";
/// Time limit of one attempt.
const ANSWER: Duration = Duration::from_secs(10);
/// Pause after a node did not answer in time.
const PAUSE: Duration = Duration::from_secs(2);
/// Maximum size in bytes of the parameter values queued for one node; the newest is queued whatever its size.
const WAITING: usize = 1 << 20;
/// Copies of a value in memory: the value and the growing text.
const FORMS: usize = 3;
/// Time for which the connection to a node is kept after the last notice.
const LINGER: Duration = Duration::from_secs(2);

/// A notification for one node.
#[derive(Debug, Clone, PartialEq)]
pub(super) struct Notice {
    /// XML-RPC address of the node.
    pub(super) api: String,
    subject: Subject,
    params: Vec<Value>,
    /// Approximate size in bytes of a parameter value.
    size: usize,
}

/// Subject of a notice; a newer notice of the same subject replaces an older one.
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
            params: vec![CALLER.into(), topic.into(), Value::strings(publishers.iter().cloned())],
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
        Self { api: api.to_owned(), subject: Subject::Shutdown, params: vec![CALLER.into(), reason.into()], size: 0 }
    }
}

/// Queues per node; each node with an entry has a task that processes it.
#[derive(Debug, Default)]
pub(super) struct Notifier {
    queues: Mutex<HashMap<String, NoticeQueue>>,
}

#[derive(Debug, Default)]
struct NoticeQueue {
    notices: VecDeque<Notice>,
    more: Arc<Notify>,
}

impl NoticeQueue {
    fn push(&mut self, notice: Notice) {
        self.notices.retain(|older| older.subject != notice.subject);
        let is_value = |notice: &Notice| matches!(notice.subject, Subject::Parameter(_));
        while is_value(&notice) && notice.size + self.notices.iter().map(|n| n.size).sum::<usize>() > WAITING {
            let Some(oldest) = self.notices.iter().position(is_value) else {
                break;
            };
            if let Some(lost) = self.notices.remove(oldest) {
                tracing::warn!(api = lost.api, subject = ?lost.subject, "the node is too slow to be notified");
            }
        }
        self.notices.push_back(notice);
        self.more.notify_one();
    }
}

impl Notifier {
    /// Queues the notices in order, and starts the tasks that are missing.
    pub(super) fn send(master: &Arc<MasterCore>, notices: Vec<Notice>) {
        let mut queues = master.notifier.queues.lock();
        for notice in notices {
            let queue = queues.entry(notice.api.clone()).or_insert_with(|| {
                let queue = NoticeQueue::default();
                let more = queue.more.clone();
                tokio::spawn(deliver_notices(master.clone(), notice.api.clone(), more));
                queue
            });
            queue.push(notice);
        }
    }

    /// Returns the number of notices that the node's task has not taken yet.
    #[cfg(test)]
    pub(super) fn waiting(&self, api: &str) -> usize {
        self.queues.lock().get(api).map_or(0, |queue| queue.notices.len())
    }

    fn next(&self, api: &str) -> Option<Notice> {
        self.queues.lock().get_mut(api)?.notices.pop_front()
    }

    /// Puts a notice back unless a newer one of its subject was queued meanwhile.
    fn retry(&self, notice: Notice) {
        if let Some(queue) = self.queues.lock().get_mut(&notice.api) {
            let notices = &mut queue.notices;
            if notices.iter().all(|newer| newer.subject != notice.subject) {
                notices.push_front(notice);
            }
        }
    }

    /// Removes the node's queue if it is empty, or in any case if `even_if_full`; returns true if it was removed.
    fn finish(&self, api: &str, even_if_full: bool) -> bool {
        let mut queues = self.queues.lock();
        let done = even_if_full || queues.get(api).is_none_or(|queue| queue.notices.is_empty());
        if done {
            queues.remove(api);
        }
        done
    }
}

async fn deliver_notices(master: Arc<MasterCore>, api: String, more: Arc<Notify>) {
    let notifier = &master.notifier;
    let Ok(client) = XmlRpcClient::new(master.sockets(), &api) else {
        notifier.finish(&api, true);
        return;
    };
    let budget = &master.limits.budget;
    let client = client.with_budget(budget);
    let mut recovering = false;
    loop {
        let Some(notice) = notifier.next(&api) else {
            // Notices come in bursts: keep the connection for a moment.
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
                tracing::warn!(%api, method, %full, "the node was not notified");
                continue;
            }
        };
        match client.call(method, &notice.params, ANSWER).await {
            Ok(_) if recovering => {
                // The node may still process older calls that timed out: repeat this one so that it is the last.
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
                if notice.subject == Subject::Shutdown && source.kind() == ErrorKind::ConnectionRefused =>
            {
                // No process is left that could register again: a successor may be given the same port.
                master.state.lock().registry.forget_replaced_address(&api);
            }
            Err(error) => {
                // The node is gone (its process's exit will clean up), or it rejects the call.
                tracing::debug!(%api, method, %error, "the node was not notified");
            }
        }
    }
}
