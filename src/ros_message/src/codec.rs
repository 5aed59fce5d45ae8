//! Conversion between serialized messages of either ROS version and JSON or CBOR, in one pass from input bytes to
//! output buffer.
//!
//! Each [`MessageType`] carries a plan compiled when it was resolved: the literals between values are already written
//! out, nested messages are flattened, and arrays of numbers are copied as blocks. No tree of values is built.
//!
//! ```text
//! ROS bytes ── SerializedReader: ROS 1 │ CDR ── walk (plan) ──▶ OutputFormat: json_out │ cbor_out │ validate
//! JSON, CBOR ─ ValueInput: json_in │ cbor_in ──▶ fill (order, defaults, stamps) ── OutputLayout: ROS 1 │ CDR
//!                                                                              ──▶ ROS bytes
//! ```
//!
//! The serialization follows from the type ([`MessageType::version`]): a message of ROS 2 begins with an encapsulation
//! header, may have either byte order, and is written little endian.
//!
//! Values follow rosbridge: bytes (`uint8[]`, `char[]`, ROS 2's `byte[]`) are base64 in JSON and a byte string in CBOR;
//! times are `{"secs", "nsecs"}` in ROS 1 and `{"sec", "nanosec"}` in ROS 2 (both are accepted as input, and so is
//! `seq` in a ROS 2 header, which is dropped); other numeric arrays are lists in JSON and RFC 8746 typed arrays in
//! CBOR.
//!
//! On an error the output buffer is left unchanged.

mod cbor_in;
mod cbor_item;
mod cbor_out;
mod cdr;
pub mod cursor;
mod digits;
pub mod embedded;
mod fault;
mod fill;
mod float;
mod json_in;
mod json_out;
mod json_text;
mod number;
mod options;
pub mod put;
mod reader;
mod realign;
mod stamps;
mod typed_array;
mod value;
mod walk;

#[cfg(test)]
mod tests;

use crate::RosVersion;
use crate::schema::MessageType;

pub use cbor_item::cbor_item_len;
pub use fault::{CodecError, CodecErrorKind, Fault};
pub use json_text::json_value_len;
pub use options::{CborOptions, DEFAULT_MAX_BYTES, FillOptions, FillReport, InvalidUtf8, JsonOptions, NonFinite, Time};
pub use stamps::Stamps;
pub use value::Value;

/// Appends the message as a JSON object.
pub fn to_json(
    message: &MessageType,
    bytes: &[u8],
    out: &mut Vec<u8>,
    options: &JsonOptions,
) -> Result<(), CodecError> {
    undo_on_error(message, out, |out| json_out::write(message, bytes, out, options))
}

/// Appends the serialized message that a JSON object describes. `json` must be exactly that object.
pub fn from_json(
    message: &MessageType,
    json: &[u8],
    out: &mut Vec<u8>,
    options: &FillOptions,
) -> Result<FillReport, CodecError> {
    undo_on_error(message, out, |out| json_in::read(message, json, out, options))
}

/// Appends the message as a CBOR map.
pub fn to_cbor(
    message: &MessageType,
    bytes: &[u8],
    out: &mut Vec<u8>,
    options: &CborOptions,
) -> Result<(), CodecError> {
    undo_on_error(message, out, |out| cbor_out::write(message, bytes, out, options))
}

/// Appends the serialized message that a CBOR map describes. `cbor` must be exactly that map.
pub fn from_cbor(
    message: &MessageType,
    cbor: &[u8],
    out: &mut Vec<u8>,
    options: &FillOptions,
) -> Result<FillReport, CodecError> {
    undo_on_error(message, out, |out| cbor_in::read(message, cbor, out, options))
}

/// Checks that the bytes are exactly one message of this type.
pub fn validate(message: &MessageType, bytes: &[u8]) -> Result<(), CodecError> {
    walk::validate(message, bytes).map_err(|fault| fault.into_codec_error(message.name()))
}

/// Returns the default message, serialized: zeros, empty strings and arrays, or the default values of a ROS 2
/// definition.
pub fn default_message(message: &MessageType) -> Vec<u8> {
    let mut out = Vec::new();
    let unlimited = FillOptions { now: None, max_bytes: usize::MAX };
    // An object without fields is a valid message of any type, so this cannot fail.
    match from_json(message, b"{}", &mut out, &unlimited) {
        Ok(_) => out,
        Err(_) => Vec::new(),
    }
}

/// Returns the default message as JSON.
pub fn default_json(message: &MessageType) -> String {
    let mut out = Vec::new();
    let unlimited = JsonOptions { max_bytes: usize::MAX, ..JsonOptions::default() };
    match to_json(message, &default_message(message), &mut out, &unlimited) {
        Ok(()) => String::from_utf8(out).unwrap_or_default(),
        Err(_) => "{}".to_owned(),
    }
}

/// Returns the stamp of a message whose first field is a `std_msgs/Header`.
pub fn header_stamp(message: &MessageType, bytes: &[u8]) -> Option<Time> {
    if !message.has_header() {
        return None;
    }
    // In ROS 2 the second byte gives the byte order of the rest.
    let big_endian = message.version() == RosVersion::Two && bytes.get(1) == Some(&0);
    let word = |at: usize| {
        let word = bytes.get(at..at + 4)?.try_into().ok()?;
        Some(if big_endian { u32::from_be_bytes(word) } else { u32::from_le_bytes(word) })
    };
    Some(Time { secs: word(4)?, nsecs: word(8)? })
}

fn undo_on_error<T>(
    message: &MessageType,
    out: &mut Vec<u8>,
    convert: impl FnOnce(&mut Vec<u8>) -> Result<T, Fault>,
) -> Result<T, CodecError> {
    let before = out.len();
    convert(out).map_err(|fault| {
        out.truncate(before);
        fault.into_codec_error(message.name())
    })
}
