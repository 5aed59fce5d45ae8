//! Objects in, serialized messages out: fields in any order, missing ones filled with defaults, stamps set from the
//! clock.
//!
//! ROS fields are positional and vary in size; the fields of JSON and CBOR objects come in any order. Nearly all
//! clients keep the order of the definition, so values are written directly to their place, with a default for every
//! field that is skipped. If a skipped field appears later (or a field appears twice), its value is appended and the
//! pieces are put in order at the end of the object.

mod layout;

use std::sync::LazyLock;

use crate::RosVersion;
use crate::codec::cdr;
use crate::codec::fault::{CodecErrorKind, Fault};
use crate::codec::fill::layout::{Aligned, OutputLayout, Packed};
use crate::codec::number::Wire;
use crate::codec::{FillOptions, FillReport, Time};
use crate::schema::MessageType;
use crate::schema::plan::{Count, Kind, Member, Members, SEQ, Scalar, Text};

/// A source of values.
pub(crate) trait ValueInput {
    /// Progress within an object.
    type Object;
    /// Progress within an array.
    type Array;

    fn begin_object(&mut self) -> Result<Self::Object, Fault>;
    /// Reads the next key and returns the index of its field, as [`Members::find`] does, or `None` at the end of the
    /// object. `expected` is the likely index.
    fn next_member(
        &mut self,
        object: &mut Self::Object,
        members: &Members,
        expected: usize,
    ) -> Result<Option<usize>, Fault>;
    fn begin_array(&mut self, expected: &'static str) -> Result<Self::Array, Fault>;
    /// Returns true if another element follows.
    fn next_element(&mut self, array: &mut Self::Array) -> Result<bool, Fault>;
    fn boolean(&mut self) -> Result<bool, Fault>;
    fn number<T: Wire>(&mut self) -> Result<T, Fault>;
    /// Appends the text of a string.
    fn text(&mut self, out: &mut Vec<u8>) -> Result<(), Fault>;
    /// Appends bytes given as a single value; returns false without reading if they are given as an array of numbers.
    fn bytes(&mut self, out: &mut Vec<u8>) -> Result<bool, Fault>;
    /// Appends numbers given as a single value; returns false without reading if they are given one by one.
    fn typed_array<T: Wire>(&mut self, out: &mut Vec<u8>) -> Result<bool, Fault>;
    /// Reads the string "now" if it follows.
    fn take_now(&mut self) -> bool;
}

/// Appends the message that `input` describes.
pub(crate) fn fill<I: ValueInput>(
    input: &mut I,
    message: &MessageType,
    out: &mut Vec<u8>,
    options: &FillOptions,
) -> Result<FillReport, Fault> {
    let end = out.len().saturating_add(options.max_bytes);
    match message.version() {
        RosVersion::One => fill_body(input, message, out, options, (Packed, end)),
        RosVersion::Two => {
            out.extend_from_slice(&cdr::HEADER);
            let layout = Aligned { origin: out.len() };
            fill_body(input, message, out, options, (layout, end))
        }
    }
}

fn fill_body<I: ValueInput, L: OutputLayout>(
    input: &mut I,
    message: &MessageType,
    out: &mut Vec<u8>,
    options: &FillOptions,
    (layout, end): (L, usize),
) -> Result<FillReport, Fault> {
    let (places, scratch, report) = (Vec::new(), Vec::new(), FillReport::default());
    let mut filler = Filler { input, out, layout, options, end, places, scratch, report };
    filler.message(message)?;
    filler.check_room(0)?;
    Ok(filler.report)
}

struct Filler<'a, I, L> {
    input: &'a mut I,
    out: &'a mut Vec<u8>,
    layout: L,
    options: &'a FillOptions,
    /// Maximum length of the output buffer.
    end: usize,
    /// Begin and end, in `out`, of the fields of the open objects; innermost object last.
    places: Vec<(usize, usize)>,
    scratch: Vec<u8>,
    report: FillReport,
}

impl<I: ValueInput, L: OutputLayout> Filler<'_, I, L> {
    fn message(&mut self, message: &MessageType) -> Result<(), Fault> {
        let plan = &message.plan;
        let members = plan.members.list();
        let (base, start) = (self.places.len(), self.out.len());
        let mut moved = false;
        let mut object = self.input.begin_object()?;
        loop {
            let next = self.places.len() - base;
            let Some(index) = self.input.next_member(&mut object, &plan.members, next)? else {
                break;
            };
            if index == members.len() {
                self.drop_seq()?;
                continue;
            }
            for skipped in &members[next.min(index)..index] {
                self.default_field(plan.header, skipped)?;
            }
            let begin = self.out.len();
            let member = &members[index];
            self.field(plan.header, member).map_err(|fault| fault.in_field(&member.name))?;
            let place = (begin, self.out.len());
            match self.places.get_mut(base + index) {
                None => self.places.push(place),
                Some(earlier) => {
                    *earlier = place;
                    moved = true;
                }
            }
        }
        for missing in &members[self.places.len() - base..] {
            self.default_field(plan.header, missing)?;
        }
        if moved {
            self.put_in_order(plan.members.list(), base, start);
        }
        self.places.truncate(base);
        if L::PLACEHOLDERS && plan.placeholder {
            self.out.push(0);
        }
        Ok(())
    }

    /// Reads the `seq` of a header of ROS 1, which must be right, and drops it.
    #[cold]
    fn drop_seq(&mut self) -> Result<(), Fault> {
        self.input.number::<u32>().map_err(|fault| fault.in_field(SEQ))?;
        self.report.dropped_seq = true;
        Ok(())
    }

    #[inline]
    fn field(&mut self, in_header: bool, member: &Member) -> Result<(), Fault> {
        match &member.kind {
            Kind::Scalar(scalar @ (Scalar::Time | Scalar::Duration | Scalar::Time2 | Scalar::Duration2)) => {
                let default = if in_header { self.options.now } else { None };
                self.time(*scalar, default.unwrap_or_default())
            }
            Kind::Scalar(scalar) => self.scalar(*scalar),
            Kind::Text(text) => self.text(*text),
            Kind::Bytes(count) => {
                let begin = self.begin_count(*count);
                if self.input.bytes(self.out)? {
                    return self.end_count(*count, begin, self.out.len() - begin);
                }
                self.out.truncate(begin);
                let found = self.numbers::<u8>(*count, "bytes")?;
                self.end_count(*count, begin, found)
            }
            Kind::Scalars(scalar, count) => self.scalars(*scalar, *count),
            Kind::Texts(text, count) => self.elements(*count, |filler| filler.text(*text)),
            Kind::Struct(message) => self.message(message),
            Kind::Structs(message, count) => self.elements(*count, |filler| filler.message(message)),
        }
    }

    fn scalar(&mut self, scalar: Scalar) -> Result<(), Fault> {
        self.layout.align(self.out, scalar.alignment());
        match scalar {
            Scalar::Bool => self.out.push(self.input.boolean()?.into()),
            Scalar::I8 => self.input.number::<i8>()?.put(self.out),
            Scalar::U8 => self.input.number::<u8>()?.put(self.out),
            Scalar::I16 => self.input.number::<i16>()?.put(self.out),
            Scalar::U16 => self.input.number::<u16>()?.put(self.out),
            Scalar::I32 => self.input.number::<i32>()?.put(self.out),
            Scalar::U32 => self.input.number::<u32>()?.put(self.out),
            Scalar::I64 => self.input.number::<i64>()?.put(self.out),
            Scalar::U64 => self.input.number::<u64>()?.put(self.out),
            Scalar::F32 => self.input.number::<f32>()?.put(self.out),
            Scalar::F64 => self.input.number::<f64>()?.put(self.out),
            Scalar::Time | Scalar::Duration | Scalar::Time2 | Scalar::Duration2 => {
                self.time(scalar, Time::default())?;
            }
        }
        Ok(())
    }

    fn scalars(&mut self, scalar: Scalar, count: Count) -> Result<(), Fault> {
        if matches!(scalar, Scalar::Bool | Scalar::Time | Scalar::Duration | Scalar::Time2 | Scalar::Duration2) {
            return self.elements(count, |filler| filler.scalar(scalar));
        }
        let begin = self.begin_count(count);
        let found = match scalar {
            Scalar::I8 => self.numbers::<i8>(count, "a list of int8"),
            Scalar::U8 => self.numbers::<u8>(count, "a list of uint8"),
            Scalar::I16 => self.numbers::<i16>(count, "a list of int16"),
            Scalar::U16 => self.numbers::<u16>(count, "a list of uint16"),
            Scalar::I32 => self.numbers::<i32>(count, "a list of int32"),
            Scalar::U32 => self.numbers::<u32>(count, "a list of uint32"),
            Scalar::I64 => self.numbers::<i64>(count, "a list of int64"),
            Scalar::U64 => self.numbers::<u64>(count, "a list of uint64"),
            Scalar::F32 => self.numbers::<f32>(count, "a list of float32"),
            // The others that are not numbers are written one by one.
            _ => self.numbers::<f64>(count, "a list of float64"),
        }?;
        self.end_count(count, begin, found)
    }

    /// Appends numbers and returns their count.
    fn numbers<T: Wire>(&mut self, count: Count, expected: &'static str) -> Result<usize, Fault> {
        let unaligned = self.out.len();
        self.layout.align(self.out, T::SCALAR.alignment());
        let begin = self.out.len();
        if self.input.typed_array::<T>(self.out)? {
            let found = (self.out.len() - begin) / T::SCALAR.size();
            if found == 0 {
                self.out.truncate(unaligned);
            }
            return Ok(found);
        }
        let most = count.max_count();
        let mut array = self.input.begin_array(expected)?;
        let mut found = 0;
        while self.input.next_element(&mut array)? {
            if found == most {
                return Err(too_many(count, found + 1));
            }
            self.input.number::<T>().map_err(|fault| fault.at_index(found))?.put(self.out);
            found += 1;
        }
        // Without elements there is no padding.
        if found == 0 {
            self.out.truncate(unaligned);
        }
        Ok(found)
    }

    fn elements(&mut self, count: Count, mut element: impl FnMut(&mut Self) -> Result<(), Fault>) -> Result<(), Fault> {
        let begin = self.begin_count(count);
        let most = count.max_count();
        let mut array = self.input.begin_array("a list")?;
        let mut found = 0;
        while self.input.next_element(&mut array)? {
            if found == most {
                return Err(too_many(count, found + 1));
            }
            element(self).and_then(|()| self.check_room(0)).map_err(|fault| fault.at_index(found))?;
            found += 1;
        }
        self.end_count(count, begin, found)
    }

    fn text(&mut self, text: Text) -> Result<(), Fault> {
        let begin = self.begin_count(Count::Variable);
        if text.wide {
            let mut scratch = std::mem::take(&mut self.scratch);
            scratch.clear();
            self.input.text(&mut scratch)?;
            let written = String::from_utf8_lossy(&scratch);
            check_text(text, &written)?;
            let units = layout::put_wide(self.out, &written);
            self.scratch = scratch;
            return self.end_count(Count::Variable, begin, units);
        }
        self.input.text(self.out)?;
        if text.most < Text::UNBOUNDED {
            check_text(text, &String::from_utf8_lossy(&self.out[begin..]))?;
        }
        if L::TERMINATED {
            self.out.push(0);
        }
        self.end_count(Count::Variable, begin, self.out.len() - begin)
    }

    /// Writes a time; `default` is used for missing parts.
    fn time(&mut self, scalar: Scalar, default: Time) -> Result<(), Fault> {
        self.layout.align(self.out, scalar.alignment());
        let begin = self.out.len();
        let is_time = matches!(scalar, Scalar::Time | Scalar::Time2);
        if is_time && self.input.take_now() {
            self.put_time(self.options.now.unwrap_or_default());
            return Ok(());
        }
        self.put_time(if is_time { default } else { Time::default() });
        let mut object = self.input.begin_object()?;
        let mut expected = 0;
        while let Some(index) = self.input.next_member(&mut object, &TIME_MEMBERS, expected)? {
            let part = match (scalar, index % 2) {
                (Scalar::Time, _) | (Scalar::Time2 | Scalar::Duration2, 1) => self.input.number::<u32>(),
                _ => self.input.number::<i32>().map(|part| part as u32),
            };
            let part = part.map_err(|fault| fault.in_field(&TIME_MEMBERS.list()[index].name))?;
            self.out[begin + 4 * (index % 2)..][..4].copy_from_slice(&part.to_le_bytes());
            expected = index + 1;
        }
        Ok(())
    }

    fn put_time(&mut self, time: Time) {
        self.out.extend_from_slice(&time.secs.to_le_bytes());
        self.out.extend_from_slice(&time.nsecs.to_le_bytes());
    }

    /// Writes the default of a skipped field and records its place.
    fn default_field(&mut self, in_header: bool, member: &Member) -> Result<(), Fault> {
        let begin = self.out.len();
        self.check_room(member.min_size).map_err(|fault| fault.in_field(&member.name))?;
        let stamped = in_header || matches!(&member.kind, Kind::Struct(message) if message.plan.header);
        let now = self.options.now.filter(|_| stamped);
        self.layout.put_default(self.out, member, now);
        self.check_room(0).map_err(|fault| fault.in_field(&member.name))?;
        self.places.push((begin, self.out.len()));
        Ok(())
    }

    /// Rewrites the object that began at `start` with its fields in the order of the definition.
    #[cold]
    fn put_in_order(&mut self, members: &[Member], base: usize, start: usize) {
        let phase = self.layout.phase(start);
        self.scratch.clear();
        self.scratch.resize(phase, 0);
        self.scratch.extend_from_slice(&self.out[start..]);
        self.out.truncate(start);
        let moved = |at: usize| phase + at - start;
        for (member, &(begin, end)) in members.iter().zip(&self.places[base..]) {
            let piece = moved(begin)..moved(end);
            self.layout.put_piece(self.out, member, &self.scratch, piece);
        }
    }

    /// Reserves space for a length; returns the offset of the elements.
    fn begin_count(&mut self, count: Count) -> usize {
        if !matches!(count, Count::Fixed(_)) {
            self.layout.align(self.out, 4);
            self.out.extend_from_slice(&[0; 4]);
        }
        self.out.len()
    }

    /// Writes the length before `begin`, or checks it.
    fn end_count(&mut self, count: Count, begin: usize, found: usize) -> Result<(), Fault> {
        self.check_room(0)?;
        match count {
            Count::Fixed(expected) if found != expected => Err(CodecErrorKind::WrongLength { expected, found }.into()),
            Count::Fixed(_) => Ok(()),
            Count::Bounded(most) if found > most => Err(too_many(count, found)),
            Count::Variable | Count::Bounded(_) => {
                let length = u32::try_from(found).map_err(|_| CodecErrorKind::TooLarge(u32::MAX as usize))?;
                self.out[begin - 4..begin].copy_from_slice(&length.to_le_bytes());
                Ok(())
            }
        }
    }

    #[inline]
    fn check_room(&self, more: usize) -> Result<(), Fault> {
        if self.out.len().saturating_add(more) <= self.end {
            return Ok(());
        }
        Err(CodecErrorKind::TooLarge(self.options.max_bytes).into())
    }
}

/// Creates the error for too many elements.
#[cold]
fn too_many(count: Count, found: usize) -> Fault {
    match count {
        Count::Fixed(expected) => CodecErrorKind::WrongLength { expected, found },
        _ => CodecErrorKind::TooMany { most: count.max_count(), of: "elements", found },
    }
    .into()
}

fn check_text(text: Text, written: &str) -> Result<(), Fault> {
    if text.most == Text::UNBOUNDED {
        return Ok(());
    }
    let most = text.most as usize;
    match written.chars().count() {
        found if found > most => Err(CodecErrorKind::TooMany { most, of: "characters", found }.into()),
        _ => Ok(()),
    }
}

/// Members of a time or duration, with the names of ROS 1 and those of ROS 2.
static TIME_MEMBERS: LazyLock<Members> = LazyLock::new(|| {
    let part = |name| Member::new(name, Kind::Scalar(Scalar::U32), 4);
    Members::new(["secs", "nsecs", "sec", "nanosec"].map(part).into())
});
