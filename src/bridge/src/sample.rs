//! One message from ROS on its way to any number of clients: encoded once per encoding, when first needed, for as long
//! as it is among the latest messages of its topic.

use std::collections::VecDeque;
use std::sync::atomic::{AtomicUsize, Ordering};
use std::sync::{Arc, Weak};

use budget::{Exceeded, Permit, UNCOUNTED};
use bytes::Bytes;
use parking_lot::Mutex;
use ros::bus::{Digest, PeerId, WireType};
use ros::codec::{self, CborOptions, CodecError, JsonOptions, Time};
use ros::schema::{MessageType, Registry, SchemaError};
use rosbridge::{Compression, Format, Publish};

use crate::names::digest_word;
use crate::{BridgeOptions, Metrics};
use ws::frame::{BINARY, TEXT};

/// Upper bound of the growth of a message by its encoding (as for an array of booleans), and of its constant part.
const LONGEST: usize = 8;
const SHORT: usize = 4 * 1024;
/// Number of encodings kept per topic, and their bytes. For a client so far behind that it needs an older one, the
/// message is encoded again: only the message from ROS waits in its queue.
const WARM: (usize, usize) = (256, 16 << 20);

/// A frame that cannot be packed as a PNG image: it is not text, or the image cannot be encoded.
#[derive(Debug, thiserror::Error)]
#[error("cannot be packed as png: {0}")]
pub(crate) struct PackError(#[source] Box<dyn std::error::Error + Send + Sync>);

/// Reasons why messages that are announced with a type have no definition.
#[derive(Debug, thiserror::Error)]
pub(crate) enum TopicTypeError {
    #[error("its type {name} has {word} {theirs}, ours has {ours}")]
    Differs {
        name: String,
        /// Term for the digests.
        word: &'static str,
        theirs: Digest,
        ours: Digest,
    },
    /// The publisher sends a definition of another digest than it announces.
    #[error("the publisher's definition of {name} has {word} {found}, not {announced} as it says")]
    FalseDigest {
        name: String,
        /// Term for the digests.
        word: &'static str,
        found: Digest,
        announced: Digest,
    },
    #[error(transparent)]
    Schema(#[from] SchemaError),
}

/// Reasons why a message does not reach a client.
#[derive(Debug, thiserror::Error)]
pub(crate) enum SampleError {
    #[error(transparent)]
    Type(#[from] Arc<TopicTypeError>),
    #[error("{error} (from {publisher})")]
    Codec { error: Box<CodecError>, publisher: PeerId },
    #[error(transparent)]
    Pack(#[from] PackError),
    /// The encoding does not fit into the servant's budget.
    #[error("a message from {publisher} was dropped: {full}")]
    NoRoom { publisher: PeerId, full: Exceeded },
    /// It does not fit into the client's budget.
    #[error("a message was dropped: {0}")]
    NoRoomAtClient(Exceeded),
}

/// A whole WebSocket message, which can be sent to any client.
#[derive(Debug, Clone, PartialEq, Eq)]
pub(crate) struct EncodedFrame {
    pub(crate) format: Format,
    /// The bytes; above [`UNCOUNTED`] they hold their permit.
    pub(crate) bytes: Bytes,
}

impl EncodedFrame {
    /// Creates a frame of printed data, which is not counted yet.
    pub(crate) fn new(format: Format, mut printed: Vec<u8>) -> Self {
        // Its length is counted, not its capacity.
        if printed.capacity() > UNCOUNTED {
            printed.shrink_to_fit();
        }
        Self { format, bytes: printed.into() }
    }

    /// Returns whether it counts by itself.
    pub(crate) fn is_big(&self) -> bool {
        self.bytes.len() > UNCOUNTED
    }

    /// Attaches `permit` to the bytes.
    pub(crate) fn with_permit(self, permit: Option<Permit>) -> Self {
        match permit {
            Some(permit) => Self { bytes: permit.wrap_bytes(self.bytes), ..self },
            None => self,
        }
    }

    pub(crate) fn opcode(&self) -> u8 {
        match self.format {
            Format::Json => TEXT,
            Format::Cbor => BINARY,
        }
    }

    /// Encodes JSON text as the pixels of a PNG image; in ASCII, since browsers interpret each byte of it as a
    /// character.
    pub(crate) fn into_png(self) -> Result<EncodedFrame, PackError> {
        let text = std::str::from_utf8(&self.bytes).map_err(|error| PackError(error.into()))?;
        let ascii = rosbridge::to_ascii(text);
        let data = rosbridge::encode_png(ascii.as_bytes());
        let data = data.map_err(|error| PackError(error.into()))?;
        let mut out = Vec::with_capacity(data.len() + 64);
        rosbridge::Op::from(rosbridge::Png { id: None, data: data.into(), part: None }).print(&mut out, Format::Json);
        Ok(EncodedFrame::new(Format::Json, out))
    }
}

/// Types announced by publishers of one topic, and the definitions found for them.
pub(crate) struct TopicTypes {
    registry: Arc<Registry>,
    found: Mutex<Vec<(Arc<WireType>, FoundType)>>,
    /// Length of the last encoding of each kind, as a hint for the next.
    sizes: [AtomicUsize; 4],
    warm: Mutex<RecentEncodings>,
}

/// Messages whose encodings are kept, oldest first.
#[derive(Default)]
struct RecentEncodings {
    samples: VecDeque<(Weak<TopicSample>, usize)>,
    bytes: usize,
}

/// The definition of an announced type, or the reason why there is none, the same for all of its messages.
type FoundType = Result<Arc<MessageType>, Arc<TopicTypeError>>;

/// The `publish` frame of a message, the same for all clients that use its encoding.
type SharedFrame = Result<EncodedFrame, Arc<SampleError>>;

impl TopicTypes {
    pub(crate) fn new(registry: Arc<Registry>) -> Self {
        Self { registry, found: Mutex::default(), sizes: Default::default(), warm: Mutex::default() }
    }

    /// Keeps an encoding of `bytes` bytes of this message, and drops older ones.
    fn cache(&self, sample: &Arc<TopicSample>, bytes: usize) {
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
        // Not under the lock, since one of them may be in the process of being encoded.
        for sample in cold.iter().filter_map(Weak::upgrade) {
            *sample.encoded.lock() = Encodings::Cold;
        }
    }

    /// Returns the definition of messages announced with this type.
    pub(crate) fn find(&self, wire_type: &Arc<WireType>) -> FoundType {
        let mut found = self.found.lock();
        let same = |known: &Arc<WireType>| Arc::ptr_eq(known, wire_type) || known == wire_type;
        if let Some((_, result)) = found.iter().find(|(known, _)| same(known)) {
            return result.clone();
        }
        let result = find_type(&self.registry, wire_type).map_err(Arc::new);
        // Publishers come and go, and one could announce a new type each time.
        if found.len() >= 16 {
            found.drain(..1);
        }
        found.push((wire_type.clone(), result.clone()));
        result
    }
}

/// Finds the registry's type if its digest matches, otherwise builds one from the definition sent by the publisher.
fn find_type(registry: &Registry, wire: &WireType) -> Result<Arc<MessageType>, TopicTypeError> {
    let agrees = |found: &MessageType| wire.digest.is_compatible_with(&found.digest().into());
    let word = digest_word(wire.format.version());
    let ours = match registry.message(&wire.name) {
        Ok(found) if agrees(&found) => return Ok(found),
        ours => ours,
    };
    if wire.definition.is_empty() {
        return Err(match ours {
            Ok(found) => TopicTypeError::Differs {
                name: wire.name.clone(),
                word,
                theirs: wire.digest.clone(),
                ours: found.digest().into(),
            },
            Err(error) => error.into(),
        });
    }
    let theirs = if ours.is_err() {
        registry.insert_full_text(&wire.name, &wire.definition).and_then(|()| registry.message(&wire.name))
    } else {
        wire.schema()
    };
    let found = theirs?;
    if agrees(&found) {
        return Ok(found);
    }
    Err(TopicTypeError::FalseDigest {
        name: wire.name.clone(),
        word,
        found: found.digest().into(),
        announced: wire.digest.clone(),
    })
}

/// A message and its encodings so far.
pub(crate) struct TopicSample {
    pub(crate) bytes: Bytes,
    pub(crate) wire_type: Arc<WireType>,
    pub(crate) publisher: PeerId,
    pub(crate) latching: bool,
    /// True if it comes from a client of this bridge rather than from a node.
    pub(crate) local: bool,
    pub(crate) received: Time,
    types: Arc<TopicTypes>,
    encoded: Mutex<Encodings>,
    /// Permit for its bytes.
    _permit: Option<Permit>,
}

enum Encodings {
    Warm(Vec<CachedEncoding>),
    /// Encodings are no longer kept.
    Cold,
}

struct CachedEncoding {
    compression: Compression,
    topic: Arc<str>,
    frame: SharedFrame,
    /// Permit in the servant's budget alone; the frame holds the one of its ancestors.
    _permit: Permit,
}

impl TopicSample {
    /// Creates a sample whose bytes count only in the ancestors of the servant's budget while it waits for clients: a
    /// slow client must not use up the servant's budget for the others.
    pub(crate) fn new(
        message: ros::bus::SerializedMessage,
        local: bool,
        types: Arc<TopicTypes>,
        options: &BridgeOptions,
    ) -> Result<Self, Exceeded> {
        let length = message.bytes.len();
        let permit = if length > UNCOUNTED { options.budget.take(length)?.split().1 } else { None };
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

    /// Returns the definition of its bytes, or the reason why it is unknown.
    pub(crate) fn schema(&self) -> FoundType {
        self.types.find(&self.wire_type)
    }

    /// Returns its bytes if they have a permit of their own, otherwise 0.
    pub(crate) fn counted_bytes(&self) -> usize {
        match self.bytes.len() {
            0..=UNCOUNTED => 0,
            bytes => bytes,
        }
    }

    /// Returns the `publish` frame for clients that use the topic name `topic`, or the reason why it cannot be encoded.
    pub(crate) fn frame(
        self: &Arc<Self>,
        compression: Compression,
        topic: &Arc<str>,
        options: &BridgeOptions,
        metrics: &Metrics,
    ) -> SharedFrame {
        // Held while encoding, so that a second subscriber waits for the first one's result instead of encoding again.
        let mut encoded = self.encoded.lock();
        let same = |other: &&CachedEncoding| other.compression == compression && other.topic == *topic;
        if let Encodings::Warm(known) = &*encoded
            && let Some(known) = known.iter().find(same)
        {
            return known.frame.clone();
        }
        metrics.encoded.add(1);
        let mut permit = options.budget.permit();
        let made = self.encode(compression, topic, options, &mut permit);
        let (own, above) = permit.split();
        let frame = made.map_err(Arc::new).map(|frame| if frame.is_big() { frame.with_permit(above) } else { frame });
        let Encodings::Warm(known) = &mut *encoded else {
            return frame;
        };
        known.push(CachedEncoding { compression, topic: topic.clone(), frame: frame.clone(), _permit: own });
        drop(encoded);
        let bytes = frame.as_ref().map_or(0, |frame| frame.bytes.len());
        self.types.cache(self, bytes);
        frame
    }

    fn encode(
        &self,
        compression: Compression,
        topic: &str,
        options: &BridgeOptions,
        permit: &mut Permit,
    ) -> Result<EncodedFrame, SampleError> {
        let slot = match compression {
            Compression::None | Compression::Png => 0,
            Compression::Cbor => 1,
            Compression::CborRaw => 2,
            Compression::Preview => 3,
        };
        let length = self.bytes.len();
        let last = self.types.sizes[slot].load(Ordering::Relaxed);
        // The last one may have had a very different size.
        let hint = last.min(LONGEST * length + SHORT).max(length) + 128;
        let full = |full: Exceeded| SampleError::NoRoom { publisher: self.publisher.clone(), full };
        if hint > UNCOUNTED {
            permit.resize(hint).map_err(full)?;
        }
        let max_bytes = options.max_encoded;
        let left = permit.bytes().saturating_add(options.budget.available());
        let max_bytes = max_bytes.min(left.max(UNCOUNTED));
        let mut out = Vec::with_capacity(hint);
        let failed =
            |error: CodecError| SampleError::Codec { error: Box::new(error), publisher: self.publisher.clone() };
        match compression {
            Compression::CborRaw => {
                Publish::print_raw(&mut out, topic, (self.received.secs, self.received.nsecs), &self.bytes);
            }
            Compression::Cbor | Compression::Preview => {
                let message_type = self.types.find(&self.wire_type)?;
                let options = CborOptions { max_bytes, ..CborOptions::default() };
                let preview = if compression == Compression::Preview { self.encode_preview() } else { None };
                let bytes = preview.as_deref().unwrap_or(&self.bytes);
                let write = |out: &mut Vec<u8>| codec::to_cbor(&message_type, bytes, out, &options);
                Publish::print_with(&mut out, Format::Cbor, topic, write).map_err(failed)?;
            }
            Compression::None | Compression::Png => {
                let message_type = self.types.find(&self.wire_type)?;
                let options = JsonOptions { non_finite: options.non_finite, max_bytes, ..JsonOptions::default() };
                let write = |out: &mut Vec<u8>| codec::to_json(&message_type, &self.bytes, out, &options);
                Publish::print_with(&mut out, Format::Json, topic, write).map_err(failed)?;
            }
        }
        self.types.sizes[slot].store(out.len(), Ordering::Relaxed);
        let format = if slot == 0 { Format::Json } else { Format::Cbor };
        let mut frame = EncodedFrame::new(format, out);
        if compression == Compression::Png {
            frame = frame.into_png()?;
        }
        let counted = if frame.is_big() { frame.bytes.len() } else { 0 };
        permit.resize(counted).map_err(full)?;
        Ok(frame)
    }

    /// Returns a smaller message of the same type for people to look at, if there is one.
    fn encode_preview(&self) -> Option<Vec<u8>> {
        let schema = ::codec::Schema::for_type(&self.wire_type.name, self.wire_type.digest.as_str());
        ::codec::encode_preview(schema, &self.bytes)
    }
}

#[cfg(test)]
#[path = "sample_tests.rs"]
mod tests;
