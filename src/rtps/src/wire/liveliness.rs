//! Liveliness assertions of participants and writers (8.4.13, 9.6.3.1).

use bytes::Bytes;

use super::{WireError, WireReader};
use crate::GuidPrefix;

/// A sample of [`crate::EntityId::LIVELINESS_WRITER`], without its optional data.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct ParticipantMessage {
    /// Prefix of the participant.
    pub prefix: GuidPrefix,
    /// Kind of the assertion; see [`Self::AUTOMATIC`].
    pub kind: [u8; 4],
}

/// CDR, big- and little-endian.
const CDR: [u16; 2] = [0x0000, 0x0001];

impl ParticipantMessage {
    /// Asserts the writers with automatic liveliness.
    pub const AUTOMATIC: [u8; 4] = [0, 0, 0, 1];
    /// Asserts the writers with manual liveliness by participant.
    pub const MANUAL: [u8; 4] = [0, 0, 0, 2];

    /// Encodes the assertion as the payload of a sample.
    pub fn to_bytes(&self) -> Bytes {
        let mut bytes = vec![0, 1, 0, 0];
        bytes.extend_from_slice(&self.prefix.0);
        bytes.extend_from_slice(&self.kind);
        bytes.extend_from_slice(&0u32.to_le_bytes());
        bytes.into()
    }

    /// Decodes the payload of a sample in either byte order. Data after the kind is ignored.
    pub fn from_payload(payload: &Bytes) -> Result<Self, WireError> {
        let mut input = WireReader::new(payload, false);
        let serialization = input.u16()?;
        if !CDR.contains(&serialization) {
            return Err(WireError::Serialization(serialization));
        }
        input.skip(2)?;
        Ok(Self { prefix: input.prefix()?, kind: input.array()? })
    }
}
