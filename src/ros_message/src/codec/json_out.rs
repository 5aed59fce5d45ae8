//! ROS bytes → JSON.

use crate::codec::fault::{CodecErrorKind, Fault};
use crate::codec::json_text::{plain_prefix, push_escaped};
use crate::codec::walk::{OutputFormat, walk};
use crate::codec::{InvalidUtf8, JsonOptions, NonFinite};
use crate::schema::MessageType;
use crate::schema::plan::{CodecPlan, Literal, Scalar};

/// Appends the message as a JSON object.
pub(crate) fn write(
    message: &MessageType,
    bytes: &[u8],
    out: &mut Vec<u8>,
    options: &JsonOptions,
) -> Result<(), Fault> {
    let end = out.len().saturating_add(options.max_bytes);
    walk(message, bytes, &mut Json { out, options, end })
}

struct Json<'a> {
    out: &'a mut Vec<u8>,
    options: &'a JsonOptions,
    /// Maximum length of the output buffer.
    end: usize,
}

impl OutputFormat for Json<'_> {
    #[inline]
    fn literal(&mut self, plan: &CodecPlan, literal: &Literal) {
        plan.push_json(literal, self.out);
    }

    #[inline]
    fn scalar(&mut self, scalar: Scalar, bytes: &[u8]) {
        match scalar {
            Scalar::Bool => self.boolean(bytes[0]),
            Scalar::I8 => self.integer(i8::from_le_bytes(array(bytes))),
            Scalar::U8 => self.integer(bytes[0]),
            Scalar::I16 => self.integer(i16::from_le_bytes(array(bytes))),
            Scalar::U16 => self.integer(u16::from_le_bytes(array(bytes))),
            Scalar::I32 => self.integer(i32::from_le_bytes(array(bytes))),
            Scalar::U32 => self.integer(u32::from_le_bytes(array(bytes))),
            Scalar::I64 => self.integer(i64::from_le_bytes(array(bytes))),
            Scalar::U64 => self.integer(u64::from_le_bytes(array(bytes))),
            Scalar::F32 => self.single(f32::from_le_bytes(array(bytes))),
            Scalar::F64 => self.double(f64::from_le_bytes(array(bytes))),
            Scalar::Time | Scalar::Duration | Scalar::Time2 | Scalar::Duration2 => {
                self.time(scalar, bytes);
            }
        }
    }

    fn text(&mut self, bytes: &[u8]) -> Result<(), Fault> {
        self.out.push(b'"');
        let plain = plain_prefix(bytes);
        self.out.extend_from_slice(&bytes[..plain]);
        for chunk in bytes[plain..].utf8_chunks() {
            push_escaped(self.out, chunk.valid());
            if !chunk.invalid().is_empty() {
                match self.options.invalid_utf8 {
                    InvalidUtf8::Replace => self.out.extend_from_slice("\u{fffd}".as_bytes()),
                    InvalidUtf8::Refuse => return Err(CodecErrorKind::InvalidUtf8.into()),
                }
            }
        }
        self.out.push(b'"');
        Ok(())
    }

    fn bytes(&mut self, bytes: &[u8]) {
        // The encoder reserves exactly; reserving more first keeps growth geometric.
        self.out.reserve(bytes.len().div_ceil(3) * 4 + 64);
        self.out.push(b'"');
        base64_simd::STANDARD.encode_append(bytes, self.out);
        self.out.push(b'"');
    }

    fn scalars(&mut self, scalar: Scalar, bytes: &[u8]) {
        // The match is done once per array, not per element.
        match scalar {
            Scalar::Bool => self.list(bytes, |json, [byte]| json.boolean(byte)),
            Scalar::I8 => self.list(bytes, |json, bytes| json.integer(i8::from_le_bytes(bytes))),
            Scalar::U8 => self.list(bytes, |json, [byte]| json.integer(byte)),
            Scalar::I16 => self.list(bytes, |json, bytes| json.integer(i16::from_le_bytes(bytes))),
            Scalar::U16 => self.list(bytes, |json, bytes| json.integer(u16::from_le_bytes(bytes))),
            Scalar::I32 => self.list(bytes, |json, bytes| json.integer(i32::from_le_bytes(bytes))),
            Scalar::U32 => self.list(bytes, |json, bytes| json.integer(u32::from_le_bytes(bytes))),
            Scalar::I64 => self.list(bytes, |json, bytes| json.integer(i64::from_le_bytes(bytes))),
            Scalar::U64 => self.list(bytes, |json, bytes| json.integer(u64::from_le_bytes(bytes))),
            Scalar::F32 => self.list(bytes, |json, bytes| json.single(f32::from_le_bytes(bytes))),
            Scalar::F64 => self.list(bytes, |json, bytes| json.double(f64::from_le_bytes(bytes))),
            Scalar::Time | Scalar::Duration | Scalar::Time2 | Scalar::Duration2 => {
                self.list(bytes, |json, bytes: [u8; 8]| json.time(scalar, &bytes));
            }
        }
    }

    fn begin_array(&mut self, _: usize) {
        self.out.push(b'[');
    }

    fn element(&mut self, index: usize) {
        if index > 0 {
            self.out.push(b',');
        }
    }

    fn end_array(&mut self) {
        self.out.push(b']');
    }

    #[inline]
    fn check_room(&self, more: usize) -> Result<(), Fault> {
        if self.out.len().saturating_add(more) <= self.end {
            return Ok(());
        }
        Err(CodecErrorKind::TooLarge(self.options.max_bytes).into())
    }
}

impl Json<'_> {
    fn list<const N: usize>(&mut self, bytes: &[u8], mut element: impl FnMut(&mut Self, [u8; N])) {
        self.out.reserve(bytes.len() + bytes.len() / N * 2 + 2);
        self.out.push(b'[');
        let mut elements = bytes.chunks_exact(N);
        if let Some(first) = elements.next() {
            element(self, array(first));
        }
        for next in elements {
            self.out.push(b',');
            element(self, array(next));
        }
        self.out.push(b']');
    }

    fn boolean(&mut self, byte: u8) {
        self.out.extend_from_slice(if byte == 0 { b"false" } else { b"true" });
    }

    #[inline]
    fn integer(&mut self, value: impl itoa::Integer) {
        self.out.extend_from_slice(itoa::Buffer::new().format(value).as_bytes());
    }

    #[inline]
    fn single(&mut self, value: f32) {
        if value.is_finite() {
            self.out.extend_from_slice(zmij::Buffer::new().format_finite(value).as_bytes());
        } else {
            self.non_finite(value.into());
        }
    }

    #[inline]
    fn double(&mut self, value: f64) {
        if value.is_finite() {
            self.out.extend_from_slice(zmij::Buffer::new().format_finite(value).as_bytes());
        } else {
            self.non_finite(value);
        }
    }

    #[cold]
    fn non_finite(&mut self, value: f64) {
        let quoted = match value {
            value if value.is_nan() => "\"NaN\"",
            value if value > 0.0 => "\"Infinity\"",
            _ => "\"-Infinity\"",
        };
        self.out.extend_from_slice(match self.options.non_finite {
            NonFinite::Null => b"null",
            NonFinite::String => quoted.as_bytes(),
            NonFinite::Bare => quoted.trim_matches('"').as_bytes(),
        });
    }

    /// Writes a time. The ROS versions differ in the names of the parts and in which parts may be negative.
    #[inline]
    fn time(&mut self, scalar: Scalar, bytes: &[u8]) {
        const ROS1_TIME_KEYS: [&[u8]; 2] = [b"{\"secs\":", b",\"nsecs\":"];
        const OF_TWO: [&[u8]; 2] = [b"{\"sec\":", b",\"nanosec\":"];
        let (secs, nsecs) = bytes.split_at(4);
        let (secs, nsecs) = (array(secs), array(nsecs));
        let (signed, unsigned) = (i32::from_le_bytes, u32::from_le_bytes);
        match scalar {
            Scalar::Time => self.parts(ROS1_TIME_KEYS, unsigned(secs), unsigned(nsecs)),
            Scalar::Duration => self.parts(ROS1_TIME_KEYS, signed(secs), signed(nsecs)),
            _ => self.parts(OF_TWO, signed(secs), unsigned(nsecs)),
        }
    }

    #[inline]
    fn parts(&mut self, names: [&[u8]; 2], secs: impl itoa::Integer, nsecs: impl itoa::Integer) {
        self.out.extend_from_slice(names[0]);
        self.integer(secs);
        self.out.extend_from_slice(names[1]);
        self.integer(nsecs);
        self.out.push(b'}');
    }
}

/// Converts to an array; `bytes` must have length N.
#[inline]
fn array<const N: usize>(bytes: &[u8]) -> [u8; N] {
    let mut array = [0; N];
    array.copy_from_slice(bytes);
    array
}
