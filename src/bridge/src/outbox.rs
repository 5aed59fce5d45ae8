//! Everything that waits to be sent to one client: control first, then the topics in turn.
//!
//! It outlives the socket, so that what happened while the client was away is there when it comes back.

use std::sync::Arc;
use std::task::Waker;
use std::time::Instant;

use budget::{Budget, Exceeded, Permit};
use parking_lot::Mutex;
use ros::ring::{Bounds, Held, Ring};
use rosbridge::Compression;
use tokio::sync::watch;

use crate::sample::{Frame, Sample};
use crate::topic_queue::{TopicQueue, Wishes};
pub(crate) use crate::topics::TopicKey;
use crate::topics::Topics;
use crate::{BridgeOptions, Metrics};

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
    control: Bounds,
    session_bytes: usize,
    topic: Bounds,
}

struct Queues {
    control: Ring<Control>,
    /// Bytes of its frames that have no permit of their own.
    control_small: usize,
    topics: Topics,
    /// For small frames and samples.
    small: Permit,
    /// For big samples, which count for the daemon by themselves: in the client's budget alone.
    big: Permit,
    goodbye: Option<Goodbye>,
    /// Which socket sends, and how to wake it.
    socket: u64,
    waker: Option<Waker>,
}

impl Outbox {
    /// For a client with this budget.
    pub(crate) fn new(options: &BridgeOptions, metrics: Arc<Metrics>, budget: &Budget) -> Self {
        let limits = Limits {
            control: Bounds {
                messages: options.control_messages,
                bytes: options.control_bytes,
            },
            session_bytes: options.session_bytes,
            topic: Bounds {
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
        // What another socket has begun to send in fragments ends with it.
        queues.topics.release_all(Instant::now());
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
        let (waiting, limit) = (&queues.control, self.limits.control);
        let full = waiting.len() >= limit.messages
            || (!waiting.is_empty() && waiting.bytes() + control.held() > limit.bytes);
        if full {
            let waiting = waiting.len();
            queues.goodbye.get_or_insert_with(|| Goodbye {
                code: 1008,
                reason: format!("{waiting} answers wait and none is read"),
            });
        } else {
            queues.control_small += control.small();
            queues.control.append(control);
            queues.count_control();
        }
        queues.wake();
    }

    /// Answers that were sent but perhaps not received: they go first again.
    pub(crate) fn again(&self, controls: impl DoubleEndedIterator<Item = Control>) {
        let mut queues = self.queues.lock();
        for control in controls.rev() {
            queues.control_small += control.small();
            queues.control.put_back(control);
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
        let queue = TopicQueue::new(topic, wishes, self.limits.topic, self.metrics.drops.clone());
        self.queues.lock().topics.add(queue)
    }

    pub(crate) fn change_topic(&self, key: TopicKey, wishes: Wishes) {
        let mut queues = self.queues.lock();
        queues.topics.change(key, |queue| queue.wishes = wishes);
        queues.topics.reschedule(key, Instant::now());
        queues.wake();
    }

    pub(crate) fn remove_topic(&self, key: TopicKey) {
        let mut queues = self.queues.lock();
        queues.topics.remove(key);
        let _ = queues.count();
    }

    pub(crate) fn sample(&self, key: TopicKey, sample: Arc<Sample>, replay: bool) {
        let now = Instant::now();
        let mut queues = self.queues.lock();
        let queues = &mut *queues;
        let push = |queue: &mut TopicQueue| queue.push(sample, replay, now);
        let mut lost = match queues.topics.change(key, push) {
            Some(Some(lost)) => lost,
            Some(None) => return self.metrics.throttled.add(1),
            None => return,
        };
        // The client's own messages give way to each other, beyond its queues' limits and beyond its budget.
        while let Some(one) = queues.topics.give_way(self.limits.session_bytes) {
            lost += one;
        }
        while queues.count().is_err() {
            let Some(one) = queues.topics.drop_largest(|_| true) else {
                break;
            };
            lost += one;
        }
        self.metrics.lost(lost);
        queues.topics.schedule(key, now);
        queues.wake();
    }

    /// That socket has sent a message of that topic to its last fragment.
    pub(crate) fn fragments_sent(&self, socket: u64, key: TopicKey) {
        let mut queues = self.queues.lock();
        if queues.socket == socket {
            queues.topics.release(key, Instant::now());
        }
    }

    /// No message of that topic is to be given out before [`fragments_sent`](Self::fragments_sent).
    pub(crate) fn sending_fragments(&self, socket: u64, key: TopicKey) {
        let mut queues = self.queues.lock();
        if queues.socket == socket {
            queues.topics.hold(key);
        }
    }

    /// A topic's messages cannot be sent; gives whether it is time to say so again.
    pub(crate) fn may_complain(&self, key: TopicKey, now: Instant) -> bool {
        let may = |queue: &mut TopicQueue| queue.may_complain(now);
        let mut queues = self.queues.lock();
        queues.topics.change(key, may).unwrap_or(false)
    }

    pub(crate) fn next(&self, now: Instant) -> Option<Outgoing> {
        let mut queues = self.queues.lock();
        if let Some(control) = queues.pop_control() {
            return Some(Outgoing::Control(control));
        }
        let (key, sample, queue) = queues.topics.next(now)?;
        let Wishes {
            compression,
            fragment_size,
            ..
        } = queue.wishes;
        let topic = queue.topic.clone();
        // Less always fits.
        let _ = queues.count();
        Some(Outgoing::Sample {
            key,
            sample,
            topic,
            compression,
            fragment_size,
        })
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
        self.queues.lock().topics.next_due()
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

impl Held for Control {
    fn held(&self) -> usize {
        self.frame.bytes.len()
    }
}

impl Queues {
    fn new(budget: &Budget) -> Self {
        Self {
            control: Ring::unbounded(),
            control_small: 0,
            topics: Topics::default(),
            small: budget.permit(),
            big: budget.alone().permit(),
            goodbye: None,
            socket: 0,
            waker: None,
        }
    }

    /// Counts what waits in the client's budget.
    fn count(&mut self) -> Result<(), Exceeded> {
        let load = self.topics.load();
        self.big.count(load.big)?;
        self.small.count(self.control_small + load.bytes - load.big)
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
        let control = self.control.pop()?;
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
}

#[cfg(test)]
#[path = "outbox_tests.rs"]
mod tests;
