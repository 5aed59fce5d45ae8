//! One message from ROS on its way to any number of clients: decoded at most once per encoding, when first needed.

use std::sync::Arc;
use std::sync::atomic::{AtomicUsize, Ordering};

use budget::Permit;
use bytes::Bytes;
use parking_lot::Mutex;
use ros::bus::WireType;
use ros::codec::{self, CborOptions, JsonOptions, Time};
use ros::schema::{MessageType, Registry};
use rosbridge::{Compression, Format, Publish};

use crate::{BridgeOptions, Metrics};
use ws::frame::{BINARY, TEXT};

/// What becomes of a message counts in no budget up to this size: the lengths of queues bound it.
const UNCOUNTED: usize = 64 * 1024;

/// A message becomes at most about so many times longer (an array of booleans does), and what it always has besides.
const LONGEST: usize = 8;
const SHORT: usize = 4 * 1024;

/// A whole WebSocket message, ready to be sent to anyone.
#[derive(Debug, Clone, PartialEq, Eq)]
pub(crate) struct Frame {
    pub(crate) format: Format,
    pub(crate) bytes: Bytes,
}

impl Frame {
    pub(crate) fn opcode(&self) -> u8 {
        match self.format {
            Format::Json => TEXT,
            Format::Cbor => BINARY,
        }
    }

    /// JSON text wrapped as the pixels of a picture; in ASCII, since browsers take each byte of it for a character.
    pub(crate) fn into_png(self) -> Result<Frame, String> {
        let failed = |error: &dyn std::fmt::Display| format!("cannot be packed as png: {error}");
        let text = std::str::from_utf8(&self.bytes).map_err(|error| failed(&error))?;
        let ascii = rosbridge::to_ascii(text);
        let data = rosbridge::encode_png(ascii.as_bytes()).map_err(|error| failed(&error))?;
        let mut out = Vec::with_capacity(data.len() + 64);
        rosbridge::Op::from(rosbridge::Png {
            id: None,
            data: data.into(),
            part: None,
        })
        .print(&mut out, Format::Json);
        Ok(Frame {
            format: Format::Json,
            bytes: out.into(),
        })
    }
}

/// What publishers of one topic announced, and the types found for it.
pub(crate) struct TopicTypes {
    registry: Arc<Registry>,
    found: Mutex<Vec<(Arc<WireType>, FoundType)>>,
    /// Length of the last encoding of each kind, as a hint for the next.
    sizes: [AtomicUsize; 3],
}

type FoundType = Result<Arc<MessageType>, Arc<str>>;

impl TopicTypes {
    pub(crate) fn new(registry: Arc<Registry>) -> Self {
        Self {
            registry,
            found: Mutex::default(),
            sizes: Default::default(),
        }
    }

    /// The type that messages announced so have.
    pub(crate) fn find(&self, wire_type: &Arc<WireType>) -> FoundType {
        let mut found = self.found.lock();
        let same = |known: &Arc<WireType>| Arc::ptr_eq(known, wire_type) || known == wire_type;
        if let Some((_, result)) = found.iter().find(|(known, _)| same(known)) {
            return result.clone();
        }
        let result = find_type(&self.registry, wire_type).map_err(Arc::from);
        // Publishers come and go, and one could announce a new type each time.
        if found.len() >= 16 {
            found.drain(..1);
        }
        found.push((wire_type.clone(), result.clone()));
        result
    }
}

/// The registry's type where its MD5 agrees, else one made from the definition that the publisher sent.
fn find_type(registry: &Registry, wire: &WireType) -> Result<Arc<MessageType>, String> {
    let agrees = |found: &MessageType| wire.md5 == "*" || wire.md5 == found.md5();
    let ours = match registry.message(&wire.name) {
        Ok(found) if agrees(&found) => return Ok(found),
        ours => ours,
    };
    if wire.definition.is_empty() {
        return Err(match ours {
            Ok(found) => format!(
                "its type {} has MD5 {}, ours has {}",
                wire.name,
                wire.md5,
                found.md5()
            ),
            Err(error) => error.to_string(),
        });
    }
    let theirs = if ours.is_err() {
        registry
            .insert_full_text(&wire.name, &wire.definition)
            .and_then(|()| registry.message(&wire.name))
    } else {
        MessageType::from_full_text(&wire.name, &wire.definition)
    };
    match theirs {
        Ok(found) if agrees(&found) => Ok(found),
        Ok(found) => Err(format!(
            "the publisher's definition of {} has MD5 {}, not {} as it says",
            wire.name,
            found.md5(),
            wire.md5
        )),
        Err(error) => Err(error.to_string()),
    }
}

/// A message and its encodings so far.
pub(crate) struct Sample {
    pub(crate) bytes: Bytes,
    pub(crate) wire_type: Arc<WireType>,
    pub(crate) publisher: Arc<str>,
    pub(crate) latching: bool,
    /// From a client of this bridge rather than from a node.
    pub(crate) local: bool,
    pub(crate) received: Time,
    types: Arc<TopicTypes>,
    encoded: Mutex<Vec<Encoded>>,
}

struct Encoded {
    compression: Compression,
    topic: Arc<str>,
    frame: Result<Frame, Arc<str>>,
    _permit: Permit,
}

impl Sample {
    pub(crate) fn new(message: ros::bus::Message, local: bool, types: Arc<TopicTypes>) -> Self {
        Self {
            bytes: message.bytes,
            wire_type: message.wire_type,
            publisher: message.publisher,
            latching: message.latching,
            local,
            received: Time::now(),
            types,
            encoded: Mutex::default(),
        }
    }

    /// The `publish` frame for clients that call the topic `topic`; the reason where it cannot be made.
    pub(crate) fn frame(
        &self,
        compression: Compression,
        topic: &Arc<str>,
        options: &BridgeOptions,
        metrics: &Metrics,
    ) -> Result<Frame, Arc<str>> {
        // Held while encoding: a second subscriber waits for the first one's result instead of making its own.
        let mut encoded = self.encoded.lock();
        let same = |other: &&Encoded| other.compression == compression && other.topic == *topic;
        if let Some(known) = encoded.iter().find(same) {
            return known.frame.clone();
        }
        metrics.encoded.add(1);
        let mut permit = options.budget.permit();
        let frame = self.encode(compression, topic, options, &mut permit);
        encoded.push(Encoded {
            compression,
            topic: topic.clone(),
            frame: frame.clone(),
            _permit: permit,
        });
        frame
    }

    fn encode(
        &self,
        compression: Compression,
        topic: &str,
        options: &BridgeOptions,
        permit: &mut Permit,
    ) -> Result<Frame, Arc<str>> {
        let slot = match compression {
            Compression::None | Compression::Png => 0,
            Compression::Cbor => 1,
            Compression::CborRaw => 2,
        };
        let length = self.bytes.len();
        let last = self.types.sizes[slot].load(Ordering::Relaxed);
        // The last one may have been of quite another size.
        let hint = last.min(LONGEST * length + SHORT).max(length) + 128;
        let full = |full: budget::Exceeded| {
            Arc::<str>::from(format!(
                "a message from {} is left out: {full}",
                self.publisher
            ))
        };
        if hint > UNCOUNTED {
            permit.resize(hint).map_err(full)?;
        }
        let max_bytes = options.max_encoded;
        let left = permit.bytes().saturating_add(options.budget.left());
        let max_bytes = max_bytes.min(left.max(UNCOUNTED));
        let mut out = Vec::with_capacity(hint);
        let failed = |error: codec::CodecError| {
            Arc::<str>::from(format!("{error} (from {})", self.publisher))
        };
        match compression {
            Compression::CborRaw => {
                Publish::print_raw(
                    &mut out,
                    topic,
                    (self.received.secs, self.received.nsecs),
                    &self.bytes,
                );
            }
            Compression::Cbor => {
                let message_type = self.types.find(&self.wire_type)?;
                let options = CborOptions {
                    max_bytes,
                    ..CborOptions::default()
                };
                let write =
                    |out: &mut Vec<u8>| codec::to_cbor(&message_type, &self.bytes, out, &options);
                Publish::print_with(&mut out, Format::Cbor, topic, write).map_err(failed)?;
            }
            Compression::None | Compression::Png => {
                let message_type = self.types.find(&self.wire_type)?;
                let options = JsonOptions {
                    non_finite: options.non_finite,
                    max_bytes,
                    ..JsonOptions::default()
                };
                let write =
                    |out: &mut Vec<u8>| codec::to_json(&message_type, &self.bytes, out, &options);
                Publish::print_with(&mut out, Format::Json, topic, write).map_err(failed)?;
            }
        }
        if out.capacity() > UNCOUNTED {
            permit.resize(out.capacity()).map_err(full)?;
        }
        self.types.sizes[slot].store(out.len(), Ordering::Relaxed);
        let format = if slot == 0 {
            Format::Json
        } else {
            Format::Cbor
        };
        let frame = Frame {
            format,
            bytes: out.into(),
        };
        if compression == Compression::Png {
            frame.into_png().map_err(Arc::from)
        } else {
            Ok(frame)
        }
    }
}
