//! One output on the robot: its publisher, and the latched messages for new subscribers.
//!
//! ```text
//!  ROS 1: it is not known in advance whether messages are latched. A second, latching advertisement is made when a
//!         latched message arrives.
//!  ROS 2: the quality of service of the node says it. There is one advertisement, which is transient-local from the
//!         start; another one replaces it when the messages that it keeps are outdated.
//! ```

use std::sync::Arc;
use std::sync::atomic::{AtomicUsize, Ordering};

use bytes::Bytes;
use link::control::OutputChannel;
use parking_lot::Mutex;
use qos::Responder;
use ros::bus::{Bus, BusError, PeerId, Publisher, QosProfile, WireType};
use ros::ring::{Ring, RingBounds};
use tokio::sync::Notify;
use tokio::task::AbortHandle;

/// Queue length for a slow subscriber, in messages.
const QUEUE: usize = 256;
/// Log topic of a ROS 2 node, which keeps as many messages for late subscribers as its queue holds. Other outputs keep
/// as many as the node does, once the cloud has told; before that one, since a latched message is usually a state.
const LOG: &str = "/rosout";

/// An advertised output.
pub(super) struct OutputTopic {
    pub(super) name: String,
    /// The output as the cloud reported it.
    told: OutputChannel,
    pub(super) wire_type: Arc<WireType>,
    /// Publisher id of messages from the cloud.
    pub(super) cloud: PeerId,
    pub(super) channel: Mutex<u32>,
    qos: QosProfile,
    publisher: Mutex<Arc<dyn Publisher>>,
    latched: Mutex<LatchedOutput>,
    /// Number of messages that late subscribers are given by a transient-local advertisement.
    kept: AtomicUsize,
    /// Number of subscribers on the robot, without other nodes of the servant.
    pub(super) listeners: AtomicUsize,
    /// Notified when another advertisement must be made.
    pub(super) news: Arc<Notify>,
    pub(super) counting: Mutex<Option<AbortHandle>>,
}

/// Latched messages for new subscribers: the last one of the side (cloud or local original) that speaks for the node.
#[derive(Default)]
struct LatchedOutput {
    /// Last latched message of each side. The cloud's is kept only while there are subscribers: without any the cloud
    /// sends nothing, and the message would become outdated.
    last: [Option<Bytes>; 2],
    advertised: LatchedAdvertisement,
    /// Set if a transient-local advertisement keeps a message.
    kept: bool,
    /// Number of messages dropped by former advertisements, and before there was one.
    dropped: u64,
}

/// Advertisement of the latched messages.
#[derive(Default)]
enum LatchedAdvertisement {
    /// No difference from other messages.
    #[default]
    Plainly,
    /// An advertisement for them has been requested; messages are queued until it is made.
    Asked(Ring<Bytes>),
    /// A second advertisement besides the plain one.
    Beside(Box<dyn Publisher>),
}

impl LatchedOutput {
    fn set_advertised(&mut self, advertised: LatchedAdvertisement) {
        if let LatchedAdvertisement::Beside(ended) = std::mem::replace(&mut self.advertised, advertised) {
            self.dropped += ended.dropped_count();
        }
    }
}

impl OutputTopic {
    /// Advertises an output with the quality of service that its node offers.
    pub(super) async fn advertise(bus: &dyn Bus, told: &OutputChannel, of: WireType) -> Result<Self, BusError> {
        let qos = match &told.qos {
            Some(qos) => qos.to_bus(QUEUE),
            None => QosProfile::keep_last(QUEUE),
        };
        let publisher = bus.advertise(&told.topic, of.clone(), qos).await?;
        let topic = Self {
            name: told.topic.clone(),
            told: told.clone(),
            wire_type: Arc::new(of),
            cloud: "cloud".into(),
            channel: Mutex::new(told.channel),
            qos,
            publisher: Mutex::new(publisher.into()),
            latched: Mutex::default(),
            kept: AtomicUsize::new(1),
            listeners: AtomicUsize::new(0),
            news: Arc::default(),
            counting: Mutex::default(),
        };
        topic.apply_kept(&*topic.publisher());
        Ok(topic)
    }

    /// Sets the number of messages that late subscribers are given, as the node does.
    pub(super) fn set_kept(&self, messages: usize) {
        self.kept.store(messages.clamp(1, QUEUE), Ordering::Relaxed);
        self.apply_kept(&*self.publisher());
    }

    fn apply_kept(&self, publisher: &dyn Publisher) {
        if self.qos.is_latching() && self.name != LOG {
            publisher.set_kept(self.kept.load(Ordering::Relaxed));
        }
    }

    /// Returns whether the reported output matches the advertised one.
    pub(super) fn matches_output(&self, told: &OutputChannel) -> bool {
        self.told.md5 == told.md5 && self.told.qos == told.qos
    }

    /// Returns the publisher of messages that are not latched, which also tracks the subscribers.
    pub(super) fn publisher(&self) -> Arc<dyn Publisher> {
        Arc::clone(&self.publisher.lock())
    }

    /// Returns the number of messages dropped because subscribers were too slow.
    pub(super) fn dropped_count(&self) -> u64 {
        let latched = self.latched.lock();
        let beside = match &latched.advertised {
            LatchedAdvertisement::Beside(publisher) => publisher.dropped_count(),
            _ => 0,
        };
        self.publisher().dropped_count() + latched.dropped + beside
    }

    /// Handles a message that a side has published; `heard` is set if that side speaks for the node.
    pub(super) fn on_message(&self, side: Responder, message: Bytes, latching: bool, heard: bool) {
        let mut latched = self.latched.lock();
        // A log line is no state that the next side to speak should repeat.
        let latching = latching && self.name != LOG;
        if latching {
            latched.last[side.index()] = Some(message.clone());
        }
        if heard {
            self.publish(&mut latched, message, latching);
        }
    }

    fn publish(&self, latched: &mut LatchedOutput, message: Bytes, latching: bool) {
        match &mut latched.advertised {
            LatchedAdvertisement::Beside(publisher) => publisher.publish(message),
            LatchedAdvertisement::Asked(waiting) => {
                latched.dropped += waiting.push(message).messages;
            }
            LatchedAdvertisement::Plainly if latching && !self.qos.is_latching() => {
                let mut waiting = Ring::new(RingBounds::with_messages(QUEUE));
                latched.dropped += waiting.push(message).messages;
                self.request_advertisement(latched, waiting);
            }
            LatchedAdvertisement::Plainly => {
                latched.kept = self.qos.is_latching();
                self.publisher().publish(message);
            }
        }
    }

    fn request_advertisement(&self, latched: &mut LatchedOutput, waiting: Ring<Bytes>) {
        latched.set_advertised(LatchedAdvertisement::Asked(waiting));
        self.news.notify_one();
    }

    /// Discards the messages that new subscribers would receive.
    fn discard_latched(&self, latched: &mut LatchedOutput) {
        if !self.qos.is_latching() {
            latched.set_advertised(LatchedAdvertisement::Plainly);
        } else if std::mem::take(&mut latched.kept) {
            self.request_advertisement(latched, Ring::new(RingBounds::with_messages(QUEUE)));
        }
    }

    /// Sets the side that speaks for the node from now on.
    pub(super) fn set_active_side(&self, side: Responder) {
        let mut latched = self.latched.lock();
        match latched.last[side.index()].clone() {
            Some(message) => self.publish(&mut latched, message, true),
            // The cloud will be asked when there is a subscriber; until it has latched something, the last message
            // stays.
            None if side == Responder::Cloud && self.listeners.load(Ordering::Relaxed) == 0 => {
                self.discard_latched(&mut latched);
            }
            None => {}
        }
    }

    /// Handles the end of the local original, whose latched message is discarded.
    pub(super) fn on_local_ended(&self) {
        self.latched.lock().last[Responder::Local.index()] = None;
    }

    /// Handles the loss of the last subscriber.
    pub(super) fn on_no_subscribers(&self, local_speaks: bool) {
        let mut latched = self.latched.lock();
        latched.last[Responder::Cloud.index()] = None;
        let kept = local_speaks && latched.last[Responder::Local.index()].is_some();
        if !kept {
            self.discard_latched(&mut latched);
        }
    }

    /// Makes a requested advertisement, before the next subscriber. Returns whether it replaced the plain one.
    pub(super) async fn advertise_pending(&self, bus: &dyn Bus) -> bool {
        if !matches!(self.latched.lock().advertised, LatchedAdvertisement::Asked(_)) {
            return false;
        }
        let wire_type = WireType::clone(&self.wire_type);
        let replaces = self.qos.is_latching();
        let qos = if replaces { self.qos } else { self.qos.latching(true) };
        let advertised = bus.advertise(&self.name, wire_type, qos).await;
        let advertised = advertised.inspect_err(|error| {
            tracing::warn!(topic = self.name, %error, "new subscribers do not get latched messages");
        });
        let mut latched = self.latched.lock();
        let LatchedAdvertisement::Asked(waiting) = &mut latched.advertised else {
            return false;
        };
        let waiting: Vec<Bytes> = waiting.collect();
        latched.kept = replaces && !waiting.is_empty();
        // Without an advertisement the messages are published all the same; the next latched message requests it again.
        let (publisher, next) = match advertised {
            Ok(fresh) if replaces => {
                let fresh: Arc<dyn Publisher> = fresh.into();
                self.apply_kept(&*fresh);
                let before = std::mem::replace(&mut *self.publisher.lock(), Arc::clone(&fresh));
                latched.dropped += before.dropped_count();
                (fresh, LatchedAdvertisement::Plainly)
            }
            Ok(beside) => {
                for message in waiting {
                    beside.publish(message);
                }
                latched.set_advertised(LatchedAdvertisement::Beside(beside));
                return false;
            }
            Err(_) => (self.publisher(), LatchedAdvertisement::Plainly),
        };
        for message in waiting {
            publisher.publish(message);
        }
        latched.set_advertised(next);
        replaces
    }
}

impl Drop for OutputTopic {
    fn drop(&mut self) {
        if let Some(counting) = self.counting.lock().take() {
            counting.abort();
        }
    }
}
