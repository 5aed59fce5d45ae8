//! How a participant says that it, or those of its writers that must be said to be, is alive (8.4.13, 9.6.3.1).

use bytes::Bytes;

use super::{Input, WireError};
use crate::GuidPrefix;

/// A sample of [`crate::EntityId::LIVELINESS_WRITER`], without its data of arbitrary use.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct ParticipantMessage {
    /// Whose it is.
    pub prefix: GuidPrefix,
    /// Which of its writers are alive; see [`Self::AUTOMATIC`].
    pub kind: [u8; 4],
}

/// CDR, big and little endian.
const CDR: [u16; 2] = [0x0000, 0x0001];

impl ParticipantMessage {
    /// Those of which nobody has to say it.
    pub const AUTOMATIC: [u8; 4] = [0, 0, 0, 1];
    /// Those of which their participant has to say it.
    pub const MANUAL: [u8; 4] = [0, 0, 0, 2];

    /// As the payload of a sample.
    pub fn to_bytes(&self) -> Bytes {
        let mut bytes = vec![0, 1, 0, 0];
        bytes.extend_from_slice(&self.prefix.0);
        bytes.extend_from_slice(&self.kind);
        bytes.extend_from_slice(&0u32.to_le_bytes());
        bytes.into()
    }

    /// Of the payload of a sample, in either byte order. What data is behind the kind is not looked at.
    pub fn from_payload(payload: &Bytes) -> Result<Self, WireError> {
        let mut input = Input::new(payload, false);
        let serialization = input.u16()?;
        if !CDR.contains(&serialization) {
            return Err(WireError::Serialization(serialization));
        }
        input.skip(2)?;
        Ok(Self {
            prefix: input.prefix()?,
            kind: input.array()?,
        })
    }
}
