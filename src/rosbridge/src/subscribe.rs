//! `subscribe`, `unsubscribe`, and the encodings a client can ask for.

use std::borrow::Cow;
use std::time::Duration;

use crate::field_kinds::{
    Encoding, FrameSize, MESSAGE_TYPE, Milliseconds, OptionalId, OptionalText, Qos, QueueLength, TOPIC,
};
use crate::message::message;
use crate::{Id, QosRequest};

/// Encoding of payloads.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Hash, Default)]
pub enum Compression {
    /// JSON.
    #[default]
    None,
    /// JSON encoded as a PNG image.
    Png,
    /// As [`Cbor`](Self::Cbor), with less in images and large clouds: for people who look at them.
    Preview,
    /// CBOR with typed arrays (RFC 8746).
    Cbor,
    /// The ROS serialization inside CBOR.
    CborRaw,
}

impl Compression {
    /// Returns the name in the protocol.
    pub fn name(self) -> &'static str {
        match self {
            Compression::None => "none",
            Compression::Png => "png",
            Compression::Preview => "preview",
            Compression::Cbor => "cbor",
            Compression::CborRaw => "cbor-raw",
        }
    }

    /// Converts from the name in the protocol.
    pub(crate) fn from_name(name: &str) -> Option<Self> {
        let all = [Compression::None, Compression::Png, Compression::Preview, Compression::Cbor, Compression::CborRaw];
        all.into_iter().find(|compression| compression.name() == name)
    }
}

message! {
    /// Subscribes to a topic.
    Subscribe "subscribe"
    /// Id of this subscription, for `unsubscribe`.
    id: Option<Id<'a>> = OptionalId,
    /// Name of the topic.
    topic: Cow<'a, str> = "topic" TOPIC,
    /// `package/Type`; inferred if absent.
    type_name: Option<Cow<'a, str>> = "type" OptionalText(MESSAGE_TYPE),
    /// Minimum time between two messages.
    throttle_rate: Duration = "throttle_rate" Milliseconds,
    /// Number of messages queued while throttled; 0: none.
    queue_length: usize = "queue_length" QueueLength,
    /// Maximum frame size in bytes; longer frames are fragmented.
    fragment_size: Option<usize> = "fragment_size" FrameSize,
    /// Encoding of the messages.
    compression: Compression = "compression" Encoding,
    /// Quality of service requested.
    qos: Option<QosRequest> = "qos" Qos,
}

message! {
    /// Ends one or all subscriptions to a topic.
    Unsubscribe "unsubscribe"
    /// Id of the subscription; all of the topic's if absent.
    id: Option<Id<'a>> = OptionalId,
    /// Name of the topic.
    topic: Cow<'a, str> = "topic" TOPIC,
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::op::tests::{assert_parses, assert_refused, assert_survives_cbor};

    fn image() -> Subscribe<'static> {
        Subscribe {
            id: Some("subscribe:/image:1".into()),
            topic: "/image".into(),
            type_name: Some("sensor_msgs/Image".into()),
            throttle_rate: Duration::from_millis(100),
            queue_length: 2,
            fragment_size: Some(10_000),
            compression: Compression::CborRaw,
            qos: None,
        }
    }

    #[test]
    fn subscribe_is_read() {
        assert_parses(
            r#"{"op":"subscribe","id":"subscribe:/image:1","topic":"/image","type":"sensor_msgs/Image","throttle_rate":100,"queue_length":2,"fragment_size":10000,"compression":"cbor-raw"}"#,
            image(),
        );
        assert_survives_cbor(image());
        assert_survives_cbor(Subscribe { throttle_rate: Duration::from_micros(1500), ..image() });
        assert_parses(
            r#"{"op":"subscribe","topic":"/image","type":"","throttle_rate":0.0,"fragment_size":null}"#,
            Subscribe {
                id: None,
                type_name: None,
                throttle_rate: Duration::ZERO,
                queue_length: 0,
                fragment_size: None,
                compression: Compression::None,
                ..image()
            },
        );
    }

    #[test]
    fn subscribe_is_checked() {
        assert_refused(r#"{"op":"subscribe"}"#, "subscribe: field \"topic\" is missing, a topic name is expected");
        for (field, value, expected) in [
            ("throttle_rate", "\"fast\"", "a number of milliseconds, 0 or more,"),
            ("throttle_rate", "-1", "a number of milliseconds, 0 or more,"),
            ("queue_length", "1.5", "a number of messages, 0 or more,"),
            ("fragment_size", "0", "a number of bytes, 1 or more,"),
            ("compression", "\"zip\"", "none, png, preview, cbor or cbor-raw"),
            ("compression", "7", "none, png, preview, cbor or cbor-raw"),
            ("type", "[]", "a message type such as \"std_msgs/String\""),
        ] {
            assert_refused(
                &format!(r#"{{"op":"subscribe","topic":"/x","{field}":{value}}}"#),
                &format!("subscribe: field \"{field}\" is {value}, {expected} is expected"),
            );
        }
    }

    #[test]
    fn unsubscribe_is_read_and_checked() {
        let op = Unsubscribe { id: Some("a".into()), topic: "/image".into() };
        assert_parses(r#"{"op":"unsubscribe","id":"a","topic":"/image"}"#, op.clone());
        assert_survives_cbor(op);
        assert_refused(r#"{"op":"unsubscribe"}"#, "unsubscribe: field \"topic\" is missing, a topic name is expected");
    }
}
