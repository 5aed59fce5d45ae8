//! `subscribe`, `unsubscribe`, and the encodings a client can ask for.

use std::borrow::Cow;
use std::time::Duration;

use crate::fields::Fields;
use crate::message::Message;
use crate::{Id, Problem, QosRequest, Writer};

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

    pub(crate) fn read(fields: &Fields<'_>) -> Result<Self, Problem> {
        Ok(Self::read_optional(fields)?.unwrap_or_default())
    }

    pub(crate) fn read_optional(fields: &Fields<'_>) -> Result<Option<Self>, Problem> {
        const EXPECTED: &str = "none, png, preview, cbor or cbor-raw";
        match fields.text("compression", EXPECTED)?.as_deref() {
            None => Ok(None),
            Some("none" | "") => Ok(Some(Compression::None)),
            Some("png") => Ok(Some(Compression::Png)),
            Some("preview") => Ok(Some(Compression::Preview)),
            Some("cbor") => Ok(Some(Compression::Cbor)),
            Some("cbor-raw") => Ok(Some(Compression::CborRaw)),
            Some(other) => {
                let found = format!("{:?}", other.chars().take(48).collect::<String>());
                Err(Problem::Mistyped { field: "compression", expected: EXPECTED, found })
            }
        }
    }

    pub(crate) fn write(self, writer: &mut Writer<'_>) {
        if self != Compression::None {
            writer.text("compression", self.name());
        }
    }
}

/// Reads the field `fragment_size`, which several ops have.
pub(crate) fn fragment_size(fields: &Fields<'_>) -> Result<Option<usize>, Problem> {
    let size = fields.count("fragment_size", 1, "a number of bytes, 1 or more,")?;
    Ok(size.map(|size| usize::try_from(size).unwrap_or(usize::MAX)))
}

/// Subscribes to a topic.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Subscribe<'a> {
    /// Id of this subscription, for `unsubscribe`.
    pub id: Option<Id<'a>>,
    /// Name of the topic.
    pub topic: Cow<'a, str>,
    /// `package/Type`; inferred if absent.
    pub type_name: Option<Cow<'a, str>>,
    /// Minimum time between two messages.
    pub throttle_rate: Duration,
    /// Number of messages queued while throttled; 0: none.
    pub queue_length: usize,
    /// Maximum frame size in bytes; longer frames are fragmented.
    pub fragment_size: Option<usize>,
    /// Encoding of the messages.
    pub compression: Compression,
    /// Quality of service requested.
    pub qos: Option<QosRequest>,
}

impl<'a> Message<'a> for Subscribe<'a> {
    const OP: &'static str = "subscribe";
    const FIELDS: &'static [&'static str] =
        &["topic", "type", "throttle_rate", "queue_length", "fragment_size", "compression", "qos"];

    fn read(id: Option<Id<'a>>, fields: &Fields<'a>) -> Result<Self, Problem> {
        let milliseconds = "a number of milliseconds, 0 or more,";
        let length = fields.count("queue_length", 0, "a number of messages, 0 or more,")?;
        Ok(Self {
            id,
            topic: fields.required_text("topic", "a topic name")?,
            type_name: fields
                .text("type", "a message type such as \"std_msgs/String\"")?
                .filter(|name| !name.is_empty()),
            throttle_rate: fields
                .duration("throttle_rate", Duration::from_millis(1), milliseconds)?
                .unwrap_or_default(),
            queue_length: usize::try_from(length.unwrap_or(0)).unwrap_or(usize::MAX),
            fragment_size: fragment_size(fields)?,
            compression: Compression::read(fields)?,
            qos: QosRequest::read(fields)?,
        })
    }

    fn id(&self) -> Option<&Id<'a>> {
        self.id.as_ref()
    }

    fn write(&self, writer: &mut Writer<'_>) {
        writer.text("topic", &self.topic);
        writer.optional_text("type", &self.type_name);
        if !self.throttle_rate.is_zero() {
            writer.number("throttle_rate", self.throttle_rate.as_secs_f64() * 1e3);
        }
        if self.queue_length > 0 {
            writer.optional_count("queue_length", Some(self.queue_length as u64));
        }
        writer.optional_count("fragment_size", self.fragment_size.map(|size| size as u64));
        self.compression.write(writer);
        QosRequest::write(self.qos, writer);
    }
}

/// Ends one or all subscriptions to a topic.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Unsubscribe<'a> {
    /// Id of the subscription; all of the topic's if absent.
    pub id: Option<Id<'a>>,
    /// Name of the topic.
    pub topic: Cow<'a, str>,
}

impl<'a> Message<'a> for Unsubscribe<'a> {
    const OP: &'static str = "unsubscribe";
    const FIELDS: &'static [&'static str] = &["topic"];

    fn read(id: Option<Id<'a>>, fields: &Fields<'a>) -> Result<Self, Problem> {
        Ok(Self { id, topic: fields.required_text("topic", "a topic name")? })
    }

    fn id(&self) -> Option<&Id<'a>> {
        self.id.as_ref()
    }

    fn write(&self, writer: &mut Writer<'_>) {
        writer.text("topic", &self.topic);
    }
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
