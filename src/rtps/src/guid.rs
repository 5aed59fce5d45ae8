//! Identifiers of participants and endpoints (8.2.4, 9.3.1).

use std::fmt;

use crate::SequenceNumber;

/// Implementation of a participant (8.3.3.1.3).
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash, Default)]
pub struct VendorId(pub [u8; 2]);

impl VendorId {
    /// Fast DDS (eProsima).
    pub const FAST_DDS: Self = Self([1, 15]);
    /// Eclipse Cyclone DDS.
    pub const CYCLONE: Self = Self([1, 16]);
    /// RTI Connext.
    pub const CONNEXT: Self = Self([1, 1]);
    /// This implementation, which is not registered.
    pub const OURS: Self = Self([0xca, 0xfe]);
}

/// Identifies a participant: the first twelve bytes of the GUIDs of all its endpoints.
#[derive(Clone, Copy, PartialEq, Eq, Hash, PartialOrd, Ord, Default)]
pub struct GuidPrefix(pub [u8; 12]);

impl GuidPrefix {
    /// No particular participant.
    pub const UNKNOWN: Self = Self([0; 12]);

    /// Creates a unique prefix: two bytes of the vendor, as is the convention, and ten random ones.
    pub fn random() -> Self {
        let mut prefix = [0; 12];
        prefix[..2].copy_from_slice(&VendorId::OURS.0);
        rand::fill(&mut prefix[2..]);
        Self(prefix)
    }
}

/// Identifies an endpoint within a participant: three bytes of key, one of kind (9.3.1.2).
#[derive(Clone, Copy, PartialEq, Eq, Hash, PartialOrd, Ord, Default)]
pub struct EntityId(pub [u8; 4]);

impl EntityId {
    /// Any matching endpoint.
    pub const UNKNOWN: Self = Self([0, 0, 0, 0]);
    /// The participant itself.
    pub const PARTICIPANT: Self = Self([0, 0, 1, 0xc1]);
    /// Writer of participant announcements.
    pub const SPDP_WRITER: Self = Self([0, 1, 0, 0xc2]);
    /// Reader of participant announcements.
    pub const SPDP_READER: Self = Self([0, 1, 0, 0xc7]);
    /// Writer of announcements of writers.
    pub const PUBLICATIONS_WRITER: Self = Self([0, 0, 3, 0xc2]);
    /// Reader of announcements of writers.
    pub const PUBLICATIONS_READER: Self = Self([0, 0, 3, 0xc7]);
    /// Writer of announcements of readers.
    pub const SUBSCRIPTIONS_WRITER: Self = Self([0, 0, 4, 0xc2]);
    /// Reader of announcements of readers.
    pub const SUBSCRIPTIONS_READER: Self = Self([0, 0, 4, 0xc7]);
    /// Writer of liveliness assertions (8.4.13).
    pub const LIVELINESS_WRITER: Self = Self([0, 2, 0, 0xc2]);
    /// Reader of liveliness assertions.
    pub const LIVELINESS_READER: Self = Self([0, 2, 0, 0xc7]);

    /// Returns the id of a local writer of a topic without keys.
    pub(crate) fn user_writer(number: u32) -> Self {
        Self::user(number, 0x03)
    }

    /// Returns the id of a local reader of a topic without keys.
    pub(crate) fn user_reader(number: u32) -> Self {
        Self::user(number, 0x04)
    }

    fn user(number: u32, kind: u8) -> Self {
        let [_, a, b, c] = number.to_be_bytes();
        Self([a, b, c, kind])
    }

    /// Returns whether it is the id of a writer.
    pub fn is_writer(self) -> bool {
        matches!(self.0[3] & 0x3f, 0x02 | 0x03)
    }

    /// Returns whether it is the id of a built-in endpoint.
    pub fn is_builtin(self) -> bool {
        self.0[3] & 0xc0 == 0xc0
    }
}

/// Globally unique identifier of an endpoint.
#[derive(Clone, Copy, PartialEq, Eq, Hash, PartialOrd, Ord, Default)]
pub struct Guid {
    /// Prefix of its participant.
    pub prefix: GuidPrefix,
    /// Id within the participant.
    pub entity: EntityId,
}

impl Guid {
    /// Creates the GUID of an endpoint of a participant.
    pub fn new(prefix: GuidPrefix, entity: EntityId) -> Self {
        Self { prefix, entity }
    }

    /// Returns the sixteen bytes.
    pub fn bytes(self) -> [u8; 16] {
        let mut bytes = [0; 16];
        bytes[..12].copy_from_slice(&self.prefix.0);
        bytes[12..].copy_from_slice(&self.entity.0);
        bytes
    }

    /// Returns the GUID as a number, for use as a key.
    pub fn number(self) -> u128 {
        u128::from_be_bytes(self.bytes())
    }
}

impl From<[u8; 16]> for Guid {
    fn from(bytes: [u8; 16]) -> Self {
        let (mut prefix, mut entity) = ([0; 12], [0; 4]);
        prefix.copy_from_slice(&bytes[..12]);
        entity.copy_from_slice(&bytes[12..]);
        Self::new(GuidPrefix(prefix), EntityId(entity))
    }
}

/// Identity of a sample; a reply refers to its request by it (DDS-RPC 7.8.2).
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash)]
pub struct SampleIdentity {
    /// GUID of the writer.
    pub writer: Guid,
    /// Sequence number of the sample.
    pub number: SequenceNumber,
}

impl fmt::Debug for GuidPrefix {
    fn fmt(&self, formatter: &mut fmt::Formatter<'_>) -> fmt::Result {
        hexadecimal(&self.0, formatter)
    }
}

impl fmt::Debug for EntityId {
    fn fmt(&self, formatter: &mut fmt::Formatter<'_>) -> fmt::Result {
        hexadecimal(&self.0, formatter)
    }
}

impl fmt::Debug for Guid {
    fn fmt(&self, formatter: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(formatter, "{self}")
    }
}

/// Formats the GUID as DDS tools do: `01.0f.…|0.0.1.c1`.
impl fmt::Display for Guid {
    fn fmt(&self, formatter: &mut fmt::Formatter<'_>) -> fmt::Result {
        let prefix: Vec<String> = self.prefix.0.iter().map(|byte| format!("{byte:02x}")).collect();
        let [a, b, c, kind] = self.entity.0;
        write!(formatter, "{}|{a:x}.{b:x}.{c:x}.{kind:x}", prefix.join("."))
    }
}

fn hexadecimal(bytes: &[u8], formatter: &mut fmt::Formatter<'_>) -> fmt::Result {
    bytes.iter().try_for_each(|byte| write!(formatter, "{byte:02x}"))
}
