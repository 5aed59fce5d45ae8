//! Where in a serialized message the stamps stand: every `time` field (of ROS 2: `builtin_interfaces/Time`), nested ones and
//! those in arrays, by the message's definition. The rest is skipped, not decoded, and what follows the last stamp is not looked at.

use std::collections::HashMap;
use std::sync::Arc;

use crate::bus::RosVersion;
use crate::codec::Time;
use crate::codec::cursor::Cursor;
use crate::schema::plan::Scalar;
use crate::schema::{Arity, Base, Field, MessageType, Primitive};

/// A `time`: seconds and nanoseconds, four bytes each.
const TIME: usize = 8;
const TIME_PART: usize = 4;

/// The way through one type's messages, from stamp to stamp.
#[derive(Debug, Clone)]
pub struct Stamps {
    version: RosVersion,
    steps: Arc<[Step]>,
}

/// None at all.
impl Default for Stamps {
    fn default() -> Self {
        Self {
            version: RosVersion::One,
            steps: [].into(),
        }
    }
}

#[derive(Debug, Clone)]
enum Step {
    /// So many bytes, one after the other whatever they are: in ROS 1.
    Skip(usize),
    /// Items of so many bytes, aligned where numbers are.
    Numbers(Items, usize, usize),
    Strings(Items),
    WideStrings(Items),
    Times(Items),
    Messages(Items, Arc<[Step]>),
}

#[derive(Debug, Clone, Copy)]
enum Items {
    Known(usize),
    /// Their number stands before them.
    Counted,
}

impl Stamps {
    /// For messages of this type.
    pub fn of(message: &MessageType) -> Self {
        let mut compiler = Compiler {
            packed: message.version() == RosVersion::One,
            known: HashMap::new(),
        };
        let mut steps = compiler.steps(message).to_vec();
        let last = steps.iter().rposition(Step::holds_stamps);
        steps.truncate(last.map_or(0, |last| last + 1));
        Self {
            version: message.version(),
            steps: steps.into(),
        }
    }

    /// Whether the type has no stamp at all.
    pub fn is_empty(&self) -> bool {
        self.steps.is_empty()
    }

    /// Where the stamps begin; none where the message is not of this type (too short).
    pub fn find(&self, message: &[u8]) -> Option<Vec<usize>> {
        let mut walk = Walk {
            cursor: Cursor::new(self.version, message)?,
            found: Vec::new(),
        };
        walk.steps(&self.steps)?;
        Some(walk.found)
    }

    /// The stamp that was found there.
    pub fn read(&self, message: &[u8], at: usize) -> Option<Time> {
        let is_big_endian = Cursor::new(self.version, message)?.is_big_endian();
        let word = |at: usize| {
            let word: [u8; TIME_PART] = message.get(at..at + TIME_PART)?.try_into().ok()?;
            Some(match is_big_endian {
                true => u32::from_be_bytes(word),
                false => u32::from_le_bytes(word),
            })
        };
        Some(Time {
            secs: word(at)?,
            nsecs: word(at + TIME_PART)?,
        })
    }

    /// Puts another there, in the order of bytes that the message is written in. Nothing where none could be read.
    pub fn write(&self, message: &mut [u8], at: usize, stamp: Time) {
        let order = Cursor::new(self.version, message).map(|cursor| cursor.is_big_endian());
        let (Some(is_big_endian), Some(place)) = (order, message.get_mut(at..at + TIME)) else {
            return;
        };
        for (word, part) in place
            .chunks_exact_mut(TIME_PART)
            .zip([stamp.secs, stamp.nsecs])
        {
            word.copy_from_slice(&match is_big_endian {
                true => part.to_be_bytes(),
                false => part.to_le_bytes(),
            });
        }
    }

    /// The first stamp: of a message that begins with a header, the header's.
    pub fn first(&self, message: &[u8]) -> Option<Time> {
        self.read(message, *self.find(message)?.first()?)
    }
}

impl Step {
    fn holds_stamps(&self) -> bool {
        match self {
            Step::Times(_) => true,
            Step::Messages(_, steps) => steps.iter().any(Step::holds_stamps),
            _ => false,
        }
    }
}

/// Types that come more than once are compiled once: a definition may name one many times over.
struct Compiler {
    /// Nothing is aligned.
    packed: bool,
    known: HashMap<*const MessageType, Arc<[Step]>>,
}

impl Compiler {
    fn steps(&mut self, message: &MessageType) -> Arc<[Step]> {
        let key = std::ptr::from_ref(message);
        if let Some(known) = self.known.get(&key) {
            return Arc::clone(known);
        }
        let mut steps = Vec::new();
        for field in message.fields() {
            match (self.step(field), steps.last_mut()) {
                (Step::Skip(more), Some(Step::Skip(bytes))) => *bytes += more,
                (step, _) => steps.push(step),
            }
        }
        if message.plan.placeholder {
            steps.push(self.skip(Items::Known(1), 1));
        }
        let steps: Arc<[Step]> = steps.into();
        self.known.insert(key, Arc::clone(&steps));
        steps
    }

    fn step(&mut self, field: &Field) -> Step {
        let items = match field.arity {
            Arity::One => Items::Known(1),
            Arity::Fixed(count) => Items::Known(count as usize),
            Arity::Variable => Items::Counted,
        };
        match &field.base {
            Base::Primitive(Primitive::Time) => Step::Times(items),
            Base::Primitive(Primitive::String) => Step::Strings(items),
            Base::Primitive(Primitive::Wstring) => Step::WideStrings(items),
            Base::Primitive(other) => self.skip(items, other.size()),
            Base::Message(message) => {
                let steps = self.steps(message);
                match message.plan.scalar {
                    Some(Scalar::Time2) => return Step::Times(items),
                    Some(other) => {
                        return Step::Numbers(items, other.size(), other.alignment());
                    }
                    None => {}
                }
                if self.packed && message.is_fixed_size() && !steps.iter().any(Step::holds_stamps) {
                    self.skip(items, message.min_size())
                } else {
                    Step::Messages(items, steps)
                }
            }
        }
    }

    fn skip(&self, items: Items, size: usize) -> Step {
        match items {
            Items::Known(count) if self.packed => Step::Skip(size.saturating_mul(count)),
            _ => Step::Numbers(items, size, size),
        }
    }
}

struct Walk<'a> {
    cursor: Cursor<'a>,
    found: Vec<usize>,
}

impl Walk<'_> {
    /// Ends at the end of the message at the latest: every item that is walked through takes at least a byte.
    fn steps(&mut self, steps: &[Step]) -> Option<()> {
        for step in steps {
            match step {
                Step::Skip(bytes) => self.cursor.skip(1, *bytes, 1)?,
                Step::Numbers(items, size, alignment) => {
                    let count = self.count(*items)?;
                    self.cursor.skip(count, *size, *alignment)?;
                }
                Step::Strings(items) | Step::WideStrings(items) => {
                    let wide = matches!(step, Step::WideStrings(_));
                    for _ in 0..self.count(*items)? {
                        self.cursor.string(wide)?;
                    }
                }
                Step::Times(items) => {
                    for _ in 0..self.count(*items)? {
                        self.cursor.take(TIME, TIME_PART)?;
                        self.found.push(self.cursor.at() - TIME);
                    }
                }
                Step::Messages(items, steps) => {
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
