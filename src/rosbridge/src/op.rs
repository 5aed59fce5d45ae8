//! The ops of the protocol, and parsing of frames into them.

use std::borrow::Cow;

use crate::fields::Fields;
use crate::message::Message;
use crate::{
    ActionFeedback, ActionResult, Advertise, AdvertiseAction, AdvertiseService, Auth, CallService, CancelActionGoal,
    Error, Format, Fragment, Id, Payload, Png, Problem, Publish, QosRequest, SendActionGoal, ServiceResponse, SetLevel,
    Status, Subscribe, Unadvertise, UnadvertiseAction, UnadvertiseService, Unsubscribe, Writer,
};

/// One WebSocket message.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum ProtocolFrame<'a> {
    /// JSON, as in a text frame.
    Text(&'a str),
    /// CBOR, as in a binary frame.
    Binary(&'a [u8]),
}

macro_rules! ops {
    ($($(#[doc = $doc:literal])* $name:ident $(<$life:lifetime>)?,)*) => {
        /// One message of the protocol.
        #[derive(Debug, Clone, PartialEq)]
        pub enum Op<'a> {
            $($(#[doc = $doc])* $name($name<'a>),)*
        }

        /// Names of all ops.
        const OP_NAMES: &[&str] = &[$(<$name<'static> as Message>::OP,)*];

        impl<'a> Op<'a> {
            fn read(op: &str, id: Option<Id<'a>>, fields: &Fields<'a>) -> Result<Self, Problem> {
                $(if op == $name::OP {
                    return $name::read(id, fields).map(Op::$name);
                })*
                Err(Problem::UnknownOp {
                    op: op.chars().take(64).collect(),
                    known: OP_NAMES,
                })
            }

            /// Returns the value of the field `op`.
            pub fn name(&self) -> &'static str {
                match self { $(Op::$name(_) => $name::OP,)* }
            }

            /// Returns the id of the interaction it belongs to.
            pub fn id(&self) -> Option<&Id<'a>> {
                match self { $(Op::$name(message) => message.id(),)* }
            }

            /// Appends it to `out` as one frame; payloads must be in `format`.
            pub fn print(&self, out: &mut Vec<u8>, format: Format) {
                let mut writer = Writer::op(out, format, self.name(), self.id());
                match self { $(Op::$name(message) => message.write(&mut writer),)* }
                writer.end();
            }
        }

        $(impl<'a> From<$name<'a>> for Op<'a> {
            fn from(message: $name<'a>) -> Self {
                Op::$name(message)
            }
        })*

        fn fields_of(op: &str) -> Option<&'static [&'static str]> {
            $(if op == $name::OP {
                return Some($name::FIELDS);
            })*
            None
        }
    };
}

// Sorted by frequency, since they are compared in this order.
ops! {
    /// A message on a topic, in both directions.
    Publish,
    /// A fragment of a message.
    Fragment,
    /// A call of a service, in both directions.
    CallService,
    /// The answer to a service call, in both directions.
    ServiceResponse,
    /// The client subscribes to a topic.
    Subscribe,
    /// The client ends a subscription.
    Unsubscribe,
    /// The client announces that it will publish.
    Advertise,
    /// The client announces that it will no longer publish.
    Unadvertise,
    /// The client serves a service.
    AdvertiseService,
    /// The client no longer serves a service.
    UnadvertiseService,
    /// A goal for an action server, in both directions.
    SendActionGoal,
    /// Cancellation of a goal, in both directions.
    CancelActionGoal,
    /// Feedback on a goal, in both directions.
    ActionFeedback,
    /// Result of a goal, in both directions.
    ActionResult,
    /// The client serves an action.
    AdvertiseAction,
    /// The client no longer serves an action.
    UnadvertiseAction,
    /// A message encoded as a PNG image.
    Png,
    /// The level of status messages that the client wants.
    SetLevel,
    /// A status message from the server.
    Status,
    /// Credentials.
    Auth,
}

impl<'a> Op<'a> {
    /// Parses one frame.
    ///
    /// # Errors
    /// Returns the mistake, with the op and id if they could be read.
    pub fn parse(frame: ProtocolFrame<'a>) -> Result<Self, Error> {
        let fields = match frame {
            ProtocolFrame::Text(text) => Fields::from_json(text)?,
            ProtocolFrame::Binary(bytes) => Fields::from_cbor(bytes)?,
        };
        let id = fields.id();
        let known = id.as_ref().ok().cloned().flatten().map(Id::into_owned);
        let op = match fields.text("op", "the name of an operation") {
            Ok(Some(op)) => op,
            Ok(None) => {
                let hint = if fields.names().any(|name| name == "receiver") {
                    " (this looks like rosbridge 1.0; the server speaks 2.0)"
                } else {
                    ""
                };
                return Err(Error { op: None, id: known, problem: Problem::NoOp { known: OP_NAMES, hint } });
            }
            Err(problem) => {
                return Err(Error { op: None, id: known, problem });
            }
        };
        let read = id.and_then(|id| Op::read(&op, id, &fields));
        read.map_err(|problem| {
            let op = (!matches!(problem, Problem::UnknownOp { .. })).then(|| op.into_owned());
            Error { op, id: known, problem }
        })
    }
}

impl<'a> ProtocolFrame<'a> {
    /// Returns what a binary frame contains. Some clients send their JSON so; it begins as no CBOR map does.
    pub fn from_binary(bytes: &'a [u8]) -> Self {
        let text = bytes.starts_with(b"{").then(|| std::str::from_utf8(bytes).ok()).flatten();
        text.map_or(Self::Binary(bytes), Self::Text)
    }

    /// Returns the frame as one payload.
    pub fn payload(self) -> Payload<'a> {
        match self {
            ProtocolFrame::Text(text) => Payload::json(text),
            ProtocolFrame::Binary(bytes) => Payload::cbor(bytes),
        }
    }

    /// Returns the format of the frame.
    pub fn format(self) -> Format {
        self.payload().format
    }
}

/// Returns whether the protocol has this op.
pub fn is_known_op(op: &str) -> bool {
    OP_NAMES.contains(&op)
}

/// Reads a short string field of a frame, even of one that [`Op::parse`] refuses; `None` if the field is absent or
/// something else.
pub fn text_field(frame: ProtocolFrame<'_>, field: &'static str) -> Option<String> {
    let fields = Fields::from_payload(frame.payload()).ok()?;
    Some(fields.text(field, "").ok()??.into_owned())
}

/// Returns the fields of a frame that its op does not define: harmless, but often misspelt. Empty for frames that
/// [`Op::parse`] refuses.
pub fn unknown_fields(frame: ProtocolFrame<'_>) -> Vec<String> {
    let Ok(fields) = Fields::from_payload(frame.payload()) else {
        return Vec::new();
    };
    let op: Option<Cow<'_, str>> = fields.text("op", "").ok().flatten();
    let Some(known) = op.as_deref().and_then(fields_of) else {
        return Vec::new();
    };
    let names = fields.names().filter(|name| !matches!(*name, "op" | "id") && !known.contains(name));
    let mut unknown: Vec<String> = names.map(str::to_owned).collect();
    if known.contains(&"qos") {
        unknown.extend(QosRequest::unknown_names(&fields));
    }
    unknown
}

#[cfg(test)]
pub(crate) mod tests {
    use super::*;

    #[test]
    fn the_document_says_what_each_operation_needs() {
        let path = concat!(env!("CARGO_MANIFEST_DIR"), "/../../docs/access.md");
        let document = std::fs::read_to_string(path).expect("docs/access.md");
        let table = document.split_once("| needs | operations |\n");
        let (_, table) = table.expect("the table of operations");
        let rows = table.lines().skip(1).take_while(|line| !line.is_empty());
        let mut named: Vec<&str> = rows.flat_map(|row| row.split('`').skip(1).step_by(2)).collect();
        let mut known = OP_NAMES.to_vec();
        named.sort_unstable();
        known.sort_unstable();
        assert_eq!(named, known);
    }

    /// Asserts that `json` is parsed as `op` and that `op` survives printing and parsing in both formats.
    #[track_caller]
    pub(crate) fn assert_parses(json: &str, op: impl Into<Op<'static>>) {
        let op = op.into();
        assert_eq!(Op::parse(ProtocolFrame::Text(json)).as_ref(), Ok(&op), "{json}");
        let mut printed = Vec::new();
        op.print(&mut printed, Format::Json);
        assert_eq!(Op::parse(ProtocolFrame::Text(std::str::from_utf8(&printed).unwrap())).as_ref(), Ok(&op));
        assert!(unknown_fields(ProtocolFrame::Text(std::str::from_utf8(&printed).unwrap())).is_empty());
        serde_json::from_slice::<serde_json::Value>(&printed).unwrap();
    }

    /// Asserts that a message without payload survives CBOR.
    #[track_caller]
    pub(crate) fn assert_survives_cbor(op: impl Into<Op<'static>>) {
        let op = op.into();
        let mut printed = Vec::new();
        op.print(&mut printed, Format::Cbor);
        assert_eq!(Op::parse(ProtocolFrame::Binary(&printed)).as_ref(), Ok(&op));
    }

    /// Asserts that `json` is refused with this text.
    #[track_caller]
    pub(crate) fn assert_refused(json: &str, text: &str) {
        assert_eq!(Op::parse(ProtocolFrame::Text(json)).unwrap_err().to_string(), text, "{json}");
    }

    #[test]
    fn a_binary_frame_has_cbor_or_json() {
        let mut printed = Vec::new();
        let op = Op::from(Unsubscribe { id: None, topic: "/x".into() });
        for format in [Format::Json, Format::Cbor] {
            printed.clear();
            op.print(&mut printed, format);
            let frame = ProtocolFrame::from_binary(&printed);
            assert_eq!((frame.format(), Op::parse(frame).as_ref()), (format, Ok(&op)));
        }
        assert_eq!(ProtocolFrame::from_binary(b"{\xff").format(), Format::Cbor);
    }

    #[test]
    fn mistakes_keep_op_and_id() {
        let error = Op::parse(ProtocolFrame::Text(r#"{"op":"publish","id":7,"topic":3}"#)).unwrap_err();
        assert_eq!(error.op.as_deref(), Some("publish"));
        assert_eq!(error.id, Some(Id::Integer(7)));
        assert_eq!(error.to_string(), "publish: field \"topic\" is 3, a topic name is expected");
        let error = Op::parse(ProtocolFrame::Text(r#"{"op":"dance","id":"x"}"#)).unwrap_err();
        assert_eq!((error.op, error.id), (None, Some(Id::from("x"))));
    }

    #[test]
    fn frames_without_a_known_op_are_refused() {
        let names = "publish, fragment, call_service, service_response, subscribe, unsubscribe, advertise, \
                     unadvertise, advertise_service, unadvertise_service, send_action_goal, cancel_action_goal, \
                     action_feedback, action_result, advertise_action, unadvertise_action, png, set_level, status, \
                     auth";
        assert_refused("{}", &format!("field \"op\" is missing; it must be one of {names}"));
        assert_refused(r#"{"op":"dance"}"#, &format!("unknown op \"dance\"; known are {names}"));
        assert_refused(r#"{"op":5}"#, "field \"op\" is 5, the name of an operation is expected");
        assert_refused(
            r#"{"receiver":"/x","msg":[]}"#,
            &format!(
                "field \"op\" is missing; it must be one of {names} (this looks like rosbridge 1.0; the server speaks \
                 2.0)"
            ),
        );
        assert_refused("hello", "invalid JSON at byte 0: an object is expected");
        assert_refused("[]", "a frame must be one JSON object");
        assert_eq!(Op::parse(ProtocolFrame::Binary(b"\x00")).unwrap_err().to_string(), "a frame must be one CBOR map");
        assert!(Op::parse(ProtocolFrame::Binary(&[0x13, 0x37, 0xff, 0xfe])).is_err());
        let many: String = (0..1000).map(|n| format!("\"f{n}\":0,")).collect();
        assert_refused(&format!("{{{many}\"op\":\"auth\"}}"), "a message has at most 64 fields");
        let long = "x".repeat(20_000);
        assert_refused(
            &format!(r#"{{"op":"unsubscribe","topic":"{long}"}}"#),
            "unsubscribe: field \"topic\" has 20002 bytes, at most 16384 are allowed",
        );
        assert_refused(
            r#"{"op":"unsubscribe","id":{},"topic":"/x"}"#,
            "unsubscribe: field \"id\" is {}, a string or an integer is expected",
        );
    }

    #[test]
    fn a_text_is_found_in_a_frame_that_is_refused() {
        let frame = ProtocolFrame::Text(r#"{"op":"call_service","service":"/add","args":5,"type":7}"#);
        assert!(Op::parse(frame).is_err());
        assert_eq!(text_field(frame, "service").as_deref(), Some("/add"));
        for field in ["args", "type", "id"] {
            assert_eq!(text_field(frame, field), None, "{field}");
        }
        assert_eq!(text_field(ProtocolFrame::Text("{"), "service"), None);
    }

    #[test]
    fn unknown_fields_are_named() {
        let frame = ProtocolFrame::Text(r#"{"op":"subscribe","id":"1","topic":"/x","trottle_rate":5}"#);
        assert!(Op::parse(frame).is_ok());
        assert_eq!(unknown_fields(frame), ["trottle_rate"]);
        let within = r#"{"op":"subscribe","topic":"/x","qos":{"depth":5,"reliabilty":"reliable"}}"#;
        assert_eq!(unknown_fields(ProtocolFrame::Text(within)), ["qos.reliabilty"]);
    }
}
