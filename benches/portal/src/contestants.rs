//! Paths from a client to the node and back. Each path is open during its own turn only, because a subscription of one
//! path would receive messages during the turns of the others.

use std::fmt;

use anyhow::{Context, Result, ensure};
use base64::prelude::{BASE64_STANDARD, Engine as _};
use bench_report::BenchDaemon;
use rosbridge::{Format, Writer};
use serde_json::Value;

use crate::line::{self, BenchConnection, Framing};
use crate::node::{IMAGE, MeterNode, MeterSockets, STRING, TypeDescription};
use crate::raw::RawNode;
use crate::relay::{Relay, RelayHops};
use crate::suite;

/// A path between client and node.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) enum ClientPath {
    /// Through the daemon, in this encoding.
    Daemon(Encoding),
    /// Through a process that copies bytes.
    Bytes,
    /// Through a process that builds trees of values.
    Values,
    /// Directly to the node, by TCPROS.
    Direct,
    /// Through the server of rosbridge_suite in the same servant, in JSON.
    Suite,
}

/// Encodings; rosbridge calls them `none`, `cbor` and `cbor-raw`.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) enum Encoding {
    Json,
    Cbor,
    Raw,
}

impl fmt::Display for ClientPath {
    fn fmt(&self, out: &mut fmt::Formatter<'_>) -> fmt::Result {
        out.write_str(match self {
            ClientPath::Daemon(Encoding::Json) => "JSON",
            ClientPath::Daemon(Encoding::Cbor) => "cbor",
            ClientPath::Daemon(Encoding::Raw) => "cbor-raw",
            ClientPath::Bytes => "byte relay",
            ClientPath::Values => "serde_json::Value",
            ClientPath::Direct => "TCPROS, no hop between",
            ClientPath::Suite => suite::NAME,
        })
    }
}

/// An open path, and the message to send on it.
pub(crate) struct OpenPath {
    pub(crate) line: BenchConnection,
    /// One framed message or call.
    pub(crate) message: Vec<u8>,
    /// Dropped after the connection.
    _relay: Option<Relay>,
    raw: Option<(RawNode, Option<String>)>,
}

/// The daemon, the node and the topics or service that all paths are opened to.
pub(crate) struct PathTarget<'a> {
    pub(crate) daemon: &'a BenchDaemon,
    pub(crate) node: &'a MeterNode,
    pub(crate) hops: RelayHops<'a>,
}

impl PathTarget<'_> {
    fn message_type(&self) -> TypeDescription {
        if self.hops.images { IMAGE } else { STRING }
    }

    /// Opens a path and waits until the node is connected to it, and to nothing else.
    pub(crate) fn open(&self, way: ClientPath) -> Result<OpenPath> {
        let topics = [self.hops.inward, self.hops.outward];
        for topic in topics.into_iter().flatten() {
            self.node.wait_until_connected(topic, 0)?;
        }
        let open = match way {
            ClientPath::Daemon(encoding) => self.open_daemon(encoding)?,
            ClientPath::Bytes | ClientPath::Values => self.open_relay(way == ClientPath::Values)?,
            ClientPath::Direct => self.open_direct()?,
            ClientPath::Suite => self.open_rosbridge(suite::connect_client(self.node)?, Encoding::Json)?,
        };
        for topic in topics.into_iter().flatten() {
            self.node.wait_until_connected(topic, 1)?;
        }
        Ok(open)
    }

    fn open_daemon(&self, encoding: Encoding) -> Result<OpenPath> {
        self.open_rosbridge(BenchConnection::connect_robot(self.daemon)?, encoding)
    }

    /// Sets up rosbridge on a connection to a server that speaks its protocol.
    fn open_rosbridge(&self, mut line: BenchConnection, encoding: Encoding) -> Result<OpenPath> {
        let (kind, mut message) = (self.message_type(), Vec::new());
        if let Some(topic) = self.hops.outward {
            let compression = match encoding {
                Encoding::Json => "none",
                Encoding::Cbor => "cbor",
                Encoding::Raw => "cbor-raw",
            };
            line.send_text(&format!(
                r#"{{"op":"subscribe","topic":"{topic}","type":"{}","compression":"{compression}"}}"#,
                kind.name
            ))?;
        }
        if let Some(topic) = self.hops.inward {
            line.send_text(&format!(
                r#"{{"op":"advertise","topic":"{topic}","type":"{}","queue_size":1000}}"#,
                kind.name
            ))?;
            message = publish_op(topic, self.hops.images, encoding);
        }
        if let Some(service) = self.hops.service {
            message = line::frame(line::TEXT, call_op(service).as_bytes());
        }
        Ok(OpenPath { line, message, _relay: None, raw: None })
    }

    fn open_relay(&self, values: bool) -> Result<OpenPath> {
        let hops = RelayHops { values, ..self.hops };
        let relay = Relay::start(self.node.pid, hops)?;
        let (line, message) = if values {
            let line = BenchConnection::connect_websocket(&relay.address, "")?;
            let message = hops.inward.map_or_else(Vec::new, |topic| publish_op(topic, hops.images, Encoding::Json));
            (line, message)
        } else {
            let stream = std::net::TcpStream::connect(&relay.address)?;
            (BenchConnection::new(stream, self.framing())?, self.framed_message())
        };
        Ok(OpenPath { line, message, _relay: Some(relay), raw: None })
    }

    fn open_direct(&self) -> Result<OpenPath> {
        let (node, kind) = (self.node, self.message_type());
        let inside = MeterSockets::for_process(node.pid)?;
        let start = RawNode::start(inside, "/bench_direct");
        let raw = node.runtime.block_on(start)?;
        let sender = match self.hops.inward {
            Some(topic) => Some(node.runtime.block_on(raw.publish(topic, kind))?),
            None => None,
        };
        let receiver = match (self.hops.outward, self.hops.service) {
            (Some(topic), _) => node.runtime.block_on(raw.subscribe(topic, kind))?,
            (None, Some(service)) => node.runtime.block_on(raw.connect_service(service))?,
            (None, None) => sender.as_ref().context("a topic")?.try_clone()?,
        };
        let mut line = BenchConnection::new(receiver, self.framing())?;
        if let Some(sender) = sender {
            line = line.with_sender(sender)?;
        }
        Ok(OpenPath {
            line,
            message: self.framed_message(),
            _relay: None,
            raw: Some((raw, self.hops.inward.map(str::to_owned))),
        })
    }

    fn framing(&self) -> Framing {
        match self.hops.service {
            Some(_) => Framing::Response,
            None => Framing::Tcpros,
        }
    }

    /// Returns the message or request in ROS serialization, framed for TCPROS.
    fn framed_message(&self) -> Vec<u8> {
        match self.hops.service {
            Some(_) => line::tcpros_frame(&[1, 0, 0, 0, 0, 0, 0, 0, 2, 0, 0, 0, 0, 0, 0, 0]),
            None => line::tcpros_frame(&serialize_message(self.hops.images)),
        }
    }

    /// Closes a path and unregisters its topics.
    pub(crate) fn close(&self, open: OpenPath) -> Result<()> {
        drop(open.line);
        if let Some((raw, Some(topic))) = &open.raw {
            self.node.runtime.block_on(raw.unpublish(topic))?;
        }
        Ok(())
    }
}

/// Checks that a received message is the one that the node publishes.
pub(crate) fn check_message(way: ClientPath, images: bool, message: &[u8]) -> Result<()> {
    let expected = self::serialize_message(images);
    match way {
        ClientPath::Daemon(Encoding::Json) | ClientPath::Values | ClientPath::Suite => {
            let op: Value = serde_json::from_slice(message)?;
            let data = op["msg"]["data"].as_str().context("data")?;
            let length = if images { BASE64_STANDARD.decode(data)?.len() } else { data.len() };
            let least = if images { 921_600 } else { TEXT.len() };
            ensure!(length == least, "{way}: data of {length} bytes");
        }
        _ => ensure!(message.len() >= expected.len(), "{way}: {} bytes", message.len()),
    }
    Ok(())
}

const TEXT: &str = "a message of a usual size";

/// Returns the serialized message.
pub(crate) fn serialize_message(images: bool) -> Vec<u8> {
    let mut out = Vec::new();
    let text = |out: &mut Vec<u8>, text: &[u8]| {
        out.extend_from_slice(&(text.len() as u32).to_le_bytes());
        out.extend_from_slice(text);
    };
    if images {
        // seq and stamp; the frame id follows.
        out.extend_from_slice(&[0; 12]);
        text(&mut out, b"camera");
        out.extend_from_slice(&480u32.to_le_bytes());
        out.extend_from_slice(&640u32.to_le_bytes());
        text(&mut out, b"rgb8");
        out.push(0);
        out.extend_from_slice(&1920u32.to_le_bytes());
        text(&mut out, &pixels());
    } else {
        text(&mut out, TEXT.as_bytes());
    }
    out
}

/// Returns pseudorandom pixels, which cannot be compressed.
fn pixels() -> Vec<u8> {
    let mut state = 1u32;
    let next = |_| {
        state = state.wrapping_mul(1_664_525).wrapping_add(1_013_904_223);
        (state >> 24) as u8
    };
    (0..921_600).map(next).collect()
}

fn publish_op(topic: &str, images: bool, encoding: Encoding) -> Vec<u8> {
    let (mut out, message) = (Vec::new(), serialize_message(images));
    let (format, opcode) = match encoding {
        Encoding::Json => (Format::Json, line::TEXT),
        Encoding::Cbor | Encoding::Raw => (Format::Cbor, line::BINARY),
    };
    let mut writer = Writer::op(&mut out, format, "publish", None);
    writer.text("topic", topic);
    if encoding == Encoding::Raw {
        writer.text("compression", "cbor-raw");
        writer.raw("msg", None, &message);
    } else {
        // The client is not part of the measurement: its message is built once, in advance.
        let kind = if images { IMAGE } else { STRING };
        let kind = ros::schema::MessageType::from_full_text(kind.name, kind.definition);
        let kind = kind.expect("a definition of ours");
        let (json, cbor) = (Default::default(), Default::default());
        let written = writer.value("msg", |out| match format {
            Format::Json => ros::codec::to_json(&kind, &message, out, &json),
            Format::Cbor => ros::codec::to_cbor(&kind, &message, out, &cbor),
        });
        written.expect("a message of ours");
    }
    writer.end();
    line::frame(opcode, &out)
}

/// Returns a service call in JSON.
fn call_op(service: &str) -> String {
    format!(r#"{{"op":"call_service","id":"1","service":"{service}","args":{{"a":1,"b":2}}}}"#)
}
