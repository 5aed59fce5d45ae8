//! Parameter lists (9.4.2.11), used for inline QoS and discovery data.

use std::time::Duration;

use bytes::Bytes;

use super::{WireError, WireReader};
use crate::locator::Locator;
use crate::time::WireDuration;
use crate::{Guid, SampleIdentity};

/// Parameter ids (9.6.3.2, 9.6.4), without the bit [`pid::MUST_BE_UNDERSTOOD`].
pub(crate) mod pid {
    pub const PAD: u16 = 0x0000;
    pub const SENTINEL: u16 = 0x0001;
    pub const PARTICIPANT_LEASE_DURATION: u16 = 0x0002;
    pub const TOPIC_NAME: u16 = 0x0005;
    pub const TYPE_NAME: u16 = 0x0007;
    pub const DOMAIN_ID: u16 = 0x000f;
    pub const DOMAIN_TAG: u16 = 0x0014;
    pub const PROTOCOL_VERSION: u16 = 0x0015;
    pub const VENDOR_ID: u16 = 0x0016;
    pub const RELIABILITY: u16 = 0x001a;
    pub const LIVELINESS: u16 = 0x001b;
    pub const DURABILITY: u16 = 0x001d;
    pub const DEADLINE: u16 = 0x0023;
    pub const LIFESPAN: u16 = 0x002b;
    pub const USER_DATA: u16 = 0x002c;
    pub const UNICAST_LOCATOR: u16 = 0x002f;
    pub const DEFAULT_UNICAST_LOCATOR: u16 = 0x0031;
    pub const METATRAFFIC_UNICAST_LOCATOR: u16 = 0x0032;
    pub const HISTORY: u16 = 0x0040;
    pub const EXPECTS_INLINE_QOS: u16 = 0x0043;
    pub const PARTICIPANT_GUID: u16 = 0x0050;
    pub const BUILTIN_ENDPOINT_SET: u16 = 0x0058;
    pub const PROPERTY_LIST: u16 = 0x0059;
    pub const ENDPOINT_GUID: u16 = 0x005a;
    pub const ENTITY_NAME: u16 = 0x0062;
    pub const KEY_HASH: u16 = 0x0070;
    pub const STATUS_INFO: u16 = 0x0071;
    /// DDS-XTypes 1.3 (7.6.3.1.1).
    pub const DATA_REPRESENTATION: u16 = 0x0073;
    /// As specified by DDS-RPC 1.0 (7.8.2).
    pub const RELATED_SAMPLE_IDENTITY: u16 = 0x0083;
    /// As used by Fast DDS before the standard; current versions write both and read either.
    pub const FAST_DDS_RELATED_SAMPLE_IDENTITY: u16 = 0x800f;

    /// Flag of a parameter that must not be ignored if it is unknown (9.6.3.2).
    pub const MUST_BE_UNDERSTOOD: u16 = 0x4000;
}

/// Serialization ids of parameter lists (10.2.1.2), big- and little-endian.
const PL_CDR: [u16; 2] = [0x0002, 0x0003];

/// Returns the parameter list in a payload.
pub(crate) fn parameter_list(payload: &Bytes) -> Result<WireReader<'_>, WireError> {
    let mut input = WireReader::new(payload, false);
    let serialization = input.u16()?;
    if !PL_CDR.contains(&serialization) {
        return Err(WireError::Serialization(serialization));
    }
    input.skip(2)?;
    input.little = serialization == PL_CDR[1];
    Ok(input)
}

/// Creates a payload with the header of a parameter list.
pub(crate) fn list_header() -> Vec<u8> {
    let mut bytes = Vec::with_capacity(512);
    bytes.extend_from_slice(&[0, 3, 0, 0]);
    bytes
}

/// Reads the next parameter: its id without the flag, and its value of at most 65,535 bytes. Returns `None` at the
/// sentinel, which is required. Parameters that are not in `known` are skipped, or an error if they must be understood.
pub(crate) fn next_parameter<'a>(
    input: &mut WireReader<'a>,
    known: &[u16],
) -> Result<Option<(u16, WireReader<'a>)>, WireError> {
    loop {
        let (number, length) = (input.u16()?, input.u16()?);
        if number == pid::SENTINEL {
            return Ok(None);
        }
        let value = input.split_to(usize::from(length))?;
        let plain = number & !pid::MUST_BE_UNDERSTOOD;
        if known.contains(&plain) {
            return Ok(Some((plain, value)));
        }
        if number & pid::MUST_BE_UNDERSTOOD != 0 {
            return Err(WireError::NotUnderstood(number));
        }
    }
}

/// Writes a parameter list, little-endian.
pub(crate) struct ParameterWriter<'a> {
    bytes: &'a mut Vec<u8>,
}

impl<'a> ParameterWriter<'a> {
    /// Creates a writer that appends to these bytes.
    pub fn new(bytes: &'a mut Vec<u8>) -> Self {
        Self { bytes }
    }

    /// Writes a value padded with zeros to a multiple of four bytes. A value that is too long for a parameter (65,532
    /// bytes) is omitted.
    pub fn raw(&mut self, number: u16, value: &[u8]) -> &mut Self {
        let padded = value.len().next_multiple_of(4);
        if let Ok(length) = u16::try_from(padded) {
            self.bytes.extend_from_slice(&number.to_le_bytes());
            self.bytes.extend_from_slice(&length.to_le_bytes());
            self.bytes.extend_from_slice(value);
            self.bytes.resize(self.bytes.len() + (padded - value.len()), 0);
        }
        self
    }

    pub fn u32(&mut self, number: u16, value: u32) -> &mut Self {
        self.raw(number, &value.to_le_bytes())
    }

    pub fn guid(&mut self, number: u16, guid: Guid) -> &mut Self {
        self.raw(number, &guid.bytes())
    }

    /// Writes a duration; `None`: infinite.
    pub fn duration(&mut self, number: u16, duration: Option<Duration>) -> &mut Self {
        self.raw(number, &duration_bytes(duration))
    }

    pub fn pair(&mut self, number: u16, first: u32, second: u32) -> &mut Self {
        let mut value = [0; 8];
        value[..4].copy_from_slice(&first.to_le_bytes());
        value[4..].copy_from_slice(&second.to_le_bytes());
        self.raw(number, &value)
    }

    /// Writes a policy that consists of a kind and a duration.
    pub fn kind_and_duration(&mut self, number: u16, kind: u32, duration: Option<Duration>) -> &mut Self {
        let mut value = [0; 12];
        value[..4].copy_from_slice(&kind.to_le_bytes());
        value[4..].copy_from_slice(&duration_bytes(duration));
        self.raw(number, &value)
    }

    /// Writes a CDR string: its length including the terminating zero, its bytes, and the zero.
    pub fn string(&mut self, number: u16, text: &str) -> &mut Self {
        // A value longer than a u16 allows is omitted by `raw`.
        let mut value = (text.len() as u32).saturating_add(1).to_le_bytes().to_vec();
        value.extend_from_slice(text.as_bytes());
        value.push(0);
        self.raw(number, &value)
    }

    /// Writes a CDR sequence of bytes.
    pub fn byte_sequence(&mut self, number: u16, bytes: &[u8]) -> &mut Self {
        let mut value = (bytes.len() as u32).to_le_bytes().to_vec();
        value.extend_from_slice(bytes);
        self.raw(number, &value)
    }

    /// Writes properties (DDS-Security 1.1, 7.2.1): a CDR sequence of pairs of strings.
    pub fn properties(&mut self, number: u16, properties: &[(&str, &str)]) -> &mut Self {
        let mut value = (properties.len() as u32).to_le_bytes().to_vec();
        for text in properties.iter().flat_map(|(name, value)| [name, value]) {
            value.extend_from_slice(&(text.len() as u32 + 1).to_le_bytes());
            value.extend_from_slice(text.as_bytes());
            value.push(0);
            value.resize(value.len().next_multiple_of(4), 0);
        }
        self.raw(number, &value)
    }

    pub fn locator(&mut self, number: u16, locator: &Locator) -> &mut Self {
        let mut value = [0; 24];
        value[..4].copy_from_slice(&locator.kind.to_le_bytes());
        value[4..8].copy_from_slice(&locator.port.to_le_bytes());
        value[8..].copy_from_slice(&locator.address);
        self.raw(number, &value)
    }

    pub fn identity(&mut self, number: u16, identity: &SampleIdentity) -> &mut Self {
        let mut value = [0; 24];
        value[..16].copy_from_slice(&identity.writer.bytes());
        value[16..].copy_from_slice(&super::write::number_bytes(identity.number));
        self.raw(number, &value)
    }

    /// Writes the sentinel.
    pub fn end(&mut self) {
        self.bytes.extend_from_slice(&[1, 0, 0, 0]);
    }
}

fn duration_bytes(duration: Option<Duration>) -> [u8; 8] {
    let duration = duration.map_or(WireDuration::INFINITE, WireDuration::from);
    let mut bytes = [0; 8];
    bytes[..4].copy_from_slice(&duration.seconds.to_le_bytes());
    bytes[4..].copy_from_slice(&duration.fraction.to_le_bytes());
    bytes
}

impl<'a> WireReader<'a> {
    pub fn locator(&mut self) -> Result<Locator, WireError> {
        Ok(Locator { kind: self.i32()?, port: self.u32()?, address: self.array()? })
    }

    /// Reads a CDR string without its terminating zero, which some implementations omit.
    pub fn string(&mut self) -> Result<&'a [u8], WireError> {
        let bytes = self.byte_sequence()?;
        Ok(bytes.strip_suffix(&[0]).unwrap_or(bytes))
    }

    /// Reads a CDR string in UTF-8, the value of parameter `number`.
    pub fn text(&mut self, number: u16) -> Result<&'a str, WireError> {
        std::str::from_utf8(self.string()?).map_err(|_| WireError::Value(number))
    }
}
