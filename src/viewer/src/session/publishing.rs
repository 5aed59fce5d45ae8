//! Topics that a viewer publishes.

use std::sync::Arc;

use access::Operation;
use bytes::Bytes;
use foxglove::ws_protocol::client;
use ros::bus::{Publisher, Qos, WireType, reaches};
use ros::codec;
use ros::schema::MessageType;
use tokio::sync::mpsc;
use tokio::time::timeout;

use super::{CONNECTS, Ended, OUTGOING, Session};

/// Topics of one viewer.
const ADVERTISEMENTS: usize = 512;
/// Messages of a viewer's topic that wait for a slow node, at least.
const PUBLISHED: usize = 10;

/// A topic that the viewer publishes.
pub(super) struct Published {
    pub(super) topic: String,
    /// None where it was refused, which was told.
    publishing: Option<Publishing>,
}

/// Where its messages go, and what they are.
struct Publishing {
    of: Arc<MessageType>,
    messages: mpsc::Sender<Bytes>,
}

impl Session {
    pub(super) async fn publish(&mut self, id: u32, message: &[u8]) {
        let Some(published) = self.publishers.get(&id) else {
            let words = format!("channel {id} is not advertised by this viewer");
            return self.complain(words);
        };
        let Some(Publishing { of, messages }) = &published.publishing else {
            return;
        };
        if let Err(error) = codec::validate(of, message) {
            let words = format!("{}: this is no {}: {error}", published.topic, of.name());
            return self.complain(words);
        }
        match self.budget.take(message.len()) {
            // It is taken for as long as the sender is there.
            Ok(permit) => drop(messages.send(permit.around(message.to_vec())).await),
            Err(exceeded) => {
                self.complain(format!("{}: {exceeded}", published.topic));
            }
        }
    }

    pub(super) async fn advertise(&mut self, channel: client::advertise::Channel<'_>) {
        let id = channel.id;
        if self.publishers.contains_key(&id) {
            return self.complain(format!("channel {id} is there already"));
        }
        let topic = channel.topic.clone().into_owned();
        if self.publishers.len() >= ADVERTISEMENTS {
            let words = format!("{topic}: one viewer may advertise {ADVERTISEMENTS} topics");
            return self.complain(words);
        }
        let publishing = match self.publisher(&topic, &channel).await {
            Ok((of, publisher)) => Some(Publishing {
                of,
                messages: self.publishing(&topic, publisher),
            }),
            Err(words) => {
                self.complain(words);
                None
            }
        };
        self.publishers.insert(id, Published { topic, publishing });
    }

    async fn publisher(
        &self,
        topic: &str,
        channel: &client::advertise::Channel<'_>,
    ) -> Result<(Arc<MessageType>, Box<dyn Publisher>), String> {
        let encoding = self.format.encoding;
        if channel.encoding != encoding {
            return Err(format!(
                "{topic}: messages are to be written as {encoding}, not {}",
                channel.encoding
            ));
        }
        self.granted.check(Operation::Publish, topic)?;
        let message = self.registry.message(&channel.schema_name);
        let message = message.map_err(|error| format!("{topic}: {error}"))?;
        let qos = Qos::keep_last(self.depth.max(PUBLISHED));
        let publisher = self.bus.advertise(topic, WireType::of(&message), qos).await;
        let publisher =
            publisher.map_err(|error| format!("{topic} cannot be advertised: {error}"))?;
        Ok((message, publisher))
    }

    /// Publishes what is sent, once all are connected who are there.
    fn publishing(&mut self, topic: &str, publisher: Box<dyn Publisher>) -> mpsc::Sender<Bytes> {
        let (messages, mut waiting) = mpsc::channel::<Bytes>(OUTGOING);
        let graph = self.bus.graph();
        let listening = graph.borrow().topics.get(topic).map_or(0, |ends| {
            let others = ends.subscribers.iter();
            others.filter(|node| **node != self.bus.node()).count()
        });
        self.tasks.spawn(async move {
            // Viewers publish right behind what they advertise.
            let _ = timeout(CONNECTS, reaches(publisher.matched(), listening)).await;
            while let Some(message) = waiting.recv().await {
                publisher.publish(message);
            }
            Ended::Published
        });
        self.publishing += 1;
        messages
    }
}
