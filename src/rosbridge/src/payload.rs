//! Content of an envelope: a message, a service's arguments, a goal.

use std::borrow::Cow;

use base64_simd::STANDARD;

use crate::cbor;
use crate::fields::Fields;
use crate::{Error, Problem};

/// Format of a frame.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash)]
pub enum Format {
    /// Text frames.
    Json,
    /// Binary frames.
    Cbor,
}

/// The slice of a frame that holds a value, for a codec that knows its type.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Payload<'a> {
    /// Format of the bytes.
    pub format: Format,
    /// One JSON value (valid UTF-8) or one CBOR item.
    pub bytes: &'a [u8],
}

/// A message in the serialization of ROS: `{"secs": …, "nsecs": …, "bytes": …}` of `cbor-raw`.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Raw<'a> {
    /// The serialized message: a slice of a CBOR frame, or decoded from the base64 of a JSON frame.
    pub bytes: Cow<'a, [u8]>,
}

impl<'a> Payload<'a> {
    /// Creates a JSON payload.
    pub fn json(text: &'a str) -> Self {
        Self { format: Format::Json, bytes: text.as_bytes() }
    }

    /// Creates a CBOR payload.
    pub fn cbor(bytes: &'a [u8]) -> Self {
        Self { format: Format::Cbor, bytes }
    }

    /// Returns whether it is a list (positional arguments) rather than an object.
    pub fn is_list(&self) -> bool {
        match self.format {
            Format::Json => self.bytes.first() == Some(&b'['),
            Format::Cbor => self.bytes.first().is_some_and(|byte| byte >> 5 == cbor::ARRAY),
        }
    }

    /// Returns whether it is an object.
    pub fn is_object(&self) -> bool {
        match self.format {
            Format::Json => self.bytes.first() == Some(&b'{'),
            Format::Cbor => self.bytes.first().is_some_and(|byte| byte >> 5 == cbor::MAP),
        }
    }

    /// Returns the names of an object's fields; `None` if it is not an object, or has more fields than any message.
    pub fn keys(&self) -> Option<Vec<String>> {
        let fields = Fields::from_payload(*self).ok()?;
        Some(fields.names().map(str::to_owned).collect())
    }

    /// Returns whether it is `null`, which is treated as absent.
    pub fn is_null(&self) -> bool {
        match self.format {
            Format::Json => self.bytes == b"null",
            Format::Cbor => matches!(self.bytes, [0xf6 | 0xf7]),
        }
    }

    /// Returns the text if it is a string, as in a failed `service_response`.
    pub fn text(&self) -> Option<Cow<'a, str>> {
        match self.format {
            Format::Json => crate::json::unescape(std::str::from_utf8(self.bytes).ok()?),
            Format::Cbor => {
                let text = cbor::CborCursor::new(self.bytes).string(cbor::TEXT)?;
                std::str::from_utf8(text).ok().map(Cow::Borrowed)
            }
        }
    }

    /// Returns the length of a list; `None` if it is not a list.
    pub fn list_len(&self) -> Option<usize> {
        Some(self.items()?.len())
    }

    fn items(&self) -> Option<Vec<&'a [u8]>> {
        match self.format {
            Format::Json => {
                let text = std::str::from_utf8(self.bytes).ok()?;
                crate::json::JsonCursor::new(text).list()
            }
            Format::Cbor => cbor::CborCursor::new(self.bytes).list(),
        }
    }

    /// Converts a list of positional arguments to an object with these names, in the same format. Names without an
    /// argument are left out, as are arguments without a name. `None` if it is not a list, or has more than 23 named
    /// arguments.
    pub fn to_named_object<'n>(&self, names: impl IntoIterator<Item = &'n str>) -> Option<Vec<u8>> {
        let items = self.items()?;
        let mut out = Vec::with_capacity(self.bytes.len() + 16 * items.len());
        let mut writer = crate::Writer::new(&mut out, self.format);
        for (at, (name, bytes)) in names.into_iter().zip(items).enumerate() {
            if at == crate::writer::MAX_FIELDS {
                return None;
            }
            let format = self.format;
            writer.payload(name, Payload { format, bytes });
        }
        writer.end();
        Some(out)
    }

    /// Parses it as [`Raw`].
    pub fn raw(&self) -> Result<Raw<'a>, Error> {
        const EXPECTED: &str = "the ROS serialization as a byte string (base64 in JSON)";
        let fields = Fields::from_payload(*self)?;
        let value = fields.require("bytes", EXPECTED)?;
        let bytes = match self.format {
            Format::Cbor => cbor::CborCursor::new(value).string(cbor::BYTES).map(Cow::Borrowed),
            Format::Json => std::str::from_utf8(value)
                .ok()
                .and_then(crate::json::unescape)
                .and_then(|text| STANDARD.decode_to_vec(text.as_bytes()).ok())
                .map(Cow::Owned),
        };
        match bytes {
            Some(bytes) => Ok(Raw { bytes }),
            None => Err(Problem::Mistyped { field: "bytes", expected: EXPECTED, found: fields.describe(value) }.into()),
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn raw_messages_come_in_both_formats() {
        let cbor = b"\xa3\x64secs\x01\x65nsecs\x02\x65bytes\x43\x01\x02\x03";
        let raw = Payload::cbor(cbor).raw().unwrap();
        assert!(matches!(raw.bytes, Cow::Borrowed(_)));
        assert_eq!(*raw.bytes, [1, 2, 3]);
        assert_eq!(*Payload::json(r#"{"bytes":"AQID"}"#).raw().unwrap().bytes, [1, 2, 3]);
        let wrong = Payload::json(r#"{"bytes":[1,2]}"#).raw().unwrap_err();
        assert_eq!(
            wrong.to_string(),
            "field \"bytes\" is [1,2], the ROS serialization as a byte string (base64 in JSON) is expected"
        );
        assert!(Payload::json("{}").raw().unwrap_err().to_string().contains("\"bytes\" is missing"));
    }

    #[test]
    fn positional_arguments_get_their_names() {
        let named = Payload::json(r#"[1, "x", {"y":[2]}]"#).to_named_object(["a", "b", "c", "d"]).unwrap();
        assert_eq!(std::str::from_utf8(&named).unwrap(), r#"{"a":1,"b":"x","c":{"y":[2]}}"#);
        assert_eq!(Payload::json("[]").to_named_object(["a"]).unwrap(), b"{}");
        assert_eq!(Payload::json("[1,2]").to_named_object(["a"]).unwrap(), br#"{"a":1}"#);
        assert_eq!(Payload::json("[1,2]").list_len(), Some(2));
        assert_eq!(Payload::json("{}").list_len(), None);
        assert_eq!(Payload::json("{}").to_named_object(["a"]), None);
        assert_eq!(Payload::cbor(b"\x82\x01\x61x").to_named_object(["a", "b"]).unwrap(), b"\xa2\x61a\x01\x61b\x61x");
        assert_eq!(Payload::cbor(b"\x9f\x01\xff").to_named_object(["a", "b"]).unwrap(), b"\xa1\x61a\x01");
    }

    #[test]
    fn kinds_are_told_apart() {
        assert!(Payload::json("[1]").is_list() && Payload::cbor(b"\x81\x01").is_list());
        assert!(Payload::json("null").is_null() && Payload::cbor(b"\xf6").is_null());
        assert_eq!(Payload::json("\"no\"").text().unwrap(), "no");
        assert_eq!(Payload::cbor(b"\x62no").text().unwrap(), "no");
    }
}
