//! Locations of the stamps in a serialized message: every `time` field (in ROS 2: `builtin_interfaces/Time`), including
//! nested ones and those in arrays, according to the definition. The rest is skipped, not decoded, and what follows the
//! last stamp is not examined.

use std::collections::HashMap;
use std::sync::Arc;

use crate::RosVersion;
use crate::codec::Time;
use crate::codec::cursor::MessageCursor;
use crate::schema::plan::Scalar;
use crate::schema::{Arity, Base, Field, MessageType, Primitive};

/// Size of a `time`: seconds and nanoseconds, four bytes each.
const TIME: usize = 8;
const TIME_PART: usize = 4;

/// Steps to the stamps in messages of one type.
#[derive(Debug, Clone)]
pub struct Stamps {
    version: RosVersion,
    steps: Arc<[StampStep]>,
}

/// No stamps.
impl Default for Stamps {
    fn default() -> Self {
        Self { version: RosVersion::One, steps: [].into() }
    }
}

#[derive(Debug, Clone)]
enum StampStep {
    /// Number of bytes to skip, without alignment: ROS 1.
    Skip(usize),
    /// Items of a given size and alignment.
    Numbers(Items, usize, usize),
    Strings(Items),
    WideStrings(Items),
    Times(Items),
    Messages(Items, Arc<[StampStep]>),
}

#[derive(Debug, Clone, Copy)]
enum Items {
    Known(usize),
    /// The count precedes the items.
    Counted,
}

impl Stamps {
    /// Compiles the steps for messages of this type.
    pub fn for_type(message: &MessageType) -> Self {
        let mut compiler = Compiler { packed: message.version() == RosVersion::One, known: HashMap::new() };
        let mut steps = compiler.steps(message).to_vec();
        let last = steps.iter().rposition(StampStep::holds_stamps);
        steps.truncate(last.map_or(0, |last| last + 1));
        Self { version: message.version(), steps: steps.into() }
    }

    /// Returns true if the type has no stamps.
    pub fn is_empty(&self) -> bool {
        self.steps.is_empty()
    }

    /// Returns the offsets of the stamps; `None` if the message is too short for the type.
    pub fn find(&self, message: &[u8]) -> Option<Vec<usize>> {
        let mut walk = Walk { cursor: MessageCursor::new(self.version, message)?, found: Vec::new() };
        walk.steps(&self.steps)?;
        Some(walk.found)
    }

    /// Reads the stamp at an offset returned by [`find`](Self::find).
    pub fn read(&self, message: &[u8], at: usize) -> Option<Time> {
        let is_big_endian = MessageCursor::new(self.version, message)?.is_big_endian();
        let word = |at: usize| {
            let word: [u8; TIME_PART] = message.get(at..at + TIME_PART)?.try_into().ok()?;
            Some(if is_big_endian { u32::from_be_bytes(word) } else { u32::from_le_bytes(word) })
        };
        Some(Time { secs: word(at)?, nsecs: word(at + TIME_PART)? })
    }

    /// Overwrites the stamp at such an offset, in the byte order of the message. Does nothing if no stamp could be read
    /// there.
    pub fn write(&self, message: &mut [u8], at: usize, stamp: Time) {
        let order = MessageCursor::new(self.version, message).map(|cursor| cursor.is_big_endian());
        let (Some(is_big_endian), Some(place)) = (order, message.get_mut(at..at + TIME)) else {
            return;
        };
        for (word, part) in place.chunks_exact_mut(TIME_PART).zip([stamp.secs, stamp.nsecs]) {
            word.copy_from_slice(&if is_big_endian { part.to_be_bytes() } else { part.to_le_bytes() });
        }
    }

    /// Returns the first stamp: for a message that begins with a header, the header's.
    pub fn first(&self, message: &[u8]) -> Option<Time> {
        self.read(message, *self.find(message)?.first()?)
    }
}

impl StampStep {
    fn holds_stamps(&self) -> bool {
        match self {
            StampStep::Times(_) => true,
            StampStep::Messages(_, steps) => steps.iter().any(StampStep::holds_stamps),
            _ => false,
        }
    }
}

/// Compiles the steps of types. A type that occurs several times is compiled once, because a definition may name one
/// type many times over.
struct Compiler {
    /// True if nothing is aligned (ROS 1).
    packed: bool,
    known: HashMap<*const MessageType, Arc<[StampStep]>>,
}

impl Compiler {
    fn steps(&mut self, message: &MessageType) -> Arc<[StampStep]> {
        let key = std::ptr::from_ref(message);
        if let Some(known) = self.known.get(&key) {
            return Arc::clone(known);
        }
        let mut steps = Vec::new();
        for field in message.fields() {
            match (self.step(field), steps.last_mut()) {
                (StampStep::Skip(more), Some(StampStep::Skip(bytes))) => *bytes += more,
                (step, _) => steps.push(step),
            }
        }
        if message.plan.placeholder {
            steps.push(self.skip(Items::Known(1), 1));
        }
        let steps: Arc<[StampStep]> = steps.into();
        self.known.insert(key, Arc::clone(&steps));
        steps
    }

    fn step(&mut self, field: &Field) -> StampStep {
        let items = match field.arity {
            Arity::One => Items::Known(1),
            Arity::Fixed(count) => Items::Known(count as usize),
            Arity::Variable => Items::Counted,
        };
        match &field.base {
            Base::Primitive(Primitive::Time) => StampStep::Times(items),
            Base::Primitive(Primitive::String) => StampStep::Strings(items),
            Base::Primitive(Primitive::Wstring) => StampStep::WideStrings(items),
            Base::Primitive(other) => self.skip(items, other.size()),
            Base::Message(message) => {
                let steps = self.steps(message);
                match message.plan.scalar {
                    Some(Scalar::Time2) => return StampStep::Times(items),
                    Some(other) => {
                        return StampStep::Numbers(items, other.size(), other.alignment());
                    }
                    None => {}
                }
                if self.packed && message.is_fixed_size() && !steps.iter().any(StampStep::holds_stamps) {
                    self.skip(items, message.min_size())
                } else {
                    StampStep::Messages(items, steps)
                }
            }
        }
    }

    fn skip(&self, items: Items, size: usize) -> StampStep {
        match items {
            Items::Known(count) if self.packed => StampStep::Skip(size.saturating_mul(count)),
            _ => StampStep::Numbers(items, size, size),
        }
    }
}

struct Walk<'a> {
    cursor: MessageCursor<'a>,
    found: Vec<usize>,
}

impl Walk<'_> {
    /// Terminates at the end of the message at the latest: every item visited takes at least a byte.
    fn steps(&mut self, steps: &[StampStep]) -> Option<()> {
        for step in steps {
            match step {
                StampStep::Skip(bytes) => self.cursor.skip(1, *bytes, 1)?,
                StampStep::Numbers(items, size, alignment) => {
                    let count = self.count(*items)?;
                    self.cursor.skip(count, *size, *alignment)?;
                }
                StampStep::Strings(items) | StampStep::WideStrings(items) => {
                    let wide = matches!(step, StampStep::WideStrings(_));
                    for _ in 0..self.count(*items)? {
                        self.cursor.string(wide)?;
                    }
                }
                StampStep::Times(items) => {
                    for _ in 0..self.count(*items)? {
                        self.cursor.take(TIME, TIME_PART)?;
                        self.found.push(self.cursor.position() - TIME);
                    }
                }
                StampStep::Messages(items, steps) => {
                    for _ in 0..self.count(*items)? {
                        self.steps(steps)?;
                    }
                }
            }
        }
        Some(())
    }

    fn count(&mut self, items: Items) -> Option<usize> {
        match items {
            Items::Known(count) => Some(count),
            Items::Counted => self.cursor.length(),
        }
    }
}

#[cfg(test)]
mod tests;
