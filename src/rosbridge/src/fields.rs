//! The fields of one message, read by name, independent of the format.

use std::borrow::Cow;
use std::time::Duration;

use crate::{Format, Id, Payload, Problem, cbor, json};

/// Maximum number of fields; no op has more than fifteen.
const MAX_FIELDS: usize = 64;
/// Maximum length of names, types and ids; only payloads may be longer.
const MAX_TEXT: usize = 16 * 1024;

/// Names and value slices of an object.
pub(crate) struct Fields<'a> {
    format: Format,
    found: Vec<(Cow<'a, str>, &'a [u8])>,
}

impl<'a> Fields<'a> {
    pub(crate) fn from_payload(payload: Payload<'a>) -> Result<Self, Problem> {
        match payload.format {
            Format::Json => match std::str::from_utf8(payload.bytes) {
                Ok(text) => Self::from_json(text),
                Err(error) => {
                    Err(Problem::Syntax { format: "JSON", at: error.valid_up_to(), reason: "the text is not UTF-8" })
                }
            },
            Format::Cbor => Self::from_cbor(payload.bytes),
        }
    }

    pub(crate) fn from_json(text: &'a str) -> Result<Self, Problem> {
        let mut fields = Self { format: Format::Json, found: Vec::with_capacity(8) };
        json::JsonCursor::new(text).object(|key, value| fields.push(key, value.as_bytes()))?;
        Ok(fields)
    }

    pub(crate) fn from_cbor(bytes: &'a [u8]) -> Result<Self, Problem> {
        let mut fields = Self { format: Format::Cbor, found: Vec::with_capacity(8) };
        cbor::CborCursor::new(bytes).map(|key, value| fields.push(Cow::Borrowed(key), value))?;
        Ok(fields)
    }

    fn push(&mut self, key: Cow<'a, str>, value: &'a [u8]) -> Result<(), Problem> {
        if self.found.len() == MAX_FIELDS {
            return Err(Problem::TooManyFields(MAX_FIELDS));
        }
        self.found.push((key, value));
        Ok(())
    }

    pub(crate) fn names(&self) -> impl Iterator<Item = &str> {
        self.found.iter().map(|(name, _)| name.as_ref())
    }

    fn is_null(&self, value: &[u8]) -> bool {
        Payload { format: self.format, bytes: value }.is_null()
    }

    /// Returns the value of a field. The last one wins, as in every JSON parser; `null` is treated as absent.
    pub(crate) fn get(&self, field: &str) -> Option<&'a [u8]> {
        let (_, value) = self.found.iter().rev().find(|(name, _)| name == field)?;
        (!self.is_null(value)).then_some(*value)
    }

    pub(crate) fn require(&self, field: &'static str, expected: &'static str) -> Result<&'a [u8], Problem> {
        self.get(field).ok_or(Problem::Missing { field, expected })
    }

    /// Describes a value for error messages, shortened.
    pub(crate) fn describe(&self, value: &[u8]) -> String {
        const MAX_SHOWN_LENGTH: usize = 48;
        match self.format {
            Format::Json => {
                let text = String::from_utf8_lossy(value);
                match text.char_indices().nth(MAX_SHOWN_LENGTH) {
                    Some((at, _)) => format!("{}…", &text[..at]),
                    None => text.into_owned(),
                }
            }
            Format::Cbor => match value.first().map_or(7, |byte| byte >> 5) {
                cbor::UNSIGNED | cbor::NEGATIVE => {
                    cbor::CborCursor::new(value).integer().map_or("a number".to_owned(), |number| number.to_string())
                }
                cbor::BYTES => "a byte string".to_owned(),
                cbor::TEXT => match cbor::CborCursor::new(value).string(cbor::TEXT) {
                    Some(text) => format!("{:?}", String::from_utf8_lossy(&text[..text.len().min(MAX_SHOWN_LENGTH)])),
                    None => "a text in chunks".to_owned(),
                },
                cbor::ARRAY => "an array".to_owned(),
                cbor::MAP => "a map".to_owned(),
                _ => cbor::CborCursor::new(value)
                    .number()
                    .map_or("a simple value".to_owned(), |number| number.to_string()),
            },
        }
    }

    pub(crate) fn mistyped_error(&self, field: &'static str, expected: &'static str, value: &[u8]) -> Problem {
        Problem::Mistyped { field, expected, found: self.describe(value) }
    }

    pub(crate) fn as_text(&self, value: &'a [u8]) -> Option<Cow<'a, str>> {
        Payload { format: self.format, bytes: value }.text()
    }

    pub(crate) fn as_number(&self, value: &[u8]) -> Option<f64> {
        match self.format {
            Format::Json => {
                // Rust's parser also accepts "inf" and "+1"; JSON does not.
                let text = std::str::from_utf8(value).ok()?;
                matches!(value.first(), Some(b'-' | b'0'..=b'9')).then(|| text.parse().ok()).flatten()
            }
            Format::Cbor => cbor::CborCursor::new(value).number(),
        }
    }

    pub(crate) fn as_integer(&self, value: &[u8]) -> Option<i64> {
        let exact = match self.format {
            Format::Json => std::str::from_utf8(value).ok().and_then(|text| text.parse().ok()),
            Format::Cbor => cbor::CborCursor::new(value).integer(),
        };
        // JavaScript and Lua clients may write 5 as 5.0.
        exact.or_else(|| {
            let number = self.as_number(value)?;
            (number.fract() == 0.0 && number.abs() < 9e15).then_some(number as i64)
        })
    }

    /// Reads a string of limited length.
    pub(crate) fn text(&self, field: &'static str, expected: &'static str) -> Result<Option<Cow<'a, str>>, Problem> {
        let Some(value) = self.get(field) else {
            return Ok(None);
        };
        if value.len() > MAX_TEXT {
            return Err(Problem::TooLong { field, length: value.len(), limit: MAX_TEXT });
        }
        self.as_text(value).map(Some).ok_or_else(|| self.mistyped_error(field, expected, value))
    }

    /// Reads a required string, which must not be empty.
    pub(crate) fn required_text(&self, field: &'static str, expected: &'static str) -> Result<Cow<'a, str>, Problem> {
        let text = self.text(field, expected)?.ok_or(Problem::Missing { field, expected })?;
        if text.is_empty() {
            return Err(Problem::Mistyped { field, expected, found: "empty".to_owned() });
        }
        Ok(text)
    }

    /// Reads a required string of any length: the data of fragments and PNGs.
    pub(crate) fn data(&self, field: &'static str, expected: &'static str) -> Result<Cow<'a, str>, Problem> {
        let value = self.require(field, expected)?;
        self.as_text(value).ok_or_else(|| self.mistyped_error(field, expected, value))
    }

    pub(crate) fn boolean(&self, field: &'static str) -> Result<Option<bool>, Problem> {
        let Some(value) = self.get(field) else {
            return Ok(None);
        };
        match self.as_boolean(value) {
            None => Err(self.mistyped_error(field, "true or false", value)),
            known => Ok(known),
        }
    }

    pub(crate) fn as_boolean(&self, value: &[u8]) -> Option<bool> {
        match (self.format, value) {
            (Format::Json, b"true") | (Format::Cbor, [0xf5]) => Some(true),
            (Format::Json, b"false") | (Format::Cbor, [0xf4]) => Some(false),
            _ => None,
        }
    }

    /// Reads an integer not below `least`.
    pub(crate) fn count(
        &self,
        field: &'static str,
        least: i64,
        expected: &'static str,
    ) -> Result<Option<u64>, Problem> {
        let Some(value) = self.get(field) else {
            return Ok(None);
        };
        match self.as_integer(value) {
            Some(number) if number >= least => Ok(Some(number.unsigned_abs())),
            _ => Err(self.mistyped_error(field, expected, value)),
        }
    }

    pub(crate) fn integer(&self, field: &'static str) -> Result<Option<i64>, Problem> {
        let Some(value) = self.get(field) else {
            return Ok(None);
        };
        self.as_integer(value).map(Some).ok_or_else(|| self.mistyped_error(field, "an integer", value))
    }

    /// Reads a duration given as a number of `unit`s.
    pub(crate) fn duration(
        &self,
        field: &'static str,
        unit: Duration,
        expected: &'static str,
    ) -> Result<Option<Duration>, Problem> {
        let Some(value) = self.get(field) else {
            return Ok(None);
        };
        match self.as_number(value) {
            Some(number) if number >= 0.0 => {
                Ok(Some(Duration::try_from_secs_f64(number * unit.as_secs_f64()).unwrap_or(Duration::MAX)))
            }
            _ => Err(self.mistyped_error(field, expected, value)),
        }
    }

    pub(crate) fn id(&self) -> Result<Option<Id<'a>>, Problem> {
        const EXPECTED: &str = "a string or an integer";
        let Some(value) = self.get("id") else {
            return Ok(None);
        };
        if let Some(number) = self.as_integer(value) {
            return Ok(Some(Id::Integer(number)));
        }
        Ok(self.text("id", EXPECTED)?.map(Id::Text))
    }

    pub(crate) fn payload(&self, field: &'static str) -> Option<Payload<'a>> {
        self.get(field).map(|bytes| Payload { format: self.format, bytes })
    }

    /// Reads a required payload, which must be an object.
    pub(crate) fn object(&self, field: &'static str) -> Result<Payload<'a>, Problem> {
        const EXPECTED: &str = "an object with the message's fields";
        let bytes = self.require(field, EXPECTED)?;
        let payload = Payload { format: self.format, bytes };
        if payload.is_object() { Ok(payload) } else { Err(self.mistyped_error(field, EXPECTED, bytes)) }
    }

    /// Reads a payload, which must be an object if present; empty otherwise.
    pub(crate) fn object_or_empty(&self, field: &'static str) -> Result<Payload<'a>, Problem> {
        if self.get(field).is_some() {
            return self.object(field);
        }
        Ok(match self.format {
            Format::Json => Payload::json("{}"),
            Format::Cbor => Payload::cbor(b"\xa0"),
        })
    }

    /// Reads a payload, which must be an object or a list of arguments if present.
    pub(crate) fn arguments(&self, field: &'static str) -> Result<Option<Payload<'a>>, Problem> {
        let Some(bytes) = self.get(field) else {
            return Ok(None);
        };
        let payload = Payload { format: self.format, bytes };
        if payload.is_object() || payload.is_list() {
            Ok(Some(payload))
        } else {
            Err(self.mistyped_error(field, "an object, or a list of arguments in order,", bytes))
        }
    }
}
