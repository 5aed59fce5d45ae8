//! Reads.
use crate::codec::fault::Fault;
use crate::schema::MessageType;
pub(crate) fn validate(_: &MessageType, _: &[u8]) -> Result<(), Fault> {
    Ok(())
}
