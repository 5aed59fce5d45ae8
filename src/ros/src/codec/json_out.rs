//! ROS bytes → JSON.
use crate::codec::JsonOptions;
use crate::codec::fault::Fault;
use crate::schema::MessageType;
pub(crate) fn write(
    _: &MessageType,
    _: &[u8],
    _: &mut Vec<u8>,
    _: &JsonOptions,
) -> Result<(), Fault> {
    Ok(())
}
