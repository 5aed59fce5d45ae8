//! `advertise`, `unadvertise`, `publish`.

use std::collections::HashSet;
use std::sync::{Arc, Weak};

use access::Operation;
use bytes::Bytes;
use ros::bus::{BusError, Digest};
use ros::schema::MessageType;
use rosbridge::{Advertise, Compression, Payload, Publish, StatusLevel, Unadvertise};

use super::decoding::{PayloadError, decode};
use super::{BridgeClient, ReplyTarget, remove_matching};
use crate::NotGrantedError;
use crate::client_state::{AdvertisedTopic, TopicPublishers, Untyped};
use crate::lacking::DefinitionError;
use crate::names::{DeclaredTypeError, ResolveNameError, digest_word, is_same_type, lookup_name, ros_type_name};
use crate::quality::{PublisherOffer, publication_offer};
use crate::tf;
use crate::topic_publisher::{PublisherEvents, TopicPublisher};

/// Maximum number of messages on one topic that wait until its type is known.
const MAX_UNTYPED_MESSAGES: usize = 64;
/// Maximum bytes of all such messages of one client; a single message may be larger.
const MAX_UNTYPED_BYTES: usize = 16 << 20;

/// Reasons why a client may not advertise a topic, or why its message is not published.
#[derive(Debug, thiserror::Error)]
pub(super) enum PublishError {
    #[error(transparent)]
    Name(#[from] ResolveNameError),
    #[error(transparent)]
    NotGranted(#[from] NotGrantedError),
    #[error(transparent)]
    OtherType(#[from] DeclaredTypeError),
    #[error("topic {topic}: {source}")]
    Definition { topic: String, source: DefinitionError },
    /// The client gives the digest of another definition.
    #[error(
        "type {name} has {word} {ours} here and {theirs} there; use the definition that /rosapi/message_details shows"
    )]
    OtherDefinition {
        name: String,
        /// Term for the digests.
        word: &'static str,
        ours: Digest,
        theirs: String,
    },
    #[error("this client advertises {topic} as {known}; unadvertise it first")]
    TwoTypes { topic: String, known: String },
    #[error("this client advertises {0} topics already; unadvertise one")]
    TooMany(usize),
    #[error("topic {0} does not exist; advertise it with its type first")]
    NoTopic(String),
    /// The type is still being looked up, and the messages that wait for it have this many bytes.
    #[error("topic {topic} has no known type yet, and {waiting} bytes wait for one already; advertise it first")]
    TooManyUntypedBytes { topic: String, waiting: usize },
    /// The type is still being looked up, and too many messages wait for it.
    #[error("topic {0} has no known type yet; advertise it first")]
    TooManyUntyped(String),
    /// The type cannot be looked up.
    #[error(transparent)]
    Bus(#[from] BusError),
    #[error("topic {topic}: {source}")]
    Payload { topic: String, source: PayloadError },
    /// The payload of a message that has waited for its type.
    #[error(transparent)]
    UntypedPayload(PayloadError),
}

impl TopicPublishers {
    /// Returns the number of advertisements.
    fn count(&self) -> usize {
        let known = self.open.values();
        known.map(|known| known.ids.len().max(1)).sum()
    }

    /// Removes the topics that match, and the messages that wait for their types.
    pub(super) fn take(&mut self, chosen: impl Fn(&str) -> bool) -> Vec<(String, AdvertisedTopic)> {
        self.untyped.retain(|topic, _| !chosen(topic));
        self.told.retain(|topic| !chosen(topic));
        remove_matching(&mut self.open, chosen)
    }

    /// Returns the names of the advertised topics.
    pub(super) fn topics(&self) -> impl Iterator<Item = &str> {
        self.open.keys().map(String::as_str)
    }
}

/// Reports events of an advertised topic to its client.
struct AdvertiseNotifier {
    client: Weak<BridgeClient>,
    topic: String,
    reply: ReplyTarget,
}

impl PublisherEvents for AdvertiseNotifier {
    fn on_failed(&self, reason: &str) {
        if let Some(client) = self.client.upgrade() {
            let gone = client.topic_publishers.lock().open.remove(&self.topic);
            drop(gone);
            self.on_refused(reason);
        }
    }

    fn on_refused(&self, reason: &str) {
        if let Some(client) = self.client.upgrade() {
            let text = format!("advertise: topic {}: {reason}", self.topic);
            client.error(&self.reply, &text);
        }
    }
}

impl BridgeClient {
    pub(super) fn advertise(self: &Arc<Self>, op: &Advertise<'_>, reply: &ReplyTarget) -> Result<(), PublishError> {
        let topic = self.resolve(&op.topic)?;
        self.client_grants().check(Operation::Publish, &topic)?;
        let message_type = self.publishable_type(&topic, &op.type_name).inspect_err(|_| {
            self.mark_reported(&topic);
        })?;
        if let Some(digest) = op.md5sum.as_deref().filter(|digest| *digest != "*" && *digest != message_type.digest()) {
            return Err(PublishError::OtherDefinition {
                name: message_type.name().to_owned(),
                word: digest_word(self.version()),
                ours: message_type.digest().into(),
                theirs: digest.to_owned(),
            });
        }
        let offer = publication_offer(self.version(), op.qos, op.latch, op.queue_size);
        self.open_publisher(&topic, message_type, offer, reply, true)?;
        self.warn_ignored_qos("advertise", op.qos, false, reply);
        self.info(reply, &format!("advertise: advertised {topic}"));
        Ok(())
    }

    pub(super) fn unadvertise(&self, op: &Unadvertise<'_>, reply: &ReplyTarget) -> Result<(), ResolveNameError> {
        let topic = self.resolve(&op.topic)?;
        let mut topic_publishers = self.topic_publishers.lock();
        topic_publishers.told.remove(&*topic);
        let known = topic_publishers.open.get_mut(&*topic);
        // Without an id, all advertisements of the client are meant. A topic that was only published on has none, and
        // ends under the id of its messages.
        let left = known.map(|known| match reply.id {
            None => Some(0),
            Some(_) if known.ids.is_empty() => Some(0),
            Some(_) => known.ids.remove(&reply.id).then_some(known.ids.len()),
        });
        let (gone, warning) = match left {
            None => (None, Some("this client does not advertise")),
            Some(None) => (None, Some("there is no advertisement with this id of")),
            Some(Some(0)) => (topic_publishers.open.remove(&*topic), None),
            Some(Some(_)) => (None, None),
        };
        // The publisher is dropped outside of the lock.
        drop(topic_publishers);
        match (&gone, warning) {
            (_, Some(warning)) => self.warn(reply, &format!("unadvertise: {warning} {topic}")),
            (Some(_), None) => self.info(reply, &format!("unadvertise: {topic} is no longer advertised")),
            (None, None) => self.info(reply, &format!("unadvertise: {topic} stays advertised, under another id")),
        }
        Ok(())
    }

    /// Returns the type of this name, if the topic may be published with it.
    fn publishable_type(&self, topic: &str, type_name: &str) -> Result<Arc<MessageType>, PublishError> {
        let version = self.version();
        let graph = self.shared.bus.graph().borrow().clone();
        let theirs = graph.topics.get(topic).map(|nodes| nodes.type_name.as_str());
        let other = |theirs: &&str| !matches!(*theirs, "" | "*") && !is_same_type(theirs, type_name);
        if let Some(theirs) = theirs.filter(other) {
            let name = ros_type_name(version, type_name, "msg");
            let topic = format!("topic {topic}");
            return Err(DeclaredTypeError::new(topic, theirs, &name).into());
        }
        self.shared.registry.message(&lookup_name(version, type_name)).map_err(|error| PublishError::Definition {
            topic: topic.to_owned(),
            source: DefinitionError::new(version, error),
        })
    }

    /// Marks that the client is told why nothing can be published on a topic; returns whether it was told before.
    fn mark_reported(&self, topic: &str) -> bool {
        let mut topic_publishers = self.topic_publishers.lock();
        // An endless number of topic names must not fill the memory.
        if topic_publishers.told.len() >= self.shared.options.max_advertisements {
            topic_publishers.told.clear();
        }
        !topic_publishers.told.insert(topic.to_owned())
    }

    /// Returns the reason why a message cannot be published, but only for the first such message of its topic: hundreds
    /// of them may follow.
    fn report_once(&self, topic: &str, reason: PublishError) -> Result<(), PublishError> {
        if self.mark_reported(topic) { Ok(()) } else { Err(reason) }
    }

    fn open_publisher(
        self: &Arc<Self>,
        topic: &str,
        message_type: Arc<MessageType>,
        offer: PublisherOffer,
        reply: &ReplyTarget,
        advertised: bool,
    ) -> Result<Arc<TopicPublisher>, PublishError> {
        let limit = self.shared.options.max_advertisements;
        let id = advertised.then(|| reply.id.clone());
        let mut topic_publishers = self.topic_publishers.lock();
        // Checked under the lock, so that a concurrent revocation comes after this.
        self.client_grants().check(Operation::Publish, topic)?;
        let count = topic_publishers.count();
        let known = topic_publishers.open.get_mut(topic);
        if let Some(known) = &known
            && known.topic_publisher.message_type.digest() != message_type.digest()
        {
            return Err(PublishError::TwoTypes {
                topic: topic.to_owned(),
                known: known.topic_publisher.message_type.name().to_owned(),
            });
        }
        let is_new = known.as_ref().is_none_or(|known| id.as_ref().is_some_and(|id| !known.ids.contains(id)));
        if is_new && count >= limit {
            return Err(PublishError::TooMany(limit));
        }
        let mut ids = HashSet::new();
        if let Some(known) = known {
            if known.topic_publisher.offer == offer || !advertised {
                known.ids.extend(id);
                return Ok(known.topic_publisher.clone());
            }
            ids = std::mem::take(&mut known.ids);
        }
        ids.extend(id);
        topic_publishers.told.remove(topic);
        let notified =
            Arc::new(AdvertiseNotifier { client: Arc::downgrade(self), topic: topic.to_owned(), reply: reply.clone() });
        if topic == tf::GOAL_TOPIC {
            self.shared.republisher.listen_for_goals(&self.shared);
        }
        let topic_publisher = TopicPublisher::open(&self.shared, topic, message_type, offer, notified);
        let opened = AdvertisedTopic { topic_publisher: topic_publisher.clone(), ids };
        let replaced = topic_publishers.open.insert(topic.to_owned(), opened);
        drop(topic_publishers);
        drop(replaced);
        Ok(topic_publisher)
    }

    pub(super) fn publish(
        self: &Arc<Self>,
        op: Publish<'_>,
        reply: &ReplyTarget,
        source: Option<&Bytes>,
    ) -> Result<(), PublishError> {
        let topic = self.resolve(&op.topic)?;
        let known = self.topic_publishers.lock().open.get(&*topic).map(|known| known.topic_publisher.clone());
        let topic_publisher = match known {
            Some(topic_publisher) => topic_publisher,
            None => match self
                .client_grants()
                .check(Operation::Publish, &topic)
                .map_err(PublishError::from)
                .and_then(|()| self.publish_type(&topic, &op))
            {
                Ok(Some(message_type)) => {
                    let offer = publication_offer(self.version(), op.qos, op.latch, None);
                    self.open_publisher(&topic, message_type, offer, reply, false)?
                }
                Ok(None) => return self.defer_publish(&topic, &op, reply),
                Err(reason) => return self.report_once(&topic, reason),
            },
        };
        let decoded = decode(&topic_publisher.message_type, op.msg, op.compression, source)
            .map_err(|source| PublishError::Payload { topic: topic.to_string(), source })?;
        topic_publisher.publish(self.take_decoded(decoded, "publish", ("topic", &topic), reply));
        if op.compression != Compression::CborRaw && self.wants_level(StatusLevel::Warning) {
            self.warn_defaulted_fields(&topic, &topic_publisher.message_type, op.msg, reply);
        }
        Ok(())
    }

    /// Warns about missing fields of the message; except a header, which clients may leave to the server.
    fn warn_defaulted_fields(&self, topic: &str, message_type: &MessageType, msg: Payload<'_>, reply: &ReplyTarget) {
        let Some(given) = msg.keys() else { return };
        let headers = usize::from(message_type.has_header());
        let fields = message_type.fields().iter().map(|field| &field.name);
        let missing: Vec<_> =
            fields.skip(headers).filter(|name| !given.contains(name)).map(|name| format!("{name:?}")).collect();
        if !missing.is_empty() {
            let missing = missing.join(", ");
            self.warn(reply, &format!("publish: topic {topic}: using defaults for {missing}"));
        }
    }

    /// Returns the type for publishing without advertising: the given one, or the topic's.
    fn publish_type(&self, topic: &str, op: &Publish<'_>) -> Result<Option<Arc<MessageType>>, PublishError> {
        if let Some(name) = &op.type_name {
            return self.publishable_type(topic, name).map(Some);
        }
        let graph = self.shared.bus.graph().borrow().clone();
        let local = self.shared.local_type(topic);
        match (graph.topics.get(topic), local) {
            (Some(nodes), _) if !matches!(nodes.type_name.as_str(), "" | "*") => {
                self.publishable_type(topic, &nodes.type_name).map(Some)
            }
            (_, Some(name)) => self.publishable_type(topic, &name).map(Some),
            (Some(_), None) => Ok(None),
            (None, None) => Err(PublishError::NoTopic(topic.to_owned())),
        }
    }

    /// Keeps a message until the nodes have announced the type of the topic.
    fn defer_publish(self: &Arc<Self>, topic: &str, op: &Publish<'_>, reply: &ReplyTarget) -> Result<(), PublishError> {
        let waiting = Untyped {
            format: op.msg.format,
            payload: Bytes::copy_from_slice(op.msg.bytes),
            compression: op.compression,
            offer: publication_offer(self.version(), op.qos, op.latch, None),
            reply: reply.clone(),
        };
        let mut topic_publishers = self.topic_publishers.lock();
        let held: usize = topic_publishers.untyped.values().flatten().map(|other| other.payload.len()).sum();
        if held > 0 && held + waiting.payload.len() > MAX_UNTYPED_BYTES {
            return Err(PublishError::TooManyUntypedBytes { topic: topic.to_owned(), waiting: held });
        }
        if let Some(others) = topic_publishers.untyped.get_mut(topic) {
            if others.len() >= MAX_UNTYPED_MESSAGES {
                return Err(PublishError::TooManyUntyped(topic.to_owned()));
            }
            others.push(waiting);
            return Ok(());
        }
        topic_publishers.untyped.insert(topic.to_owned(), vec![waiting]);
        drop(topic_publishers);
        let (client, topic) = (self.clone(), topic.to_owned());
        tokio::spawn(async move {
            let asked = tokio::select! {
                () = client.wait_ended() => return,
                asked = client.shared.bus.topic_type(&topic) => asked,
            };
            let waiting = client.topic_publishers.lock().untyped.remove(&topic).unwrap_or_default();
            let report = |message: &Untyped, error: &PublishError| {
                if !client.mark_reported(&topic) {
                    client.error(&message.reply, &format!("publish: topic {topic}: {error}"));
                }
            };
            let found = asked.map_err(PublishError::from);
            match found.and_then(|wire| client.publishable_type(&topic, &wire.name)) {
                Ok(message_type) => {
                    for message in &waiting {
                        let done = client.publish_untyped(&topic, message_type.clone(), message);
                        if let Err(error) = done {
                            report(message, &error);
                        }
                    }
                }
                Err(error) => {
                    for message in &waiting {
                        report(message, &error);
                    }
                }
            }
        });
        Ok(())
    }

    /// Publishes a message that has waited for this type.
    fn publish_untyped(
        self: &Arc<Self>,
        topic: &str,
        message_type: Arc<MessageType>,
        message: &Untyped,
    ) -> Result<(), PublishError> {
        let topic_publisher = self.open_publisher(topic, message_type, message.offer, &message.reply, false)?;
        let payload = Payload { format: message.format, bytes: &message.payload };
        let decoded = decode(&topic_publisher.message_type, payload, message.compression, None);
        let decoded = decoded.map_err(PublishError::UntypedPayload)?;
        topic_publisher.publish(self.take_decoded(decoded, "publish", ("topic", topic), &message.reply));
        Ok(())
    }
}
