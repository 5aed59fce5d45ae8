//! Topics that the real node subscribes to: subscribed to on the robot under this node's name, and sent to the cloud.

use std::collections::BTreeSet;
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::time::Duration;

use link::DeliveryMode;
use link::clock::now;
use link::control::{FromRobot, InputChannel, RequestedInput};
use link::drops::Cause;
use link::record::Data;
use ros::bus::{MatchedPeers, PeerId, QosProfile, SerializedMessage, TopicPeer, WireType};

use super::state::{InputTopic, Inputs, Mirror, OpenChannel, TopicChannels};

/// Queue length on the bus while the link is busy, in messages.
const QUEUE: usize = 256;

/// Delay before a refused subscription is tried again.
const RETRY_DELAY: Duration = Duration::from_secs(1);

impl Drop for InputTopic {
    fn drop(&mut self) {
        self.reading.abort();
    }
}

impl Inputs {
    /// Subscribes to new inputs and unsubscribes from those that are not listed, unless `keeps` is set.
    pub fn apply(&self, mirror: &Arc<Mirror>, inputs: &[RequestedInput], keeps: bool) {
        // The local original must keep receiving, whatever the servant's node subscribes to.
        let others_need = keeps || mirror.keeper().is_some_and(|keeper| keeper.is_local_fed());
        let mut topics = self.topics.lock();
        topics.retain(|name, topic| {
            let listed = inputs.iter().find(|wanted| wanted.topic == *name);
            listed.map_or(others_need, |wanted| satisfies(&topic.wanted, wanted))
        });
        // A topic that is subscribed to anew gets new channels.
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
                        self.open_expected(mirror, &wanted.topic);
                    }
                    continue;
                }
                None => {
                    let feed = Arc::new(AtomicBool::new(wanted.feed));
                    let reading = read_input(Arc::downgrade(mirror), wanted.clone(), feed.clone());
                    let topic =
                        InputTopic { wanted: wanted.clone(), feed, reading: tokio::spawn(reading).abort_handle() };
                    topics.insert(wanted.topic.clone(), topic);
                }
            }
        }
    }

    /// Sends latched messages to a new servant, since their publishers do not send them again.
    fn send_latched(&self, mirror: &Mirror, topic: &str) {
        let kept = match self.channels.lock().get_mut(topic) {
            Some(channels) => std::mem::take(&mut channels.to_send_again),
            None => return,
        };
        for message in kept.into_values() {
            self.send(mirror, topic, &message);
        }
    }

    /// Sends a message to the cloud.
    pub fn send(&self, mirror: &Mirror, topic: &str, message: &SerializedMessage) {
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
            channels.channel_for(mirror, topic, (&message.publisher, message.latching), &message.wire_type)
        };
        let quality = DeliveryMode::for_type(&message.wire_type.name, message.latching);
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

    /// Opens channels for the topic's prospective publishers, so that the node in the cloud is already connected when
    /// the first message arrives.
    fn open_expected(&self, mirror: &Mirror, topic: &str) {
        // While the link is down nothing is queued for the cloud, which may never ask for it.
        if !mirror.session().is_up() {
            return;
        }
        let siblings = mirror.siblings.read().clone();
        if let Some(channels) = self.channels.lock().get_mut(topic) {
            let mut offered = channels.offered.clone();
            // Other nodes of the servant reach each other inside it.
            offered.retain(|publisher, _| !siblings.contains(publisher.node()));
            for (publisher, of) in offered {
                channels.channel_for(mirror, topic, (&publisher, false), &of);
            }
        }
    }

    /// Records the connected publishers and their types.
    fn set_offered(&self, topic: &str, present: &MatchedPeers) {
        let stream = |peer: &TopicPeer| {
            // Latched messages arrive at once.
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

    /// Closes the channels of publishers that are no longer present.
    fn remove_absent(&self, mirror: &Mirror, topic: &str, present: &MatchedPeers) {
        if let Some(channels) = self.channels.lock().get_mut(topic) {
            channels.remove_absent(mirror, present);
        }
    }

    /// Returns the number of open channels and of retained latched messages.
    #[cfg(test)]
    pub fn counts(&self) -> (usize, usize) {
        let channels = self.channels.lock();
        let open = channels.values().map(|of| of.by_publisher.len()).sum();
        (open, channels.values().map(|of| of.latched.len()).sum())
    }

    /// Resets the channels at the start of another session, in which the cloud knows none. The subscriptions on the
    /// robot stay, or the local original would miss messages.
    pub fn reset_channels(&self) {
        for channels in self.channels.lock().values_mut() {
            channels.by_publisher.clear();
            channels.to_send_again = channels.latched.clone();
        }
    }
}

/// Returns whether a subscription made for one request satisfies another. A subscriber with stricter requests also
/// receives from publishers that offer less, but what was received once is not sent again.
fn satisfies(made: &RequestedInput, wanted: &RequestedInput) -> bool {
    let enough = match (&made.qos, &wanted.qos) {
        (Some(made), Some(wanted)) => {
            (made.transient_local || !wanted.transient_local) && (!made.best_effort || wanted.best_effort)
        }
        (None, _) => true,
        (Some(_), None) => false,
    };
    made.md5 == wanted.md5 && enough
}

async fn read_input(mirror: std::sync::Weak<Mirror>, wanted: RequestedInput, feed: Arc<AtomicBool>) {
    let Some(bus) = mirror.upgrade().map(|mirror| mirror.bus.clone()) else {
        return;
    };
    let of = match mirror.upgrade() {
        Some(mirror) => mirror.wire_type(&wanted.type_name, &wanted.md5),
        None => return,
    };
    let qos = match &wanted.qos {
        // ROS 2 publishers log subscribers with incompatible quality of service, so no more is requested than the node
        // requests.
        Some(qos) => qos.to_bus(QUEUE),
        // Latched messages are sent to the cloud, too.
        None => QosProfile::keep_last(QUEUE).latching(true),
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
        tokio::time::sleep(RETRY_DELAY).await;
    };
    let Some(refused) = mirror.upgrade().map(|mirror| {
        let dropped = Arc::clone(&subscription.dropped);
        mirror.drops.watch(&wanted.topic, Cause::Busy, dropped);
        mirror.refusals.register_end(&wanted.topic)
    }) else {
        return;
    };
    let topic: Arc<str> = wanted.topic.as_str().into();
    let mut present = subscription.matched.clone();
    // The initial state is not reported as a change.
    present.mark_changed();
    let mut latching: BTreeSet<PeerId> = BTreeSet::new();
    // The changed set of publishers, handled after all messages received before it.
    let mut changed: Option<MatchedPeers> = None;
    loop {
        let message = tokio::select! {
            // A publisher that has left has sent all of its messages before.
            biased;
            message = subscription.messages.recv() => message,
            () = std::future::ready(()), if changed.is_some() => {
                let (Some(mirror), Some(present)) = (mirror.upgrade(), changed.take()) else {
                    return;
                };
                // Set first, or channels would be opened again for a publisher that has left.
                mirror.inputs.set_offered(&topic, &present);
                mirror.inputs.remove_absent(&mirror, &topic, &present);
                if feed.load(Ordering::Relaxed) {
                    mirror.inputs.open_expected(&mirror, &topic);
                }
                latching.retain(|publisher| {
                    let stays = present.contains(publisher);
                    if let Some(keeper) = mirror.keeper().filter(|_| !stays) {
                        keeper.on_publisher_left(&topic, publisher);
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
                refused.update(&now);
                changed = Some(now);
                continue;
            }
        };
        let (Some(message), Some(mirror)) = (message, mirror.upgrade()) else {
            return;
        };
        // The publisher has left in the meantime: the channel that is opened for its last message is closed afterwards.
        if !present.borrow().contains(&message.publisher) {
            changed = Some(present.borrow().clone());
        }
        if message.latching && !latching.contains(&message.publisher) {
            latching.insert(message.publisher.clone());
        }
        // Other nodes of the servant reach each other inside it. Their originals on the robot do not.
        let inside = mirror.siblings.read().contains(message.publisher.node());
        match (mirror.keeper(), !inside && feed.load(Ordering::Relaxed)) {
            (Some(keeper), true) => keeper.on_input(&topic, message),
            (Some(keeper), false) => keeper.on_overheard_input(&topic, message),
            (None, true) => mirror.inputs.send(&mirror, &topic, &message),
            (None, false) => {}
        }
    }
}

impl TopicChannels {
    /// Reports the channels as closed to the cloud.
    fn close(&mut self, mirror: &Mirror) {
        for (_, channel) in self.by_publisher.drain() {
            mirror.session().close_channel(channel.number);
        }
    }

    /// Removes publishers that are not present.
    fn remove_absent(&mut self, mirror: &Mirror, present: &MatchedPeers) {
        self.by_publisher.retain(|_, channel| {
            channel.publishers.retain(|name| present.contains(name));
            if channel.publishers.is_empty() {
                mirror.session().close_channel(channel.number);
            }
            !channel.publishers.is_empty()
        });
        self.to_send_again.retain(|name, _| present.contains(name));
        self.latched.retain(|name, _| present.contains(name));
    }

    /// Returns the channel number for this publisher, depending on whether it latches.
    fn channel_for(
        &mut self,
        mirror: &Mirror,
        topic: &str,
        (publisher, latching): (&PeerId, bool),
        of: &WireType,
    ) -> u32 {
        let key = (latching.then(|| publisher.clone()), of.digest.clone());
        let known = self.by_publisher.entry(key).or_insert_with(|| {
            let channel = mirror.inputs.next.fetch_add(1, Ordering::Relaxed);
            // ROS 2 publishers do not send the definition; the cloud may have it.
            let definition = if of.definition.is_empty() {
                mirror.wire_type(&of.name, of.digest.as_str()).definition
            } else {
                of.definition.clone()
            };
            mirror.session().send_control(&FromRobot::Open(InputChannel {
                channel,
                topic: topic.to_owned(),
                type_name: of.name.clone(),
                md5: of.digest.to_string(),
                definition,
                latching,
                qos: None,
            }));
            let schema = codec::Schema::for_type(&of.name, of.digest.as_str());
            mirror.session().open_channel(channel, topic, schema);
            OpenChannel { number: channel, publishers: BTreeSet::new() }
        });
        if !known.publishers.contains(publisher) {
            known.publishers.insert(publisher.clone());
        }
        known.number
    }
}
