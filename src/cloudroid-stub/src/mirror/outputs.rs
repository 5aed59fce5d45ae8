//! Topics that the real node publishes, advertised on the robot under this node's name.

mod topic;

use std::collections::HashMap;
use std::sync::Arc;
use std::sync::atomic::Ordering;

use bytes::Bytes;
use link::control::{FromRobot, OutputChannel};
use link::drops::Cause;
use link::record::Data;
use parking_lot::Mutex;
use qos::Responder;
use ros::bus::{SerializedMessage, TopicPeer, WireType};

use self::topic::OutputTopic;
use super::reports;
use super::state::Mirror;

/// Channel of outputs that the cloud has not reported.
pub const NOWHERE: u32 = u32::MAX;

/// Outputs, by topic and by channel.
#[derive(Default)]
pub struct Outputs {
    topics: Mutex<HashMap<String, Arc<OutputTopic>>>,
    channels: Mutex<HashMap<u32, Arc<OutputTopic>>>,
}

impl Outputs {
    /// Publishes a message of the cloud.
    pub fn publish_cloud(&self, mirror: &Mirror, data: Data, arrived: i64) {
        let Some(topic) = self.channels.lock().get(&data.channel).cloned() else {
            return;
        };
        let mut heard = true;
        if let Some(keeper) = mirror.keeper() {
            let message = SerializedMessage {
                bytes: data.message.clone(),
                wire_type: topic.wire_type.clone(),
                publisher: topic.cloud.clone(),
                latching: data.latching,
            };
            let offset = mirror.session().clock().map(|clock| clock.offset);
            let timing = reports::output_timing(&data, arrived, offset);
            heard = keeper.on_cloud_output(&topic.name, &message, timing);
        }
        topic.on_message(Responder::Cloud, data.message, data.latching, heard);
    }

    /// Sets how many messages of an output its node gives to late subscribers.
    pub fn set_kept(&self, channel: u32, messages: usize) {
        let topic = self.channels.lock().get(&channel).cloned();
        if let Some(topic) = topic {
            topic.set_kept(messages);
        }
    }

    /// Publishes a message of the local original; `heard` is set if it speaks for the node.
    pub fn publish_local(&self, topic: &str, message: SerializedMessage, heard: bool) {
        let topic = self.topics.lock().get(topic).cloned();
        if let Some(topic) = topic {
            topic.on_message(Responder::Local, message.bytes, message.latching, heard);
        }
    }

    /// Sets the side that speaks for the node from now on.
    pub fn set_active_side(&self, side: Responder) {
        for topic in self.all() {
            topic.set_active_side(side);
        }
    }

    /// Handles the end of the local original, whose latched messages are discarded.
    pub fn on_local_ended(&self) {
        for topic in self.all() {
            topic.on_local_ended();
        }
    }

    fn all(&self) -> Vec<Arc<OutputTopic>> {
        self.topics.lock().values().cloned().collect()
    }

    /// Returns the name of a channel's topic.
    pub fn topic_name(&self, channel: u32) -> Option<String> {
        let channels = self.channels.lock();
        channels.get(&channel).map(|topic| topic.name.clone())
    }

    /// Publishes a message of this side, on an advertised topic.
    pub fn publish(&self, topic: &str, message: Bytes) {
        if let Some(topic) = self.topics.lock().get(topic) {
            topic.publisher().publish(message);
        }
    }

    /// Returns the type of an output.
    pub fn wire_type(&self, topic: &str) -> Option<Arc<WireType>> {
        let topics = self.topics.lock();
        topics.get(topic).map(|topic| topic.wire_type.clone())
    }

    /// Advertises new outputs and removes those that are not listed, unless `keeps` is set.
    pub async fn apply(&self, mirror: &Arc<Mirror>, outputs: &[OutputChannel], keeps: bool) {
        self.topics.lock().retain(|name, topic| {
            let listed = outputs.iter().find(|output| output.topic == *name);
            listed.map_or(keeps, |output| topic.matches_output(output))
        });
        let mut channels = HashMap::new();
        for output in outputs {
            let known = self.topics.lock().get(&output.topic).cloned();
            let topic = match known {
                Some(topic) => topic,
                None => match self.advertise(mirror, output).await {
                    Some(topic) => topic,
                    None => continue,
                },
            };
            *topic.channel.lock() = output.channel;
            // The siblings may have changed and with them the number of subscribers; a new session knows no numbers.
            watch_listeners(mirror, &topic);
            channels.insert(output.channel, topic);
        }
        channels.remove(&NOWHERE);
        *self.channels.lock() = channels;
    }

    async fn advertise(&self, mirror: &Arc<Mirror>, output: &OutputChannel) -> Option<Arc<OutputTopic>> {
        let of = mirror.wire_type(&output.type_name, &output.md5);
        match OutputTopic::advertise(&*mirror.bus, output, of).await {
            Ok(topic) => {
                let topic = Arc::new(topic);
                let counted = Arc::downgrade(&topic);
                mirror.drops.watch_with(&output.topic, Cause::Slow, move || {
                    let topic = counted.upgrade();
                    (topic.as_ref().map_or(0, |it| it.dropped_count()), topic.is_none())
                });
                self.topics.lock().insert(output.topic.clone(), topic.clone());
                Some(topic)
            }
            Err(error) => {
                tracing::warn!(topic = output.topic, %error, "cannot be advertised");
                None
            }
        }
    }
}

/// Reports the number of subscribers to the cloud, now and at every change.
fn watch_listeners(mirror: &Arc<Mirror>, topic: &Arc<OutputTopic>) {
    let (mirror, of) = (Arc::downgrade(mirror), Arc::downgrade(topic));
    let mut subscribers = topic.publisher().matched_subscribers();
    let refused = mirror.upgrade().map(|mirror| mirror.refusals.register_end(&topic.name));
    // The task must not hold the topic itself, which is removed when only this task would still hold it.
    let news = Arc::clone(&topic.news);
    let task = tokio::spawn(async move {
        let mut told = None;
        loop {
            let matched = subscribers.borrow_and_update().clone();
            if let Some(end) = &refused {
                end.update(&matched);
            }
            {
                let (Some(mirror), Some(topic)) = (mirror.upgrade(), of.upgrade()) else {
                    return;
                };
                let siblings = mirror.siblings.read().clone();
                let others = matched.peers.iter();
                let others = others.filter(|peer| !siblings.contains(peer.id.node()));
                let requests_latched = |peer: &TopicPeer| peer.offer.as_ref().is_none_or(|request| request.latching);
                let (count, latching) =
                    others.fold((0, false), |(count, latching), peer| (count + 1, latching || requests_latched(peer)));
                if told != Some((count, latching)) {
                    told = Some((count, latching));
                    topic.listeners.store(count, Ordering::Relaxed);
                    if let Some(keeper) = mirror.keeper() {
                        keeper.set_wanted(&topic.name, count > 0);
                    }
                    if count == 0 {
                        topic.on_no_subscribers(mirror.keeper().is_some_and(|keeper| keeper.is_local_fed()));
                    }
                    let channel = *topic.channel.lock();
                    if channel != NOWHERE {
                        mirror.session().send_control(&FromRobot::Listeners { channel, count, latching });
                    }
                }
                if topic.advertise_pending(&*mirror.bus).await {
                    subscribers = topic.publisher().matched_subscribers();
                    continue;
                }
            }
            tokio::select! {
                changed = subscribers.changed() => if changed.is_err() { return },
                () = news.notified() => {}
            }
        }
    });
    if let Some(earlier) = topic.counting.lock().replace(task.abort_handle()) {
        earlier.abort();
    }
}
