//! Messages of a topic in the other ROS. They are translated when they are read from the queue of a subscription, so
//! that dropped ones cost nothing, and when they are published.

use std::sync::Arc;

use bytes::Bytes;
use parking_lot::Mutex;
use ros::bus::{BusError, MatchedPeers, Publisher, QosProfile, SerializedMessage, Subscription, WireType};
use tokio::sync::watch;
use tokio_util::task::AbortOnDropHandle;
use tracing::Instrument;

use super::state::{Translation, not_translated};
use crate::MessageTranslator;

/// Subscribes to a topic in the terms of the robot's ROS.
pub(super) async fn subscribe(
    translation: &Arc<Translation>,
    topic: &str,
    of: WireType,
    qos: QosProfile,
) -> Result<Subscription, BusError> {
    let known = translation.twins.message_with_twin(&of);
    let original = known.map_or_else(WireType::any, |twin| WireType::from_message(&twin.original));
    let original = original.with_version(translation.servant_version());
    let Subscription { messages, dropped, matched, guard } = translation.inner.subscribe(topic, original, qos).await?;
    let converter = MessageConverter {
        translation: Arc::clone(translation),
        topic: topic.to_owned(),
        wanted: of,
        last: Mutex::default(),
    };
    let (matched, following) = translate_changes(translation, matched);
    Ok(Subscription {
        messages: messages.with_conversion(move |message| converter.convert(message)),
        dropped,
        matched,
        guard: Box::new((guard, following)),
    })
}

/// Translates the messages of one subscription.
struct MessageConverter {
    translation: Arc<Translation>,
    topic: String,
    /// Type that the subscriber requests.
    wanted: WireType,
    last: Mutex<Option<KnownSource>>,
}

/// The type of the last message, and what becomes of its messages.
#[derive(Clone)]
struct KnownSource {
    original: Arc<WireType>,
    target: Result<(Arc<WireType>, Arc<MessageTranslator>), Arc<str>>,
}

impl MessageConverter {
    fn convert(&self, message: SerializedMessage) -> Option<SerializedMessage> {
        let translation = &self.translation;
        let source = self.find_source(&message.wire_type);
        let (wire_type, translator) = match source.target {
            Ok((wire_type, translator)) => (wire_type, translator),
            Err(reason) => {
                translation.losses.record_untranslated(&self.topic, reason);
                return None;
            }
        };
        if self.wanted.name != "*" && !self.wanted.is_compatible_with(&wire_type) {
            return None;
        }
        let bytes = translation.losses.translate(&self.topic, &translator, &message.bytes).ok()?;
        let publisher = translation.translate_peer(&message.publisher);
        Some(SerializedMessage { bytes, wire_type, publisher, latching: message.latching })
    }

    fn find_source(&self, original: &Arc<WireType>) -> KnownSource {
        let mut last = self.last.lock();
        let is_same = |known: &&KnownSource| {
            let of = &known.original;
            Arc::ptr_eq(of, original) || (of.name == original.name && of.digest == original.digest)
        };
        if let Some(known) = last.as_ref().filter(is_same) {
            return known.clone();
        }
        let twin = self.translation.twins.message(original);
        let target = twin.map(|twin| (Arc::new(WireType::from_message(&twin.twin)), Arc::clone(&twin.to_twin)));
        let target = target.map_err(|reason| reason.to_string().into());
        let found = KnownSource { original: Arc::clone(original), target };
        *last = Some(found.clone());
        found
    }
}

/// Advertises a topic with a type of the robot's ROS.
pub(super) async fn advertise(
    translation: &Arc<Translation>,
    topic: &str,
    of: &WireType,
    qos: QosProfile,
) -> Result<Box<dyn Publisher>, BusError> {
    let target = translation.twins.for_robot(of);
    let target = target.inspect_err(|reason| translation.losses.record_untranslated(topic, reason));
    let (original, translator) = target.map_err(|reason| not_translated(format!("topic {topic}"), reason))?;
    let publisher = translation.inner.advertise(topic, WireType::from_message(&original), qos).await?;
    let (matched, following) = translate_changes(translation, publisher.matched_subscribers());
    Ok(Box::new(TranslatedPublisher {
        publisher,
        translation: Arc::clone(translation),
        topic: topic.to_owned(),
        translator,
        matched,
        _following: following,
    }))
}

/// A topic of the servant to which a robot's messages are published.
struct TranslatedPublisher {
    publisher: Box<dyn Publisher>,
    translation: Arc<Translation>,
    topic: String,
    translator: Arc<MessageTranslator>,
    matched: watch::Receiver<MatchedPeers>,
    _following: AbortOnDropHandle<()>,
}

impl Publisher for TranslatedPublisher {
    fn publish(&self, bytes: Bytes) {
        // What cannot be carried was counted.
        if let Ok(message) = self.translation.losses.translate(&self.topic, &self.translator, &bytes) {
            self.publisher.publish(message);
        }
    }

    fn matched_subscribers(&self) -> watch::Receiver<MatchedPeers> {
        self.matched.clone()
    }

    fn dropped_count(&self) -> u64 {
        self.publisher.dropped_count()
    }
}

/// Returns matched endpoints as the robot sees them, updated as they change while the handle exists.
fn translate_changes(
    translation: &Arc<Translation>,
    mut inner: watch::Receiver<MatchedPeers>,
) -> (watch::Receiver<MatchedPeers>, AbortOnDropHandle<()>) {
    let first = translation.translate_matched(&inner.borrow_and_update());
    let (sender, matched) = watch::channel(first);
    let translation = Arc::clone(translation);
    let following = async move {
        while inner.changed().await.is_ok() {
            let now = inner.borrow_and_update().clone();
            let now = translation.translate_matched(&now);
            sender.send_if_modified(|before| std::mem::replace(before, now.clone()) != now);
        }
    };
    (matched, AbortOnDropHandle::new(tokio::spawn(following.in_current_span())))
}
