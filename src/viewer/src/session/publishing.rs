//! Topics published by a viewer.

use std::sync::Arc;

use access::Operation;
use bridge::NotGrantedError;
use bytes::Bytes;
use foxglove::ws_protocol::client;
use ros::bus::{BusError, Publisher, QosProfile, WireType, wait_for_connected};
use ros::codec;
use ros::schema::{MessageType, SchemaError};
use tokio::sync::mpsc;
use tokio::time::timeout;

use super::{CONNECTS, FinishedTask, OUTGOING, Session};

/// Limit on the topics that one viewer may advertise.
const ADVERTISEMENTS: usize = 512;
/// Minimum queue size of a viewer's topic towards a slow node.
const MIN_QUEUE: usize = 10;

/// Reason why a topic of a viewer is not advertised.
#[derive(Debug, thiserror::Error)]
enum AdvertiseError {
    /// The messages are encoded in another way than the servant's.
    #[error("{topic}: messages must be encoded as {expected}, not {given}")]
    Encoding {
        /// Name of the topic.
        topic: String,
        /// Encoding of the servant's messages.
        expected: &'static str,
        /// Encoding of the viewer's messages.
        given: String,
    },
    /// The viewer may not publish on the topic.
    #[error(transparent)]
    NotGranted(#[from] NotGrantedError),
    /// The type of the messages has no definition.
    #[error("{topic}: {source}")]
    UnknownType {
        /// Name of the topic.
        topic: String,
        /// Error of the definitions.
        source: SchemaError,
    },
    /// The servant's bus does not advertise the topic.
    #[error("{topic} cannot be advertised: {source}")]
    Bus {
        /// Name of the topic.
        topic: String,
        /// Error of the bus.
        source: BusError,
    },
}

/// A topic advertised by the viewer.
pub(super) struct ViewerPublication {
    pub(super) topic: String,
    /// `None` if the advertisement was refused, which the viewer has been told.
    publishing: Option<PublicationSink>,
}

/// Message type of a publication and the queue to its publisher.
struct PublicationSink {
    of: Arc<MessageType>,
    messages: mpsc::Sender<Bytes>,
}

impl Session {
    pub(super) async fn publish(&mut self, id: u32, message: &[u8]) {
        let Some(published) = self.publishers.get(&id) else {
            let words = format!("channel {id} is not advertised by this viewer");
            return self.send_error(words);
        };
        let Some(PublicationSink { of, messages }) = &published.publishing else {
            return;
        };
        if let Err(error) = codec::validate(of, message) {
            let words = format!("{}: not a {}: {error}", published.topic, of.name());
            return self.send_error(words);
        }
        match self.budget.take(message.len()) {
            // The receiver lives as long as the sender does.
            Ok(permit) => drop(messages.send(permit.wrap_bytes(message.to_vec())).await),
            Err(exceeded) => {
                self.send_error(format!("{}: {exceeded}", published.topic));
            }
        }
    }

    pub(super) async fn advertise(&mut self, channel: client::advertise::Channel<'_>) {
        let id = channel.id;
        if self.publishers.contains_key(&id) {
            return self.send_error(format!("channel {id} already exists"));
        }
        let topic = channel.topic.clone().into_owned();
        if self.publishers.len() >= ADVERTISEMENTS {
            let words = format!("{topic}: one viewer may advertise {ADVERTISEMENTS} topics");
            return self.send_error(words);
        }
        let publishing = match self.open_publisher(&topic, &channel).await {
            Ok((of, publisher)) => Some(PublicationSink { of, messages: self.spawn_publisher(&topic, publisher) }),
            Err(error) => {
                self.send_error(error.to_string());
                None
            }
        };
        self.publishers.insert(id, ViewerPublication { topic, publishing });
    }

    async fn open_publisher(
        &self,
        topic: &str,
        channel: &client::advertise::Channel<'_>,
    ) -> Result<(Arc<MessageType>, Box<dyn Publisher>), AdvertiseError> {
        let encoding = self.format.encoding;
        if channel.encoding != encoding {
            return Err(AdvertiseError::Encoding {
                topic: topic.to_owned(),
                expected: encoding,
                given: channel.encoding.clone().into_owned(),
            });
        }
        self.granted.check(Operation::Publish, topic)?;
        let message = self.registry.message(&channel.schema_name);
        let message = message.map_err(|source| AdvertiseError::UnknownType { topic: topic.to_owned(), source })?;
        let qos = QosProfile::keep_last(self.depth.max(MIN_QUEUE));
        let publisher = self.bus.advertise(topic, WireType::from_message(&message), qos).await;
        let publisher = publisher.map_err(|source| AdvertiseError::Bus { topic: topic.to_owned(), source })?;
        Ok((message, publisher))
    }

    /// Spawns a task that publishes the messages sent to it once all present subscribers are connected.
    fn spawn_publisher(&mut self, topic: &str, publisher: Box<dyn Publisher>) -> mpsc::Sender<Bytes> {
        let (messages, mut waiting) = mpsc::channel::<Bytes>(OUTGOING);
        let graph = self.bus.graph();
        let listening = graph.borrow().topics.get(topic).map_or(0, |ends| {
            let others = ends.subscribers.iter();
            others.filter(|node| **node != self.bus.node()).count()
        });
        self.tasks.spawn(async move {
            // Viewers publish immediately after advertising.
            let _ = timeout(CONNECTS, wait_for_connected(publisher.matched_subscribers(), listening)).await;
            while let Some(message) = waiting.recv().await {
                publisher.publish(message);
            }
            FinishedTask::Published
        });
        self.publishing += 1;
        messages
    }
}
