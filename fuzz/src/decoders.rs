//! Memory limits of the decoders of untrusted bytes: a multiple of the input, plus a constant.
//!
//! A fuzz target reads, writes and compares; a decoder here only reads, as the daemon or a stub does, so that the
//! measured memory is the decoder's own. The tests compare the limit with what was requested from the allocator.

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
use ::translation::TranslationRules;
use ::ws::{WebSocket, WsMessage};
use budget::JsonWeight;
use bytes::Bytes;
use foxglove::ws_protocol::client::ClientMessage;
use serde::de::DeserializeOwned;

use crate::codec::LIMIT;
use crate::translation::PAIRS;
pub use repeats::Repeat;
use repeats::{DEFINITIONS, HELLO, INTERFACES, MANIFESTS, ORDERS, ROSBRIDGE, SAVED, VALUES, VIEWER, XML_RPC};

/// Maximum number of bytes that a conversion may write here.
const MAX_OUTPUT: usize = 1 << 14;
/// Memory that no decoder need account for: a name in an error, a buffer of minimum size.
const LITTLE: usize = 4 << 10;

/// A decoder and its memory limit.
pub struct Decoder {
    /// Name of its target and of its directory in `corpus/`.
    pub name: &'static str,
    /// Reads an input and drops the result.
    pub decode: fn(&[u8]),
    /// Maximum bytes of memory per byte of input.
    pub times: usize,
    /// Maximum bytes of memory for any input, in addition.
    pub fixed: usize,
    /// Estimate of the memory of an input before it is read: the size of the permit that is acquired for it.
    pub weigh: Option<fn(&[u8]) -> usize>,
    /// Inputs that take much memory for their size; `{n}` becomes a counter.
    pub repeats: &'static [Repeat],
}

const fn decoder(name: &'static str, decode: fn(&[u8]), times: usize, fixed: usize) -> Decoder {
    Decoder { name, decode, times, fixed, weigh: None, repeats: &[] }
}

impl Decoder {
    const fn with_repeats(self, repeats: &'static [Repeat]) -> Self {
        Self { repeats, ..self }
    }

    const fn with_weigh(self, weigh: fn(&[u8]) -> usize) -> Self {
        Self { weigh: Some(weigh), ..self }
    }
}

/// All decoders.
pub const DECODERS: &[Decoder] = &[
    decoder("ros_parameter", read::<ParamValue>, TREE, LITTLE).with_repeats(VALUES).with_weigh(weigh),
    decoder("link_hello", hello, TREE, LITTLE).with_repeats(HELLO).with_weigh(weigh),
    decoder("link_orders", orders, TREE, LITTLE).with_repeats(ORDERS).with_weigh(weigh),
    decoder("link_frame", frame, 4, LITTLE),
    decoder("viewer_json", viewer, 4 * JsonWeight::MOST_TIMES, LITTLE).with_repeats(VIEWER).with_weigh(weigh_copied),
    decoder("ws_frames", frames, 8, 64 << 10),
    decoder("rosbridge_json", op_json, 4, LITTLE).with_repeats(ROSBRIDGE),
    decoder("rosbridge_cbor", op_cbor, 4, LITTLE),
    decoder("rosbridge_fragments", fragments, 8, LITTLE),
    decoder("rosbridge_png", png, 8, 4 * LIMIT),
    decoder("ros_json", json, 4, 4 * MAX_OUTPUT).with_repeats(VALUES),
    decoder("ros_cbor", cbor, 4, 4 * MAX_OUTPUT),
    decoder("ros_bytes", bytes, 96, 4 * MAX_OUTPUT),
    decoder("ros_definition", definition, 64, 64 << 10).with_repeats(DEFINITIONS),
    decoder("ros_tcpros", tcpros, 8, LITTLE),
    decoder("ros_xmlrpc", xml_rpc, 16, LITTLE).with_repeats(XML_RPC).with_weigh(xmlrpc::weight),
    decoder("ros2_json", json_2, 4, 4 * MAX_OUTPUT).with_repeats(VALUES),
    decoder("ros2_cbor", cbor_2, 4, 4 * MAX_OUTPUT),
    decoder("ros2_bytes", bytes_2, 96, 4 * MAX_OUTPUT),
    decoder("ros2_definition", definition_2, 64, 64 << 10).with_repeats(DEFINITIONS),
    decoder("translation_bytes", carry, 48, 256 << 10),
    decoder("rtps_datagram", datagram, 4, LITTLE),
    decoder("rtps_discovery", discovery, 4, LITTLE),
    decoder("codec_zlib", decode_packed, 8, CODEC),
    decoder("codec_deflate", decode_packed, 8, CODEC),
    decoder("codec_zstd", decode_packed, 8, CODEC),
    decoder("codec_image", decode_packed, 8, CODEC),
    decoder("codec_grid", decode_packed, 8, CODEC),
    decoder("codec_scan", decode_packed, 8, CODEC),
    decoder("codec_cloud", decode_packed, 8, CODEC),
    decoder("codec_jpeg", decode_packed, 8, CODEC),
    decoder("codec_frame", decode_packed, 8, CODEC),
    decoder("ros_bag", bag, 32, LITTLE),
    decoder("image_archive", crate::image::archive, 8, ARCHIVE),
    decoder("image_saved", crate::image::saved_image, 64, 1 << 20).with_repeats(SAVED),
    decoder("package_manifest", crate::package::manifest, TREE, 64 << 10).with_repeats(MANIFESTS),
    decoder("package_interface", crate::package::interface, TOML, 64 << 10).with_repeats(INTERFACES),
    decoder("translation_rules", rules, TOML, 4 << 20),
    decoder("sign_signature", crate::sign::signature, 16, LITTLE),
    decoder("authority_request", request, 8, LITTLE),
    decoder("authority_certificate", certificate, 8, LITTLE),
];

/// Factor for trees of values: a map with one member is eight bytes of text, and a node of eleven entries in memory.
const TREE: usize = 128;
/// Factor for configuration files: tables keep the place of each key and value for messages.
const TOML: usize = 512;
/// Constant for archives: extended headers of one entry take 1 MiB, which a compressed archive has in a few bytes.
const ARCHIVE: usize = 8 << 20;
/// Constant for codecs: besides the message, a decoder keeps an image and tables of its own.
const CODEC: usize = 8 * LIMIT + (1 << 20);

fn weigh(input: &[u8]) -> usize {
    JsonWeight::estimate(input).bytes
}

fn weigh_copied(input: &[u8]) -> usize {
    JsonWeight::estimate(input).bytes_if_copied()
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
        if !matches!(next, Poll::Ready(Ok(_))) || matches!(next, Poll::Ready(Ok(WsMessage::Close(..)))) {
            return;
        }
    }
}

fn op_json(input: &[u8]) {
    if let Ok(text) = std::str::from_utf8(input) {
        let _ = Op::parse(rosbridge::ProtocolFrame::Text(text));
        unknown_fields(rosbridge::ProtocolFrame::Text(text));
    }
}

fn op_cbor(input: &[u8]) {
    let _ = Op::parse(rosbridge::ProtocolFrame::Binary(input));
    unknown_fields(rosbridge::ProtocolFrame::Binary(input));
}

fn fragments(input: &[u8]) {
    let limits = FragmentLimits { messages: 4, parts: 64, bytes: 1 << 20, age: std::time::Duration::from_secs(100) };
    let mut fragments = Fragments::new(limits);
    for (num, data) in (0..).zip(input.chunks(1 + input.len() / 64)) {
        let fragment = Fragment { id: Id::Integer(1), data: String::from_utf8_lossy(data), num, total: 64 };
        let _ = fragments.add(&fragment, Instant::now());
    }
}

fn png(input: &[u8]) {
    let text = base64_simd::STANDARD.encode_to_string(input);
    let _ = decode_png(&text, LIMIT);
}

/// Returns a type with lists, strings, numbers, and messages without fields.
fn message_of(version: RosVersion) -> Arc<MessageType> {
    let registry = Registry::for_version(version);
    for (key, text) in [
        ("a/msg/Nothing", ""),
        ("a/msg/Text", "string data\nuint8[] bytes\n"),
        ("a/msg/All", "Text[] a\nNothing[] b\nuint8[] c\nstring[] d\nfloat64[3] e\nbool[] f\n"),
    ] {
        registry.insert(key, text).expect("these are definitions");
    }
    registry.message("a/All").expect("it was inserted")
}

static ROS1_TYPE: LazyLock<Arc<MessageType>> = LazyLock::new(|| message_of(RosVersion::One));
static TWO: LazyLock<Arc<MessageType>> = LazyLock::new(|| message_of(RosVersion::Two));

fn fill() -> FillOptions {
    FillOptions { max_bytes: MAX_OUTPUT, ..FillOptions::default() }
}

fn json_of(of: &MessageType, input: &[u8]) {
    let _ = codec::from_json(of, input, &mut Vec::new(), &fill());
}

fn json(input: &[u8]) {
    json_of(&ROS1_TYPE, input);
}

fn json_2(input: &[u8]) {
    json_of(&TWO, input);
}

fn cbor_of(of: &MessageType, input: &[u8]) {
    let _ = codec::from_cbor(of, input, &mut Vec::new(), &fill());
}

fn cbor(input: &[u8]) {
    cbor_of(&ROS1_TYPE, input);
}

fn cbor_2(input: &[u8]) {
    cbor_of(&TWO, input);
}

fn bytes_of(of: &MessageType, input: &[u8]) {
    let _ = Value::read(of, input);
    let json = JsonOptions { max_bytes: MAX_OUTPUT, ..JsonOptions::default() };
    let cbor = CborOptions { max_bytes: MAX_OUTPUT, ..CborOptions::default() };
    let _ = codec::to_json(of, input, &mut Vec::new(), &json);
    let _ = codec::to_cbor(of, input, &mut Vec::new(), &cbor);
}

fn bytes(input: &[u8]) {
    bytes_of(&ROS1_TYPE, input);
}

fn bytes_2(input: &[u8]) {
    bytes_of(&TWO, input);
}

fn definition_of(version: RosVersion, input: &[u8]) {
    let Ok(text) = std::str::from_utf8(input) else {
        return;
    };
    {
        let registry = Registry::for_version(version);
        for kind in ["msg", "srv", "action"] {
            let _ = registry.insert(&format!("b/{kind}/X"), text);
        }
    }
    let _ = MessageType::parse_full_text(version, "b/X", text);
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

fn carry(input: &[u8]) {
    for pair in PAIRS.iter() {
        let _ = pair.to_twin.translate(input);
        let _ = pair.from_twin.translate(input);
    }
}

fn rules(input: &[u8]) {
    let _ = TranslationRules::default().with_yaml("rules.yaml", &String::from_utf8_lossy(input));
}

fn bag(input: &[u8]) {
    let _ = ::ros::bag::read(&Bytes::copy_from_slice(input), usize::MAX);
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

/// Decodes the input as a frame of every codec. The seeds are lists of frames of the codec that the target names.
fn decode_packed(input: &[u8]) {
    for tag in 0..16 {
        for version in 0..3 {
            let frame = [&[tag, version], input.get(2..).unwrap_or_default()].concat();
            let _ = LinkDecoder::new(LIMIT).decode(&frame, &mut Vec::new());
        }
    }
}

fn request(input: &[u8]) {
    let text = String::from_utf8_lossy(input);
    let _ = ::authority::CertificateRequest::parse(&text, "r1");
}

fn certificate(input: &[u8]) {
    let certificate = tokio_rustls::rustls::pki_types::CertificateDer::from(input);
    let _ = ::authority::read_robot_certificate(&certificate);
}
