//! Where a JSON value ends.
use crate::codec::CodecError;
/// Length of one JSON value.
pub fn json_value_len(_: &[u8]) -> Result<usize, CodecError> {
    Ok(0)
}
