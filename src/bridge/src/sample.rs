//! One message from ROS on its way to any number of clients: decoded once per encoding while it is one of its topic's
//! latest, when first needed.

use std::collections::VecDeque;
use std::sync::atomic::{AtomicUsize, Ordering};
use std::sync::{Arc, Weak};

use budget::{Exceeded, Permit, UNCOUNTED};
use bytes::Bytes;
use parking_lot::Mutex;
use ros::bus::{PeerId, WireType};
use ros::codec::{self, CborOptions, JsonOptions, Time};
use ros::schema::{MessageType, Registry};
use rosbridge::{Compression, Format, Publish};

use crate::names::digest_word;
use crate::{BridgeOptions, Metrics};
use ws::frame::{BINARY, TEXT};

/// A message becomes at most about so many times longer (an array of booleans does), and what it always has besides.
const LONGEST: usize = 8;
const SHORT: usize = 4 * 1024;
/// Encodings that a topic keeps, and their bytes. A client that is so far behind that it wants an older one has it encoded
/// again: what waits for it is the message from ROS alone.
const WARM: (usize, usize) = (256, 16 << 20);

/// A whole WebSocket message, ready to be sent to anyone.
#[derive(Debug, Clone, PartialEq, Eq)]
pub(crate) struct Frame {
    pub(crate) format: Format,
    /// Above [`UNCOUNTED`] they hold their permit.
    pub(crate) bytes: Bytes,
}

impl Frame {
    /// A frame of what was printed, which counts nowhere yet.
    pub(crate) fn new(format: Format, mut printed: Vec<u8>) -> Self {
        // What is counted is its length.
        if printed.capacity() > UNCOUNTED {
            printed.shrink_to_fit();
        }
        Self {
            format,
            bytes: printed.into(),
        }
    }

    /// Whether it counts by itself.
    pub(crate) fn is_big(&self) -> bool {
        self.bytes.len() > UNCOUNTED
    }

    /// The same, holding `permit`.
    pub(crate) fn holding(self, permit: Option<Permit>) -> Self {
        match permit {
            Some(permit) => Self {
                bytes: permit.around(self.bytes),
                ..self
            },
            None => self,
        }
    }

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
        Ok(Frame::new(Format::Json, out))
    }
}

/// What publishers of one topic announced, and the types found for it.
pub(crate) struct TopicTypes {
    registry: Arc<Registry>,
    found: Mutex<Vec<(Arc<WireType>, FoundType)>>,
    /// Length of the last encoding of each kind, as a hint for the next.
    sizes: [AtomicUsize; 3],
    warm: Mutex<Warm>,
}

/// Messages whose encodings are kept, oldest first.
#[derive(Default)]
struct Warm {
    samples: VecDeque<(Weak<Sample>, usize)>,
    bytes: usize,
}

type FoundType = Result<Arc<MessageType>, Arc<str>>;

impl TopicTypes {
    pub(crate) fn new(registry: Arc<Registry>) -> Self {
        Self {
            registry,
            found: Mutex::default(),
            sizes: Default::default(),
            warm: Mutex::default(),
        }
    }

    /// Keeps an encoding of `bytes` bytes of this message, and older ones no longer.
    fn keep_warm(&self, sample: &Arc<Sample>, bytes: usize) {
        let mut cold = Vec::new();
        {
            let mut warm = self.warm.lock();
            warm.samples.push_back((Arc::downgrade(sample), bytes));
            warm.bytes += bytes;
            while warm.samples.len() > 1 && (warm.samples.len() > WARM.0 || warm.bytes > WARM.1) {
                let Some((oldest, bytes)) = warm.samples.pop_front() else {
                    break;
                };
                warm.bytes -= bytes;
                cold.push(oldest);
            }
        }
        // Not under the lock: one of them may be being encoded.
        for sample in cold.iter().filter_map(Weak::upgrade) {
            *sample.encoded.lock() = Encodings::Cold;
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

/// The registry's type where its digest agrees, else one made from the definition that the publisher sent.
fn find_type(registry: &Registry, wire: &WireType) -> Result<Arc<MessageType>, String> {
    let agrees = |found: &MessageType| wire.digest.agrees(&found.digest().into());
    let word = digest_word(wire.format.version());
    let ours = match registry.message(&wire.name) {
        Ok(found) if agrees(&found) => return Ok(found),
        ours => ours,
    };
    if wire.definition.is_empty() {
        return Err(match ours {
            Ok(found) => format!(
                "its type {} has {word} {}, ours has {}",
                wire.name,
                wire.digest,
                found.digest()
            ),
            Err(error) => error.to_string(),
        });
    }
    let theirs = if ours.is_err() {
        registry
            .insert_full_text(&wire.name, &wire.definition)
            .and_then(|()| registry.message(&wire.name))
    } else {
        wire.schema()
    };
    match theirs {
        Ok(found) if agrees(&found) => Ok(found),
        Ok(found) => Err(format!(
            "the publisher's definition of {} has {word} {}, not {} as it says",
            wire.name,
            found.digest(),
            wire.digest
        )),
        Err(error) => Err(error.to_string()),
    }
}

/// A message and its encodings so far.
pub(crate) struct Sample {
    pub(crate) bytes: Bytes,
    pub(crate) wire_type: Arc<WireType>,
    pub(crate) publisher: PeerId,
    pub(crate) latching: bool,
    /// From a client of this bridge rather than from a node.
    pub(crate) local: bool,
    pub(crate) received: Time,
    types: Arc<TopicTypes>,
    encoded: Mutex<Encodings>,
    /// For its bytes.
    _permit: Option<Permit>,
}

enum Encodings {
    Warm(Vec<Encoded>),
    /// None is kept any more.
    Cold,
}

struct Encoded {
    compression: Compression,
    topic: Arc<str>,
    frame: Result<Frame, Arc<str>>,
    /// In the servant's budget alone; the frame holds the one above.
    _permit: Permit,
}

impl Sample {
    /// A sample whose bytes count in the budgets above the servant's while it waits for clients: a slow one of those must not
    /// use up what the servant has for the others.
    pub(crate) fn new(
        message: ros::bus::Message,
        local: bool,
        types: Arc<TopicTypes>,
        options: &BridgeOptions,
    ) -> Result<Self, Exceeded> {
        let length = message.bytes.len();
        let permit = if length > UNCOUNTED {
            options.budget.take(length)?.split().1
        } else {
            None
        };
        Ok(Self {
            bytes: message.bytes,
            wire_type: message.wire_type,
            publisher: message.publisher,
            latching: message.latching,
            local,
            received: Time::now(),
            types,
            encoded: Mutex::new(Encodings::Warm(Vec::new())),
            _permit: permit,
        })
    }

    /// The type of its bytes; the reason where that cannot be known.
    pub(crate) fn schema(&self) -> Result<Arc<MessageType>, Arc<str>> {
        self.types.find(&self.wire_type)
    }

    /// Its bytes, where they have a permit of their own.
    pub(crate) fn big(&self) -> usize {
        match self.bytes.len() {
            0..=UNCOUNTED => 0,
            bytes => bytes,
        }
    }

    /// The `publish` frame for clients that call the topic `topic`; the reason where it cannot be made.
    pub(crate) fn frame(
        self: &Arc<Self>,
        compression: Compression,
        topic: &Arc<str>,
        options: &BridgeOptions,
        metrics: &Metrics,
    ) -> Result<Frame, Arc<str>> {
        // Held while encoding: a second subscriber waits for the first one's result instead of making its own.
        let mut encoded = self.encoded.lock();
        let same = |other: &&Encoded| other.compression == compression && other.topic == *topic;
        if let Encodings::Warm(known) = &*encoded
            && let Some(known) = known.iter().find(same)
        {
            return known.frame.clone();
        }
        metrics.encoded.add(1);
        let mut permit = options.budget.permit();
        let made = self.encode(compression, topic, options, &mut permit);
        let (own, above) = permit.split();
        let frame = made.map(|frame| match frame.is_big() {
            true => frame.holding(above),
            false => frame,
        });
        let Encodings::Warm(known) = &mut *encoded else {
            return frame;
        };
        known.push(Encoded {
            compression,
            topic: topic.clone(),
            frame: frame.clone(),
            _permit: own,
        });
        drop(encoded);
        let bytes = frame.as_ref().map_or(0, |frame| frame.bytes.len());
        self.types.keep_warm(self, bytes);
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
        self.types.sizes[slot].store(out.len(), Ordering::Relaxed);
        let format = if slot == 0 {
            Format::Json
        } else {
            Format::Cbor
        };
        let mut frame = Frame::new(format, out);
        if compression == Compression::Png {
            frame = frame.into_png().map_err(Arc::from)?;
        }
        let counted = if frame.is_big() { frame.bytes.len() } else { 0 };
        permit.resize(counted).map_err(full)?;
        Ok(frame)
    }
}

#[cfg(test)]
#[path = "sample_tests.rs"]
mod tests;
