//! CBOR → ROS bytes (RFC 8949), including typed arrays (RFC 8746).

use crate::cbor_head::{ARRAY, BYTES, MAP, NEGATIVE, SIMPLE, TAG, TEXT, UNSIGNED};
use crate::codec::cbor_item::{INDEFINITE, ItemHead};
use crate::codec::fault::{CodecErrorKind, Fault, mismatch};
use crate::codec::fill::{ValueInput, fill};
use crate::codec::number::{Number, Wire};
use crate::codec::typed_array::{ElementLayout, head_to_float};
use crate::codec::{FillOptions, FillReport};
use crate::schema::MessageType;
use crate::schema::plan::Members;

/// Appends the message that the CBOR map describes.
pub(crate) fn read(
    message: &MessageType,
    cbor: &[u8],
    out: &mut Vec<u8>,
    options: &FillOptions,
) -> Result<FillReport, Fault> {
    let mut input = Cbor { input: cbor, at: 0, scratch: Vec::new() };
    let report = fill(&mut input, message, out, options)?;
    if input.at < cbor.len() {
        return Err(input.invalid("more follows the message"));
    }
    Ok(report)
}

struct Cbor<'a> {
    input: &'a [u8],
    at: usize,
    scratch: Vec<u8>,
}

/// Number of remaining items; `None` if they end with a break.
pub(crate) struct RemainingItems(Option<u64>);

impl ValueInput for Cbor<'_> {
    type Object = RemainingItems;
    type Array = RemainingItems;

    fn begin_object(&mut self) -> Result<RemainingItems, Fault> {
        self.open_container(MAP, "a map")
    }

    #[inline]
    fn next_member(
        &mut self,
        object: &mut RemainingItems,
        members: &Members,
        expected: usize,
    ) -> Result<Option<usize>, Fault> {
        if !self.has_next(object)? {
            return Ok(None);
        }
        if let Some(likely) = members.list().get(expected) {
            if self.input[self.at..].starts_with(&likely.cbor_key) {
                self.at += likely.cbor_key.len();
                return Ok(Some(expected));
            }
        }
        self.read_key(members).map(Some)
    }

    fn begin_array(&mut self, expected: &'static str) -> Result<RemainingItems, Fault> {
        self.open_container(ARRAY, expected)
    }

    #[inline]
    fn next_element(&mut self, array: &mut RemainingItems) -> Result<bool, Fault> {
        self.has_next(array)
    }

    fn boolean(&mut self) -> Result<bool, Fault> {
        let head = self.read_untagged_head()?;
        match (head.major, head.info) {
            (SIMPLE, 20) => Ok(false),
            (SIMPLE, 21) => Ok(true),
            _ => Err(type_mismatch("bool", head)),
        }
    }

    #[inline]
    fn number<T: Wire>(&mut self) -> Result<T, Fault> {
        let head = self.read_untagged_head()?;
        let number = match (head.major, head.info) {
            (UNSIGNED, _) => Number::Unsigned(head.value),
            (NEGATIVE, _) => Number::Negative(head.value),
            (SIMPLE, 22 | 23) => {
                return T::from_non_finite(f64::NAN).ok_or_else(|| type_mismatch(T::NAME, head));
            }
            (SIMPLE, _) => Number::Float(head_to_float(head).ok_or_else(|| type_mismatch(T::NAME, head))?),
            _ => return Err(type_mismatch(T::NAME, head)),
        };
        T::from_number(number)
    }

    fn text(&mut self, out: &mut Vec<u8>) -> Result<(), Fault> {
        let head = self.read_untagged_head()?;
        if head.major != TEXT {
            return Err(type_mismatch("a string", head));
        }
        let begin = out.len();
        self.string(head, out)?;
        match std::str::from_utf8(&out[begin..]) {
            Ok(_) => Ok(()),
            Err(_) => Err(CodecErrorKind::InvalidUtf8.into()),
        }
    }

    fn bytes(&mut self, out: &mut Vec<u8>) -> Result<bool, Fault> {
        let before = self.at;
        let head = self.read_head()?;
        match head.major {
            BYTES => self.string(head, out)?,
            TEXT => {
                let mut text = std::mem::take(&mut self.scratch);
                text.clear();
                self.string(head, &mut text)?;
                let decoded = base64_simd::forgiving_decode_to_vec(&text).map_err(|_| CodecErrorKind::Base64)?;
                out.extend_from_slice(&decoded);
                self.scratch = text;
            }
            _ => {
                self.at = before;
                return Ok(false);
            }
        }
        Ok(true)
    }

    fn typed_array<T: Wire>(&mut self, out: &mut Vec<u8>) -> Result<bool, Fault> {
        let before = self.at;
        let head = self.read_head()?;
        let layout = if head.major == TAG { ElementLayout::from_tag(head.value) } else { None };
        let Some(layout) = layout else {
            self.at = before;
            return Ok(false);
        };
        let bytes = self.read_head()?;
        if bytes.major != BYTES {
            return Err(self.invalid("a typed array that is not a byte string"));
        }
        if bytes.info == INDEFINITE {
            let mut gathered = Vec::new();
            self.string(bytes, &mut gathered)?;
            self.typed_bytes::<T>(layout, head.value, &gathered, out)?;
        } else {
            let bytes = self.take(bytes.value)?;
            self.typed_bytes::<T>(layout, head.value, bytes, out)?;
        }
        Ok(true)
    }

    fn take_now(&mut self) -> bool {
        let follows = self.input[self.at..].starts_with(b"\x63now");
        if follows {
            self.at += 4;
        }
        follows
    }
}

impl<'a> Cbor<'a> {
    #[cold]
    fn invalid(&self, reason: &'static str) -> Fault {
        CodecErrorKind::Cbor { at: self.at, reason }.into()
    }

    #[inline]
    fn read_head(&mut self) -> Result<ItemHead, Fault> {
        let head = ItemHead::read(&self.input[self.at..]).map_err(|reason| self.invalid(reason))?;
        self.at += head.size;
        Ok(head)
    }

    /// Reads the next head that is not a tag: the field type determines the value, so tags are ignored.
    #[inline]
    fn read_untagged_head(&mut self) -> Result<ItemHead, Fault> {
        loop {
            let head = self.read_head()?;
            if head.major != TAG {
                return Ok(head);
            }
        }
    }

    fn take(&mut self, size: u64) -> Result<&'a [u8], Fault> {
        let rest = &self.input[self.at..];
        let size = usize::try_from(size).ok().filter(|size| *size <= rest.len());
        let size = size.ok_or_else(|| self.invalid("a string longer than the input"))?;
        self.at += size;
        Ok(&rest[..size])
    }

    fn open_container(&mut self, major: u8, expected: &'static str) -> Result<RemainingItems, Fault> {
        let head = self.read_untagged_head()?;
        if head.major != major {
            return Err(type_mismatch(expected, head));
        }
        Ok(RemainingItems((head.info != INDEFINITE).then_some(head.value)))
    }

    /// Returns true if another item (or pair) follows; skips the break after the last one.
    #[inline]
    fn has_next(&mut self, left: &mut RemainingItems) -> Result<bool, Fault> {
        match &mut left.0 {
            Some(0) => Ok(false),
            Some(left) => {
                *left -= 1;
                Ok(true)
            }
            None => {
                let ended = self.input.get(self.at) == Some(&(SIMPLE | INDEFINITE));
                self.at += usize::from(ended);
                Ok(!ended)
            }
        }
    }

    fn read_key(&mut self, members: &Members) -> Result<usize, Fault> {
        let mut name = std::mem::take(&mut self.scratch);
        name.clear();
        let head = self.read_untagged_head()?;
        if head.major != TEXT {
            return Err(self.invalid("a key that is not a string"));
        }
        self.string(head, &mut name)?;
        let Some(index) = members.find(&name) else {
            let name: String = String::from_utf8_lossy(&name).chars().take(100).collect();
            return Err(Fault::from(CodecErrorKind::NoSuchField).in_field(&name));
        };
        self.scratch = name;
        Ok(index)
    }

    /// Appends the content of a byte or text string whose head has been read.
    fn string(&mut self, head: ItemHead, out: &mut Vec<u8>) -> Result<(), Fault> {
        if head.info != INDEFINITE {
            out.extend_from_slice(self.take(head.value)?);
            return Ok(());
        }
        loop {
            let chunk = self.read_head()?;
            if chunk.is_break() {
                return Ok(());
            }
            if chunk.major != head.major || chunk.info == INDEFINITE {
                return Err(self.invalid("a string's chunk is of another type"));
            }
            out.extend_from_slice(self.take(chunk.value)?);
        }
    }

    fn typed_bytes<T: Wire>(
        &self,
        layout: ElementLayout,
        tag: u64,
        bytes: &[u8],
        out: &mut Vec<u8>,
    ) -> Result<(), Fault> {
        if bytes.len() % layout.width != 0 {
            return Err(self.invalid("a typed array whose length is not a multiple of its element"));
        }
        layout.append::<T>(tag, bytes, out)
    }
}

#[cold]
fn type_mismatch(expected: &'static str, head: ItemHead) -> Fault {
    let found = match (head.major, head.info) {
        (UNSIGNED | NEGATIVE, _) | (SIMPLE, 25..=27) => "a number",
        (BYTES, _) => "a byte string",
        (TEXT, _) => "a string",
        (ARRAY, _) => "an array",
        (MAP, _) => "a map",
        (SIMPLE, 20 | 21) => "a bool",
        (SIMPLE, 22 | 23) => "null",
        (SIMPLE, INDEFINITE) => "the end of the array or map around it",
        _ => "an unknown value",
    };
    mismatch(expected, found)
}
