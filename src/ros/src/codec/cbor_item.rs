//! Where a CBOR item ends.
use crate::codec::CodecError;
/// Length of one CBOR item.
pub fn cbor_item_len(_: &[u8]) -> Result<usize, CodecError> {
    Ok(0)
}
