//! `advertise`, `unadvertise`, `publish`.

use std::collections::{HashMap, HashSet};
use std::sync::{Arc, Weak};

use access::Operation;
use bytes::Bytes;
use ros::schema::MessageType;
use rosbridge::{Advertise, Compression, Format, Id, Level, Payload, Publish, Unadvertise};

use super::decoding::decode;
use super::{Client, Reply, take_chosen};
use crate::lacking::explain;
use crate::names::{digest_word, is_same_type, other_type, sought, spelled};
use crate::quality::{Offer, offered};
use crate::tf;
use crate::topic_publisher::{Notified, TopicPublisher};

/// Messages on one topic that wait until its type is known.
const MAX_UNTYPED: usize = 64;
/// Bytes of all such messages of one client; one message may have more.
const MAX_UNTYPED_BYTES: usize = 16 << 20;

/// A client's topics, by their absolute names.
#[derive(Default)]
pub(super) struct TopicPublishers {
    open: HashMap<String, Advertised>,
    untyped: HashMap<String, Vec<Untyped>>,
    /// Topics of which the client has been told why nothing can be published on them.
    told: HashSet<String>,
}

/// A topic that is published on until it has been unadvertised as often as it was advertised.
pub(super) struct Advertised {
    topic_publisher: Arc<TopicPublisher>,
    /// Those of its advertisements; none where it was only published on.
    ids: HashSet<Option<Id<'static>>>,
}

impl TopicPublishers {
    /// How many advertisements there are.
    fn count(&self) -> usize {
        let known = self.open.values();
        known.map(|known| known.ids.len().max(1)).sum()
    }

    /// Removes those of these topics, and what waits for their types.
    pub(super) fn take(&mut self, chosen: impl Fn(&str) -> bool) -> Vec<(String, Advertised)> {
        self.untyped.retain(|topic, _| !chosen(topic));
        self.told.retain(|topic| !chosen(topic));
        take_chosen(&mut self.open, chosen)
    }

    /// Names of the topics advertised.
    pub(super) fn topics(&self) -> impl Iterator<Item = &str> {
        self.open.keys().map(String::as_str)
    }
}

/// Passes on to a client what it must know of a topic that it publishes.
struct Advertiser {
    client: Weak<Client>,
    topic: String,
    reply: Reply,
}

impl Notified for Advertiser {
    fn failed(&self, reason: &str) {
        if let Some(client) = self.client.upgrade() {
            let gone = client.topic_publishers.lock().open.remove(&self.topic);
            drop(gone);
            self.refused(reason);
        }
    }

    fn refused(&self, reason: &str) {
        if let Some(client) = self.client.upgrade() {
            let text = format!("advertise: topic {}: {reason}", self.topic);
            client.error(&self.reply, &text);
        }
    }
}

/// A message whose topic's type is being asked for.
struct Untyped {
    format: Format,
    payload: Bytes,
    compression: Compression,
    offer: Offer,
    reply: Reply,
}

impl Client {
    pub(super) fn advertise(
        self: &Arc<Self>,
        op: &Advertise<'_>,
        reply: &Reply,
    ) -> Result<(), String> {
        let topic = self.resolve(&op.topic)?;
        self.granted().check(Operation::Publish, &topic)?;
        let message_type = self
            .publishable_type(&topic, &op.type_name)
            .inspect_err(|_| {
                self.note_told(&topic);
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
        let offer = offered(self.version(), op.qos, op.latch, op.queue_size);
        self.open_outlet(&topic, message_type, offer, reply, true)?;
        self.report_unheard("advertise", op.qos, false, reply);
        self.info(reply, &format!("advertise: advertised {topic}"));
        Ok(())
    }

    pub(super) fn unadvertise(&self, op: &Unadvertise<'_>, reply: &Reply) -> Result<(), String> {
        let topic = self.resolve(&op.topic)?;
        let mut topic_publishers = self.topic_publishers.lock();
        topic_publishers.told.remove(&*topic);
        let known = topic_publishers.open.get_mut(&*topic);
        // Without an id all of the client's advertisements are meant.
        let left = known.map(|known| match reply.id {
            None => Some(0),
            Some(_) => known.ids.remove(&reply.id).then_some(known.ids.len()),
        });
        let (gone, warning) = match left {
            None => (None, Some("this client does not advertise")),
            Some(None) => (None, Some("no advertisement with this id is there of")),
            Some(Some(0)) => (topic_publishers.open.remove(&*topic), None),
            Some(Some(_)) => (None, None),
        };
        // The topic_publisher goes outside of the lock.
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

    /// The type by that name, if the topic may be published with it.
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
            let name = spelled(version, type_name, "msg");
            return Err(other_type(&format!("topic {topic}"), theirs, &name));
        }
        self.shared
            .registry
            .message(&sought(version, type_name))
            .map_err(|error| format!("topic {topic}: {}", explain(version, error)))
    }

    /// The client is being told why nothing can be published on a topic. Gives whether it had been before.
    fn note_told(&self, topic: &str) -> bool {
        let mut topic_publishers = self.topic_publishers.lock();
        // Topics whose names never end must not fill the memory.
        if topic_publishers.told.len() >= self.shared.options.max_advertisements {
            topic_publishers.told.clear();
        }
        !topic_publishers.told.insert(topic.to_owned())
    }

    /// Gives the reason why a message cannot be published with the first such message of its topic: more of them may
    /// come by the hundred.
    fn report_once(&self, topic: &str, reason: String) -> Result<(), String> {
        match self.note_told(topic) {
            false => Err(reason),
            true => Ok(()),
        }
    }

    fn open_outlet(
        self: &Arc<Self>,
        topic: &str,
        message_type: Arc<MessageType>,
        offer: Offer,
        reply: &Reply,
        advertised: bool,
    ) -> Result<Arc<TopicPublisher>, String> {
        let limit = self.shared.options.max_advertisements;
        let id = advertised.then(|| reply.id.clone());
        let mut topic_publishers = self.topic_publishers.lock();
        // Under the lock: what is taken back meanwhile is taken after this.
        self.granted().check(Operation::Publish, topic)?;
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
        let notified = Arc::new(Advertiser {
            client: Arc::downgrade(self),
            topic: topic.to_owned(),
            reply: reply.clone(),
        });
        if topic == tf::GOAL_TOPIC {
            self.shared.republisher.listen(&self.shared);
        }
        let topic_publisher =
            TopicPublisher::open(&self.shared, topic, message_type, offer, notified);
        let opened = Advertised {
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
        reply: &Reply,
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
                .granted()
                .check(Operation::Publish, &topic)
                .and_then(|()| self.type_to_publish(&topic, &op))
            {
                Ok(Some(message_type)) => {
                    let offer = offered(self.version(), op.qos, op.latch, None);
                    self.open_outlet(&topic, message_type, offer, reply, false)?
                }
                Ok(None) => return self.publish_later(&topic, &op, reply),
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
        if op.compression != Compression::CborRaw && self.hears(Level::Warning) {
            self.report_defaults(&topic, &topic_publisher.message_type, op.msg, reply);
        }
        Ok(())
    }

    /// Names the message's own fields that were left out; not a header, which clients may leave to the server.
    fn report_defaults(
        &self,
        topic: &str,
        message_type: &MessageType,
        msg: Payload<'_>,
        reply: &Reply,
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
                &format!("publish: topic {topic}: defaults stand for {missing}"),
            );
        }
    }

    /// What to publish as without having advertised: the type said, or the topic's.
    fn type_to_publish(
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

    /// Keeps a message until the nodes have said what type the topic has.
    fn publish_later(
        self: &Arc<Self>,
        topic: &str,
        op: &Publish<'_>,
        reply: &Reply,
    ) -> Result<(), String> {
        let waiting = Untyped {
            format: op.msg.format,
            payload: Bytes::copy_from_slice(op.msg.bytes),
            compression: op.compression,
            offer: offered(self.version(), op.qos, op.latch, None),
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
                "topic {topic} has no known type yet, and {waiting_bytes} bytes wait for one already; advertise it first"
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
                () = client.ended() => return,
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
                    let topic_publisher = client.open_outlet(
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
                    && !client.note_told(&topic)
                {
                    client.error(&message.reply, &format!("publish: topic {topic}: {reason}"));
                }
            }
        });
        Ok(())
    }
}
