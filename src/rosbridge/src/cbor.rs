//! The subset of CBOR (RFC 8949) that an envelope needs.

use crate::Problem;

/// Maximum nesting depth; no ROS message is nested deeper.
const MAX_DEPTH: usize = 64;

pub(crate) const UNSIGNED: u8 = 0;
pub(crate) const NEGATIVE: u8 = 1;
pub(crate) const BYTES: u8 = 2;
pub(crate) const TEXT: u8 = 3;
pub(crate) const ARRAY: u8 = 4;
pub(crate) const MAP: u8 = 5;
const TAG: u8 = 6;
const SIMPLE: u8 = 7;
const BREAK: u8 = 0xff;

fn syntax_error(at: usize, reason: &'static str) -> Problem {
    Problem::Syntax { format: "CBOR", at, reason }
}

/// Head of an item: its major type and argument; `None` for indefinite length.
#[derive(Clone, Copy)]
pub(crate) struct CborHead {
    pub(crate) major: u8,
    pub(crate) info: u8,
    pub(crate) argument: Option<u64>,
}

/// A position in a CBOR text.
pub(crate) struct CborCursor<'a> {
    bytes: &'a [u8],
    at: usize,
}

impl<'a> CborCursor<'a> {
    pub(crate) fn new(bytes: &'a [u8]) -> Self {
        Self { bytes, at: 0 }
    }

    fn take(&mut self, count: u64) -> Result<&'a [u8], Problem> {
        let rest = &self.bytes[self.at..];
        if count > rest.len() as u64 {
            return Err(syntax_error(self.at, "the frame ends too early"));
        }
        let count = count as usize;
        self.at += count;
        Ok(&rest[..count])
    }

    pub(crate) fn head(&mut self) -> Result<CborHead, Problem> {
        let start = self.at;
        let first = self.take(1)?[0];
        let (major, info) = (first >> 5, first & 0x1f);
        let argument = match info {
            0..=23 => Some(u64::from(info)),
            24..=27 => {
                let bytes = self.take(1 << (info - 24))?;
                Some(bytes.iter().fold(0, |sum, &byte| (sum << 8) | u64::from(byte)))
            }
            31 if matches!(major, BYTES | TEXT | ARRAY | MAP) => None,
            _ => return Err(syntax_error(start, "a reserved length is used")),
        };
        Ok(CborHead { major, info, argument })
    }

    fn take_break(&mut self) -> bool {
        if self.bytes.get(self.at) == Some(&BREAK) {
            self.at += 1;
            return true;
        }
        false
    }

    /// Calls `each` with every key and the slice of its value; the bytes must be exactly one map.
    pub(crate) fn map(
        &mut self,
        mut each: impl FnMut(&'a str, &'a [u8]) -> Result<(), Problem>,
    ) -> Result<(), Problem> {
        let head = self.head()?;
        if head.major != MAP {
            return Err(Problem::NotAnObject("CBOR map"));
        }
        let mut left = head.argument;
        loop {
            match &mut left {
                Some(0) => break,
                Some(count) => *count -= 1,
                None if self.take_break() => break,
                None => {}
            }
            let start = self.at;
            let key = self.head()?;
            let CborHead { major: TEXT, argument: Some(length), .. } = key else {
                return Err(syntax_error(start, "a field name (a text string of definite length) is expected"));
            };
            let key =
                std::str::from_utf8(self.take(length)?).map_err(|_| syntax_error(start, "a name is not UTF-8"))?;
            let value = self.at;
            self.skip(0)?;
            each(key, &self.bytes[value..self.at])?;
        }
        if self.at == self.bytes.len() { Ok(()) } else { Err(syntax_error(self.at, "nothing may follow the map")) }
    }

    /// Returns the slices of an array's items.
    pub(crate) fn list(&mut self) -> Option<Vec<&'a [u8]>> {
        let CborHead { major: ARRAY, argument, .. } = self.head().ok()? else {
            return None;
        };
        let mut items = Vec::new();
        while argument.map_or_else(|| !self.take_break(), |count| (items.len() as u64) < count) {
            let start = self.at;
            self.skip(0).ok()?;
            items.push(&self.bytes[start..self.at]);
        }
        Some(items)
    }

    fn skip(&mut self, depth: usize) -> Result<(), Problem> {
        if depth > MAX_DEPTH {
            return Err(syntax_error(self.at, "nested deeper than 64 levels"));
        }
        let start = self.at;
        let head = self.head()?;
        match (head.major, head.argument) {
            (UNSIGNED | NEGATIVE | SIMPLE, _) => Ok(()),
            (BYTES | TEXT, Some(length)) => self.take(length).map(drop),
            (BYTES | TEXT, None) => {
                while !self.take_break() {
                    let chunk = self.head()?;
                    match chunk.argument {
                        Some(length) if chunk.major == head.major => self.take(length)?,
                        _ => {
                            return Err(syntax_error(start, "a string has chunks of another kind"));
                        }
                    };
                }
                Ok(())
            }
            (ARRAY | MAP, count) => {
                let each = if head.major == MAP { 2 } else { 1 };
                match count {
                    Some(count) => {
                        for _ in 0..count {
                            for _ in 0..each {
                                self.skip(depth + 1)?;
                            }
                        }
                    }
                    None => {
                        while !self.take_break() {
                            for _ in 0..each {
                                self.skip(depth + 1)?;
                            }
                        }
                    }
                }
                Ok(())
            }
            (TAG, _) => self.skip(depth + 1),
            _ => Err(syntax_error(start, "an unknown item")),
        }
    }

    /// Reads a byte or text string of definite length (after any tags).
    pub(crate) fn string(&mut self, major: u8) -> Option<&'a [u8]> {
        let mut head = self.head().ok()?;
        while head.major == TAG {
            head = self.head().ok()?;
        }
        if head.major != major {
            return None;
        }
        self.take(head.argument?).ok()
    }

    /// Reads a number.
    pub(crate) fn number(&mut self) -> Option<f64> {
        let head = self.head().ok()?;
        let argument = head.argument?;
        match (head.major, head.info) {
            (UNSIGNED, _) => Some(argument as f64),
            (NEGATIVE, _) => Some(-1.0 - argument as f64),
            (SIMPLE, 25) => Some(half_to_f64(argument as u16)),
            (SIMPLE, 26) => Some(f64::from(f32::from_bits(argument as u32))),
            (SIMPLE, 27) => Some(f64::from_bits(argument)),
            _ => None,
        }
    }

    /// Reads an integer.
    pub(crate) fn integer(&mut self) -> Option<i64> {
        let head = self.head().ok()?;
        let argument = head.argument?;
        match head.major {
            UNSIGNED => i64::try_from(argument).ok(),
            NEGATIVE => i64::try_from(argument).ok().map(|value| -1 - value),
            _ => None,
        }
    }
}

/// Converts IEEE 754 half precision.
fn half_to_f64(bits: u16) -> f64 {
    let exponent = i32::from(bits >> 10 & 0x1f);
    let mantissa = f64::from(bits & 0x3ff);
    let magnitude = match exponent {
        0 => mantissa * 2f64.powi(-24),
        31 if mantissa == 0.0 => f64::INFINITY,
        31 => f64::NAN,
        _ => (mantissa + 1024.0) * 2f64.powi(exponent - 25),
    };
    if bits & 0x8000 == 0 { magnitude } else { -magnitude }
}

/// Appends the head of an item in its shortest form.
pub(crate) fn write_head(out: &mut Vec<u8>, major: u8, argument: u64) {
    let major = major << 5;
    match argument {
        0..=23 => out.push(major | argument as u8),
        24..=0xff => out.extend_from_slice(&[major | 24, argument as u8]),
        0x100..=0xffff => {
            out.push(major | 25);
            out.extend_from_slice(&(argument as u16).to_be_bytes());
        }
        0x1_0000..=0xffff_ffff => {
            out.push(major | 26);
            out.extend_from_slice(&(argument as u32).to_be_bytes());
        }
        _ => {
            out.push(major | 27);
            out.extend_from_slice(&argument.to_be_bytes());
        }
    }
}

/// Appends a text string.
pub(crate) fn write_text(out: &mut Vec<u8>, text: &str) {
    write_head(out, TEXT, text.len() as u64);
    out.extend_from_slice(text.as_bytes());
}

/// Appends an integer.
pub(crate) fn write_integer(out: &mut Vec<u8>, value: i64) {
    if value < 0 {
        write_head(out, NEGATIVE, value.unsigned_abs() - 1);
    } else {
        write_head(out, UNSIGNED, value.unsigned_abs());
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn fields(bytes: &[u8]) -> Result<Vec<(String, Vec<u8>)>, Problem> {
        let mut found = Vec::new();
        CborCursor::new(bytes).map(|key, value| {
            found.push((key.to_owned(), value.to_vec()));
            Ok(())
        })?;
        Ok(found)
    }

    #[test]
    fn fields_are_found_with_their_slices() {
        // {"a": 1, "b": [_ h'00', {"x": 1.5}], "c": 64(h'0102')}
        let bytes = b"\xa3\x61a\x01\x61b\x9f\x41\x00\xa1\x61x\xf9\x3e\x00\xff\x61c\xd8\x40\x42\x01\x02";
        let found = fields(bytes).unwrap();
        assert_eq!(found[0], ("a".to_owned(), vec![1]));
        assert_eq!(found[1], ("b".to_owned(), b"\x9f\x41\x00\xa1\x61x\xf9\x3e\x00\xff".to_vec()));
        assert_eq!(found[2], ("c".to_owned(), b"\xd8\x40\x42\x01\x02".to_vec()));
        assert_eq!(fields(b"\xbf\x61a\x20\xff").unwrap(), [("a".to_owned(), vec![0x20])]);
    }

    #[test]
    fn broken_cbor_is_refused_and_never_trusted() {
        assert_eq!(fields(b""), Err(syntax_error(0, "the frame ends too early")));
        assert_eq!(fields(b"\x01"), Err(Problem::NotAnObject("CBOR map")));
        // A byte string that claims 2^63 bytes, an array that claims 2^63 items.
        assert!(fields(b"\xa1\x61a\x5b\x80\0\0\0\0\0\0\0").is_err());
        assert!(fields(b"\xa1\x61a\x9b\x80\0\0\0\0\0\0\0").is_err());
        assert!(fields(b"\xbb\xff\xff\xff\xff\xff\xff\xff\xff").is_err());
        assert!(fields(b"\xa1\x01\x01").is_err());
        assert!(fields(b"\xa1\x61a\x01\x01").is_err());
        assert!(fields(b"\xa1\x61a\x1c").is_err());
        let mut deep = b"\xa1\x61a".to_vec();
        deep.extend(std::iter::repeat_n(0x81, 100_000));
        assert_eq!(fields(&deep), Err(syntax_error(68, "nested deeper than 64 levels")));
    }

    #[test]
    fn numbers_are_read_in_every_width() {
        for (bytes, value) in [
            (&b"\x17"[..], 23.0),
            (b"\x18\xff", 255.0),
            (b"\x19\x01\x00", 256.0),
            (b"\x1a\x00\x01\x00\x00", 65536.0),
            (b"\x20", -1.0),
            (b"\xf9\x3c\x00", 1.0),
            (b"\xf9\xc4\x00", -4.0),
            (b"\xf9\x00\x01", 5.960464477539063e-8),
            (b"\xfa\x3f\xc0\x00\x00", 1.5),
            (b"\xfb\x3f\xf8\x00\x00\x00\x00\x00\x00", 1.5),
        ] {
            assert_eq!(CborCursor::new(bytes).number(), Some(value));
        }
        for value in [0, 23, 24, 255, 256, 65535, 65536, i64::MAX, -1, -24, -25, i64::MIN] {
            let mut out = Vec::new();
            write_integer(&mut out, value);
            assert_eq!(CborCursor::new(&out).integer(), Some(value));
        }
    }
}
