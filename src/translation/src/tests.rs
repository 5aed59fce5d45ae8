//! Types and messages of both ROSes.

mod messages;
mod packaged;
mod property;
mod twins;

use std::sync::Arc;

use ros_message::RosVersion;
use ros_message::codec::{FillOptions, JsonOptions, NonFinite, Time, from_json, to_json};
use ros_message::schema::{Field, MessageType, Registry};

use crate::shape::Slot;
use crate::{MessageTwin, NoTwin, TranslationRules, TypeTranslations};

/// Returns a registry of these definitions.
pub(crate) fn registry(version: RosVersion, definitions: &[(&str, &str)]) -> Arc<Registry> {
    let registry = Registry::for_version(version);
    for (key, text) in definitions {
        registry.insert(key, text).unwrap();
    }
    Arc::new(registry)
}

/// Returns the first of these definitions as a type.
pub(crate) fn message(version: RosVersion, definitions: &[(&str, &str)]) -> Arc<MessageType> {
    registry(version, definitions).message(definitions[0].0).unwrap()
}

/// Returns the twin by the built-in table.
fn twin(version: RosVersion, definitions: &[(&str, &str)]) -> Arc<MessageTwin> {
    twin_by(TranslationRules::default(), version, definitions).unwrap()
}

pub(crate) fn twin_by(
    rules: TranslationRules,
    version: RosVersion,
    definitions: &[(&str, &str)],
) -> Result<Arc<MessageTwin>, NoTwin> {
    TypeTranslations::new(rules).message(&message(version, definitions))
}

/// Returns the twin among these definitions of the other ROS.
pub(crate) fn twin_among(
    rules: TranslationRules,
    version: RosVersion,
    definitions: &[(&str, &str)],
    others: &[(&str, &str)],
) -> Result<Arc<MessageTwin>, NoTwin> {
    let other = version.other();
    let translations = TypeTranslations::new(rules).with_known(registry(other, others), other);
    translations.message(&message(version, definitions))
}

/// Returns the serialized message that this JSON describes.
pub(crate) fn serialize(message: &MessageType, json: &str) -> Vec<u8> {
    let mut bytes = Vec::new();
    let options = FillOptions { now: Some(Time { secs: 1, nsecs: 2 }), max_bytes: 1 << 20 };
    from_json(message, json.as_bytes(), &mut bytes, &options).unwrap();
    bytes
}

/// Returns a serialized message as JSON.
pub(crate) fn json(message: &MessageType, bytes: &[u8]) -> serde_json::Value {
    let mut json = Vec::new();
    let options = JsonOptions { non_finite: NonFinite::String, ..JsonOptions::default() };
    to_json(message, bytes, &mut json, &options).unwrap();
    serde_json::from_slice(&json).unwrap()
}

/// Carries a message, given as JSON, to its twin and returns it as JSON.
pub(crate) fn carry(pair: &MessageTwin, given: &str) -> serde_json::Value {
    let bytes = pair.to_twin.translate(&serialize(&pair.original, given)).unwrap();
    json(&pair.twin, &bytes)
}

/// Returns types and names of fields.
pub(crate) fn fields(message: &MessageType) -> Vec<String> {
    let written = |field: &Field| format!("{} {}", Slot::from_field(field).definition_text(), field.name);
    message.fields().iter().map(written).collect()
}
