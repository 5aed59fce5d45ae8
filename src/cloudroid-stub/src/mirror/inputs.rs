//! What the real node listens to: subscribed to on the robot under this node's name, and sent up.

use std::collections::{BTreeSet, HashMap};
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, AtomicU32, Ordering};
use std::time::Duration;

use link::Quality;
use link::clock::now;
use link::control::{FromRobot, Input, Wanted};
use link::drops::Cause;
use link::record::Data;
use parking_lot::Mutex;
use ros::bus::{Digest, Matched, Message, Peer, PeerId, Qos, WireType};
use tokio::task::AbortHandle;

use super::Mirror;

/// Messages that the bus keeps while the link is busy.
const QUEUE: usize = 256;

/// Before a subscription that was refused is tried again.
const REFUSED: Duration = Duration::from_secs(1);

/// Inputs by topic.
#[derive(Default)]
pub struct Inputs {
    topics: Mutex<HashMap<String, Topic>>,
    channels: Mutex<HashMap<String, Channels>>,
    next: AtomicU32,
}

struct Topic {
    wanted: Wanted,
    feed: Arc<AtomicBool>,
    reading: AbortHandle,
}

impl Drop for Topic {
    fn drop(&mut self) {
        self.reading.abort();
    }
}

impl Inputs {
    /// Subscribes to what is new and takes back what is gone, unless it `keeps` that for the time being.
    pub fn apply(&self, mirror: &Arc<Mirror>, inputs: &[Wanted], keeps: bool) {
        // The local original must not become deaf, whatever the servant's node listens to.
        let others_need = keeps || mirror.keeper().is_some_and(|keeper| keeper.is_local_fed());
        let mut topics = self.topics.lock();
        topics.retain(|name, topic| {
            let listed = inputs.iter().find(|wanted| wanted.topic == *name);
            listed.map_or(others_need, |wanted| suffices(&topic.wanted, wanted))
        });
        // Subscribed to anew, a topic gets new channels.
        self.channels.lock().retain(|name, channels| {
            let stays = topics.contains_key(name);
            if !stays {
                channels.close(mirror);
            }
            stays
        });
        for wanted in inputs {
            match topics.get(&wanted.topic) {
                Some(topic) => {
                    self.send_latched(mirror, &wanted.topic);
                    topic.feed.store(wanted.feed, Ordering::Relaxed);
                    if wanted.feed {
                        self.expect(mirror, &wanted.topic);
                    }
                    continue;
                }
                None => {
                    let feed = Arc::new(AtomicBool::new(wanted.feed));
                    let reading = read(Arc::downgrade(mirror), wanted.clone(), feed.clone());
                    let topic = Topic {
                        wanted: wanted.clone(),
                        feed,
                        reading: tokio::spawn(reading).abort_handle(),
                    };
                    topics.insert(wanted.topic.clone(), topic);
                }
            }
        }
    }

    /// Gives a new servant what publishers have latched: they do not send it again.
    fn send_latched(&self, mirror: &Mirror, topic: &str) {
        let kept = match self.channels.lock().get_mut(topic) {
            Some(channels) => std::mem::take(&mut channels.to_send_again),
            None => return,
        };
        for message in kept.into_values() {
            self.send(mirror, topic, &message);
        }
    }

    /// Sends a message up.
    pub fn send(&self, mirror: &Mirror, topic: &str, message: &Message) {
        let born = now();
        let channel = {
            let mut channels = self.channels.lock();
            let channels = match channels.get_mut(topic) {
                Some(channels) => channels,
                None => channels.entry(topic.to_owned()).or_default(),
            };
            if message.latching {
                let publisher = message.publisher.clone();
                channels.latched.insert(publisher, message.clone());
            }
            channels.of(
                mirror,
                topic,
                (&message.publisher, message.latching),
                &message.wire_type,
            )
        };
        let quality = Quality::of(&message.wire_type.name, message.latching);
        let data = Data {
            channel,
            encoded: false,
            latching: message.latching,
            born,
            left: 0,
            serialise: 0,
            answered: None,
            message: message.bytes.clone(),
        };
        mirror.session().publish(data, quality);
    }

    /// Opens the topic for who will publish it: in the cloud the node is connected then when the first message comes.
    fn expect(&self, mirror: &Mirror, topic: &str) {
        // While the cloud is away, nothing is put down for it that it may never be asked for.
        if !mirror.session().is_up() {
            return;
        }
        let siblings = mirror.siblings.read().clone();
        if let Some(channels) = self.channels.lock().get_mut(topic) {
            let mut offered = channels.offered.clone();
            // Other nodes of the servant hear each other inside.
            offered.retain(|publisher, _| !siblings.contains(publisher.node()));
            for (publisher, of) in offered {
                channels.of(mirror, topic, (&publisher, false), &of);
            }
        }
    }

    /// These are there now, and will publish this.
    fn offered(&self, topic: &str, present: &Matched) {
        let stream = |peer: &Peer| {
            // What is latched comes at once.
            let offer = peer.offer.as_ref().filter(|offer| !offer.latching)?;
            let known = offer.wire_type.name != "*";
            known.then(|| (peer.id.clone(), offer.wire_type.clone()))
        };
        let mut channels = self.channels.lock();
        let channels = match channels.get_mut(topic) {
            Some(channels) => channels,
            None => channels.entry(topic.to_owned()).or_default(),
        };
        let connected = present.peers.iter().filter(|peer| peer.connected);
        channels.offered = connected.filter_map(stream).collect();
    }

    /// Only these publishers of a topic are left: what the cloud was given of others is taken back.
    fn left(&self, mirror: &Mirror, topic: &str, present: &Matched) {
        if let Some(channels) = self.channels.lock().get_mut(topic) {
            channels.left(mirror, present);
        }
    }

    /// How many channels are open, and how many messages are kept since they are latched.
    #[cfg(test)]
    pub fn known(&self) -> (usize, usize) {
        let channels = self.channels.lock();
        let open = channels.values().map(|of| of.by_publisher.len()).sum();
        (open, channels.values().map(|of| of.latched.len()).sum())
    }

    /// Another session begins: the cloud knows no channel any more. What is subscribed to on the robot stays so, or
    /// the local original would miss messages.
    pub fn renew(&self) {
        for channels in self.channels.lock().values_mut() {
            channels.by_publisher.clear();
            channels.to_send_again = channels.latched.clone();
        }
    }
}

/// Whether a subscription that was made for one wish does for another: whoever asks for more hears those who offer less, too, and
/// what was heard once is not to come again.
fn suffices(made: &Wanted, wanted: &Wanted) -> bool {
    let enough = match (&made.qos, &wanted.qos) {
        (Some(made), Some(wanted)) => {
            (made.transient_local || !wanted.transient_local)
                && (!made.best_effort || wanted.best_effort)
        }
        (None, _) => true,
        (Some(_), None) => false,
    };
    made.md5 == wanted.md5 && enough
}

async fn read(mirror: std::sync::Weak<Mirror>, wanted: Wanted, feed: Arc<AtomicBool>) {
    let Some(bus) = mirror.upgrade().map(|mirror| mirror.bus.clone()) else {
        return;
    };
    let of = match mirror.upgrade() {
        Some(mirror) => mirror.wire_type(&wanted.type_name, &wanted.md5),
        None => return,
    };
    let qos = match &wanted.qos {
        // Publishers of ROS 2 log whom they do not suit: no more is asked for than the node does.
        Some(qos) => qos.to_qos(QUEUE),
        // Whatever is latched goes to the cloud, too.
        None => Qos::keep_last(QUEUE).latching(true),
    };
    let mut told = false;
    let mut subscription = loop {
        match bus.subscribe(&wanted.topic, of.clone(), qos).await {
            Ok(subscription) => break subscription,
            Err(error) if !told => {
                told = true;
                tracing::warn!(topic = wanted.topic, %error, "cannot be subscribed to; trying again");
            }
            Err(_) => {}
        }
        tokio::time::sleep(REFUSED).await;
    };
    let Some(refused) = mirror.upgrade().map(|mirror| {
        let dropped = Arc::clone(&subscription.dropped);
        mirror.drops.watch(&wanted.topic, Cause::Busy, dropped);
        mirror.refusals.end(&wanted.topic)
    }) else {
        return;
    };
    let topic: Arc<str> = wanted.topic.as_str().into();
    let mut present = subscription.matched.clone();
    // Who is there already is no change.
    present.mark_changed();
    let mut latching: BTreeSet<PeerId> = BTreeSet::new();
    // Who is there, as it has changed: looked at when all that had come by then was read.
    let mut changed: Option<Matched> = None;
    loop {
        let message = tokio::select! {
            // Who has left has sent all that it had before.
            biased;
            message = subscription.messages.recv() => message,
            () = std::future::ready(()), if changed.is_some() => {
                let (Some(mirror), Some(present)) = (mirror.upgrade(), changed.take()) else {
                    return;
                };
                // First, or one that has left might be expected again.
                mirror.inputs.offered(&topic, &present);
                mirror.inputs.left(&mirror, &topic, &present);
                if feed.load(Ordering::Relaxed) {
                    mirror.inputs.expect(&mirror, &topic);
                }
                latching.retain(|publisher| {
                    let stays = present.contains(publisher);
                    if let Some(keeper) = mirror.keeper().filter(|_| !stays) {
                        keeper.left(&topic, publisher);
                    }
                    stays
                });
                continue;
            }
            change = present.changed() => {
                if change.is_err() {
                    return;
                }
                let now = present.borrow_and_update().clone();
                refused.meets(&now);
                changed = Some(now);
                continue;
            }
        };
        let (Some(message), Some(mirror)) = (message, mirror.upgrade()) else {
            return;
        };
        // One that has left meanwhile: what is opened for its last message is closed again behind it.
        if !present.borrow().contains(&message.publisher) {
            changed = Some(present.borrow().clone());
        }
        if message.latching && !latching.contains(&message.publisher) {
            latching.insert(message.publisher.clone());
        }
        // Other nodes of the servant hear each other inside. Their originals on the robot do not.
        let inside = mirror.siblings.read().contains(message.publisher.node());
        match (mirror.keeper(), !inside && feed.load(Ordering::Relaxed)) {
            (Some(keeper), true) => keeper.input(&topic, message),
            (Some(keeper), false) => keeper.overheard(&topic, message),
            (None, true) => mirror.inputs.send(&mirror, &topic, &message),
            (None, false) => {}
        }
    }
}

/// A channel for all publishers that do not latch, and one for each that does: what each has latched is kept.
#[derive(Default)]
struct Channels {
    by_publisher: HashMap<(Option<PeerId>, Digest), Channel>,
    /// What each publisher has latched last.
    latched: HashMap<PeerId, Message>,
    /// Of that, what a new servant was not given yet.
    to_send_again: HashMap<PeerId, Message>,
    /// What those publish who are connected and do not latch.
    offered: HashMap<PeerId, Arc<WireType>>,
}

struct Channel {
    number: u32,
    /// Who has sent by it.
    publishers: BTreeSet<PeerId>,
}

impl Channels {
    /// The cloud is told that nothing more comes by any of them.
    fn close(&mut self, mirror: &Mirror) {
        for (_, channel) in self.by_publisher.drain() {
            mirror.session().closes(channel.number);
        }
    }

    /// Forgets publishers that are not among these.
    fn left(&mut self, mirror: &Mirror, present: &Matched) {
        self.by_publisher.retain(|_, channel| {
            channel.publishers.retain(|name| present.contains(name));
            if channel.publishers.is_empty() {
                mirror.session().closes(channel.number);
            }
            !channel.publishers.is_empty()
        });
        self.to_send_again.retain(|name, _| present.contains(name));
        self.latched.retain(|name, _| present.contains(name));
    }

    /// The number of the channel of this publisher, which latches or does not.
    fn of(
        &mut self,
        mirror: &Mirror,
        topic: &str,
        (publisher, latching): (&PeerId, bool),
        of: &WireType,
    ) -> u32 {
        let key = (latching.then(|| publisher.clone()), of.digest.clone());
        let known = self.by_publisher.entry(key).or_insert_with(|| {
            let channel = mirror.inputs.next.fetch_add(1, Ordering::Relaxed);
            // Publishers of ROS 2 do not tell it; the cloud may have.
            let definition = match of.definition.is_empty() {
                true => mirror.wire_type(&of.name, of.digest.as_str()).definition,
                false => of.definition.clone(),
            };
            mirror.session().report(&FromRobot::Open(Input {
                channel,
                topic: topic.to_owned(),
                type_name: of.name.clone(),
                md5: of.digest.to_string(),
                definition,
                latching,
                qos: None,
            }));
            let schema = codec::Schema::of(&of.name, of.digest.as_str());
            mirror.session().opens(channel, topic, schema);
            Channel {
                number: channel,
                publishers: BTreeSet::new(),
            }
        });
        if !known.publishers.contains(publisher) {
            known.publishers.insert(publisher.clone());
        }
        known.number
    }
}
