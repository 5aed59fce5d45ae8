//! ROS: definitions, serialized messages and their JSON and CBOR, TCPROS, XML-RPC. The messages here are of ROS 1;
//! those of ROS 2 share the functions.

use std::sync::{Arc, LazyLock};

use ::ros::bus::{ParamValue, RosVersion};
use ::ros::codec::{
    self, CborOptions, CodecErrorKind, FillOptions, InvalidUtf8, JsonOptions, NonFinite, Stamps, Time, Value,
    cbor_item_len, json_value_len,
};
use ::ros::ros1::tcpros::{FrameReader, Header};
use ::ros::ros1::xmlrpc::{self, parse_call, parse_response, print_call, print_response};
use ::ros::schema::{MessageType, Registry};
use bytes::{Bytes, BytesMut};

/// Maximum number of bytes that a conversion may write here.
const MAX_BYTES: usize = 1 << 20;

/// Types from which the first byte of the input selects one.
static TYPES: LazyLock<Vec<Arc<MessageType>>> = LazyLock::new(|| {
    let registry = Registry::new();
    for (key, text) in [
        ("a/msg/Text", "string data\n"),
        (
            "a/msg/Numbers",
            "bool a\nint8 b\nuint8 c\nint16 d\nuint16 e\nint32 f\nuint32 g\nint64 h\nuint64 i\nfloat32 j\n\
             float64 k\ntime l\nduration m\n",
        ),
        (
            "a/msg/Lists",
            "bool[] a\nint8[] b\nuint8[] c\nchar[3] d\nint16[2] e\nuint32[] f\nint64[] g\nfloat32[] h\n\
             float64[2] i\nstring[] j\ntime[] k\nduration[1] l\na/Nothing[] m\na/Text[2] n\n",
        ),
        ("a/msg/Nothing", ""),
        ("a/msg/Picture", "Header header\nuint32 height\nuint32 width\nstring encoding\nuint8[] data\n"),
        ("a/msg/Point", "float64 x\nfloat64 y\n"),
        ("a/msg/Place", "Header header\nPoint point\nstring name\n"),
        ("a/msg/Way", "Header header\nPlace[] places\nint32[] indices\n"),
    ] {
        registry.insert(key, text).expect("these are definitions");
    }
    let names = ["a/Text", "a/Numbers", "a/Lists", "a/Picture", "a/Way"];
    let find = |name| registry.message(name).expect("these were inserted");
    names.into_iter().map(find).collect()
});

const JSON: JsonOptions =
    JsonOptions { non_finite: NonFinite::String, invalid_utf8: InvalidUtf8::Replace, max_bytes: MAX_BYTES };

const CBOR: CborOptions = CborOptions { typed_arrays: true, invalid_utf8: InvalidUtf8::Replace, max_bytes: MAX_BYTES };

const FILL: FillOptions = FillOptions { now: Some(Time { secs: 1, nsecs: 2 }), max_bytes: MAX_BYTES };

fn choose<'a>(types: &'a [Arc<MessageType>], data: &'a [u8]) -> Option<(&'a MessageType, &'a [u8])> {
    let (first, rest) = data.split_first()?;
    Some((&types[usize::from(*first) % types.len()], rest))
}

/// JSON of a message.
pub fn json(data: &[u8]) {
    json_of(&TYPES, data);
}

pub(crate) fn json_of(types: &[Arc<MessageType>], data: &[u8]) {
    let Some((message, text)) = choose(types, data) else {
        return;
    };
    let length = json_value_len(text);
    assert!(length.is_err() || length.unwrap() <= text.len());
    let mut bytes = Vec::new();
    if codec::from_json(message, text, &mut bytes, &FILL).is_ok() {
        codec::validate(message, &bytes).expect("what was written is a message");
        round_trip(message, &bytes);
    } else {
        assert!(bytes.is_empty(), "an error leaves nothing behind");
    }
}

/// CBOR of a message.
pub fn cbor(data: &[u8]) {
    cbor_of(&TYPES, data);
}

pub(crate) fn cbor_of(types: &[Arc<MessageType>], data: &[u8]) {
    let Some((message, item)) = choose(types, data) else {
        return;
    };
    let length = cbor_item_len(item);
    let mut bytes = Vec::new();
    if codec::from_cbor(message, item, &mut bytes, &FILL).is_ok() {
        assert_eq!(length.expect("what was read is an item"), item.len());
        codec::validate(message, &bytes).expect("what was written is a message");
        round_trip(message, &bytes);
    } else {
        assert!(bytes.is_empty(), "an error leaves nothing behind");
    }
}

/// A serialized message.
pub fn bytes(data: &[u8]) {
    bytes_of(&TYPES, data);
}

pub(crate) fn bytes_of(types: &[Arc<MessageType>], data: &[u8]) {
    let Some((message, bytes)) = choose(types, data) else {
        return;
    };
    message_of(message, bytes);
}

fn message_of(message: &MessageType, bytes: &[u8]) {
    if let Some(found) = Stamps::for_type(message).find(bytes) {
        assert!(found.iter().all(|at| at + 8 <= bytes.len()));
    }
    let is_valid = codec::validate(message, bytes).is_ok();
    let _ = Value::read(message, bytes);
    let (mut json, mut cbor) = (Vec::new(), Vec::new());
    let written = [
        codec::to_json(message, bytes, &mut json, &JSON).is_ok(),
        codec::to_cbor(message, bytes, &mut cbor, &CBOR).is_ok(),
    ];
    if is_valid {
        // A byte of text becomes up to six bytes.
        if bytes.len() < MAX_BYTES / 32 {
            assert_eq!(written, [true, true]);
            round_trip(message, bytes);
        }
    } else {
        assert_eq!(written, [false, false]);
        assert!(json.is_empty() && cbor.is_empty());
    }
}

/// Checks that a message becomes JSON and CBOR that other parsers can read, and from there the same message.
fn round_trip(message: &MessageType, bytes: &[u8]) {
    let (mut json, mut cbor) = (Vec::new(), Vec::new());
    if codec::to_json(message, bytes, &mut json, &JSON).is_err() {
        return;
    }
    serde_json::from_slice::<serde_json::Value>(&json).expect("it is JSON");
    assert_eq!(json_value_len(&json).expect("it is JSON"), json.len());
    codec::to_cbor(message, bytes, &mut cbor, &CBOR).expect("CBOR is shorter than JSON");
    assert_eq!(cbor_item_len(&cbor).expect("it is CBOR"), cbor.len());
    let (mut from_json, mut from_cbor) = (Vec::new(), Vec::new());
    for read in [
        codec::from_json(message, &json, &mut from_json, &FILL),
        codec::from_cbor(message, &cbor, &mut from_cbor, &FILL),
    ] {
        match read.map_err(|error| error.kind) {
            Ok(_) => {}
            // Only writing is limited; and padding may make a ROS 2 message longer than its JSON.
            Err(CodecErrorKind::TooMany { .. } | CodecErrorKind::TooLarge(_))
                if message.version() == RosVersion::Two =>
            {
                return;
            }
            Err(kind) => panic!("its own JSON or CBOR: {kind}"),
        }
    }
    // Compared as JSON, because NaN payloads and invalid UTF-8 bytes are not preserved.
    for back in [from_json, from_cbor] {
        let mut again = Vec::new();
        codec::to_json(message, &back, &mut again, &JSON).expect("it is a message");
        assert_eq!(again, json);
    }
}

/// A definition, then a zero byte and a message of it.
pub fn definition(data: &[u8]) {
    definition_of(RosVersion::One, data);
}

pub(crate) fn definition_of(version: RosVersion, data: &[u8]) {
    let at = data.iter().position(|byte| *byte == 0).unwrap_or(data.len());
    let (text, bytes) = (&data[..at], data.get(at + 1..).unwrap_or_default());
    let Ok(text) = std::str::from_utf8(text) else {
        return;
    };
    let registry = Registry::for_version(version);
    for kind in ["msg", "srv", "action"] {
        let _ = registry.insert(&format!("b/{kind}/X"), text);
    }
    let _ = (registry.service("b/X"), registry.action("b/X"));
    if let Ok(message) = MessageType::parse_full_text(version, "b/X", text) {
        let again = MessageType::parse_full_text(version, "b/X", message.full_text());
        assert_eq!(again.expect("its own text").digest(), message.digest());
        if message.min_size() < MAX_BYTES {
            codec::default_json(&message);
        }
        message_of(&message, bytes);
    }
}

/// A TCPROS stream: a header, then messages.
pub fn tcpros(data: &[u8]) {
    const MAX: usize = 1 << 16;
    let read = async {
        let (mut stream, mut buffer) = (data, BytesMut::new());
        let Ok(header) = Header::read(&mut stream, &mut buffer).await else {
            return;
        };
        let encoded = header.encode();
        assert_eq!(Header::decode(&encoded[4..]).expect("its own"), header);
        let mut frames = FrameReader::new(buffer, MAX);
        let mut total = 0;
        while let Ok(Some(message)) = frames.next(&mut stream).await {
            assert!(message.len() <= MAX);
            total += 4 + message.len();
        }
        assert!(total <= data.len());
    };
    tokio::runtime::Builder::new_current_thread().enable_time().build().expect("a runtime").block_on(read);
}

/// An XML-RPC document.
pub fn xmlrpc(data: &[u8]) {
    if let Ok(call) = parse_call(data) {
        let printed = print_call(&call.method, &call.params);
        let again = parse_call(printed.as_bytes()).expect("its own call");
        assert_eq!(again.params.len(), call.params.len());
    }
    if let Ok(Ok(value)) = parse_response(data) {
        parse_response(print_response(&value).as_bytes()).expect("its own response").expect("a value");
    }
}

/// A parameter in JSON.
pub fn parameter(data: &[u8]) {
    let Ok(value) = serde_json::from_slice::<ParamValue>(data) else {
        return;
    };
    let written = serde_json::to_vec(&value).expect("it can be written");
    let again = serde_json::from_slice::<ParamValue>(&written);
    assert_eq!(again.expect("its own JSON"), value);
    if let Ok(sent) = xmlrpc::Value::try_from(value.clone()) {
        assert!(sent.depth() <= ParamValue::MAX_DEPTH);
        assert_eq!(ParamValue::from(sent), value);
    }
}

/// A recording; messages point into it.
pub fn bag(data: &[u8]) {
    const MAX_ITEMS: usize = 100;
    if let Ok(messages) = ::ros::bag::read(&Bytes::copy_from_slice(data), MAX_ITEMS) {
        assert!(messages.len() <= MAX_ITEMS);
        let bytes: usize = messages.iter().map(|message| message.bytes.len()).sum();
        assert!(bytes <= data.len(), "{bytes} bytes of messages in {}", data.len());
    }
}
