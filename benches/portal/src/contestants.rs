//! Paths from a client to the node and back, each open during its own turn only.

use std::fmt;
use std::net::TcpStream;

use anyhow::{Context, Result, ensure};
use base64::prelude::{BASE64_STANDARD, Engine as _};
use bench_report::BenchDaemon;
use rosbridge::{Format, Writer};
use serde_json::{Value, json};

use crate::line::{self, BenchConnection, Framing};
use crate::node::{IMAGE, MeterNode, STRING, TypeDescription};
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
    /// Topic to unregister in the end.
    published: Option<String>,
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
            ClientPath::Daemon(encoding) => {
                self.open_rosbridge(BenchConnection::connect_robot(self.daemon)?, encoding)?
            }
            ClientPath::Bytes | ClientPath::Values => self.open_raw(Some(way == ClientPath::Values))?,
            ClientPath::Direct => self.open_raw(None)?,
            ClientPath::Suite => self.open_rosbridge(suite::connect_client(self.node)?, Encoding::Json)?,
        };
        for topic in topics.into_iter().flatten() {
            self.node.wait_until_connected(topic, 1)?;
        }
        Ok(open)
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
            let op = json!({"op": "subscribe", "topic": topic, "type": kind.name, "compression": compression});
            line.send_text(&op.to_string())?;
        }
        if let Some(topic) = self.hops.inward {
            let op = json!({"op": "advertise", "topic": topic, "type": kind.name, "queue_size": 1000});
            line.send_text(&op.to_string())?;
            message = publish_op(topic, self.hops.images, encoding);
        }
        if let Some(service) = self.hops.service {
            let op = json!({"op": "call_service", "id": "1", "service": service, "args": {"a": 1, "b": 2}});
            message = line::frame(line::TEXT, op.to_string().as_bytes());
        }
        Ok(OpenPath { line, message, _relay: None, published: None })
    }

    /// Opens bare connections to the node; with `relay` a process between them and the client, which converts through
    /// values if that is true.
    fn open_raw(&self, relay: Option<bool>) -> Result<OpenPath> {
        let (node, kind, hops) = (self.node, self.message_type(), self.hops);
        let publish = |topic| node.runtime.block_on(node.raw.publish(topic, kind));
        let mut to = hops.inward.map(publish).transpose()?;
        let mut from = hops.outward.map(|topic| node.runtime.block_on(node.raw.subscribe(topic, kind))).transpose()?;
        if let Some(service) = hops.service {
            let stream = node.runtime.block_on(node.raw.connect_service(service))?;
            (to, from) = (Some(stream.try_clone()?), Some(stream));
        }
        let mut message = self.framed_message();
        let (line, relay) = match relay {
            Some(values) => {
                let (relay, client) = Relay::start(values, hops, from, to)?;
                let line = if values {
                    let publication = hops.inward.map(|topic| publish_op(topic, hops.images, Encoding::Json));
                    message = publication.unwrap_or_default();
                    BenchConnection::upgrade(client, "127.0.0.1", "")?
                } else {
                    BenchConnection::new(client, self.framing())?
                };
                (line, Some(relay))
            }
            None => {
                let receiver = from.or(to.as_ref().map(TcpStream::try_clone).transpose()?).context("a topic")?;
                let line = BenchConnection::new(receiver, self.framing())?;
                (line.with_sender(to)?, None)
            }
        };
        Ok(OpenPath { line, message, _relay: relay, published: hops.inward.map(str::to_owned) })
    }

    fn framing(&self) -> Framing {
        if self.hops.service.is_some() { Framing::Response } else { Framing::Tcpros }
    }

    /// Returns the message or request in ROS serialization, framed for TCPROS.
    fn framed_message(&self) -> Vec<u8> {
        let request = || [1_i64, 2].map(i64::to_le_bytes).concat();
        let message = self.hops.service.map_or_else(|| serialize_message(self.hops.images), |_| request());
        line::tcpros_frame(&message)
    }

    /// Closes a path and unregisters its topics.
    pub(crate) fn close(&self, open: OpenPath) -> Result<()> {
        drop(open.line);
        if let Some(topic) = &open.published {
            self.node.runtime.block_on(self.node.raw.unpublish(topic))?;
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
