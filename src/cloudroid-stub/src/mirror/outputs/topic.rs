//! One output: who publishes it on the robot, and what newcomers among its subscribers are given.
//!
//! ```text
//!  ROS 1: nobody says beforehand what is latched. A second advertisement, which latches, is made when a latched message comes.
//!  ROS 2: a node's quality of service says it. There is one advertisement, which is transient-local from the start; another one
//!         takes its place when what it keeps has grown old.
//! ```

use std::sync::Arc;
use std::sync::atomic::{AtomicUsize, Ordering};

use bytes::Bytes;
use link::control::Output;
use parking_lot::Mutex;
use qos::Side;
use ros::bus::{Bus, BusError, PeerId, Publisher, Qos, WireType};
use ros::ring::{Bounds, Ring};
use tokio::sync::Notify;
use tokio::task::AbortHandle;

/// Messages kept for a slow subscriber.
const QUEUE: usize = 256;
/// Of a node of ROS 2: what it prints, for those who come late, too. Others keep one message for newcomers: how many does not
/// travel, and what is latched is mostly a state.
const LOG: &str = "/rosout";

/// An output that is advertised.
pub(super) struct Topic {
    pub(super) name: String,
    /// As it was told.
    told: Output,
    pub(super) wire_type: Arc<WireType>,
    /// Who publishes what comes from the cloud.
    pub(super) cloud: PeerId,
    pub(super) channel: Mutex<u32>,
    qos: Qos,
    publisher: Mutex<Arc<dyn Publisher>>,
    latched: Mutex<Latched>,
    /// Who listens on the robot, other nodes of the servant not counted.
    pub(super) listeners: AtomicUsize,
    /// Another advertisement is to be made.
    pub(super) news: Arc<Notify>,
    pub(super) counting: Mutex<Option<AbortHandle>>,
}

/// Latched messages for new subscribers: the last one of the side (cloud or original) that answers for the node.
#[derive(Default)]
struct Latched {
    /// What each side has latched last. Of the cloud only while somebody listens: else it sends nothing, and what is
    /// kept would grow old.
    last: [Option<Bytes>; 2],
    advertised: Advertised,
    /// A transient-local advertisement keeps something.
    kept: bool,
    /// Messages dropped by advertisements that have ended, and before there was one.
    dropped: u64,
}

/// How latched messages are published.
#[derive(Default)]
enum Advertised {
    /// As all others are.
    #[default]
    Plainly,
    /// An advertisement for them has been asked for; until it is there, messages wait.
    Asked(Ring<Bytes>),
    /// By one beside the plain one.
    Beside(Box<dyn Publisher>),
}

impl Latched {
    fn become_advertised(&mut self, advertised: Advertised) {
        if let Advertised::Beside(ended) = std::mem::replace(&mut self.advertised, advertised) {
            self.dropped += ended.dropped();
        }
    }
}

impl Topic {
    /// Advertises an output with what its node offers.
    pub(super) async fn advertise(
        bus: &dyn Bus,
        told: &Output,
        of: WireType,
    ) -> Result<Self, BusError> {
        let qos = match &told.qos {
            Some(qos) if qos.transient_local && told.topic != LOG => Qos {
                depth: 1,
                ..qos.to_qos(1)
            },
            Some(qos) => qos.to_qos(QUEUE),
            None => Qos::keep_last(QUEUE),
        };
        let publisher = bus.advertise(&told.topic, of.clone(), qos).await?;
        Ok(Self {
            name: told.topic.clone(),
            told: told.clone(),
            wire_type: Arc::new(of),
            cloud: "cloud".into(),
            channel: Mutex::new(told.channel),
            qos,
            publisher: Mutex::new(publisher.into()),
            latched: Mutex::default(),
            listeners: AtomicUsize::new(0),
            news: Arc::default(),
            counting: Mutex::default(),
        })
    }

    /// Whether that which is told is what is advertised.
    pub(super) fn is(&self, told: &Output) -> bool {
        self.told.md5 == told.md5 && self.told.qos == told.qos
    }

    /// Publishes what is not latched, and tells who listens.
    pub(super) fn publisher(&self) -> Arc<dyn Publisher> {
        Arc::clone(&self.publisher.lock())
    }

    /// Messages that whoever listens was too slow for.
    pub(super) fn dropped(&self) -> u64 {
        let latched = self.latched.lock();
        let beside = match &latched.advertised {
            Advertised::Beside(publisher) => publisher.dropped(),
            _ => 0,
        };
        self.publisher().dropped() + latched.dropped + beside
    }

    /// A side has published; `heard`: it answers for the node.
    pub(super) fn take(&self, side: Side, message: Bytes, latching: bool, heard: bool) {
        let mut latched = self.latched.lock();
        // A line of the log is no state, which would be said again by the next who speaks.
        let latching = latching && self.name != LOG;
        if latching {
            latched.last[side.index()] = Some(message.clone());
        }
        if heard {
            self.publish(&mut latched, message, latching);
        }
    }

    fn publish(&self, latched: &mut Latched, message: Bytes, latching: bool) {
        match &mut latched.advertised {
            Advertised::Beside(publisher) => publisher.publish(message),
            Advertised::Asked(waiting) => {
                latched.dropped += waiting.push(message).messages;
            }
            Advertised::Plainly if latching && !self.qos.is_latching() => {
                let mut waiting = Ring::new(Bounds::messages(QUEUE));
                latched.dropped += waiting.push(message).messages;
                self.ask(latched, waiting);
            }
            Advertised::Plainly => {
                latched.kept = self.qos.is_latching();
                self.publisher().publish(message);
            }
        }
    }

    fn ask(&self, latched: &mut Latched, waiting: Ring<Bytes>) {
        latched.become_advertised(Advertised::Asked(waiting));
        self.news.notify_one();
    }

    /// Newcomers are given nothing of what was published until now.
    fn forget(&self, latched: &mut Latched) {
        if !self.qos.is_latching() {
            latched.become_advertised(Advertised::Plainly);
        } else if std::mem::take(&mut latched.kept) {
            self.ask(latched, Ring::new(Bounds::messages(QUEUE)));
        }
    }

    /// This side speaks for the node from now on.
    pub(super) fn speaks(&self, side: Side) {
        let mut latched = self.latched.lock();
        match latched.last[side.index()].clone() {
            Some(message) => self.publish(&mut latched, message, true),
            // The cloud will be asked when somebody listens; until it has latched something, what was heard last stays.
            None if side == Side::Cloud && self.listeners.load(Ordering::Relaxed) == 0 => {
                self.forget(&mut latched);
            }
            None => {}
        }
    }

    /// The local original has ended, and what it has latched goes with it.
    pub(super) fn local_ended(&self) {
        self.latched.lock().last[Side::Local.index()] = None;
    }

    /// There are no subscribers any more.
    pub(super) fn is_left(&self, local_speaks: bool) {
        let mut latched = self.latched.lock();
        latched.last[Side::Cloud.index()] = None;
        let kept = local_speaks && latched.last[Side::Local.index()].is_some();
        if !kept {
            self.forget(&mut latched);
        }
    }

    /// Makes the advertisement that was asked for, before the next newcomer. True where it took the place of the plain one.
    pub(super) async fn keep_latched(&self, bus: &dyn Bus) -> bool {
        if !matches!(self.latched.lock().advertised, Advertised::Asked(_)) {
            return false;
        }
        let wire_type = WireType::clone(&self.wire_type);
        let replaces = self.qos.is_latching();
        let qos = match replaces {
            true => self.qos,
            false => self.qos.latching(true),
        };
        let advertised = bus.advertise(&self.name, wire_type, qos).await;
        let advertised = advertised.inspect_err(|error| {
            tracing::warn!(topic = self.name, %error, "newcomers are not given what is latched");
        });
        let mut latched = self.latched.lock();
        let Advertised::Asked(waiting) = &mut latched.advertised else {
            return false;
        };
        let waiting: Vec<Bytes> = waiting.collect();
        latched.kept = replaces && !waiting.is_empty();
        // Without one they are heard all the same; the next latched message asks again.
        let (publisher, next) = match advertised {
            Ok(fresh) if replaces => {
                let fresh: Arc<dyn Publisher> = fresh.into();
                let before = std::mem::replace(&mut *self.publisher.lock(), Arc::clone(&fresh));
                latched.dropped += before.dropped();
                (fresh, Advertised::Plainly)
            }
            Ok(beside) => {
                for message in waiting {
                    beside.publish(message);
                }
                latched.become_advertised(Advertised::Beside(beside));
                return false;
            }
            Err(_) => (self.publisher(), Advertised::Plainly),
        };
        for message in waiting {
            publisher.publish(message);
        }
        latched.become_advertised(next);
        replaces
    }
}

impl Drop for Topic {
    fn drop(&mut self) {
        if let Some(counting) = self.counting.lock().take() {
            counting.abort();
        }
    }
}
