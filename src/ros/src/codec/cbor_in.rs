//! Input → ROS bytes.
use crate::codec::FillOptions;
use crate::codec::fault::Fault;
use crate::schema::MessageType;
pub(crate) fn read(
    _: &MessageType,
    _: &[u8],
    _: &mut Vec<u8>,
    _: &FillOptions,
) -> Result<(), Fault> {
    Ok(())
}
