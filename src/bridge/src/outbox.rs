//! Everything that waits to be sent to one client: control first, then the topics in turn.
//!
//! It outlives the socket, so that what happened while the client was away is there when it comes back.

use std::collections::{BTreeSet, HashMap, VecDeque};
use std::sync::Arc;
use std::task::Waker;
use std::time::Instant;

use budget::{Budget, Exceeded, Permit};
use parking_lot::Mutex;
use rosbridge::Compression;
use tokio::sync::watch;

use crate::sample::{Frame, Sample};
use crate::topic_queue::{Pushed, QueueLimits, TopicQueue, Wishes};
use crate::{BridgeOptions, Metrics};

/// Names one topic of one client.
pub(crate) type TopicKey = u64;

/// An answer, a status, a call: small or not, none may be lost.
#[derive(Debug, Clone)]
pub(crate) struct Control {
    pub(crate) frame: Frame,
    /// Longer text frames are cut.
    pub(crate) fragment_size: Option<usize>,
    /// Must reach the client even if this socket fails: the answer to a call or a goal.
    pub(crate) answer: bool,
}

/// The next thing to send.
pub(crate) enum Outgoing {
    Control(Control),
    Sample {
        key: TopicKey,
        sample: Arc<Sample>,
        topic: Arc<str>,
        compression: Compression,
        fragment_size: Option<usize>,
    },
}

/// Why a client is to be told goodbye.
#[derive(Debug, Clone, PartialEq, Eq)]
pub(crate) struct Goodbye {
    pub(crate) code: u16,
    pub(crate) reason: String,
}

pub(crate) struct Outbox {
    queues: Mutex<Queues>,
    limits: Limits,
    metrics: Arc<Metrics>,
    /// The number of the socket attached last.
    attached: watch::Sender<u64>,
}

struct Limits {
    control_messages: usize,
    control_bytes: usize,
    session_bytes: usize,
    topic: QueueLimits,
}

struct Queues {
    control: VecDeque<Control>,
    control_bytes: usize,
    /// Of those, bytes of frames that have no permit of their own.
    control_small: usize,
    /// For small frames and samples.
    small: Permit,
    /// For big samples, which count for the daemon by themselves: in the client's budget alone.
    big: Permit,
    topics: HashMap<TopicKey, TopicQueue>,
    next_key: TopicKey,
    /// Topics with something to send, in turn.
    ready: VecDeque<TopicKey>,
    /// Topics whose throttle rate holds them back, by when.
    later: BTreeSet<(Instant, TopicKey)>,
    bytes: usize,
    /// Of those, bytes of big samples.
    big_bytes: usize,
    goodbye: Option<Goodbye>,
    /// Which socket sends, and how to wake it.
    socket: u64,
    waker: Option<Waker>,
}

impl Outbox {
    /// For a client with this budget.
    pub(crate) fn new(options: &BridgeOptions, metrics: Arc<Metrics>, budget: &Budget) -> Self {
        let limits = Limits {
            control_messages: options.control_messages,
            control_bytes: options.control_bytes,
            session_bytes: options.session_bytes,
            topic: QueueLimits {
                messages: options.topic_messages.max(1),
                bytes: options.topic_bytes,
            },
        };
        Self {
            queues: Mutex::new(Queues::new(budget)),
            limits,
            metrics,
            attached: watch::Sender::default(),
        }
    }

    /// Makes the caller the one that sends; whoever did before is woken and finds out. Gives the caller's number.
    pub(crate) fn attach(&self) -> u64 {
        let mut queues = self.queues.lock();
        queues.socket += 1;
        queues.wake();
        self.attached.send_replace(queues.socket);
        queues.socket
    }

    /// Whether that socket is still the one that sends, or was the last one.
    pub(crate) fn is_attached(&self, socket: u64) -> bool {
        self.queues.lock().socket == socket
    }

    /// Ready when a later socket has been attached.
    pub(crate) async fn taken_over(&self, socket: u64) {
        let mut attached = self.attached.subscribe();
        // The sender lives as long as `self`.
        let _ = attached.wait_for(|latest| *latest != socket).await;
    }

    /// Whether that socket is still the one that sends; if so, `waker` is called when there is something to do.
    pub(crate) fn register(&self, socket: u64, waker: &Waker) -> bool {
        let mut queues = self.queues.lock();
        if queues.socket != socket {
            return false;
        }
        if !queues
            .waker
            .as_ref()
            .is_some_and(|known| known.will_wake(waker))
        {
            queues.waker = Some(waker.clone());
        }
        true
    }

    pub(crate) fn control(&self, control: Control) {
        let mut queues = self.queues.lock();
        let length = queues.control_bytes + control.frame.bytes.len();
        let full = queues.control.len() >= self.limits.control_messages
            || (length > self.limits.control_bytes && !queues.control.is_empty());
        if full {
            let waiting = queues.control.len();
            queues.goodbye.get_or_insert_with(|| Goodbye {
                code: 1008,
                reason: format!("{waiting} answers wait and none is read"),
            });
        } else {
            queues.control_bytes = length;
            queues.control_small += control.small();
            queues.control.push_back(control);
            queues.count_control();
        }
        queues.wake();
    }

    /// Answers that were sent but perhaps not received: they go first again.
    pub(crate) fn again(&self, controls: impl DoubleEndedIterator<Item = Control>) {
        let mut queues = self.queues.lock();
        for control in controls.rev() {
            queues.control_bytes += control.frame.bytes.len();
            queues.control_small += control.small();
            queues.control.push_front(control);
        }
        queues.count_control();
        queues.wake();
    }

    pub(crate) fn control_waiting(&self) -> usize {
        self.queues.lock().control.len()
    }

    /// The session is to end with these words, once what waits in the control queue has been sent.
    pub(crate) fn say_goodbye(&self, goodbye: Goodbye) {
        let mut queues = self.queues.lock();
        queues.goodbye.get_or_insert(goodbye);
        queues.wake();
    }

    pub(crate) fn goodbye(&self) -> Option<Goodbye> {
        self.queues.lock().goodbye.clone()
    }

    pub(crate) fn add_topic(&self, topic: Arc<str>, wishes: Wishes) -> TopicKey {
        let mut queues = self.queues.lock();
        queues.next_key += 1;
        let key = queues.next_key;
        queues
            .topics
            .insert(key, TopicQueue::new(topic, wishes, self.limits.topic));
        key
    }

    pub(crate) fn change_topic(&self, key: TopicKey, wishes: Wishes) {
        let mut queues = self.queues.lock();
        let queues = &mut *queues;
        if let Some(queue) = queues.topics.get_mut(&key) {
            queue.wishes = wishes;
            if queue.scheduled {
                queues.later.retain(|(_, other)| *other != key);
                queues.ready.retain(|other| *other != key);
                queue.scheduled = false;
            }
            queues.schedule(key, Instant::now());
            queues.wake();
        }
    }

    pub(crate) fn remove_topic(&self, key: TopicKey) {
        let mut queues = self.queues.lock();
        if let Some(queue) = queues.topics.remove(&key) {
            queues.bytes -= queue.bytes;
            queues.big_bytes -= queue.big;
            let _ = queues.count();
            queues.ready.retain(|other| *other != key);
            queues.later.retain(|(_, other)| *other != key);
        }
    }

    pub(crate) fn sample(&self, key: TopicKey, sample: Arc<Sample>, replay: bool) {
        let now = Instant::now();
        let mut queues = self.queues.lock();
        let queues = &mut *queues;
        let Some(queue) = queues.topics.get_mut(&key) else {
            return;
        };
        let before = (queue.bytes, queue.big);
        let Pushed {
            throttled,
            mut dropped,
            mut dropped_bytes,
        } = queue.push(sample, replay, now);
        if throttled {
            self.metrics.throttled.add(1);
            return;
        }
        queues.bytes = queues.bytes + queue.bytes - before.0;
        queues.big_bytes = queues.big_bytes + queue.big - before.1;
        // The client's own messages give way to each other, beyond its queues' limits and beyond its budget.
        while let Some(lost) = queues.give_way(self.limits.session_bytes) {
            dropped += 1;
            dropped_bytes += lost;
        }
        while queues.count().is_err() {
            let Some(lost) = queues.drop_largest(|_| true) else {
                break;
            };
            dropped += 1;
            dropped_bytes += lost;
        }
        if dropped > 0 {
            self.metrics.dropped.add(dropped);
            self.metrics.dropped_bytes.add(dropped_bytes as u64);
        }
        queues.schedule(key, now);
        queues.wake();
    }

    /// A message of that topic has been sent to its last fragment.
    pub(crate) fn fragments_sent(&self, key: TopicKey) {
        let mut queues = self.queues.lock();
        if let Some(queue) = queues.topics.get_mut(&key) {
            queue.busy = false;
            queues.schedule(key, Instant::now());
        }
    }

    /// No message of that topic is to be given out before [`fragments_sent`](Self::fragments_sent).
    pub(crate) fn sending_fragments(&self, key: TopicKey) {
        let mut queues = self.queues.lock();
        let queues = &mut *queues;
        if let Some(queue) = queues.topics.get_mut(&key) {
            queue.busy = true;
            if queue.scheduled {
                queue.scheduled = false;
                queues.ready.retain(|other| *other != key);
                queues.later.retain(|(_, other)| *other != key);
            }
        }
    }

    /// A topic's messages cannot be sent; gives whether it is time to say so again.
    pub(crate) fn may_complain(&self, key: TopicKey, now: Instant) -> bool {
        let mut queues = self.queues.lock();
        let Some(queue) = queues.topics.get_mut(&key) else {
            return false;
        };
        let due = queue
            .complained
            .is_none_or(|at| now.saturating_duration_since(at).as_secs() >= 5);
        if due {
            queue.complained = Some(now);
        }
        due
    }

    pub(crate) fn next(&self, now: Instant) -> Option<Outgoing> {
        let mut queues = self.queues.lock();
        let queues = &mut *queues;
        if let Some(control) = queues.pop_control() {
            return Some(Outgoing::Control(control));
        }
        queues.wake_up_later(now);
        loop {
            let key = queues.ready.pop_front()?;
            let Some(queue) = queues.topics.get_mut(&key) else {
                continue;
            };
            queue.scheduled = false;
            let before = (queue.bytes, queue.big);
            let Some(sample) = queue.pop(now) else {
                continue;
            };
            queues.bytes -= before.0 - queue.bytes;
            queues.big_bytes -= before.1 - queue.big;
            let Wishes {
                compression,
                fragment_size,
                ..
            } = queue.wishes;
            let topic = queue.topic.clone();
            queues.schedule(key, now);
            // Less always fits.
            let _ = queues.count();
            return Some(Outgoing::Sample {
                key,
                sample,
                topic,
                compression,
                fragment_size,
            });
        }
    }

    /// The next control message only: for the last words before goodbye.
    pub(crate) fn next_control(&self) -> Option<Control> {
        self.next_control_if(|_| true)
    }

    /// The next control message, if it is one of those that `fits`.
    pub(crate) fn next_control_if(&self, fits: impl Fn(&Control) -> bool) -> Option<Control> {
        let mut queues = self.queues.lock();
        if !fits(queues.control.front()?) {
            return None;
        }
        queues.pop_control()
    }

    /// When a throttle rate lets something through that now waits.
    pub(crate) fn next_due(&self) -> Option<Instant> {
        self.queues.lock().later.first().map(|(at, _)| *at)
    }
}

impl Control {
    /// Its bytes, unless they have a permit of their own.
    pub(crate) fn small(&self) -> usize {
        match self.frame.is_big() {
            true => 0,
            false => self.frame.bytes.len(),
        }
    }
}

impl Queues {
    fn new(budget: &Budget) -> Self {
        Self {
            control: VecDeque::new(),
            control_bytes: 0,
            control_small: 0,
            small: budget.permit(),
            big: budget.alone().permit(),
            topics: HashMap::new(),
            next_key: 0,
            ready: VecDeque::new(),
            later: BTreeSet::new(),
            bytes: 0,
            big_bytes: 0,
            goodbye: None,
            socket: 0,
            waker: None,
        }
    }

    /// Counts what waits in the client's budget.
    fn count(&mut self) -> Result<(), Exceeded> {
        self.big.count(self.big_bytes)?;
        let small = self.control_small + self.bytes - self.big_bytes;
        self.small.count(small)
    }

    /// The same after a control message came, of which none may be dropped.
    fn count_control(&mut self) {
        if let Err(full) = self.count() {
            let waiting = self.control.len();
            self.goodbye.get_or_insert_with(|| Goodbye {
                code: 1013,
                reason: format!("{waiting} answers wait to be read: {full}"),
            });
        }
    }

    fn pop_control(&mut self) -> Option<Control> {
        let control = self.control.pop_front()?;
        self.control_bytes -= control.frame.bytes.len();
        self.control_small -= control.small();
        // Less always fits.
        let _ = self.count();
        Some(control)
    }

    fn wake(&mut self) {
        if let Some(waker) = self.waker.take() {
            waker.wake();
        }
    }

    /// Drops a sample of the topic that holds most while there is more than `limit` in all. A topic's only message
    /// is spared up to four times that: a map larger than the limit must get through, too.
    fn give_way(&mut self, limit: usize) -> Option<usize> {
        if self.bytes <= limit {
            return None;
        }
        let spare_only =
            self.bytes <= limit.saturating_mul(4) || self.bytes == self.largest_bytes();
        self.drop_largest(|queue| !(spare_only && queue.has_one()))
    }

    /// Drops a sample of the topic that holds most, of those that `may` lose one; gives its bytes.
    fn drop_largest(&mut self, may: impl Fn(&TopicQueue) -> bool) -> Option<usize> {
        let candidates = self.topics.values_mut().filter(|queue| may(queue));
        let queue = candidates.max_by_key(|queue| queue.bytes)?;
        let before = queue.big;
        let lost = queue.drop_one()?;
        self.big_bytes -= before - queue.big;
        self.bytes -= lost;
        Some(lost)
    }

    fn largest_bytes(&self) -> usize {
        self.topics
            .values()
            .map(|queue| queue.bytes)
            .max()
            .unwrap_or(0)
    }

    fn schedule(&mut self, key: TopicKey, now: Instant) {
        let Some(queue) = self.topics.get_mut(&key) else {
            return;
        };
        if queue.scheduled {
            return;
        }
        let Some(due) = queue.due(now) else { return };
        queue.scheduled = true;
        if due <= now {
            self.ready.push_back(key);
        } else {
            self.later.insert((due, key));
        }
    }

    fn wake_up_later(&mut self, now: Instant) {
        while let Some((at, key)) = self.later.first().copied().filter(|(at, _)| *at <= now) {
            self.later.remove(&(at, key));
            self.ready.push_back(key);
        }
    }
}

#[cfg(test)]
#[path = "outbox_tests.rs"]
mod tests;
