//! Everything queued for one client: control messages first, then the topics in turn.
//!
//! It outlives the socket, so that what happened while the client was disconnected is sent when it comes back.

use std::sync::Arc;
use std::task::Waker;
use std::time::Instant;

use budget::{Budget, Exceeded, Permit};
use parking_lot::Mutex;
use ros::ring::{DropTally, Ring, RingBounds, RingItem};
use rosbridge::Compression;
use tokio::sync::watch;

use crate::sample::{EncodedFrame, TopicSample};
use crate::topic_queue::{SubscriptionOptions, TopicQueue};
pub(crate) use crate::topics::TopicKey;
use crate::topics::TopicQueues;
use crate::{BridgeOptions, Metrics};

/// An answer, a status, a call: must not be dropped, whatever its size.
#[derive(Debug, Clone)]
pub(crate) struct ControlMessage {
    pub(crate) frame: EncodedFrame,
    /// Maximum frame size; longer text frames are fragmented.
    pub(crate) fragment_size: Option<usize>,
    /// True for the answer to a call or a goal, which must reach the client even if this socket fails.
    pub(crate) answer: bool,
}

/// The next message to send.
pub(crate) enum Outgoing {
    Control(ControlMessage),
    Sample {
        key: TopicKey,
        sample: Arc<TopicSample>,
        topic: Arc<str>,
        compression: Compression,
        fragment_size: Option<usize>,
    },
}

/// Close code and reason for a client.
#[derive(Debug, Clone, PartialEq, Eq)]
pub(crate) struct CloseReason {
    pub(crate) code: u16,
    pub(crate) reason: String,
}

pub(crate) struct Outbox {
    queues: Mutex<OutboxQueues>,
    limits: OutboxLimits,
    metrics: Arc<Metrics>,
    /// Number of the socket attached last.
    attached: watch::Sender<u64>,
}

struct OutboxLimits {
    control: RingBounds,
    session_bytes: usize,
    topic: RingBounds,
}

struct OutboxQueues {
    control: Ring<ControlMessage>,
    /// Bytes of its frames that have no permit of their own.
    control_small: usize,
    topics: TopicQueues,
    /// Permit for small frames and samples.
    small: Permit,
    /// Permit for large samples, which count for the daemon by themselves: in the client's budget alone.
    big: Permit,
    goodbye: Option<CloseReason>,
    /// Number of the socket that sends, and its waker.
    socket: u64,
    waker: Option<Waker>,
}

impl Outbox {
    /// Creates the outbox of a client with this budget.
    pub(crate) fn new(options: &BridgeOptions, metrics: Arc<Metrics>, budget: &Budget) -> Self {
        let limits = OutboxLimits {
            control: RingBounds { messages: options.control_messages, bytes: options.control_bytes },
            session_bytes: options.session_bytes,
            topic: RingBounds { messages: options.topic_messages.max(1), bytes: options.topic_bytes },
        };
        Self { queues: Mutex::new(OutboxQueues::new(budget)), limits, metrics, attached: watch::Sender::default() }
    }

    /// Makes the caller's socket the one that sends, and wakes the previous one, which notices. Returns the caller's
    /// number.
    pub(crate) fn attach(&self) -> u64 {
        let mut queues = self.queues.lock();
        queues.socket += 1;
        // Messages that another socket has started to send in fragments end with it.
        queues.topics.release_all(Instant::now());
        queues.wake();
        self.attached.send_replace(queues.socket);
        queues.socket
    }

    /// Returns whether this socket is the one attached last.
    pub(crate) fn is_attached(&self, socket: u64) -> bool {
        self.queues.lock().socket == socket
    }

    /// Completes when a later socket is attached.
    pub(crate) async fn wait_for_takeover(&self, socket: u64) {
        let mut attached = self.attached.subscribe();
        // The sender lives as long as `self`.
        let _ = attached.wait_for(|latest| *latest != socket).await;
    }

    /// Returns whether this socket is still the one that sends; if so, `waker` is called when there is something to do.
    pub(crate) fn register(&self, socket: u64, waker: &Waker) -> bool {
        let mut queues = self.queues.lock();
        if queues.socket != socket {
            return false;
        }
        if !queues.waker.as_ref().is_some_and(|known| known.will_wake(waker)) {
            queues.waker = Some(waker.clone());
        }
        true
    }

    pub(crate) fn push_control(&self, control: ControlMessage) {
        let mut queues = self.queues.lock();
        let (waiting, limit) = (&queues.control, self.limits.control);
        let full = waiting.len() >= limit.messages
            || (!waiting.is_empty() && waiting.bytes() + control.memory_size() > limit.bytes);
        if full {
            let waiting = waiting.len();
            queues.goodbye.get_or_insert_with(|| CloseReason {
                code: 1008,
                reason: format!("{waiting} answers wait and none is read"),
            });
        } else {
            queues.control_small += control.small_bytes();
            queues.control.append(control);
            queues.count_control();
        }
        queues.wake();
    }

    /// Puts answers that were sent but possibly not received back at the front.
    pub(crate) fn requeue(&self, controls: impl DoubleEndedIterator<Item = ControlMessage>) {
        let mut queues = self.queues.lock();
        for control in controls.rev() {
            queues.control_small += control.small_bytes();
            queues.control.put_back(control);
        }
        queues.count_control();
        queues.wake();
    }

    pub(crate) fn control_len(&self) -> usize {
        self.queues.lock().control.len()
    }

    /// Ends the session with this reason, once the control queue has been sent.
    pub(crate) fn request_close(&self, goodbye: CloseReason) {
        let mut queues = self.queues.lock();
        queues.goodbye.get_or_insert(goodbye);
        queues.wake();
    }

    pub(crate) fn close_reason(&self) -> Option<CloseReason> {
        self.queues.lock().goodbye.clone()
    }

    pub(crate) fn add_topic(&self, topic: Arc<str>, wishes: SubscriptionOptions) -> TopicKey {
        let queue = TopicQueue::new(topic, wishes, self.limits.topic, self.metrics.drops.clone());
        self.queues.lock().topics.add(queue)
    }

    pub(crate) fn change_topic(&self, key: TopicKey, wishes: SubscriptionOptions) {
        let mut queues = self.queues.lock();
        queues.topics.update(key, |queue| queue.wishes = wishes);
        queues.topics.reschedule(key, Instant::now());
        queues.wake();
    }

    pub(crate) fn remove_topic(&self, key: TopicKey) {
        let mut queues = self.queues.lock();
        queues.topics.remove(key);
        let _ = queues.count_bytes();
    }

    pub(crate) fn push_sample(&self, key: TopicKey, sample: Arc<TopicSample>, replay: bool) {
        let now = Instant::now();
        let mut queues = self.queues.lock();
        let queues = &mut *queues;
        let push = |queue: &mut TopicQueue| queue.push(sample, replay, now);
        let mut lost = match queues.topics.update(key, push) {
            Some(Some(lost)) => lost,
            Some(None) => return self.metrics.throttled.add(1),
            None => return,
        };
        // Messages of the client are dropped for each other, beyond its queues' limits and beyond its budget.
        while let Some(one) = queues.topics.drop_over_limit(self.limits.session_bytes) {
            lost += one;
        }
        while let Some(one) = queues.drop_over_budget() {
            lost += one;
        }
        self.metrics.record_lost(lost);
        queues.topics.schedule(key, now);
        queues.wake();
    }

    /// Called when this socket has sent the last fragment of a message of this topic.
    pub(crate) fn release_topic(&self, socket: u64, key: TopicKey) {
        let mut queues = self.queues.lock();
        if queues.socket == socket {
            queues.topics.release(key, Instant::now());
        }
    }

    /// Holds back further messages of this topic until [`release_topic`](Self::release_topic).
    pub(crate) fn hold_topic(&self, socket: u64, key: TopicKey) {
        let mut queues = self.queues.lock();
        if queues.socket == socket {
            queues.topics.hold(key);
        }
    }

    /// Returns whether it is time to report again that messages of a topic cannot be sent.
    pub(crate) fn should_report(&self, key: TopicKey, now: Instant) -> bool {
        let may = |queue: &mut TopicQueue| queue.should_report(now);
        let mut queues = self.queues.lock();
        queues.topics.update(key, may).unwrap_or(false)
    }

    pub(crate) fn next(&self, now: Instant) -> Option<Outgoing> {
        let mut queues = self.queues.lock();
        if let Some(control) = queues.pop_control() {
            return Some(Outgoing::Control(control));
        }
        let (key, sample, queue) = queues.topics.next(now)?;
        let SubscriptionOptions { compression, fragment_size, .. } = queue.wishes;
        let topic = queue.topic.clone();
        // Shrinking always succeeds.
        let _ = queues.count_bytes();
        Some(Outgoing::Sample { key, sample, topic, compression, fragment_size })
    }

    /// Takes the next control message only, before the connection is closed.
    pub(crate) fn next_control(&self) -> Option<ControlMessage> {
        self.next_control_if(|_| true)
    }

    /// Takes the next control message, if `fits` accepts it.
    pub(crate) fn next_control_if(&self, fits: impl Fn(&ControlMessage) -> bool) -> Option<ControlMessage> {
        let mut queues = self.queues.lock();
        if !fits(queues.control.front()?) {
            return None;
        }
        queues.pop_control()
    }

    /// Returns when a throttle rate lets the next queued message through.
    pub(crate) fn next_due(&self) -> Option<Instant> {
        self.queues.lock().topics.next_due()
    }
}

impl ControlMessage {
    /// Returns its bytes, unless they have a permit of their own.
    pub(crate) fn small_bytes(&self) -> usize {
        if self.frame.is_big() { 0 } else { self.frame.bytes.len() }
    }
}

impl RingItem for ControlMessage {
    fn memory_size(&self) -> usize {
        self.frame.bytes.len()
    }
}

impl OutboxQueues {
    fn new(budget: &Budget) -> Self {
        Self {
            control: Ring::default(),
            control_small: 0,
            topics: TopicQueues::default(),
            small: budget.permit(),
            big: budget.without_parents().permit(),
            goodbye: None,
            socket: 0,
            waker: None,
        }
    }

    /// Counts the queues in the client's budget.
    fn count_bytes(&mut self) -> Result<(), Exceeded> {
        let load = self.topics.load();
        self.big.count(load.big)?;
        self.small.count(self.control_small + load.bytes - load.big)
    }

    /// Drops a message if the queues do not fit into the client's budget, or, where more than one of a topic waits,
    /// leave less than an eighth of it for what the client sends.
    fn drop_over_budget(&mut self) -> Option<DropTally> {
        if self.count_bytes().is_err() {
            return self.topics.drop_largest(|_| true);
        }
        let budget = self.big.budget();
        let is_crowded = budget.used_bytes() > budget.limit() - budget.limit() / 8;
        is_crowded.then(|| self.topics.drop_largest(|queue| !queue.has_at_most_one())).flatten()
    }

    /// Counts the queues after a control message was added; since these cannot be dropped, the session ends if there is
    /// no room.
    fn count_control(&mut self) {
        if let Err(full) = self.count_bytes() {
            let waiting = self.control.len();
            self.goodbye.get_or_insert_with(|| CloseReason {
                code: 1013,
                reason: format!("{waiting} answers wait to be read: {full}"),
            });
        }
    }

    fn pop_control(&mut self) -> Option<ControlMessage> {
        let control = self.control.pop()?;
        self.control_small -= control.small_bytes();
        // Shrinking always succeeds.
        let _ = self.count_bytes();
        Some(control)
    }

    fn wake(&mut self) {
        if let Some(waker) = self.waker.take() {
            waker.wake();
        }
    }
}

#[cfg(test)]
#[path = "outbox_tests.rs"]
mod tests;
