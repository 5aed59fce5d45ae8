//! Datagrams of RTPS as bytes, and what they say (8.3, 9.4): [`parse`] reads them, [`DatagramWriter`] writes them.
//!
//! A datagram is a header and submessages. Those that only tell about the ones after them (who sends, to whom, when) are
//! carried out here: what is given on is a [`Received`] for each of the others. Payloads are slices of the datagram.

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

pub(crate) use input::Input;
pub use liveliness::ParticipantMessage;
pub(crate) use parameters::{ParameterWriter, list, list_header, parameter, pid};
pub use read::parse;
pub use write::{DataFragHead, DatagramWriter};

use crate::time::WireTime;
use crate::{
    EntityId, FragmentNumber, FragmentSet, GuidPrefix, SampleIdentity, SequenceNumber, SequenceSet,
    VendorId,
};

/// What bytes are not what they should be.
#[derive(Debug, Clone, Copy, PartialEq, Eq, thiserror::Error)]
pub enum WireError {
    /// Another protocol, or a version of RTPS with another layout.
    #[error("it does not begin as a message of RTPS 2")]
    NotRtps,
    /// Something is longer than what holds it.
    #[error("it is cut short")]
    Short,
    /// A number of a sample that there cannot be.
    #[error("{0} is no number of a sample")]
    Number(i64),
    /// A set of numbers of more bits than there may be, or with an impossible base.
    #[error("it has a set of {0} bits, or with a base that there cannot be")]
    Set(u32),
    /// A fragment that is not of its sample.
    #[error(
        "fragments {first} and the {count} from it on are not of a sample of {sample} bytes in pieces of {size}"
    )]
    Fragments {
        /// The first one's number.
        first: FragmentNumber,
        /// How many they are.
        count: u16,
        /// How long one is, in bytes.
        size: u16,
        /// How long the sample is, in bytes.
        sample: u32,
    },
    /// Flags of a submessage that do not go together.
    #[error("it has flags {0:#04x}, which do not go together")]
    Flags(u8),
    /// More submessages in one datagram than are read.
    #[error("it has more than {MOST_SUBMESSAGES} submessages")]
    TooMany,
    /// A payload of discovery in another serialization.
    #[error("its serialization is {0:#06x}, not a list of parameters")]
    Serialization(u16),
    /// A parameter without which the rest must not be used, and which is not known.
    #[error("it has parameter {0:#06x}, which has to be understood and is not known")]
    NotUnderstood(u16),
    /// A parameter with a value that there cannot be.
    #[error("the value of its parameter {0:#06x} is not one")]
    Value(u16),
    /// A parameter that has to be there.
    #[error("its parameter {0:#06x} is missing")]
    Missing(u16),
}

/// More submessages of one datagram are not read. The most that peers send together are a few dozen.
pub const MOST_SUBMESSAGES: usize = 1024;

/// How long the header of a datagram is, in bytes.
pub const HEADER: usize = 20;

/// What was read of a datagram: all until its end or its first fault.
#[derive(Debug, Clone, Default, PartialEq, Eq)]
pub struct Parsed {
    /// In the order in which they stand there.
    pub received: Vec<Received>,
    /// Why the rest was not read (8.3.4.1); what came before it stands.
    pub fault: Option<WireError>,
}

/// A submessage, with what the submessages before it in the datagram said.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Received {
    /// Who sent it.
    pub from: GuidPrefix,
    /// Which implementation that is.
    pub vendor: VendorId,
    /// For whom it is; none where it is for everybody.
    pub to: Option<GuidPrefix>,
    /// When it was written, by its writer's clock.
    pub written: Option<WireTime>,
    /// What it says.
    pub submessage: Submessage,
}

/// What one end says to another (8.3.7).
#[derive(Debug, Clone, PartialEq, Eq)]
pub enum Submessage {
    /// A whole sample.
    Data(Data),
    /// A part of a sample.
    DataFrag(DataFrag),
    /// Which samples a writer has.
    Heartbeat(Heartbeat),
    /// Which parts of a sample a writer has.
    HeartbeatFrag(HeartbeatFrag),
    /// Which samples a reader has and which it misses.
    AckNack(AckNack),
    /// Which parts of a sample a reader misses.
    NackFrag(NackFrag),
    /// Which samples a reader need not wait for.
    Gap(Gap),
}

/// A whole sample, or that an instance is no more (8.3.7.2).
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Data {
    /// For which reader; UNKNOWN: all that match.
    pub reader: EntityId,
    /// Of which writer.
    pub writer: EntityId,
    /// Its number; at least 1.
    pub number: SequenceNumber,
    /// What it tells of itself.
    pub inline: InlineQos,
    /// CDR with its header of four bytes, then up to three bytes that are no part of it; none where it says only what
    /// `inline` does.
    pub payload: Option<Bytes>,
    /// The payload is not a sample but only its key.
    pub key_only: bool,
}

/// Consecutive fragments of a sample (8.3.7.3). They are what they say: `first` and `count` lie within the sample.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct DataFrag {
    /// For which reader; UNKNOWN: all that match.
    pub reader: EntityId,
    /// Of which writer.
    pub writer: EntityId,
    /// The sample's number; at least 1.
    pub number: SequenceNumber,
    /// What it tells of itself; not every fragment need have it.
    pub inline: InlineQos,
    /// The first fragment's number; at least 1.
    pub first: FragmentNumber,
    /// How many fragments; at least 1.
    pub count: u16,
    /// How long each is but the sample's last, in bytes; at least 1.
    pub fragment_size: u16,
    /// How long the whole sample is with the header of its CDR, in bytes. Nothing was reserved for it.
    pub sample_size: u32,
    /// Exactly these fragments' bytes: they begin at `(first - 1) * fragment_size` of the sample.
    pub payload: Bytes,
    /// The sample is only a key.
    pub key_only: bool,
}

impl DataFrag {
    /// Where the payload begins in its sample, in bytes.
    pub fn offset(&self) -> usize {
        // At most the length of the sample, as read; what is written is ours.
        (u64::from(self.first.saturating_sub(1)) * u64::from(self.fragment_size)) as usize
    }
}

/// Which samples a writer has (8.3.7.5).
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Heartbeat {
    /// For which reader; UNKNOWN: all that match.
    pub reader: EntityId,
    /// Of which writer.
    pub writer: EntityId,
    /// The first sample that it still has; at least 1.
    pub first: SequenceNumber,
    /// The last one; `first - 1` where it has none.
    pub last: SequenceNumber,
    /// Grows with every one; a reader passes over those that it has had.
    pub count: u32,
    /// It need not be answered.
    pub is_final: bool,
    /// The writer says that it is alive.
    pub liveliness: bool,
}

/// Which fragments of a sample a writer has (8.3.7.6).
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct HeartbeatFrag {
    /// For which reader; UNKNOWN: all that match.
    pub reader: EntityId,
    /// Of which writer.
    pub writer: EntityId,
    /// The sample's number; at least 1.
    pub number: SequenceNumber,
    /// It has all from 1 to this one; at least 1.
    pub last: FragmentNumber,
    /// Grows with every one.
    pub count: u32,
}

/// Which samples a reader has and which it misses (8.3.7.1).
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct AckNack {
    /// Whose it is.
    pub reader: EntityId,
    /// For which writer.
    pub writer: EntityId,
    /// All before the base have come; those in the set are asked for. Base 0 has a reader that has heard nothing yet.
    pub set: SequenceSet,
    /// Grows with every one.
    pub count: u32,
    /// It need not be answered with a heartbeat.
    pub is_final: bool,
}

/// Which fragments of a sample a reader misses (8.3.7.10).
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct NackFrag {
    /// Whose it is.
    pub reader: EntityId,
    /// For which writer.
    pub writer: EntityId,
    /// The sample's number; at least 1.
    pub number: SequenceNumber,
    /// Those that are asked for; the base is at least 1.
    pub set: FragmentSet,
    /// Grows with every one.
    pub count: u32,
}

/// Which samples a reader need not wait for (8.3.7.4): those from `start` up to the set's base, and those in the set.
/// From `start` to the base it may be any number of samples.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Gap {
    /// For which reader; UNKNOWN: all that match.
    pub reader: EntityId,
    /// Of which writer.
    pub writer: EntityId,
    /// The first one; at least 1.
    pub start: SequenceNumber,
    /// Further ones; its base, at least 1, is behind the last one of those from `start` on.
    pub set: SequenceSet,
}

/// What a sample tells of itself before its payload (9.6.4), as far as anybody here asks.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub struct InlineQos {
    /// The request that a reply answers, or by which a request wants to be answered.
    pub related: Option<SampleIdentity>,
    /// What has become of its instance: [`Self::DISPOSED`] and [`Self::UNREGISTERED`]; 0: it is alive.
    pub status: u32,
    /// Its instance. Of what tells of participants and ends, that is their GUID.
    pub key_hash: Option<[u8; 16]>,
}

impl InlineQos {
    /// The instance is no more.
    pub const DISPOSED: u32 = 1;
    /// The writer will write of the instance no more.
    pub const UNREGISTERED: u32 = 2;

    /// Whether it says that the instance is no more, or that nobody will write of it any more.
    pub fn is_gone(&self) -> bool {
        self.status & (Self::DISPOSED | Self::UNREGISTERED) != 0
    }
}
