//! `subscribe` and `unsubscribe`.

use std::collections::HashMap;
use std::sync::{Arc, Weak};
use std::time::Instant;

use access::Operation;
use ros::bus::{Qos, RosVersion};
use ros::schema::MessageType;
use rosbridge::{Compression, Format, Id, Level, Subscribe, Unsubscribe};

use super::{Client, Reply};
use crate::fanout::{Listener, Listening};
use crate::lacking::explain;
use crate::names::{is_same_type, other_type, sought, spelled};
use crate::outbox::{Outbox, TopicKey};
use crate::quality::{asked, most, queue_length};
use crate::sample::Sample;
use crate::topic_queue::{Subscriptions, Wishes};

/// A client's topics, by the name it uses.
pub(super) type Subscribed = HashMap<Arc<str>, TopicSubscription>;

pub(super) struct TopicSubscription {
    key: TopicKey,
    subscriptions: Subscriptions,
    /// What each of them asks of publishers.
    asked: HashMap<Option<Id<'static>>, Qos>,
    /// The topic's type, where it was known.
    expected: Option<Arc<MessageType>>,
    listening: Listening,
    listener: Arc<TopicListener>,
}

impl TopicSubscription {
    /// Its queue in the outbox.
    pub(super) fn key(&self) -> TopicKey {
        self.key
    }
}

/// Puts a topic's messages into the client's queue.
struct TopicListener {
    outbox: Arc<Outbox>,
    key: TopicKey,
    hears_clients: bool,
    client: Weak<Client>,
    topic: Arc<str>,
    /// The type the client asked for, where it did.
    wanted: Option<String>,
    id: Option<Id<'static>>,
    format: Format,
}

impl TopicListener {
    /// The type of a message, where it is not the one that the client asked for.
    fn misfit<'s>(&self, sample: &'s Sample) -> Option<&'s str> {
        let offered = sample.wire_type.name.as_str();
        let wanted = self.wanted.as_deref()?;
        (offered != "*" && !is_same_type(wanted, offered)).then_some(offered)
    }
}

impl Listener for TopicListener {
    fn sample(&self, sample: &Arc<Sample>, replay: bool) {
        if !self.hears_clients && sample.local {
            return;
        }
        match self.misfit(sample) {
            None => self.outbox.sample(self.key, sample.clone(), replay),
            Some(offered) if self.outbox.may_complain(self.key, Instant::now()) => {
                let wanted = self.wanted.as_deref().unwrap_or_default();
                self.failed(&format!(
                    "{} publishes {offered} there, not {wanted}; its messages are left out",
                    sample.publisher
                ));
            }
            Some(_) => {}
        }
    }

    fn failed(&self, reason: &str) {
        if let Some(client) = self.client.upgrade() {
            let text = format!("subscribe: topic {}: {reason}", self.topic);
            client.status(Level::Error, self.id.clone(), self.format, &text);
        }
    }

    fn refused(&self, reason: &str) {
        self.failed(reason);
    }
}

impl Client {
    pub(super) fn subscribe(
        self: &Arc<Self>,
        op: Subscribe<'_>,
        reply: &Reply,
    ) -> Result<(), String> {
        let name = self.resolve(&op.topic)?;
        self.granted().check(Operation::Subscribe, &name)?;
        let expected = self.expected_type(&name, &op)?;
        let wishes = Wishes {
            throttle_rate: op.throttle_rate,
            queue_length: queue_length(&op),
            fragment_size: op.fragment_size,
            compression: op.compression,
        };
        let qos = asked(op.qos, self.shared.options.bus_queue);
        let wanted = op
            .type_name
            .as_deref()
            .filter(|name| *name != "*")
            .map(|name| spelled(self.version(), name, "msg").into_owned());
        let limit = self.shared.options.max_subscriptions;
        let mut subscribed = self.subscriptions.lock();
        let all: usize = subscribed
            .values()
            .map(|known| known.subscriptions.len())
            .sum();
        let is_new = subscribed
            .get(&*op.topic)
            .is_none_or(|known| !known.subscriptions.contains_key(&reply.id));
        if is_new && all >= limit {
            return Err(format!(
                "this client has {limit} subscriptions already; unsubscribe from one"
            ));
        }
        if let Some(known) = subscribed.get_mut(&*op.topic) {
            if let (Some(wanted), Some(earlier)) = (&wanted, &known.listener.wanted)
                && !is_same_type(wanted, earlier)
            {
                return Err(format!(
                    "this client subscribes to {name} as {earlier}, not {wanted}; unsubscribe from it first"
                ));
            }
            known.subscriptions.insert(reply.id.clone(), wishes);
            known.asked.insert(reply.id.clone(), qos);
            if !self.apply_wishes(known) {
                known.listening.fanout().replay(known.listener.as_ref());
            }
        } else {
            let topic: Arc<str> = op.topic.as_ref().into();
            let key = self.outbox.add_topic(topic.clone(), wishes);
            let listener = Arc::new(TopicListener {
                outbox: self.outbox.clone(),
                key,
                hears_clients: self.hears_clients,
                client: Arc::downgrade(self),
                topic: topic.clone(),
                wanted,
                id: reply.id.clone(),
                format: reply.format,
            });
            let fanout = self.shared.fanout_of(&name, expected.as_deref(), qos);
            let listening = fanout.listen(listener.clone());
            let subscriptions = Subscriptions::from([(reply.id.clone(), wishes)]);
            subscribed.insert(
                topic,
                TopicSubscription {
                    key,
                    subscriptions,
                    asked: HashMap::from([(reply.id.clone(), qos)]),
                    expected,
                    listening,
                    listener,
                },
            );
        }
        drop(subscribed);
        self.report_unheard("subscribe", op.qos, true, reply);
        self.info(reply, &format!("subscribe: subscribed to {name}"));
        Ok(())
    }

    /// The type the client may expect, where anybody knows it; an error where it expects the wrong one.
    fn expected_type(
        &self,
        topic: &str,
        op: &Subscribe<'_>,
    ) -> Result<Option<Arc<MessageType>>, String> {
        let version = self.version();
        let graph = self.shared.bus.graph().borrow().clone();
        let nodes = graph.topics.get(topic);
        let actual = nodes
            .map(|nodes| nodes.type_name.as_str())
            .filter(|name| !name.is_empty() && *name != "*");
        let local = self.shared.local_type(topic);
        let actual = actual.or(local.as_deref());
        let wanted = op.type_name.as_deref().filter(|name| *name != "*");
        match (wanted, actual) {
            (None, None) if nodes.is_none() => {
                return Err(format!(
                    "topic {topic} does not exist; say its \"type\" to wait for it, /rosapi/topics lists those that do"
                ));
            }
            (Some(wanted), Some(actual)) if !is_same_type(wanted, actual) => {
                let wanted = spelled(version, wanted, "msg");
                return Err(other_type(&format!("topic {topic}"), actual, &wanted));
            }
            _ => {}
        }
        let is_published = nodes.is_some_and(|nodes| !nodes.publishers.is_empty());
        // As the servant writes it, where it does.
        let Some(name) = actual.or(wanted) else {
            return Ok(None);
        };
        match self.shared.registry.message(&sought(version, name)) {
            Ok(found) => Ok(Some(found)),
            // For ROS bytes none is needed, and a publisher of ROS 1 brings its own along.
            Err(_) if op.compression == Compression::CborRaw => Ok(None),
            Err(_) if version == RosVersion::One && is_published => Ok(None),
            Err(error) => Err(format!("topic {topic}: {}", explain(version, error))),
        }
    }

    /// Gives the topic what its subscriptions want together. Whether it is listened to anew, and so hears what was kept.
    fn apply_wishes(&self, known: &mut TopicSubscription) -> bool {
        if let Some(merged) = Wishes::merged(known.subscriptions.values()) {
            self.outbox.change_topic(known.key, merged);
        }
        let fanout = known.listening.fanout();
        let asked = most(known.asked.values());
        let Some(qos) = asked.filter(|qos| !fanout.serves(qos)) else {
            return false;
        };
        let expected = known.expected.as_deref();
        let fanout = self.shared.fanout_of(&fanout.topic, expected, qos);
        known.listening = fanout.listen(known.listener.clone());
        true
    }

    pub(super) fn unsubscribe(&self, op: &Unsubscribe<'_>, reply: &Reply) -> Result<(), String> {
        let mut subscribed = self.subscriptions.lock();
        let Some(known) = subscribed.get_mut(&*op.topic) else {
            drop(subscribed);
            self.warn(
                reply,
                &format!(
                    "unsubscribe: this client has no subscription to {}",
                    op.topic
                ),
            );
            return Ok(());
        };
        let gone = match &reply.id {
            None => true,
            id => {
                known.asked.remove(id);
                if known.subscriptions.remove(id).is_none() {
                    self.warn(
                        reply,
                        &format!("unsubscribe: no subscription to {} has this id", op.topic),
                    );
                }
                known.subscriptions.is_empty()
            }
        };
        if gone {
            let known = subscribed.remove(&*op.topic);
            drop(subscribed);
            if let Some(known) = known {
                self.outbox.remove_topic(known.key);
            }
        } else {
            self.apply_wishes(known);
        }
        self.info(
            reply,
            &format!("unsubscribe: unsubscribed from {}", op.topic),
        );
        Ok(())
    }
}
