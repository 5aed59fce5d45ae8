//! `subscribe` and `unsubscribe`.

use std::collections::HashMap;
use std::sync::Arc;
use std::time::Instant;

use access::Operation;
use ros::bus::RosVersion;
use ros::schema::MessageType;
use rosbridge::{Compression, StatusLevel, Subscribe, Unsubscribe};

use super::{BridgeClient, ReplyTarget};
use crate::NotGrantedError;
use crate::client_state::{TopicListener, TopicSubscription};
use crate::fanout::Listener;
use crate::lacking::DefinitionError;
use crate::names::{DeclaredTypeError, ResolveNameError, is_same_type, lookup_name, ros_type_name};
use crate::outbox::TopicKey;
use crate::quality::{merge_qos, queue_length, subscription_qos};
use crate::sample::TopicSample;
use crate::topic_queue::{SubscriptionOptions, Subscriptions};

/// Reasons why a client may not subscribe to a topic.
#[derive(Debug, thiserror::Error)]
pub(super) enum SubscribeError {
    #[error(transparent)]
    Name(#[from] ResolveNameError),
    #[error(transparent)]
    NotGranted(#[from] NotGrantedError),
    #[error(transparent)]
    OtherType(#[from] DeclaredTypeError),
    #[error("topic {topic}: {source}")]
    Definition { topic: String, source: DefinitionError },
    #[error("topic {0} does not exist; give its \"type\" to wait for it; /rosapi/topics lists existing topics")]
    NoTopic(String),
    #[error("this client has {0} subscriptions already; unsubscribe from one")]
    TooMany(usize),
    #[error("this client subscribes to {topic} as {earlier}, not {wanted}; unsubscribe from it first")]
    TwoTypes { topic: String, earlier: String, wanted: String },
}

impl TopicSubscription {
    /// Returns the key of its queue in the outbox.
    pub(super) fn key(&self) -> TopicKey {
        self.key
    }
}

impl TopicListener {
    /// Returns the type of a message if it is not the one that the client asked for.
    fn mismatched_type<'s>(&self, sample: &'s TopicSample) -> Option<&'s str> {
        let offered = sample.wire_type.name.as_str();
        let wanted = self.wanted.as_deref()?;
        (offered != "*" && !is_same_type(wanted, offered)).then_some(offered)
    }
}

impl Listener for TopicListener {
    fn on_sample(&self, sample: &Arc<TopicSample>, replay: bool) {
        if !self.hears_clients && sample.local {
            return;
        }
        match self.mismatched_type(sample) {
            None => self.outbox.push_sample(self.key, sample.clone(), replay),
            Some(offered) if self.outbox.should_report(self.key, Instant::now()) => {
                let wanted = self.wanted.as_deref().unwrap_or_default();
                self.on_failed(&format!(
                    "{} publishes {offered} there, not {wanted}; its messages are dropped",
                    sample.publisher
                ));
            }
            Some(_) => {}
        }
    }

    fn on_failed(&self, reason: &str) {
        if let Some(client) = self.client.upgrade() {
            let text = format!("subscribe: topic {}: {reason}", self.topic);
            client.send_status(StatusLevel::Error, self.id.clone(), self.format, &text);
        }
    }

    fn on_refused(&self, reason: &str) {
        self.on_failed(reason);
    }
}

impl BridgeClient {
    pub(super) fn subscribe(self: &Arc<Self>, op: Subscribe<'_>, reply: &ReplyTarget) -> Result<(), SubscribeError> {
        let name = self.resolve(&op.topic)?;
        self.client_grants().check(Operation::Subscribe, &name)?;
        let expected = self.expected_type(&name, &op)?;
        let wishes = SubscriptionOptions {
            throttle_rate: op.throttle_rate,
            queue_length: queue_length(&op),
            fragment_size: op.fragment_size,
            compression: op.compression,
        };
        let qos = subscription_qos(op.qos, self.shared.options.bus_queue);
        let wanted = op
            .type_name
            .as_deref()
            .filter(|name| *name != "*")
            .map(|name| ros_type_name(self.version(), name, "msg").into_owned());
        let limit = self.shared.options.max_subscriptions;
        let mut subscribed = self.subscriptions.lock();
        let all: usize = subscribed.values().map(|known| known.subscriptions.len()).sum();
        let is_new = subscribed.get(&*op.topic).is_none_or(|known| !known.subscriptions.contains_key(&reply.id));
        if is_new && all >= limit {
            return Err(SubscribeError::TooMany(limit));
        }
        if let Some(known) = subscribed.get_mut(&*op.topic) {
            if let (Some(wanted), Some(earlier)) = (&wanted, &known.listener.wanted)
                && !is_same_type(wanted, earlier)
            {
                return Err(SubscribeError::TwoTypes {
                    topic: name.into_owned(),
                    earlier: earlier.clone(),
                    wanted: wanted.clone(),
                });
            }
            known.subscriptions.insert(reply.id.clone(), wishes);
            known.asked.insert(reply.id.clone(), qos);
            if !self.apply_options(known) {
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
            let fanout = self.shared.fanout_with_qos(&name, expected.as_deref(), qos);
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
        self.warn_ignored_qos("subscribe", op.qos, true, reply);
        self.info(reply, &format!("subscribe: subscribed to {name}"));
        Ok(())
    }

    /// Returns the type that the client may expect, if it is known; fails if the client expects another.
    fn expected_type(&self, topic: &str, op: &Subscribe<'_>) -> Result<Option<Arc<MessageType>>, SubscribeError> {
        let version = self.version();
        let graph = self.shared.bus.graph().borrow().clone();
        let nodes = graph.topics.get(topic);
        let actual = nodes.map(|nodes| nodes.type_name.as_str()).filter(|name| !name.is_empty() && *name != "*");
        let local = self.shared.local_type(topic);
        let actual = actual.or(local.as_deref());
        let wanted = op.type_name.as_deref().filter(|name| *name != "*");
        match (wanted, actual) {
            (None, None) if nodes.is_none() => {
                return Err(SubscribeError::NoTopic(topic.to_owned()));
            }
            (Some(wanted), Some(actual)) if !is_same_type(wanted, actual) => {
                let wanted = ros_type_name(version, wanted, "msg");
                let topic = format!("topic {topic}");
                return Err(DeclaredTypeError::new(topic, actual, &wanted).into());
            }
            _ => {}
        }
        let is_published = nodes.is_some_and(|nodes| !nodes.publishers.is_empty());
        // As the servant spells it, if it does.
        let Some(name) = actual.or(wanted) else {
            return Ok(None);
        };
        match self.shared.registry.message(&lookup_name(version, name)) {
            Ok(found) => Ok(Some(found)),
            // Not needed for ROS bytes, and a publisher of ROS 1 sends its own.
            Err(_) if op.compression == Compression::CborRaw => Ok(None),
            Err(_) if version == RosVersion::One && is_published => Ok(None),
            Err(error) => Err(SubscribeError::Definition {
                topic: topic.to_owned(),
                source: DefinitionError::new(version, error),
            }),
        }
    }

    /// Applies the combined options of a topic's subscriptions. Returns whether it listens to another fanout now, and
    /// so receives latched messages.
    fn apply_options(&self, known: &mut TopicSubscription) -> bool {
        if let Some(merged) = SubscriptionOptions::merge(known.subscriptions.values()) {
            self.outbox.change_topic(known.key, merged);
        }
        let fanout = known.listening.fanout();
        let asked = merge_qos(known.asked.values());
        let Some(qos) = asked.filter(|qos| !fanout.serves_qos(qos)) else {
            return false;
        };
        let expected = known.expected.as_deref();
        let fanout = self.shared.fanout_with_qos(&fanout.topic, expected, qos);
        known.listening = fanout.listen(known.listener.clone());
        true
    }

    pub(super) fn unsubscribe(&self, op: &Unsubscribe<'_>, reply: &ReplyTarget) {
        let mut subscribed = self.subscriptions.lock();
        let Some(known) = subscribed.get_mut(&*op.topic) else {
            drop(subscribed);
            self.warn(reply, &format!("unsubscribe: this client has no subscription to {}", op.topic));
            return;
        };
        let gone = match &reply.id {
            None => true,
            id => {
                known.asked.remove(id);
                if known.subscriptions.remove(id).is_none() {
                    self.warn(reply, &format!("unsubscribe: no subscription to {} has this id", op.topic));
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
            self.apply_options(known);
        }
        self.info(reply, &format!("unsubscribe: unsubscribed from {}", op.topic));
    }
}
