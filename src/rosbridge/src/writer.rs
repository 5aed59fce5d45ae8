//! Prints a message field by field, in either format, straight into the socket's output buffer.

use crate::{Format, Id, Payload, cbor, json};

/// Largest count that fits into a one-byte CBOR head.
pub(crate) const MAX_FIELDS: usize = 23;

/// Writes one object of at most 23 fields, more than any op has.
pub struct Writer<'o> {
    out: &'o mut Vec<u8>,
    format: Format,
    start: usize,
    fields: u8,
}

impl<'o> Writer<'o> {
    /// Begins an object at the end of `out`.
    pub fn new(out: &'o mut Vec<u8>, format: Format) -> Self {
        let start = out.len();
        out.push(match format {
            Format::Json => b'{',
            // The count is filled in at the end.
            Format::Cbor => cbor::MAP << 5,
        });
        Self { out, format, start, fields: 0 }
    }

    /// Begins a message with this op and, if given, id.
    pub fn op(out: &'o mut Vec<u8>, format: Format, op: &str, id: Option<&Id<'_>>) -> Self {
        let mut writer = Self::new(out, format);
        writer.text("op", op);
        match id {
            Some(Id::Text(text)) => writer.text("id", text),
            Some(Id::Integer(number)) => writer.integer("id", *number),
            None => {}
        }
        writer
    }

    fn key(&mut self, key: &str) {
        match self.format {
            Format::Json => {
                if self.fields > 0 {
                    self.out.push(b',');
                }
                self.out.push(b'"');
                self.out.extend_from_slice(key.as_bytes());
                self.out.extend_from_slice(b"\":");
            }
            Format::Cbor => cbor::write_text(self.out, key),
        }
        self.fields += 1;
        debug_assert!(usize::from(self.fields) <= MAX_FIELDS);
    }

    /// Writes a string field.
    pub fn text(&mut self, key: &str, value: &str) {
        self.key(key);
        match self.format {
            Format::Json => json::write_string(self.out, value),
            Format::Cbor => cbor::write_text(self.out, value),
        }
    }

    /// Writes an integer field.
    pub fn integer(&mut self, key: &str, value: i64) {
        self.key(key);
        match self.format {
            Format::Json => self.out.extend_from_slice(value.to_string().as_bytes()),
            Format::Cbor => cbor::write_integer(self.out, value),
        }
    }

    /// Writes an integer field, if there is a value.
    pub fn optional_count(&mut self, key: &str, value: Option<u64>) {
        if let Some(value) = value {
            self.integer(key, i64::try_from(value).unwrap_or(i64::MAX));
        }
    }

    /// Writes a number field; it must be finite.
    pub fn number(&mut self, key: &str, value: f64) {
        if value.fract() == 0.0 && value.abs() < 9e15 {
            return self.integer(key, value as i64);
        }
        self.key(key);
        match self.format {
            Format::Json => self.out.extend_from_slice(format!("{value:?}").as_bytes()),
            Format::Cbor => {
                self.out.push(0xfb);
                self.out.extend_from_slice(&value.to_be_bytes());
            }
        }
    }

    /// Writes a boolean field.
    pub fn boolean(&mut self, key: &str, value: bool) {
        self.key(key);
        match (self.format, value) {
            (Format::Json, true) => self.out.extend_from_slice(b"true"),
            (Format::Json, false) => self.out.extend_from_slice(b"false"),
            (Format::Cbor, value) => self.out.push(0xf4 + u8::from(value)),
        }
    }

    /// Writes a byte field: a byte string in CBOR, base64 in JSON.
    pub fn bytes(&mut self, key: &str, value: &[u8]) {
        self.key(key);
        match self.format {
            Format::Json => {
                self.out.push(b'"');
                base64_simd::STANDARD.encode_append(value, self.out);
                self.out.push(b'"');
            }
            Format::Cbor => {
                cbor::write_head(self.out, cbor::BYTES, value.len() as u64);
                self.out.extend_from_slice(value);
            }
        }
    }

    /// Writes a payload that is already in this object's format.
    ///
    /// # Panics
    /// Panics if the formats differ: the caller chooses the format of the object from the payload.
    pub fn payload(&mut self, key: &str, payload: Payload<'_>) {
        assert_eq!(payload.format, self.format, "a payload keeps its format");
        self.key(key);
        self.out.extend_from_slice(payload.bytes);
    }

    /// Writes a field whose value `write` appends in this object's format.
    pub fn value<E>(&mut self, key: &str, write: impl FnOnce(&mut Vec<u8>) -> Result<(), E>) -> Result<(), E> {
        self.key(key);
        write(self.out)
    }

    /// Writes an object field, whose fields `write` writes.
    pub fn object(&mut self, key: &str, write: impl FnOnce(&mut Writer<'_>)) {
        self.key(key);
        let mut inner = Writer::new(self.out, self.format);
        write(&mut inner);
        inner.end();
    }

    /// Writes the payload of `cbor-raw`: a serialized message and its time of reception.
    pub fn raw(&mut self, key: &str, stamp: Option<(u32, u32)>, bytes: &[u8]) {
        self.key(key);
        let mut inner = Writer::new(self.out, self.format);
        if let Some((secs, nsecs)) = stamp {
            inner.integer("secs", i64::from(secs));
            inner.integer("nsecs", i64::from(nsecs));
        }
        inner.bytes("bytes", bytes);
        inner.end();
    }

    /// Closes the object.
    pub fn end(self) {
        match self.format {
            Format::Json => self.out.push(b'}'),
            Format::Cbor => self.out[self.start] |= self.fields,
        }
    }
}
