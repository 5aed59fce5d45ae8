//! Lists of parameters (9.4.2.11): of inline QoS, and of the payloads by which ends are discovered.

use std::time::Duration;

use bytes::Bytes;

use super::{Input, WireError};
use crate::locator::Locator;
use crate::time::WireDuration;
use crate::{Guid, SampleIdentity};

/// Numbers of parameters (9.6.3.2, 9.6.4), without the bit [`pid::MUST_BE_UNDERSTOOD`].
pub(crate) mod pid {
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
    /// As DDS-RPC 1.0 has it (7.8.2).
    pub const RELATED_SAMPLE_IDENTITY: u16 = 0x0083;
    /// As Fast DDS had it before the standard; its versions of today write both and read either.
    pub const FAST_DDS_RELATED_SAMPLE_IDENTITY: u16 = 0x800f;

    /// The bit of a parameter that whoever does not know it must not pass over (9.6.3.2).
    pub const MUST_BE_UNDERSTOOD: u16 = 0x4000;
}

/// How payloads that are lists of parameters begin (10.2.1.2): big and little endian.
const PL_CDR: [u16; 2] = [0x0002, 0x0003];

/// The list that is such a payload.
pub(crate) fn list(payload: &Bytes) -> Result<Input<'_>, WireError> {
    let mut input = Input::new(payload, false);
    let serialization = input.u16()?;
    if !PL_CDR.contains(&serialization) {
        return Err(WireError::Serialization(serialization));
    }
    input.skip(2)?;
    input.little = serialization == PL_CDR[1];
    Ok(input)
}

/// What a payload of ours that is a list of parameters begins with.
pub(crate) fn list_header() -> Vec<u8> {
    let mut bytes = Vec::with_capacity(512);
    bytes.extend_from_slice(&[0, 3, 0, 0]);
    bytes
}

/// The next parameter: its number without the bit, and its value, which is at most 65,535 bytes long. None at the end of the
/// list, which must be there. Those that are not in `known` are passed over, or an error where they must not be.
pub(crate) fn parameter<'a>(
    input: &mut Input<'a>,
    known: &[u16],
) -> Result<Option<(u16, Input<'a>)>, WireError> {
    loop {
        let (number, length) = (input.u16()?, input.u16()?);
        if number == pid::SENTINEL {
            return Ok(None);
        }
        let value = input.part(usize::from(length))?;
        let plain = number & !pid::MUST_BE_UNDERSTOOD;
        if known.contains(&plain) {
            return Ok(Some((plain, value)));
        }
        if number & pid::MUST_BE_UNDERSTOOD != 0 {
            return Err(WireError::NotUnderstood(number));
        }
    }
}

/// Writes a list of parameters, little endian.
pub(crate) struct ParameterWriter<'a> {
    bytes: &'a mut Vec<u8>,
}

impl<'a> ParameterWriter<'a> {
    /// At the end of these.
    pub fn new(bytes: &'a mut Vec<u8>) -> Self {
        Self { bytes }
    }

    /// A value as it is; filled up with zeros to a multiple of four bytes. One that is too long for a parameter (65,532 bytes)
    /// is left out.
    pub fn raw(&mut self, number: u16, value: &[u8]) -> &mut Self {
        let padded = value.len().next_multiple_of(4);
        if let Ok(length) = u16::try_from(padded) {
            self.bytes.extend_from_slice(&number.to_le_bytes());
            self.bytes.extend_from_slice(&length.to_le_bytes());
            self.bytes.extend_from_slice(value);
            self.bytes
                .resize(self.bytes.len() + (padded - value.len()), 0);
        }
        self
    }

    pub fn u32(&mut self, number: u16, value: u32) -> &mut Self {
        self.raw(number, &value.to_le_bytes())
    }

    pub fn guid(&mut self, number: u16, guid: Guid) -> &mut Self {
        self.raw(number, &guid.bytes())
    }

    /// None: without end.
    pub fn duration(&mut self, number: u16, duration: Option<Duration>) -> &mut Self {
        self.raw(number, &duration_bytes(duration))
    }

    pub fn pair(&mut self, number: u16, first: u32, second: u32) -> &mut Self {
        let mut value = [0; 8];
        value[..4].copy_from_slice(&first.to_le_bytes());
        value[4..].copy_from_slice(&second.to_le_bytes());
        self.raw(number, &value)
    }

    /// A policy that is a kind and a duration.
    pub fn kind_and_duration(
        &mut self,
        number: u16,
        kind: u32,
        duration: Option<Duration>,
    ) -> &mut Self {
        let mut value = [0; 12];
        value[..4].copy_from_slice(&kind.to_le_bytes());
        value[4..].copy_from_slice(&duration_bytes(duration));
        self.raw(number, &value)
    }

    /// A string of CDR: its length with the zero at its end, its bytes, the zero.
    pub fn string(&mut self, number: u16, text: &str) -> &mut Self {
        // What is longer than a u16 says is left out by `raw`.
        let mut value = (text.len() as u32).saturating_add(1).to_le_bytes().to_vec();
        value.extend_from_slice(text.as_bytes());
        value.push(0);
        self.raw(number, &value)
    }

    /// A sequence of bytes of CDR.
    pub fn counted(&mut self, number: u16, bytes: &[u8]) -> &mut Self {
        let mut value = (bytes.len() as u32).to_le_bytes().to_vec();
        value.extend_from_slice(bytes);
        self.raw(number, &value)
    }

    /// Names and their values (DDS-Security 1.1, 7.2.1): a sequence of pairs of strings of CDR.
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

    /// The end of the list.
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

impl<'a> Input<'a> {
    pub fn locator(&mut self) -> Result<Locator, WireError> {
        Ok(Locator {
            kind: self.i32()?,
            port: self.u32()?,
            address: self.array()?,
        })
    }

    /// The bytes of a string of CDR without the zero at its end, which some leave out.
    pub fn string(&mut self) -> Result<&'a [u8], WireError> {
        let bytes = self.counted()?;
        Ok(bytes.strip_suffix(&[0]).unwrap_or(bytes))
    }

    /// A string of CDR, of this parameter.
    pub fn text(&mut self, number: u16) -> Result<&'a str, WireError> {
        std::str::from_utf8(self.string()?).map_err(|_| WireError::Value(number))
    }
}
