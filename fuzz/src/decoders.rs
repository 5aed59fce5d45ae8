//! What each decoder of strangers' bytes may take in memory: so many times its input, and something fixed.
//!
//! A target of the fuzzer reads, writes and compares; a decoder here only reads, as the daemon or a stub does, so that what it takes is
//! its own. The tests compare it with what an allocator was asked for.

mod repeats;

use std::future::poll_fn;
use std::pin::pin;
use std::sync::{Arc, LazyLock};
use std::task::{Context, Poll, Waker};
use std::time::Instant;

use ::codec::Decoder as LinkDecoder;
use ::link::control::{FromCloud, FromRobot, Hello, Welcome};
use ::link::frame::Frame;
use ::link::record::Record;
use ::ros::bus::{ParamValue, RosVersion};
use ::ros::codec::{self, CborOptions, FillOptions, JsonOptions, Value};
use ::ros::ros1::tcpros::Header;
use ::ros::ros1::xmlrpc;
use ::ros::schema::{InterfaceFile, MessageType, Registry};
use ::rosbridge::{Fragment, FragmentLimits, Fragments, Id, Op, decode_png, unknown_fields};
use ::rtps::wire::{self, ParticipantMessage};
use ::rtps::{EndpointData, ParticipantData};
use ::ws::{Message, WebSocket};
use budget::JsonWeight;
use bytes::Bytes;
use foxglove::ws_protocol::client::ClientMessage;
use serde::de::DeserializeOwned;

use crate::codec::LIMIT;
pub use repeats::Repeat;
use repeats::{DEFINITIONS, HELLO, ORDERS, ROSBRIDGE, VALUES, VIEWER, XML_RPC};

/// Most bytes that a conversion may write here.
const WRITTEN: usize = 1 << 14;
/// What no decoder need account for: a name in an error, a buffer of the least size.
const LITTLE: usize = 4 << 10;

/// A decoder, and what it may take.
pub struct Decoder {
    /// Its folder in `corpus/`, and the name of a target.
    pub name: &'static str,
    /// Reads, and drops what was read.
    pub decode: fn(&[u8]),
    /// Bytes of memory for each byte of input, at most.
    pub times: usize,
    /// And so many for any input.
    pub fixed: usize,
    /// What is known of an input before it is read: the bytes of the permit that is taken for it.
    pub weigh: Option<fn(&[u8]) -> usize>,
    /// Inputs that take much for what they are: `{n}` becomes a number that counts.
    pub repeats: &'static [Repeat],
}

const fn of(name: &'static str, decode: fn(&[u8]), times: usize, fixed: usize) -> Decoder {
    Decoder {
        name,
        decode,
        times,
        fixed,
        weigh: None,
        repeats: &[],
    }
}

impl Decoder {
    const fn with(self, repeats: &'static [Repeat]) -> Self {
        Self { repeats, ..self }
    }

    const fn weighed(self, weigh: fn(&[u8]) -> usize) -> Self {
        Self {
            weigh: Some(weigh),
            ..self
        }
    }
}

/// All of them.
pub const DECODERS: &[Decoder] = &[
    of("ros_parameter", read::<ParamValue>, TREE, LITTLE)
        .with(VALUES)
        .weighed(weigh),
    of("link_hello", hello, TREE, LITTLE)
        .with(HELLO)
        .weighed(weigh),
    of("link_orders", orders, TREE, LITTLE)
        .with(ORDERS)
        .weighed(weigh),
    of("link_frame", frame, 4, LITTLE),
    of("viewer_json", viewer, 4 * JsonWeight::MOST_TIMES, LITTLE)
        .with(VIEWER)
        .weighed(weigh_copied),
    of("ws_frames", frames, 8, 64 << 10),
    of("rosbridge_json", op_json, 4, LITTLE).with(ROSBRIDGE),
    of("rosbridge_cbor", op_cbor, 4, LITTLE),
    of("rosbridge_fragments", fragments, 8, LITTLE),
    of("rosbridge_png", png, 8, 4 * LIMIT),
    of("ros_json", json, 4, 4 * WRITTEN).with(VALUES),
    of("ros_cbor", cbor, 4, 4 * WRITTEN),
    of("ros_bytes", bytes, 96, 4 * WRITTEN),
    of("ros_definition", definition, 64, 64 << 10).with(DEFINITIONS),
    of("ros_tcpros", tcpros, 8, LITTLE),
    of("ros_xmlrpc", xml_rpc, 16, LITTLE)
        .with(XML_RPC)
        .weighed(xmlrpc::weight),
    of("ros2_json", json_2, 4, 4 * WRITTEN).with(VALUES),
    of("ros2_cbor", cbor_2, 4, 4 * WRITTEN),
    of("ros2_bytes", bytes_2, 96, 4 * WRITTEN),
    of("ros2_definition", definition_2, 64, 64 << 10).with(DEFINITIONS),
    of("rtps_datagram", datagram, 4, LITTLE),
    of("rtps_discovery", discovery, 4, LITTLE),
    of("codec_zlib", packed, 8, CODEC),
    of("codec_deflate", packed, 8, CODEC),
    of("codec_zstd", packed, 8, CODEC),
    of("codec_image", packed, 8, CODEC),
    of("codec_grid", packed, 8, CODEC),
    of("codec_scan", packed, 8, CODEC),
    of("codec_cloud", packed, 8, CODEC),
    of("codec_jpeg", packed, 8, CODEC),
    of("codec_frame", packed, 8, CODEC),
    of("authority_request", request, 8, LITTLE),
    of("authority_certificate", certificate, 8, LITTLE),
];

/// Of trees of values: a map of one member is eight bytes of text, and a node of eleven in memory.
const TREE: usize = 128;
/// Of codecs: a decoder keeps a picture, and tables of its own, beside the message that it makes.
const CODEC: usize = 8 * LIMIT + (1 << 20);

fn weigh(input: &[u8]) -> usize {
    JsonWeight::of(input).bytes
}

fn weigh_copied(input: &[u8]) -> usize {
    JsonWeight::of(input).bytes_if_copied()
}

fn read<T: DeserializeOwned>(input: &[u8]) {
    let _ = serde_json::from_slice::<T>(input);
}

fn hello(input: &[u8]) {
    read::<Hello>(input);
    read::<Welcome>(input);
}

fn orders(input: &[u8]) {
    read::<FromRobot>(input);
    read::<FromCloud>(input);
}

fn frame(input: &[u8]) {
    if let Ok(Frame::Whole { record, .. }) = Frame::decode(Bytes::copy_from_slice(input)) {
        let _ = Record::decode(record);
    }
}

fn viewer(input: &[u8]) {
    let _ = std::str::from_utf8(input).map(ClientMessage::parse_json);
}

fn frames(input: &[u8]) {
    let mut socket = WebSocket::new(tokio::io::empty(), input, 1 << 20, 1 << 20);
    loop {
        let next = poll_fn(|cx| socket.poll_next(cx));
        let next = pin!(next).poll(&mut Context::from_waker(Waker::noop()));
        if !matches!(next, Poll::Ready(Ok(_)))
            || matches!(next, Poll::Ready(Ok(Message::Close(..))))
        {
            return;
        }
    }
}

fn op_json(input: &[u8]) {
    if let Ok(text) = std::str::from_utf8(input) {
        let _ = Op::parse(rosbridge::Frame::Text(text));
        unknown_fields(rosbridge::Frame::Text(text));
    }
}

fn op_cbor(input: &[u8]) {
    let _ = Op::parse(rosbridge::Frame::Binary(input));
    unknown_fields(rosbridge::Frame::Binary(input));
}

fn fragments(input: &[u8]) {
    let limits = FragmentLimits {
        messages: 4,
        parts: 64,
        bytes: 1 << 20,
        age: std::time::Duration::from_secs(100),
    };
    let mut fragments = Fragments::new(limits);
    for (num, data) in (0..).zip(input.chunks(1 + input.len() / 64)) {
        let fragment = Fragment {
            id: Id::Integer(1),
            data: String::from_utf8_lossy(data),
            num,
            total: 64,
        };
        let _ = fragments.add(&fragment, Instant::now());
    }
}

fn png(input: &[u8]) {
    let text = base64_simd::STANDARD.encode_to_string(input);
    let _ = decode_png(&text, LIMIT);
}

/// Lists, texts, numbers, and messages without fields.
fn message_of(version: RosVersion) -> Arc<MessageType> {
    let registry = Registry::of(version);
    for (key, text) in [
        ("a/msg/Nothing", ""),
        ("a/msg/Text", "string data\nuint8[] bytes\n"),
        (
            "a/msg/All",
            "Text[] a\nNothing[] b\nuint8[] c\nstring[] d\nfloat64[3] e\nbool[] f\n",
        ),
    ] {
        registry.insert(key, text).expect("these are definitions");
    }
    registry.message("a/All").expect("it was inserted")
}

static ONE: LazyLock<Arc<MessageType>> = LazyLock::new(|| message_of(RosVersion::One));
static TWO: LazyLock<Arc<MessageType>> = LazyLock::new(|| message_of(RosVersion::Two));

fn fill() -> FillOptions {
    FillOptions {
        max_bytes: WRITTEN,
        ..FillOptions::default()
    }
}

fn json_of(of: &MessageType, input: &[u8]) {
    let _ = codec::from_json(of, input, &mut Vec::new(), &fill());
}

fn json(input: &[u8]) {
    json_of(&ONE, input);
}

fn json_2(input: &[u8]) {
    json_of(&TWO, input);
}

fn cbor_of(of: &MessageType, input: &[u8]) {
    let _ = codec::from_cbor(of, input, &mut Vec::new(), &fill());
}

fn cbor(input: &[u8]) {
    cbor_of(&ONE, input);
}

fn cbor_2(input: &[u8]) {
    cbor_of(&TWO, input);
}

fn bytes_of(of: &MessageType, input: &[u8]) {
    let _ = Value::read(of, input);
    let json = JsonOptions {
        max_bytes: WRITTEN,
        ..JsonOptions::default()
    };
    let cbor = CborOptions {
        max_bytes: WRITTEN,
        ..CborOptions::default()
    };
    let _ = codec::to_json(of, input, &mut Vec::new(), &json);
    let _ = codec::to_cbor(of, input, &mut Vec::new(), &cbor);
}

fn bytes(input: &[u8]) {
    bytes_of(&ONE, input);
}

fn bytes_2(input: &[u8]) {
    bytes_of(&TWO, input);
}

fn definition_of(version: RosVersion, input: &[u8]) {
    let Ok(text) = std::str::from_utf8(input) else {
        return;
    };
    {
        let registry = Registry::of(version);
        for kind in ["msg", "srv", "action"] {
            let _ = registry.insert(&format!("b/{kind}/X"), text);
        }
    }
    let _ = MessageType::of_full_text(version, "b/X", text);
}

fn definition(input: &[u8]) {
    definition_of(RosVersion::One, input);
}

fn definition_2(input: &[u8]) {
    definition_of(RosVersion::Two, input);
    if let Ok(text) = std::str::from_utf8(input) {
        let _ = InterfaceFile::read_idl("b/msg/X", text);
        let _ = InterfaceFile::read_description("b/msg/X", text);
    }
}

fn tcpros(input: &[u8]) {
    let _ = Header::decode(input);
}

fn xml_rpc(input: &[u8]) {
    let _ = xmlrpc::parse_call(input);
    let _ = xmlrpc::parse_response(input);
}

fn datagram(input: &[u8]) {
    wire::parse(&Bytes::copy_from_slice(input));
}

fn discovery(input: &[u8]) {
    let payload = Bytes::copy_from_slice(input);
    let _ = ParticipantData::from_payload(&payload);
    let _ = EndpointData::from_payload(&payload);
    let _ = ParticipantMessage::from_payload(&payload);
}

/// Seeds of codecs are lists of frames, whose codec the target's name says; here each input is a frame of every codec.
fn packed(input: &[u8]) {
    for tag in 0..16 {
        for version in 0..3 {
            let frame = [&[tag, version], input.get(2..).unwrap_or_default()].concat();
            let _ = LinkDecoder::new(LIMIT).decode(&frame, &mut Vec::new());
        }
    }
}

fn request(input: &[u8]) {
    let text = String::from_utf8_lossy(input);
    let _ = ::authority::Request::read(&text, "r1");
}

fn certificate(input: &[u8]) {
    let certificate = tokio_rustls::rustls::pki_types::CertificateDer::from(input);
    let _ = ::authority::read(&certificate);
}
