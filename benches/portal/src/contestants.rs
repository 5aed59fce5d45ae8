//! Ways from a client to the node and back. Each is opened for its turn only: what another has subscribed to would be
//! sent there too.

use std::fmt;

use anyhow::{Context, Result, ensure};
use base64::prelude::{BASE64_STANDARD, Engine as _};
use bench_servant::Daemon;
use rosbridge::{Format, Writer};
use serde_json::Value;

use crate::line::{self, Framing, Line};
use crate::node::{IMAGE, Inside, Node, STRING, Type};
use crate::raw::Raw;
use crate::relay::{Hops, Relay};
use crate::suite;

/// A way.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) enum Way {
    /// Through the daemon, with this encoding.
    Daemon(Encoding),
    /// A process that moves bytes.
    Bytes,
    /// A process that builds trees of values.
    Values,
    /// The node itself, by TCPROS.
    Direct,
    /// The server of rosbridge_suite in the same servant, JSON.
    Suite,
}

/// rosbridge's names: `none`, `cbor`, `cbor-raw`.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) enum Encoding {
    Json,
    Cbor,
    Raw,
}

impl fmt::Display for Way {
    fn fmt(&self, out: &mut fmt::Formatter<'_>) -> fmt::Result {
        out.write_str(match self {
            Way::Daemon(Encoding::Json) => "JSON",
            Way::Daemon(Encoding::Cbor) => "cbor",
            Way::Daemon(Encoding::Raw) => "cbor-raw",
            Way::Bytes => "byte relay",
            Way::Values => "serde_json::Value",
            Way::Direct => "TCPROS, no hop between",
            Way::Suite => suite::NAME,
        })
    }
}

/// A connection that is ready, and what is sent on it.
pub(crate) struct Open {
    pub(crate) line: Line,
    /// One message or call, framed.
    pub(crate) message: Vec<u8>,
    /// Ended after the line.
    _relay: Option<Relay>,
    raw: Option<(Raw, Option<String>)>,
}

/// What all ways lead to.
pub(crate) struct Course<'a> {
    pub(crate) daemon: &'a Daemon,
    pub(crate) node: &'a Node,
    pub(crate) hops: Hops<'a>,
}

impl Course<'_> {
    fn kind(&self) -> Type {
        if self.hops.images { IMAGE } else { STRING }
    }

    /// Opens a way; ready when the node is connected, and only with it.
    pub(crate) fn open(&self, way: Way) -> Result<Open> {
        let topics = [self.hops.inward, self.hops.outward];
        for topic in topics.into_iter().flatten() {
            self.node.until_connected(topic, 0)?;
        }
        let open = match way {
            Way::Daemon(encoding) => self.daemon(encoding)?,
            Way::Bytes | Way::Values => self.relay(way == Way::Values)?,
            Way::Direct => self.direct()?,
            Way::Suite => self.bridge(suite::client(self.node)?, Encoding::Json)?,
        };
        for topic in topics.into_iter().flatten() {
            self.node.until_connected(topic, 1)?;
        }
        Ok(open)
    }

    fn daemon(&self, encoding: Encoding) -> Result<Open> {
        self.bridge(Line::robot(self.daemon)?, encoding)
    }

    /// By rosbridge's protocol, on a line to whoever speaks it.
    fn bridge(&self, mut line: Line, encoding: Encoding) -> Result<Open> {
        let (kind, mut message) = (self.kind(), Vec::new());
        if let Some(topic) = self.hops.outward {
            let compression = match encoding {
                Encoding::Json => "none",
                Encoding::Cbor => "cbor",
                Encoding::Raw => "cbor-raw",
            };
            line.say(&format!(
                r#"{{"op":"subscribe","topic":"{topic}","type":"{}","compression":"{compression}"}}"#,
                kind.name
            ))?;
        }
        if let Some(topic) = self.hops.inward {
            line.say(&format!(
                r#"{{"op":"advertise","topic":"{topic}","type":"{}","queue_size":1000}}"#,
                kind.name
            ))?;
            message = publish(topic, self.hops.images, encoding);
        }
        if let Some(service) = self.hops.service {
            message = line::frame(line::TEXT, call(service).as_bytes());
        }
        Ok(Open {
            line,
            message,
            _relay: None,
            raw: None,
        })
    }

    fn relay(&self, values: bool) -> Result<Open> {
        let hops = Hops {
            values,
            ..self.hops
        };
        let relay = Relay::start(self.node.pid, hops)?;
        let (line, message) = if values {
            let line = Line::websocket(&relay.address, "")?;
            let message = hops.inward.map_or_else(Vec::new, |topic| {
                publish(topic, hops.images, Encoding::Json)
            });
            (line, message)
        } else {
            let stream = std::net::TcpStream::connect(&relay.address)?;
            (Line::new(stream, self.framing())?, self.bare())
        };
        Ok(Open {
            line,
            message,
            _relay: Some(relay),
            raw: None,
        })
    }

    fn direct(&self) -> Result<Open> {
        let (node, kind) = (self.node, self.kind());
        let inside = Inside::of(node.pid)?;
        let start = Raw::start(inside, "/bench_direct");
        let raw = node.runtime.block_on(start)?;
        let sender = match self.hops.inward {
            Some(topic) => Some(node.runtime.block_on(raw.publish(topic, kind))?),
            None => None,
        };
        let receiver = match (self.hops.outward, self.hops.service) {
            (Some(topic), _) => node.runtime.block_on(raw.subscribe(topic, kind))?,
            (None, Some(service)) => node.runtime.block_on(raw.service(service))?,
            (None, None) => sender.as_ref().context("a topic")?.try_clone()?,
        };
        let mut line = Line::new(receiver, self.framing())?;
        if let Some(sender) = sender {
            line = line.sending_on(sender)?;
        }
        Ok(Open {
            line,
            message: self.bare(),
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

    /// What is sent as ROS bytes.
    fn bare(&self) -> Vec<u8> {
        match self.hops.service {
            Some(_) => line::tcpros(&[1, 0, 0, 0, 0, 0, 0, 0, 2, 0, 0, 0, 0, 0, 0, 0]),
            None => line::tcpros(&message(self.hops.images)),
        }
    }

    /// Ends a way in good order.
    pub(crate) fn close(&self, open: Open) -> Result<()> {
        drop(open.line);
        if let Some((raw, Some(topic))) = &open.raw {
            self.node.runtime.block_on(raw.unpublish(topic))?;
        }
        Ok(())
    }
}

/// A message that came is the one that the node publishes.
pub(crate) fn check(way: Way, images: bool, message: &[u8]) -> Result<()> {
    let expected = self::message(images);
    match way {
        Way::Daemon(Encoding::Json) | Way::Values | Way::Suite => {
            let op: Value = serde_json::from_slice(message)?;
            let data = op["msg"]["data"].as_str().context("data")?;
            let length = if images {
                BASE64_STANDARD.decode(data)?.len()
            } else {
                data.len()
            };
            let least = if images { 921_600 } else { TEXT.len() };
            ensure!(length == least, "{way}: data of {length} bytes");
        }
        _ => ensure!(
            message.len() >= expected.len(),
            "{way}: {} bytes",
            message.len()
        ),
    }
    Ok(())
}

const TEXT: &str = "a message of a usual size";

/// A message, serialized.
pub(crate) fn message(images: bool) -> Vec<u8> {
    let mut out = Vec::new();
    let text = |out: &mut Vec<u8>, text: &[u8]| {
        out.extend_from_slice(&(text.len() as u32).to_le_bytes());
        out.extend_from_slice(text);
    };
    if images {
        // seq and stamp, then the frame.
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

/// Every byte different from its neighbours.
fn pixels() -> Vec<u8> {
    let mut state = 1u32;
    let next = |_| {
        state = state.wrapping_mul(1_664_525).wrapping_add(1_013_904_223);
        (state >> 24) as u8
    };
    (0..921_600).map(next).collect()
}

fn publish(topic: &str, images: bool, encoding: Encoding) -> Vec<u8> {
    let (mut out, message) = (Vec::new(), message(images));
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
        // The bench's client is another's: what it sends was made once, beforehand.
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

/// A call, in JSON.
fn call(service: &str) -> String {
    format!(r#"{{"op":"call_service","id":"1","service":"{service}","args":{{"a":1,"b":2}}}}"#)
}
