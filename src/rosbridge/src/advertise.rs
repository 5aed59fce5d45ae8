//! `advertise`, `unadvertise`: a client announces that it will publish on a topic, or no longer will.

use std::borrow::Cow;

use crate::fields::Fields;
use crate::message::Message;
use crate::{Id, Problem, QosRequest, Writer};

/// Announces that the client will publish on a topic.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Advertise<'a> {
    /// Id of the interaction.
    pub id: Option<Id<'a>>,
    /// Name of the topic.
    pub topic: Cow<'a, str>,
    /// Type of the messages: `package/Type`.
    pub type_name: Cow<'a, str>,
    /// Sends the last message to new subscribers.
    pub latch: bool,
    /// Number of messages queued for a slow subscriber.
    pub queue_size: Option<u64>,
    /// Digest of the client's own definition (MD5, or the type hash of ROS 2), for clients that publish ROS bytes
    /// (extension).
    pub md5sum: Option<Cow<'a, str>>,
    /// Quality of service offered by the client.
    pub qos: Option<QosRequest>,
}

impl<'a> Message<'a> for Advertise<'a> {
    const OP: &'static str = "advertise";
    const FIELDS: &'static [&'static str] = &["topic", "type", "latch", "queue_size", "md5sum", "qos"];

    fn read(id: Option<Id<'a>>, fields: &Fields<'a>) -> Result<Self, Problem> {
        Ok(Self {
            id,
            topic: fields.required_text("topic", "a topic name")?,
            type_name: fields.required_text("type", "a message type such as \"std_msgs/String\"")?,
            latch: fields.boolean("latch")?.unwrap_or(false),
            queue_size: fields.count("queue_size", 0, "a number of messages")?,
            md5sum: fields.text("md5sum", "the definition's MD5 in hex, or its type hash,")?,
            qos: QosRequest::read(fields)?,
        })
    }

    fn id(&self) -> Option<&Id<'a>> {
        self.id.as_ref()
    }

    fn write(&self, writer: &mut Writer<'_>) {
        writer.text("topic", &self.topic);
        writer.text("type", &self.type_name);
        if self.latch {
            writer.boolean("latch", true);
        }
        writer.optional_count("queue_size", self.queue_size);
        writer.optional_text("md5sum", &self.md5sum);
        QosRequest::write(self.qos, writer);
    }
}

/// Announces that the client will no longer publish on a topic.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Unadvertise<'a> {
    /// Id of the interaction.
    pub id: Option<Id<'a>>,
    /// Name of the topic.
    pub topic: Cow<'a, str>,
}

impl<'a> Message<'a> for Unadvertise<'a> {
    const OP: &'static str = "unadvertise";
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

    fn chatter() -> Advertise<'static> {
        Advertise {
            id: Some("advertise:/chatter:1".into()),
            topic: "/chatter".into(),
            type_name: "std_msgs/String".into(),
            latch: true,
            queue_size: Some(100),
            md5sum: None,
            qos: None,
        }
    }

    #[test]
    fn advertise_is_read() {
        assert_parses(
            r#"{"op":"advertise","id":"advertise:/chatter:1","type":"std_msgs/String","topic":"/chatter","latch":true,"queue_size":100}"#,
            chatter(),
        );
        assert_survives_cbor(chatter());
        assert_parses(
            r#"{"op":"advertise","topic":"/chatter","type":"std_msgs/String","queue_size":null,"md5sum":"992c"}"#,
            Advertise { id: None, latch: false, queue_size: None, md5sum: Some("992c".into()), ..chatter() },
        );
    }

    #[test]
    fn advertise_is_checked() {
        assert_refused(r#"{"op":"advertise"}"#, "advertise: field \"topic\" is missing, a topic name is expected");
        assert_refused(
            r#"{"op":"advertise","topic":"/x"}"#,
            "advertise: field \"type\" is missing, a message type such as \"std_msgs/String\" is expected",
        );
        assert_refused(
            r#"{"op":"advertise","topic":"","type":"a/B"}"#,
            "advertise: field \"topic\" is empty, a topic name is expected",
        );
        assert_refused(
            r#"{"op":"advertise","topic":"/x","type":"a/B","latch":1}"#,
            "advertise: field \"latch\" is 1, true or false is expected",
        );
        assert_refused(
            r#"{"op":"advertise","topic":"/x","type":"a/B","queue_size":-1}"#,
            "advertise: field \"queue_size\" is -1, a number of messages is expected",
        );
        assert_refused(
            r#"{"op":"advertise","topic":"/x","type":"a/B","queue_size":1e300}"#,
            "advertise: field \"queue_size\" is 1e300, a number of messages is expected",
        );
    }

    #[test]
    fn unadvertise_is_read_and_checked() {
        let op = Unadvertise { id: Some(Id::Integer(3)), topic: "/chatter".into() };
        assert_parses(r#"{"op":"unadvertise","id":3,"topic":"/chatter"}"#, op.clone());
        assert_survives_cbor(op);
        assert_refused(r#"{"op":"unadvertise"}"#, "unadvertise: field \"topic\" is missing, a topic name is expected");
    }
}
