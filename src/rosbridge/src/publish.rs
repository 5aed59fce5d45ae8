//! `publish`: one message on a topic, from the client or to it.

use std::borrow::Cow;

use crate::field_kinds::{Encoding, Flag, MESSAGE_TYPE, MessageOrEmpty, OptionalId, OptionalText, Qos, TOPIC};
use crate::message::{Message, message};
use crate::{Compression, Format, Id, Payload, QosRequest, Writer};

message! {
    /// A message on a topic.
    Publish "publish" ignores ["queue_size"]
    /// Id of the interaction.
    id: Option<Id<'a>> = OptionalId,
    /// Name of the topic.
    topic: Cow<'a, str> = "topic" TOPIC,
    /// `package/Type`, if the client has not advertised (extension).
    type_name: Option<Cow<'a, str>> = "type" OptionalText(MESSAGE_TYPE),
    /// Encoding of `msg`. Clients must say `cbor-raw` when they send it; the server does not repeat what a client asked
    /// for.
    compression: Compression = "compression" Encoding,
    /// Latches, as in `advertise`; some clients repeat it here instead.
    latch: bool = "latch" Flag,
    /// Quality of service offered, if the client has not advertised.
    qos: Option<QosRequest> = "qos" Qos,
    /// The message; an empty object if the client gave none; [`Payload::raw`] if `compression` is `cbor-raw`.
    msg: Payload<'a> = "msg" MessageOrEmpty,
}

impl<'a> Publish<'a> {
    /// Appends a whole frame for a client; `msg` writes the message in place.
    ///
    /// # Errors
    /// Returns the error of `msg`; `out` then ends in an incomplete frame.
    pub fn print_with<E>(
        out: &mut Vec<u8>,
        format: Format,
        topic: &str,
        msg: impl FnOnce(&mut Vec<u8>) -> Result<(), E>,
    ) -> Result<(), E> {
        let mut writer = Writer::op(out, format, Self::OP, None);
        writer.text("topic", topic);
        writer.value("msg", msg)?;
        writer.end();
        Ok(())
    }

    /// Appends a whole `cbor-raw` frame: a serialized message and its time of reception.
    pub fn print_raw(out: &mut Vec<u8>, topic: &str, stamp: (u32, u32), bytes: &[u8]) {
        let mut writer = Writer::op(out, Format::Cbor, Self::OP, None);
        writer.text("topic", topic);
        writer.raw("msg", Some(stamp), bytes);
        writer.end();
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::op::tests::{assert_parses, assert_refused};
    use crate::{Op, ProtocolFrame};

    fn hello() -> Publish<'static> {
        Publish {
            id: None,
            topic: "/chatter".into(),
            msg: Payload::json(r#"{"data":"hello"}"#),
            compression: Compression::None,
            latch: false,
            type_name: None,
            qos: None,
        }
    }

    #[test]
    fn publish_is_read() {
        assert_parses(r#"{"op":"publish","topic":"/chatter","msg":{"data":"hello"}}"#, hello());
        assert_parses(
            r#"{"msg":{"data":"hello"},"latch":true,"topic":"/chatter","id":"publish:/chatter:1","op":"publish"}"#,
            Publish { id: Some("publish:/chatter:1".into()), latch: true, ..hello() },
        );
    }

    #[test]
    fn without_a_message_it_is_one_of_defaults() {
        let empty = Publish { msg: Payload::json("{}"), ..hello() };
        assert_parses(r#"{"op":"publish","topic":"/chatter"}"#, empty.clone());
        assert_parses(r#"{"op":"publish","topic":"/chatter","msg":null}"#, empty);
        let frame = b"\xa2\x62op\x67publish\x65topic\x62/x";
        let Op::Publish(read) = Op::parse(ProtocolFrame::Binary(frame)).unwrap() else { panic!("not a publish") };
        assert_eq!(read.msg, Payload::cbor(b"\xa0"));
    }

    #[test]
    fn publish_is_checked() {
        assert_refused(r#"{"op":"publish","msg":{}}"#, "publish: field \"topic\" is missing, a topic name is expected");
        assert_refused(
            r#"{"op":"publish","topic":"/x","msg":[1,2]}"#,
            "publish: field \"msg\" is [1,2], an object with the message's fields is expected",
        );
        assert_refused(
            &format!(r#"{{"op":"publish","topic":"/x","msg":"{}"}}"#, "ü".repeat(100)),
            &format!(
                "publish: field \"msg\" is \"{}…, an object with the message's fields is expected",
                "ü".repeat(47)
            ),
        );
    }

    #[test]
    fn frames_for_clients_are_printed_in_place() {
        let mut out = Vec::new();
        let msg = |out: &mut Vec<u8>| {
            out.extend_from_slice(br#"{"data":"hello"}"#);
            Ok::<(), std::convert::Infallible>(())
        };
        Publish::print_with(&mut out, Format::Json, "/chatter", msg).unwrap();
        assert_eq!(String::from_utf8(out).unwrap(), r#"{"op":"publish","topic":"/chatter","msg":{"data":"hello"}}"#);

        let mut out = Vec::new();
        Publish::print_raw(&mut out, "/chatter", (5, 6), b"\x01\x02");
        let Op::Publish(read) = Op::parse(ProtocolFrame::Binary(&out)).unwrap() else { panic!("not a publish") };
        assert_eq!(&*read.msg.raw().unwrap().bytes, b"\x01\x02");
        assert_eq!(
            out,
            b"\xa3\x62op\x67publish\x65topic\x68/chatter\x63msg\xa3\x64secs\x05\x65nsecs\x06\x65bytes\x42\x01\x02"
        );
    }
}
