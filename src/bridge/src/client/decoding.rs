//! Conversion of clients' payloads to serialized messages.

use std::borrow::Cow;

use bytes::Bytes;
use ros::codec::{self, CodecError, FillOptions, Time};
use ros::schema::MessageType;
use rosbridge::{Compression, Format, Payload};

/// Raw messages shorter than this are copied: a slice would keep the whole read buffer alive.
const MIN_SLICE: usize = 16 * 1024;

/// Reasons why a payload is not a message of its type.
#[derive(Debug, thiserror::Error)]
pub(super) enum PayloadError {
    /// It does not have the form of a serialized message.
    #[error(transparent)]
    Raw(#[from] Box<rosbridge::Error>),
    #[error(transparent)]
    Message(#[from] Box<CodecError>),
    #[error("field \"args\" is missing, the ROS serialization is expected")]
    NoArgs,
    #[error("field \"args\" is a list of too many values; name them in an object")]
    TooManyArgs,
}

/// A payload as a serialized message.
pub(super) struct DecodedPayload {
    pub(super) bytes: Bytes,
    /// True if a header of ROS 2 came with a `seq`, which was dropped.
    pub(super) dropped_seq: bool,
}

/// Returns the ROS serialization in a payload, without a check of its content.
pub(super) fn read_raw(payload: Payload<'_>) -> Result<Cow<'_, [u8]>, PayloadError> {
    Ok(payload.raw().map_err(Box::new)?.bytes)
}

/// Converts a payload to a serialized message.
pub(super) fn decode(
    message_type: &MessageType,
    payload: Payload<'_>,
    compression: Compression,
    source: Option<&Bytes>,
) -> Result<DecodedPayload, PayloadError> {
    if compression == Compression::CborRaw {
        let raw = read_raw(payload)?;
        codec::validate(message_type, &raw).map_err(Box::new)?;
        let bytes = match (&raw, source) {
            (Cow::Borrowed(slice), Some(source)) if slice.len() >= MIN_SLICE => source.slice_ref(slice),
            _ => Bytes::from(raw.into_owned()),
        };
        return Ok(DecodedPayload { bytes, dropped_seq: false });
    }
    let options = FillOptions { now: Some(Time::now()), ..FillOptions::default() };
    // Base64 shrinks by a quarter; everything else of relevance by more.
    let mut out = Vec::with_capacity(payload.bytes.len() / 4 * 3 + 64);
    let decoded = match payload.format {
        Format::Json => codec::from_json(message_type, payload.bytes, &mut out, &options),
        Format::Cbor => codec::from_cbor(message_type, payload.bytes, &mut out, &options),
    };
    let report = decoded.map_err(Box::new)?;
    Ok(DecodedPayload { bytes: Bytes::from(out), dropped_seq: report.dropped_seq })
}

/// Converts the arguments of a service or goal, an object or a list, to a serialized message; without arguments all
/// fields have defaults, and surplus values of a list are dropped.
pub(super) fn decode_args(
    message_type: &MessageType,
    args: Option<Payload<'_>>,
    compression: Compression,
) -> Result<DecodedPayload, PayloadError> {
    match args {
        None if compression == Compression::CborRaw && !message_type.fields().is_empty() => Err(PayloadError::NoArgs),
        None => decode(message_type, Payload::json("{}"), Compression::None, None),
        Some(list) if list.is_list() && compression != Compression::CborRaw => {
            let fields = message_type.fields();
            let named = list
                .to_named_object(fields.iter().map(|field| field.name.as_str()))
                .ok_or(PayloadError::TooManyArgs)?;
            decode(message_type, Payload { format: list.format, bytes: &named }, compression, None)
        }
        Some(args) => decode(message_type, args, compression, None),
    }
}
