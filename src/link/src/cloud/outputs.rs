//! Topics that the node publishes: subscribed to in the servant only while the robot has listeners, so a node that
//! works only for listeners does so here, too.

use std::collections::HashMap;
use std::sync::Arc;

use bytes::Bytes;
use parking_lot::Mutex;
use ros::bus::SubscribeOptions;
use tokio::task::AbortHandle;

use super::Hub;
use super::given::Given;
use super::inputs::{Mark, mark};
use super::node_link::NodeLink;
use crate::Quality;
use crate::clock::now;
use crate::record::{Answered, Data};
use crate::skew::Way;
use crate::stamps::Stamps;

/// Messages that the bus keeps for a busy link.
const QUEUE: usize = 256;

/// Outputs by channel.
#[derive(Default)]
pub(super) struct Outputs {
    channels: Mutex<HashMap<u32, Channel>>,
    given: Mutex<Given>,
}

struct Channel {
    topic: String,
    stamps: Stamps,
    reading: Option<AbortHandle>,
}

impl Drop for Channel {
    fn drop(&mut self) {
        if let Some(reading) = self.reading.take() {
            reading.abort();
        }
    }
}

impl Outputs {
    /// The robot is told of this output.
    pub(super) fn add(&self, channel: u32, topic: &str, stamps: Stamps) {
        let fresh = Channel {
            topic: topic.to_owned(),
            stamps,
            reading: None,
        };
        self.channels.lock().insert(channel, fresh);
    }

    pub(super) fn remove(&self, channel: u32) {
        self.channels.lock().remove(&channel);
    }

    pub(super) fn clear(&self) {
        self.channels.lock().clear();
    }

    /// An input was given to the node.
    pub(super) fn note(&self, channel: u32, mark: Mark, answered: Answered) {
        self.given.lock().note(channel, mark, answered);
    }

    /// Of how many of the last inputs something is known, and how many of them the node has left out.
    pub(super) fn left_out(&self) -> (usize, usize) {
        self.given.lock().left_out()
    }

    /// So many listen on the robot now.
    pub(super) async fn listeners(
        &self,
        link: &Arc<NodeLink>,
        hub: &Arc<Hub>,
        channel: u32,
        count: usize,
    ) {
        let (topic, stamps) = {
            let mut channels = self.channels.lock();
            let Some(known) = channels.get_mut(&channel) else {
                return;
            };
            match (&known.reading, count) {
                (Some(_), 0) => {
                    if let Some(reading) = known.reading.take() {
                        reading.abort();
                    }
                    return;
                }
                (None, 1..) => (known.topic.clone(), known.stamps.clone()),
                _ => return,
            }
        };
        let options = SubscribeOptions {
            wire_type: None,
            queue: QUEUE,
        };
        let subscription = match hub.bus.subscribe(&topic, options).await {
            Ok(subscription) => subscription,
            Err(error) => {
                tracing::warn!(topic, %error, "an output cannot be read");
                return;
            }
        };
        let (reader, hub) = (Arc::clone(link), Arc::downgrade(hub));
        let reading = tokio::spawn(async move {
            // All of it, or its guard would stay behind and end the subscription.
            let subscription = &mut { subscription };
            while let Some(message) = subscription.messages.recv().await {
                // Other nodes of the servant have links of their own.
                if *message.publisher == *reader.node {
                    let Some(hub) = hub.upgrade() else { return };
                    let bytes = hub.skew.apply(Way::Out, &stamps, message.bytes);
                    reader.send(channel, bytes, message.latching);
                }
            }
        });
        if let Some(known) = self.channels.lock().get_mut(&channel) {
            known.reading = Some(reading.abort_handle());
        } else {
            reading.abort();
        }
    }
}

impl NodeLink {
    fn send(&self, channel: u32, message: Bytes, latching: bool) {
        let born = now();
        let data = Data {
            channel,
            encoded: false,
            latching,
            born,
            left: 0,
            serialise: 0,
            answered: self.outputs.given.lock().answered_by(mark(&message), born),
            message,
        };
        let quality = if latching {
            Quality::Each
        } else {
            Quality::Newest
        };
        self.session.publish(data, quality);
    }
}
