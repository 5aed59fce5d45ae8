//! Compiled translations: the steps that carry a message of one type to the other, and what executes them.
//!
//! Steps read the source where the cursor stands and append to the output. Where both definitions have their fields in
//! one order, that is one pass. Otherwise a program first steps over its message and notes the places of the fields
//! that it needs ([`Program::scan`]); [`Action::Jump`] then goes to them.

use std::sync::Arc;

use ros_message::RosVersion;
use ros_message::codec::cursor::MessageCursor;
use ros_message::codec::{CodecErrorKind, Fault};

use crate::number::{Number, convert};
use crate::output::Output;
use crate::shape::{Count, Shape, take, take_count, take_text};
use crate::stamp::{Stamp, convert_stamp};
use crate::text::{TextForm, check_bound, push_units, push_utf8};

/// A compiled translation of one message type.
#[derive(Debug, Default)]
pub(crate) struct Program {
    pub(crate) steps: Vec<Step>,
    /// The source's fields in order, with true for those whose place is noted; empty if the steps follow that order.
    pub(crate) scan: Vec<(Shape, bool)>,
    /// Number of bytes that it writes for fields that the twin alone has.
    pub(crate) filled: usize,
}

impl Program {
    /// Returns about how many bytes it takes without the programs that it calls.
    pub(crate) fn bytes_held(&self) -> usize {
        let steps = self.steps.iter().map(|step| size_of::<Step>() + step.path.len());
        steps.sum::<usize>() + self.scan.len() * size_of::<(Shape, bool)>()
    }
}

/// One step, with the path of the field that it reads.
#[derive(Debug, Clone)]
pub(crate) struct Step {
    pub(crate) path: Box<str>,
    pub(crate) action: Action,
}

/// Operation of a step.
#[derive(Debug, Clone)]
pub(crate) enum Action {
    /// Copies numbers of one width.
    Copy { width: usize, bytes: usize },
    /// Converts a number.
    Number { from: Number, to: Number },
    /// Converts a time or duration.
    Stamp(Stamp),
    /// Converts a text, which may have `most` characters.
    Text { from: TextForm, to: TextForm, most: Option<usize> },
    /// Converts an array by its elements, each of at least `min_size` bytes.
    Array { from: Count, to: Count, min_size: usize, element: Box<Action> },
    /// Runs the program of a message.
    Message(Arc<Program>),
    /// Steps over a field that the source alone has.
    Skip(Shape),
    /// Writes the default of a field that the twin alone has.
    Fill(Arc<[Piece]>),
    /// Goes to a place that was noted.
    Jump(usize),
}

/// Bytes of a default, in numbers of one width.
#[derive(Debug, Clone)]
pub(crate) enum Piece {
    Bytes { width: usize, bytes: Box<[u8]> },
    Zeros { width: usize, count: usize },
}

/// The execution of programs on one message.
#[derive(Debug)]
pub(crate) struct Run<'a> {
    /// ROS version of the source.
    pub(crate) from: RosVersion,
    pub(crate) cursor: MessageCursor<'a>,
    pub(crate) out: Output,
    /// Places noted by the programs that are being executed.
    pub(crate) places: Vec<MessageCursor<'a>>,
    /// Number of values that did not fit.
    pub(crate) saturated: u64,
}

impl Run<'_> {
    /// Executes a program.
    pub(crate) fn program(&mut self, program: &Program) -> Result<(), Fault> {
        if program.scan.is_empty() {
            return self.steps(&program.steps, 0);
        }
        let base = self.places.len();
        for (shape, is_noted) in &program.scan {
            if *is_noted {
                self.places.push(self.cursor);
            }
            shape.skip(&mut self.cursor)?;
        }
        let end = self.cursor;
        self.steps(&program.steps, base)?;
        self.places.truncate(base);
        self.cursor = end;
        Ok(())
    }

    #[inline]
    fn steps(&mut self, steps: &[Step], base: usize) -> Result<(), Fault> {
        for step in steps {
            self.action(&step.action, base).map_err(|fault| fault.in_field(&step.path))?;
        }
        Ok(())
    }

    fn action(&mut self, action: &Action, base: usize) -> Result<(), Fault> {
        match action {
            Action::Copy { width, bytes } => self.copy(*width, *bytes),
            Action::Number { from, to } => {
                let (number, saturated) = convert(*from, *to, self.number(from.width())?);
                self.saturated += u64::from(saturated);
                self.out.put(to.width(), &number[..to.width()], false)
            }
            Action::Stamp(stamp) => {
                let (seconds, nanoseconds) = (self.word()?, self.word()?);
                let ([seconds, nanoseconds], saturated) = convert_stamp(*stamp, self.from, seconds, nanoseconds);
                self.saturated += u64::from(saturated);
                let mut bytes = [0; 8];
                bytes[..4].copy_from_slice(&seconds.to_le_bytes());
                bytes[4..].copy_from_slice(&nanoseconds.to_le_bytes());
                self.out.put(4, &bytes, false)
            }
            Action::Text { from, to, most } => self.text(*from, *to, *most),
            Action::Array { from, to, min_size, element } => self.array(*from, *to, *min_size, element, base),
            Action::Message(program) => self.program(program),
            Action::Skip(shape) => shape.skip(&mut self.cursor),
            Action::Fill(pieces) => pieces.iter().try_for_each(|piece| match piece {
                Piece::Bytes { width, bytes } => self.out.put(*width, bytes, false),
                Piece::Zeros { width, count } => self.out.put_zeros(*width, *count),
            }),
            Action::Jump(place) => {
                if let Some(place) = self.places.get(base + place) {
                    self.cursor = *place;
                }
                Ok(())
            }
        }
    }

    #[inline]
    fn copy(&mut self, width: usize, bytes: usize) -> Result<(), Fault> {
        // Nothing is padded where nothing is written.
        if bytes == 0 {
            return Ok(());
        }
        let taken = take(&mut self.cursor, bytes, width)?;
        self.out.put(width, taken, self.cursor.is_big_endian())
    }

    /// Reads a number of `width` bytes; the result is little endian and has its bytes first.
    fn number(&mut self, width: usize) -> Result<[u8; 8], Fault> {
        let mut number = [0; 8];
        let taken = take(&mut self.cursor, width, width)?;
        number[..width].copy_from_slice(taken);
        if self.cursor.is_big_endian() {
            number[..width].reverse();
        }
        Ok(number)
    }

    fn word(&mut self) -> Result<u32, Fault> {
        let [a, b, c, d, ..] = self.number(4)?;
        Ok(u32::from_le_bytes([a, b, c, d]))
    }

    fn text(&mut self, from: TextForm, to: TextForm, most: Option<usize>) -> Result<(), Fault> {
        let big_endian = self.cursor.is_big_endian();
        let (_, given) = take_text(&mut self.cursor, from == TextForm::Wide)?;
        if from == TextForm::Wide {
            // A unit of four bytes is at most three of UTF-8.
            self.out.check_room(given.len() + 4)?;
            let units = given.chunks_exact(4).map(|unit| {
                let unit = [unit[0], unit[1], unit[2], unit[3]];
                if big_endian { u32::from_be_bytes(unit) } else { u32::from_le_bytes(unit) }
            });
            let mut replaced = 0;
            self.out.put_counted(|out| {
                let begin = out.len();
                replaced = push_utf8(units, out);
                out.len() - begin
            })?;
            self.saturated += replaced;
            return Ok(());
        }
        // Nodes accept a string without its NUL too.
        let text = match from {
            TextForm::Terminated => given.strip_suffix(&[0]).unwrap_or(given),
            _ => given,
        };
        check_bound(text, most)?;
        match to {
            TextForm::Packed => {
                self.out.put_length(text.len())?;
                self.out.put(1, text, false)
            }
            TextForm::Terminated => {
                self.out.put_length(text.len() + 1)?;
                self.out.put(1, text, false)?;
                self.out.put(1, &[0], false)
            }
            TextForm::Wide => {
                self.out.check_room(4 * text.len() + 8)?;
                let mut replaced = 0;
                self.out.put_counted(|out| {
                    let (units, not_text) = push_units(text, out);
                    replaced = not_text;
                    units
                })?;
                self.saturated += replaced;
                Ok(())
            }
        }
    }

    fn array(&mut self, from: Count, to: Count, min_size: usize, element: &Action, base: usize) -> Result<(), Fault> {
        let found = take_count(&mut self.cursor, from, min_size)?;
        match to {
            Count::Fixed(expected) if found != expected => {
                return Err(CodecErrorKind::WrongLength { expected, found }.into());
            }
            Count::Fixed(_) => {}
            Count::Variable { most } if found > most => {
                return Err(CodecErrorKind::TooMany { most, of: "elements", found }.into());
            }
            Count::Variable { .. } => self.out.put_length(found)?,
        }
        if let Action::Copy { width, bytes } = element {
            return self.copy(*width, bytes.saturating_mul(found));
        }
        for index in 0..found {
            self.action(element, base).map_err(|fault| fault.at_index(index))?;
        }
        Ok(())
    }
}
