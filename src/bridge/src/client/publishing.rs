//! `advertise`, `unadvertise`, `publish`.

use std::collections::{HashMap, HashSet};
use std::sync::{Arc, Weak};

use access::Operation;
use bytes::Bytes;
use ros::schema::MessageType;
use rosbridge::{Advertise, Compression, Format, Id, Payload, Publish, StatusLevel, Unadvertise};

use super::decoding::decode;
use super::{BridgeClient, ReplyTarget, remove_matching};
use crate::lacking::explain_schema_error;
use crate::names::{digest_word, is_same_type, lookup_name, ros_type_name, type_mismatch};
use crate::quality::{PublisherOffer, publication_offer};
use crate::tf;
use crate::topic_publisher::{PublisherEvents, TopicPublisher};

/// Maximum number of messages on one topic that wait until its type is known.
const MAX_UNTYPED: usize = 64;
/// Maximum bytes of all such messages of one client; a single message may be larger.
const MAX_UNTYPED_BYTES: usize = 16 << 20;

/// Topics of a client, by absolute name.
#[derive(Default)]
pub(super) struct TopicPublishers {
    open: HashMap<String, AdvertisedTopic>,
    untyped: HashMap<String, Vec<Untyped>>,
    /// Topics for which the client was told why nothing can be published.
    told: HashSet<String>,
}

/// A topic that is published until it has been unadvertised as often as it was advertised.
pub(super) struct AdvertisedTopic {
    topic_publisher: Arc<TopicPublisher>,
    /// Ids of its advertisements; empty if it was only published on.
    ids: HashSet<Option<Id<'static>>>,
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

/// A message whose topic's type is being looked up.
struct Untyped {
    format: Format,
    payload: Bytes,
    compression: Compression,
    offer: PublisherOffer,
    reply: ReplyTarget,
}

impl BridgeClient {
    pub(super) fn advertise(
        self: &Arc<Self>,
        op: &Advertise<'_>,
        reply: &ReplyTarget,
    ) -> Result<(), String> {
        let topic = self.resolve(&op.topic)?;
        self.client_grants().check(Operation::Publish, &topic)?;
        let message_type = self
            .publishable_type(&topic, &op.type_name)
            .inspect_err(|_| {
                self.mark_reported(&topic);
            })?;
        if let Some(digest) = op
            .md5sum
            .as_deref()
            .filter(|digest| *digest != "*" && *digest != message_type.digest())
        {
            return Err(format!(
                "type {} has {} {} here and {digest} there; use the definition that /rosapi/message_details shows",
                message_type.name(),
                digest_word(self.version()),
                message_type.digest()
            ));
        }
        let offer = publication_offer(self.version(), op.qos, op.latch, op.queue_size);
        self.open_publisher(&topic, message_type, offer, reply, true)?;
        self.warn_ignored_qos("advertise", op.qos, false, reply);
        self.info(reply, &format!("advertise: advertised {topic}"));
        Ok(())
    }

    pub(super) fn unadvertise(
        &self,
        op: &Unadvertise<'_>,
        reply: &ReplyTarget,
    ) -> Result<(), String> {
        let topic = self.resolve(&op.topic)?;
        let mut topic_publishers = self.topic_publishers.lock();
        topic_publishers.told.remove(&*topic);
        let known = topic_publishers.open.get_mut(&*topic);
        // Without an id, all advertisements of the client are meant.
        let left = known.map(|known| match reply.id {
            None => Some(0),
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
            (Some(_), None) => self.info(
                reply,
                &format!("unadvertise: {topic} is no longer advertised"),
            ),
            (None, None) => self.info(
                reply,
                &format!("unadvertise: {topic} stays advertised, under another id"),
            ),
        }
        Ok(())
    }

    /// Returns the type of this name, if the topic may be published with it.
    fn publishable_type(&self, topic: &str, type_name: &str) -> Result<Arc<MessageType>, String> {
        let version = self.version();
        let graph = self.shared.bus.graph().borrow().clone();
        let theirs = graph
            .topics
            .get(topic)
            .map(|nodes| nodes.type_name.as_str());
        let other =
            |theirs: &&str| !matches!(*theirs, "" | "*") && !is_same_type(theirs, type_name);
        if let Some(theirs) = theirs.filter(other) {
            let name = ros_type_name(version, type_name, "msg");
            return Err(type_mismatch(&format!("topic {topic}"), theirs, &name));
        }
        self.shared
            .registry
            .message(&lookup_name(version, type_name))
            .map_err(|error| format!("topic {topic}: {}", explain_schema_error(version, error)))
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
    fn report_once(&self, topic: &str, reason: String) -> Result<(), String> {
        if self.mark_reported(topic) {
            Ok(())
        } else {
            Err(reason)
        }
    }

    fn open_publisher(
        self: &Arc<Self>,
        topic: &str,
        message_type: Arc<MessageType>,
        offer: PublisherOffer,
        reply: &ReplyTarget,
        advertised: bool,
    ) -> Result<Arc<TopicPublisher>, String> {
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
            let known = known.topic_publisher.message_type.name();
            return Err(format!(
                "this client advertises {topic} as {known}; unadvertise it first"
            ));
        }
        let is_new = known
            .as_ref()
            .is_none_or(|known| id.as_ref().is_some_and(|id| !known.ids.contains(id)));
        if is_new && count >= limit {
            return Err(format!(
                "this client advertises {limit} topics already; unadvertise one"
            ));
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
        let notified = Arc::new(AdvertiseNotifier {
            client: Arc::downgrade(self),
            topic: topic.to_owned(),
            reply: reply.clone(),
        });
        if topic == tf::GOAL_TOPIC {
            self.shared.republisher.listen_for_goals(&self.shared);
        }
        let topic_publisher =
            TopicPublisher::open(&self.shared, topic, message_type, offer, notified);
        let opened = AdvertisedTopic {
            topic_publisher: topic_publisher.clone(),
            ids,
        };
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
    ) -> Result<(), String> {
        let topic = self.resolve(&op.topic)?;
        let known = self
            .topic_publishers
            .lock()
            .open
            .get(&*topic)
            .map(|known| known.topic_publisher.clone());
        let topic_publisher = match known {
            Some(topic_publisher) => topic_publisher,
            None => match self
                .client_grants()
                .check(Operation::Publish, &topic)
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
        let bytes = decode(
            &topic_publisher.message_type,
            op.msg,
            op.compression,
            source,
        )
        .map_err(|reason| format!("topic {topic}: {reason}"))?;
        topic_publisher.publish(bytes);
        if op.compression != Compression::CborRaw && self.wants_level(StatusLevel::Warning) {
            self.warn_defaulted_fields(&topic, &topic_publisher.message_type, op.msg, reply);
        }
        Ok(())
    }

    /// Warns about missing fields of the message; except a header, which clients may leave to the server.
    fn warn_defaulted_fields(
        &self,
        topic: &str,
        message_type: &MessageType,
        msg: Payload<'_>,
        reply: &ReplyTarget,
    ) {
        let Some(given) = msg.keys() else { return };
        let headers = usize::from(message_type.has_header());
        let fields = message_type.fields().iter().map(|field| &field.name);
        let missing: Vec<_> = fields
            .skip(headers)
            .filter(|name| !given.contains(name))
            .map(|name| format!("{name:?}"))
            .collect();
        if !missing.is_empty() {
            let missing = missing.join(", ");
            self.warn(
                reply,
                &format!("publish: topic {topic}: using defaults for {missing}"),
            );
        }
    }

    /// Returns the type for publishing without advertising: the given one, or the topic's.
    fn publish_type(
        &self,
        topic: &str,
        op: &Publish<'_>,
    ) -> Result<Option<Arc<MessageType>>, String> {
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
            (None, None) => Err(format!(
                "topic {topic} does not exist; advertise it with its type first"
            )),
        }
    }

    /// Keeps a message until the nodes have announced the type of the topic.
    fn defer_publish(
        self: &Arc<Self>,
        topic: &str,
        op: &Publish<'_>,
        reply: &ReplyTarget,
    ) -> Result<(), String> {
        let waiting = Untyped {
            format: op.msg.format,
            payload: Bytes::copy_from_slice(op.msg.bytes),
            compression: op.compression,
            offer: publication_offer(self.version(), op.qos, op.latch, None),
            reply: reply.clone(),
        };
        let mut topic_publishers = self.topic_publishers.lock();
        let waiting_bytes: usize = topic_publishers
            .untyped
            .values()
            .flatten()
            .map(|other| other.payload.len())
            .sum();
        if waiting_bytes > 0 && waiting_bytes + waiting.payload.len() > MAX_UNTYPED_BYTES {
            return Err(format!(
                "topic {topic} has no known type yet, and {waiting_bytes} bytes wait for one already; advertise it \
                 first"
            ));
        }
        if let Some(others) = topic_publishers.untyped.get_mut(topic) {
            if others.len() >= MAX_UNTYPED {
                return Err(format!(
                    "topic {topic} has no known type yet; advertise it first"
                ));
            }
            others.push(waiting);
            return Ok(());
        }
        topic_publishers
            .untyped
            .insert(topic.to_owned(), vec![waiting]);
        drop(topic_publishers);
        let (client, topic) = (self.clone(), topic.to_owned());
        tokio::spawn(async move {
            let asked = tokio::select! {
                () = client.wait_ended() => return,
                asked = client.shared.bus.topic_type(&topic) => asked,
            };
            let waiting = client
                .topic_publishers
                .lock()
                .untyped
                .remove(&topic)
                .unwrap_or_default();
            let found = asked.map_err(|error| error.to_string());
            let found = found.and_then(|wire| client.publishable_type(&topic, &wire.name));
            for message in waiting {
                let done = found.clone().and_then(|message_type| {
                    let topic_publisher = client.open_publisher(
                        &topic,
                        message_type,
                        message.offer,
                        &message.reply,
                        false,
                    )?;
                    let payload = Payload {
                        format: message.format,
                        bytes: &message.payload,
                    };
                    topic_publisher.publish(decode(
                        &topic_publisher.message_type,
                        payload,
                        message.compression,
                        None,
                    )?);
                    Ok(())
                });
                if let Err(reason) = done
                    && !client.mark_reported(&topic)
                {
                    client.error(&message.reply, &format!("publish: topic {topic}: {reason}"));
                }
            }
        });
        Ok(())
    }
}
