//! `advertise`, `unadvertise`: a client announces that it will publish on a topic, or no longer will.

use std::borrow::Cow;

use crate::field_kinds::{Flag, MESSAGE_TYPE, OptionalCount, OptionalId, OptionalText, Qos, TOPIC, Text};
use crate::message::message;
use crate::{Id, QosRequest};

message! {
    /// Announces that the client will publish on a topic.
    Advertise "advertise"
    /// Id of the interaction.
    id: Option<Id<'a>> = OptionalId,
    /// Name of the topic.
    topic: Cow<'a, str> = "topic" TOPIC,
    /// Type of the messages: `package/Type`.
    type_name: Cow<'a, str> = "type" Text(MESSAGE_TYPE),
    /// Sends the last message to new subscribers.
    latch: bool = "latch" Flag,
    /// Number of messages queued for a slow subscriber.
    queue_size: Option<u64> = "queue_size" OptionalCount("a number of messages"),
    /// Digest of the client's own definition (MD5, or the type hash of ROS 2), for clients that publish ROS bytes
    /// (extension).
    md5sum: Option<Cow<'a, str>> = "md5sum" OptionalText("the definition's MD5 in hex, or its type hash,"),
    /// Quality of service offered by the client.
    qos: Option<QosRequest> = "qos" Qos,
}

message! {
    /// Announces that the client will no longer publish on a topic.
    Unadvertise "unadvertise"
    /// Id of the interaction.
    id: Option<Id<'a>> = OptionalId,
    /// Name of the topic.
    topic: Cow<'a, str> = "topic" TOPIC,
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
