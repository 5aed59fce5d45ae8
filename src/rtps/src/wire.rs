//! Wire format of RTPS messages (8.3, 9.4): [`parse`] reads them, [`DatagramWriter`] writes them.
//!
//! A datagram consists of a header and submessages. Submessages that only provide context for the following ones
//! (sender, destination, time) are interpreted here; each of the others results in a [`ReceivedSubmessage`]. Payloads
//! are slices of the datagram.

#![forbid(unsafe_code)]

#[cfg(test)]
mod captured;
mod input;
mod kind;
mod liveliness;
mod parameters;
#[cfg(test)]
pub(crate) mod properties;
mod read;
#[cfg(test)]
pub(crate) mod tests;
mod write;

use bytes::Bytes;

pub(crate) use input::WireReader;
pub use liveliness::ParticipantMessage;
pub(crate) use parameters::{ParameterWriter, list_header, next_parameter, parameter_list, pid};
pub use read::parse;
pub use write::{DataFragHead, DatagramWriter};

use crate::time::WireTime;
use crate::{EntityId, FragmentNumber, FragmentSet, GuidPrefix, SampleIdentity, SequenceNumber, SequenceSet, VendorId};

/// Errors in the wire format.
#[derive(Debug, Clone, Copy, PartialEq, Eq, thiserror::Error)]
pub enum WireError {
    /// Another protocol, or an RTPS version with another format.
    #[error("it does not begin like an RTPS 2 message")]
    NotRtps,
    /// Truncated data.
    #[error("it is truncated")]
    Short,
    /// Invalid sequence number.
    #[error("{0} is not a sequence number")]
    Number(i64),
    /// A set with too many bits or an invalid base.
    #[error("it has a set of {0} bits, or with an impossible base")]
    Set(u32),
    /// A fragment that does not belong to its sample.
    #[error("fragments {first} and the {count} from it on are not of a sample of {sample} bytes in pieces of {size}")]
    Fragments {
        /// Number of the first fragment.
        first: FragmentNumber,
        /// Number of fragments.
        count: u16,
        /// Fragment size in bytes.
        size: u16,
        /// Sample size in bytes.
        sample: u32,
    },
    /// Contradictory flags of a submessage.
    #[error("it has flags {0:#04x}, which contradict each other")]
    Flags(u8),
    /// Too many submessages in one datagram.
    #[error("it has more than {MOST_SUBMESSAGES} submessages")]
    TooMany,
    /// A discovery payload with an unsupported serialization.
    #[error("its serialization is {0:#06x}, not a list of parameters")]
    Serialization(u16),
    /// An unknown parameter that must be understood for the rest to be used.
    #[error("it has parameter {0:#06x}, which must be understood but is unknown")]
    NotUnderstood(u16),
    /// A parameter with an invalid value.
    #[error("the value of its parameter {0:#06x} is invalid")]
    Value(u16),
    /// A required parameter is missing.
    #[error("its parameter {0:#06x} is missing")]
    Missing(u16),
}

/// Maximum number of submessages read from a datagram. Peers send at most a few dozen together.
pub const MOST_SUBMESSAGES: usize = 1024;

/// Length of the header of a datagram in bytes.
pub const HEADER: usize = 20;

/// The submessages of a datagram up to its end or first error.
#[derive(Debug, Clone, Default, PartialEq, Eq)]
pub struct Parsed {
    /// Submessages in the order of the datagram.
    pub received: Vec<ReceivedSubmessage>,
    /// Why the rest was not read (8.3.4.1); the submessages before it are valid.
    pub fault: Option<WireError>,
}

/// A submessage with the context given by preceding submessages.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct ReceivedSubmessage {
    /// GUID prefix of the sender.
    pub from: GuidPrefix,
    /// Implementation of the sender.
    pub vendor: VendorId,
    /// Destination participant; `None`: any.
    pub to: Option<GuidPrefix>,
    /// Source timestamp, on the writer's clock.
    pub written: Option<WireTime>,
    /// The submessage.
    pub submessage: Submessage,
}

/// A submessage exchanged between endpoints (8.3.7).
#[derive(Debug, Clone, PartialEq, Eq)]
pub enum Submessage {
    /// A complete sample.
    Data(Data),
    /// Fragments of a sample.
    DataFrag(DataFrag),
    /// The samples that a writer has.
    Heartbeat(Heartbeat),
    /// The fragments of a sample that a writer has.
    HeartbeatFrag(HeartbeatFrag),
    /// The samples that a reader has received and misses.
    AckNack(AckNack),
    /// The fragments of a sample that a reader misses.
    NackFrag(NackFrag),
    /// Samples that a reader need not wait for.
    Gap(Gap),
}

/// A complete sample, or the disposal of an instance (8.3.7.2).
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Data {
    /// Destination reader; UNKNOWN: all matched readers.
    pub reader: EntityId,
    /// Sending writer.
    pub writer: EntityId,
    /// Sequence number, at least 1.
    pub number: SequenceNumber,
    /// Inline QoS.
    pub inline: InlineQos,
    /// CDR with its header of four bytes, followed by up to three bytes of padding; `None` if the submessage contains
    /// only `inline`.
    pub payload: Option<Bytes>,
    /// The payload is only a key.
    pub key_only: bool,
}

/// Consecutive fragments of a sample (8.3.7.3). They are valid: `first` and `count` lie within the sample.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct DataFrag {
    /// Destination reader; UNKNOWN: all matched readers.
    pub reader: EntityId,
    /// Sending writer.
    pub writer: EntityId,
    /// Sequence number of the sample, at least 1.
    pub number: SequenceNumber,
    /// Inline QoS; not every fragment has it.
    pub inline: InlineQos,
    /// Number of the first fragment, at least 1.
    pub first: FragmentNumber,
    /// Number of fragments, at least 1.
    pub count: u16,
    /// Size of each fragment except the last of the sample in bytes, at least 1.
    pub fragment_size: u16,
    /// Size of the complete sample including its CDR header in bytes. No memory was allocated for it.
    pub sample_size: u32,
    /// Exactly the bytes of these fragments, which start at `(first - 1) * fragment_size` of the sample.
    pub payload: Bytes,
    /// The sample is only a key.
    pub key_only: bool,
}

impl DataFrag {
    /// Returns the offset of the payload in its sample in bytes.
    pub fn offset(&self) -> usize {
        // At most the size of the sample if received; otherwise written by us.
        (u64::from(self.first.saturating_sub(1)) * u64::from(self.fragment_size)) as usize
    }
}

/// The samples that a writer has (8.3.7.5).
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Heartbeat {
    /// Destination reader; UNKNOWN: all matched readers.
    pub reader: EntityId,
    /// Sending writer.
    pub writer: EntityId,
    /// First available sample, at least 1.
    pub first: SequenceNumber,
    /// Last available sample; `first - 1` if there is none.
    pub last: SequenceNumber,
    /// Increases with each heartbeat; a reader ignores those that it has already received.
    pub count: u32,
    /// No response is required.
    pub is_final: bool,
    /// The writer asserts its liveliness.
    pub liveliness: bool,
}

/// The fragments of a sample that a writer has (8.3.7.6).
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct HeartbeatFrag {
    /// Destination reader; UNKNOWN: all matched readers.
    pub reader: EntityId,
    /// Sending writer.
    pub writer: EntityId,
    /// Sequence number of the sample, at least 1.
    pub number: SequenceNumber,
    /// Last available fragment, at least 1; all earlier ones are available.
    pub last: FragmentNumber,
    /// Increases with each submessage of this kind.
    pub count: u32,
}

/// The samples that a reader has received and misses (8.3.7.1).
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct AckNack {
    /// Sending reader.
    pub reader: EntityId,
    /// Destination writer.
    pub writer: EntityId,
    /// All numbers before the base have been received; those in the set are requested. A reader that has received
    /// nothing yet sends a base of 0.
    pub set: SequenceSet,
    /// Increases with each submessage of this kind.
    pub count: u32,
    /// No heartbeat is required in response.
    pub is_final: bool,
}

/// The fragments of a sample that a reader misses (8.3.7.10).
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct NackFrag {
    /// Sending reader.
    pub reader: EntityId,
    /// Destination writer.
    pub writer: EntityId,
    /// Sequence number of the sample, at least 1.
    pub number: SequenceNumber,
    /// Requested fragments; the base is at least 1.
    pub set: FragmentSet,
    /// Increases with each submessage of this kind.
    pub count: u32,
}

/// Samples that a reader need not wait for (8.3.7.4): those from `start` up to the base of the set, which may be any
/// number of samples, and those in the set.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Gap {
    /// Destination reader; UNKNOWN: all matched readers.
    pub reader: EntityId,
    /// Sending writer.
    pub writer: EntityId,
    /// First number, at least 1.
    pub start: SequenceNumber,
    /// Further numbers; the base, at least 1, follows the last number of the range from `start`.
    pub set: SequenceSet,
}

/// Inline QoS of a sample (9.6.4), as far as it is used here.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub struct InlineQos {
    /// The request that a reply answers, or the identity with which a request wants to be answered.
    pub related: Option<SampleIdentity>,
    /// Status of the instance: [`Self::DISPOSED`] and [`Self::UNREGISTERED`]; 0: alive.
    pub status: u32,
    /// Key hash of the instance. For discovery samples it is the GUID of the participant or endpoint.
    pub key_hash: Option<[u8; 16]>,
}

impl InlineQos {
    /// The instance was disposed of.
    pub const DISPOSED: u32 = 1;
    /// The writer will not write the instance any more.
    pub const UNREGISTERED: u32 = 2;

    /// Returns whether the instance was disposed of or unregistered.
    pub fn is_gone(&self) -> bool {
        self.status & (Self::DISPOSED | Self::UNREGISTERED) != 0
    }
}
