//! JSON → ROS bytes. A parser that builds no tree: the caller asks for what the message needs next, and just that is
//! read.

use memchr::memchr2;

use crate::codec::digits::{eight_digits, many_digits};
use crate::codec::fault::{CodecErrorKind, Fault, mismatch};
use crate::codec::fill::{ValueInput, fill};
use crate::codec::json_text::{is_space, plain_prefix, unescape};
use crate::codec::number::{Decimal, Wire};
use crate::codec::{FillOptions, FillReport};
use crate::schema::MessageType;
use crate::schema::plan::Members;

/// Appends the message that the JSON object describes.
pub(crate) fn read(
    message: &MessageType,
    json: &[u8],
    out: &mut Vec<u8>,
    options: &FillOptions,
) -> Result<FillReport, Fault> {
    let mut input = Json { input: json, at: 0, scratch: Vec::new() };
    let report = fill(&mut input, message, out, options)?;
    input.skip_space();
    match input.peek() {
        None => Ok(report),
        Some(_) => Err(input.invalid("more follows the message")),
    }
}

struct Json<'a> {
    input: &'a [u8],
    at: usize,
    scratch: Vec<u8>,
}

/// True until the first element has been read, after which a comma must precede each element.
pub(crate) struct ListProgress(bool);

impl ValueInput for Json<'_> {
    type Object = ListProgress;
    type Array = ListProgress;

    fn begin_object(&mut self) -> Result<ListProgress, Fault> {
        self.open_bracket(b'{', "an object")
    }

    #[inline]
    fn next_member(
        &mut self,
        object: &mut ListProgress,
        members: &Members,
        expected: usize,
    ) -> Result<Option<usize>, Fault> {
        if !self.has_next(object, b'}')? {
            return Ok(None);
        }
        if let Some(likely) = members.list().get(expected) {
            if self.rest().starts_with(&likely.json_key) {
                self.at += likely.json_key.len();
                return Ok(Some(expected));
            }
        }
        self.read_key(members).map(Some)
    }

    fn begin_array(&mut self, expected: &'static str) -> Result<ListProgress, Fault> {
        self.open_bracket(b'[', expected)
    }

    #[inline]
    fn next_element(&mut self, array: &mut ListProgress) -> Result<bool, Fault> {
        self.has_next(array, b']')
    }

    fn boolean(&mut self) -> Result<bool, Fault> {
        self.skip_space();
        if self.skip_word("true") {
            return Ok(true);
        }
        if self.skip_word("false") {
            return Ok(false);
        }
        Err(self.mismatch("bool"))
    }

    #[inline]
    fn number<T: Wire>(&mut self) -> Result<T, Fault> {
        self.skip_space();
        match self.peek() {
            Some(b'0'..=b'9' | b'-') if !self.rest().starts_with(b"-I") => T::from_decimal(&self.decimal()?),
            _ => self.non_finite(),
        }
    }

    fn text(&mut self, out: &mut Vec<u8>) -> Result<(), Fault> {
        self.skip_space();
        if self.peek() != Some(b'"') {
            return Err(self.mismatch("a string"));
        }
        self.at += 1;
        let plain = plain_prefix(self.rest());
        out.extend_from_slice(&self.rest()[..plain]);
        self.at += plain;
        if self.peek() == Some(b'"') {
            self.at += 1;
            return Ok(());
        }
        self.rest_of_text(out)
    }

    fn bytes(&mut self, out: &mut Vec<u8>) -> Result<bool, Fault> {
        self.skip_space();
        match self.peek() {
            Some(b'[') => return Ok(false),
            Some(b'"') => self.at += 1,
            _ => return Err(self.mismatch("base64 or a list of uint8")),
        }
        let rest = self.rest();
        let end = memchr2(b'"', b'\\', rest).ok_or_else(|| self.invalid("a string without an end"))?;
        if rest[end] == b'"' {
            self.at += end + 1;
            decode_base64(&rest[..end], out)?;
            return Ok(true);
        }
        // Some writers escape the slash.
        let mut text = std::mem::take(&mut self.scratch);
        text.clear();
        self.rest_of_text(&mut text)?;
        decode_base64(&text, out)?;
        self.scratch = text;
        Ok(true)
    }

    fn typed_array<T: Wire>(&mut self, _: &mut Vec<u8>) -> Result<bool, Fault> {
        Ok(false)
    }

    fn take_now(&mut self) -> bool {
        self.skip_space();
        self.skip_word("\"now\"")
    }
}

impl<'a> Json<'a> {
    #[inline]
    fn rest(&self) -> &'a [u8] {
        &self.input[self.at..]
    }

    #[inline]
    fn peek(&self) -> Option<u8> {
        self.input.get(self.at).copied()
    }

    #[inline]
    fn skip_space(&mut self) {
        while self.peek().is_some_and(is_space) {
            self.at += 1;
        }
    }

    /// Skips `word` if it follows.
    fn skip_word(&mut self, word: &str) -> bool {
        let follows = self.rest().starts_with(word.as_bytes());
        if follows {
            self.at += word.len();
        }
        follows
    }

    #[cold]
    fn invalid(&self, reason: &'static str) -> Fault {
        CodecErrorKind::Json { at: self.at, reason }.into()
    }

    /// Returns the error for a value that the field does not take, or for invalid JSON.
    #[cold]
    fn mismatch(&self, expected: &'static str) -> Fault {
        match self.peek() {
            Some(b'"') => mismatch(expected, "a string"),
            Some(b'{') => mismatch(expected, "an object"),
            Some(b'[') => mismatch(expected, "a list"),
            Some(b'0'..=b'9' | b'-') => mismatch(expected, "a number"),
            Some(b't' | b'f') => mismatch(expected, "a bool"),
            Some(b'n') => mismatch(expected, "null"),
            Some(b'N' | b'I') => mismatch(expected, "a number that is not finite"),
            Some(_) => self.invalid("expected a value"),
            None => self.invalid("the input ends inside a value"),
        }
    }

    fn open_bracket(&mut self, bracket: u8, expected: &'static str) -> Result<ListProgress, Fault> {
        self.skip_space();
        if self.peek() != Some(bracket) {
            return Err(self.mismatch(expected));
        }
        self.at += 1;
        Ok(ListProgress(true))
    }

    /// Returns true if another element follows, and skips the comma before it; otherwise skips the closing bracket.
    #[inline]
    fn has_next(&mut self, first: &mut ListProgress, bracket: u8) -> Result<bool, Fault> {
        self.skip_space();
        if self.peek() == Some(bracket) {
            self.at += 1;
            return Ok(false);
        }
        if !std::mem::replace(&mut first.0, false) {
            if self.peek() != Some(b',') {
                return Err(self.invalid("expected a comma or a closing bracket"));
            }
            self.at += 1;
            self.skip_space();
        }
        Ok(true)
    }

    /// Reads a key that is not the expected one in its usual spelling, and the colon.
    fn read_key(&mut self, members: &Members) -> Result<usize, Fault> {
        if self.peek() != Some(b'"') {
            return Err(self.invalid("expected a key"));
        }
        let mut name = std::mem::take(&mut self.scratch);
        name.clear();
        self.text(&mut name)?;
        let Some(index) = members.find(&name) else {
            let name: String = String::from_utf8_lossy(&name).chars().take(100).collect();
            return Err(Fault::from(CodecErrorKind::NoSuchField).in_field(&name));
        };
        self.scratch = name;
        self.skip_space();
        if self.peek() != Some(b':') {
            return Err(self.invalid("expected a colon"));
        }
        self.at += 1;
        Ok(index)
    }

    /// Reads the rest of a string: text that is not plain ASCII, and escapes.
    fn rest_of_text(&mut self, out: &mut Vec<u8>) -> Result<(), Fault> {
        loop {
            let rest = self.rest();
            let end = memchr2(b'"', b'\\', rest).ok_or_else(|| self.invalid("a string without an end"))?;
            let literal = &rest[..end];
            if std::str::from_utf8(literal).is_err() {
                return Err(CodecErrorKind::InvalidUtf8.into());
            }
            if let Some(control) = literal.iter().position(|byte| *byte < 0x20) {
                self.at += control;
                return Err(self.invalid("a control character in a string"));
            }
            out.extend_from_slice(literal);
            self.at += end + 1;
            if rest[end] == b'"' {
                return Ok(());
            }
            self.at += unescape(self.rest(), out).map_err(|reason| self.invalid(reason))?;
        }
    }

    /// Reads a number in JSON's grammar; the caller checks what follows.
    // Returned through memory, its flags would be read back before they are written: half the time of a number.
    #[inline(always)]
    fn decimal(&mut self) -> Result<Decimal<'a>, Fault> {
        let start = self.at;
        let negative = self.peek() == Some(b'-');
        self.at += usize::from(negative);
        let mut mantissa = 0;
        let integer = self.digits(&mut mantissa)?;
        if integer > 1 && self.input[self.at - integer] == b'0' {
            return Err(self.invalid("a number that begins with 0"));
        }
        let mut fraction = 0;
        let mut integral = true;
        if self.peek() == Some(b'.') {
            integral = false;
            self.at += 1;
            fraction = self.digits(&mut mantissa)?;
        }
        let mut exponent = -(fraction as i64);
        let mut truncated = false;
        // A u64 holds this many digits for certain.
        if integer + fraction > 19 {
            (mantissa, truncated) = many_digits(&self.input[start..self.at]);
        }
        if matches!(self.peek(), Some(b'e' | b'E')) {
            integral = false;
            exponent = exponent.saturating_add(self.exponent()?);
        }
        let text = &self.input[start..self.at];
        Ok(Decimal { negative, mantissa, exponent, truncated, integral, text })
    }

    /// Reads one or more digits, eight at a time where possible.
    #[inline(always)]
    fn digits(&mut self, mantissa: &mut u64) -> Result<usize, Fault> {
        let rest = self.rest();
        let mut count = 0;
        while let Some(eight) = rest[count..].first_chunk().and_then(|chunk| eight_digits(*chunk)) {
            *mantissa = mantissa.wrapping_mul(100_000_000).wrapping_add(eight);
            count += 8;
        }
        while let Some(digit @ b'0'..=b'9') = rest.get(count) {
            *mantissa = mantissa.wrapping_mul(10).wrapping_add((digit - b'0').into());
            count += 1;
        }
        self.at += count;
        if count == 0 {
            return Err(self.invalid("expected a digit"));
        }
        Ok(count)
    }

    fn exponent(&mut self) -> Result<i64, Fault> {
        self.at += 1;
        let negative = self.peek() == Some(b'-');
        if matches!(self.peek(), Some(b'+' | b'-')) {
            self.at += 1;
        }
        let start = self.at;
        let mut exponent: i64 = 0;
        while let Some(digit @ b'0'..=b'9') = self.peek() {
            exponent = exponent.saturating_mul(10).saturating_add(i64::from(digit - b'0'));
            self.at += 1;
        }
        if start == self.at {
            return Err(self.invalid("expected a digit"));
        }
        Ok(if negative { -exponent } else { exponent })
    }

    /// Reads a representation of NaN or an infinity: `null`, Python's bare words, or the same words as strings.
    #[cold]
    fn non_finite<T: Wire>(&mut self) -> Result<T, Fault> {
        const NUMBER_WORDS: [(&str, f64); 7] = [
            ("null", f64::NAN),
            ("NaN", f64::NAN),
            ("Infinity", f64::INFINITY),
            ("-Infinity", f64::NEG_INFINITY),
            ("\"NaN\"", f64::NAN),
            ("\"Infinity\"", f64::INFINITY),
            ("\"-Infinity\"", f64::NEG_INFINITY),
        ];
        for (word, value) in NUMBER_WORDS {
            if let Some(value) = T::from_non_finite(value) {
                if self.skip_word(word) {
                    return Ok(value);
                }
            }
        }
        Err(self.mismatch(T::NAME))
    }
}

/// Appends the bytes encoded by base64 text. Padding may be missing and white space may be interspersed.
fn decode_base64(text: &[u8], out: &mut Vec<u8>) -> Result<(), Fault> {
    // The decoder reserves exactly; reserving more first keeps growth geometric.
    out.reserve(text.len() / 4 * 3 + 64);
    if base64_simd::STANDARD.decode_append(text, out).is_ok() {
        return Ok(());
    }
    let decoded = base64_simd::forgiving_decode_to_vec(text).map_err(|_| CodecErrorKind::Base64)?;
    out.extend_from_slice(&decoded);
    Ok(())
}
