//! Where in a serialized message the stamps stand: every `time` field, nested ones and those in arrays, by the
//! message's definition. The rest is skipped, not decoded, and what follows the last stamp is not looked at.

use std::collections::HashMap;
use std::sync::Arc;

use crate::codec::Time;
use crate::schema::{Arity, Base, Field, MessageType, Primitive};

/// A `time`: seconds and nanoseconds, four bytes each.
const TIME: usize = 8;

/// The way through one type's messages, from stamp to stamp.
#[derive(Debug, Clone, Default)]
pub struct Stamps {
    steps: Arc<[Step]>,
}

#[derive(Debug, Clone)]
enum Step {
    /// So many bytes.
    Skip(usize),
    /// An array with its length before it, of items of so many bytes.
    SkipItems(usize),
    Strings(Items),
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
        let mut steps = Compiler::default().steps(message).to_vec();
        let last = steps.iter().rposition(Step::holds_stamps);
        steps.truncate(last.map_or(0, |last| last + 1));
        Self {
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
            message,
            at: 0,
            found: Vec::new(),
        };
        walk.steps(&self.steps)?;
        Some(walk.found)
    }

    /// The first stamp: of a message that begins with a header, the header's.
    pub fn first(&self, message: &[u8]) -> Option<Time> {
        let at = *self.find(message)?.first()?;
        let word = |at: usize| {
            Some(u32::from_le_bytes(
                message.get(at..at + 4)?.try_into().ok()?,
            ))
        };
        Some(Time {
            secs: word(at)?,
            nsecs: word(at + 4)?,
        })
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
#[derive(Default)]
struct Compiler {
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
        let skip = |size: usize| match items {
            Items::Known(count) => Step::Skip(size.saturating_mul(count)),
            Items::Counted => Step::SkipItems(size),
        };
        match &field.base {
            Base::Primitive(Primitive::Time) => Step::Times(items),
            Base::Primitive(Primitive::String) => Step::Strings(items),
            Base::Primitive(other) => skip(other.size()),
            Base::Message(message) => {
                let steps = self.steps(message);
                if message.is_fixed_size() && !steps.iter().any(Step::holds_stamps) {
                    skip(message.min_size())
                } else {
                    Step::Messages(items, steps)
                }
            }
        }
    }
}

struct Walk<'a> {
    message: &'a [u8],
    at: usize,
    found: Vec<usize>,
}

impl Walk<'_> {
    /// Ends at the end of the message at the latest: every item that is walked through takes at least a byte.
    fn steps(&mut self, steps: &[Step]) -> Option<()> {
        for step in steps {
            match step {
                Step::Skip(bytes) => self.skip(*bytes)?,
                Step::SkipItems(size) => {
                    let count = self.number()?;
                    self.skip(count.checked_mul(*size)?)?;
                }
                Step::Strings(items) => {
                    for _ in 0..self.count(*items)? {
                        let length = self.number()?;
                        self.skip(length)?;
                    }
                }
                Step::Times(items) => {
                    for _ in 0..self.count(*items)? {
                        let here = self.at;
                        self.skip(TIME)?;
                        self.found.push(here);
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
            Items::Counted => self.number(),
        }
    }

    fn number(&mut self) -> Option<usize> {
        let bytes = self.message.get(self.at..self.at + 4)?;
        self.at += 4;
        Some(u32::from_le_bytes(bytes.try_into().ok()?) as usize)
    }

    fn skip(&mut self, bytes: usize) -> Option<()> {
        self.at = self.at.checked_add(bytes)?;
        (self.at <= self.message.len()).then_some(())
    }
}

#[cfg(test)]
mod tests;
