//! Encoding of the discovery data of participants (8.5.3.2, 9.6.3).

use std::time::Duration;

use bytes::Bytes;

use super::ParticipantData;
use crate::locator::Locator;
use crate::wire::{ParameterWriter, WireError, WireReader, list_header, next_parameter, parameter_list, pid};
use crate::{EntityId, Guid, VendorId};

/// Default lease duration (8.5.3.2).
const LEASE: Duration = Duration::from_secs(100);

/// Built-in endpoints of a participant that does not announce them: those that each participant must have (8.5.1).
const BUILTIN: u32 = 0x3f;

/// Maximum number of locators of one kind that are kept.
pub(super) const MOST_LOCATORS: usize = 16;

const KNOWN_PARAMETERS: [u16; 11] = [
    pid::PROTOCOL_VERSION,
    pid::VENDOR_ID,
    pid::PARTICIPANT_GUID,
    pid::DOMAIN_ID,
    pid::DOMAIN_TAG,
    pid::ENTITY_NAME,
    pid::USER_DATA,
    pid::METATRAFFIC_UNICAST_LOCATOR,
    pid::DEFAULT_UNICAST_LOCATOR,
    pid::BUILTIN_ENDPOINT_SET,
    pid::PARTICIPANT_LEASE_DURATION,
];

impl ParticipantData {
    /// Encodes the data as the payload of a sample. A name or user data of more than 65,527 bytes is omitted.
    pub fn to_bytes(&self) -> Bytes {
        self.to_bytes_with(&[])
    }

    /// Encodes the data with additional properties, given as names and values.
    pub fn to_bytes_with(&self, properties: &[(&str, &str)]) -> Bytes {
        let mut bytes = list_header();
        let mut list = ParameterWriter::new(&mut bytes);
        list.raw(pid::PROTOCOL_VERSION, &self.version);
        list.raw(pid::VENDOR_ID, &self.vendor.0);
        list.guid(pid::PARTICIPANT_GUID, Guid::new(self.prefix, EntityId::PARTICIPANT));
        for locator in &self.discovery {
            list.locator(pid::METATRAFFIC_UNICAST_LOCATOR, locator);
        }
        for locator in &self.user {
            list.locator(pid::DEFAULT_UNICAST_LOCATOR, locator);
        }
        list.duration(pid::PARTICIPANT_LEASE_DURATION, self.lease);
        list.u32(pid::BUILTIN_ENDPOINT_SET, self.builtin);
        if let Some(domain) = self.domain {
            list.u32(pid::DOMAIN_ID, domain);
        }
        if !self.name.is_empty() {
            list.string(pid::ENTITY_NAME, &self.name);
        }
        if !self.user_data.is_empty() {
            list.byte_sequence(pid::USER_DATA, &self.user_data);
        }
        if !properties.is_empty() {
            list.properties(pid::PROPERTY_LIST, properties);
        }
        list.end();
        bytes.into()
    }

    /// Decodes the payload of a sample in either byte order. Shares no memory with it. Multicast locators are not kept,
    /// and of each other kind the first 16. A participant with a domain tag (`PID_DOMAIN_TAG`) is rejected.
    pub fn from_payload(payload: &Bytes) -> Result<Self, WireError> {
        let mut input = parameter_list(payload)?;
        let mut guid = None;
        let mut data = Self {
            prefix: Default::default(),
            vendor: VendorId::default(),
            version: [2, 1],
            domain: None,
            name: String::new(),
            user_data: Bytes::new(),
            discovery: Vec::new(),
            user: Vec::new(),
            builtin: BUILTIN,
            lease: Some(LEASE),
        };
        while let Some((number, mut value)) = next_parameter(&mut input, &KNOWN_PARAMETERS)? {
            match number {
                pid::PARTICIPANT_GUID => guid = Some(value.guid()?),
                _ => data.set_parameter(number, value)?,
            }
        }
        data.prefix = guid.ok_or(WireError::Missing(pid::PARTICIPANT_GUID))?.prefix;
        Ok(data)
    }

    fn set_parameter(&mut self, number: u16, mut value: WireReader) -> Result<(), WireError> {
        match number {
            pid::PROTOCOL_VERSION => self.version = value.array()?,
            pid::VENDOR_ID => self.vendor = VendorId(value.array()?),
            pid::DOMAIN_ID => self.domain = Some(value.u32()?),
            pid::DOMAIN_TAG if !value.text(number)?.is_empty() => {
                return Err(WireError::NotUnderstood(pid::DOMAIN_TAG | pid::MUST_BE_UNDERSTOOD));
            }
            pid::ENTITY_NAME => self.name = String::from_utf8_lossy(value.string()?).into_owned(),
            pid::USER_DATA => self.user_data = Bytes::copy_from_slice(value.byte_sequence()?),
            pid::METATRAFFIC_UNICAST_LOCATOR => push_locator(&mut self.discovery, value.locator()?),
            pid::DEFAULT_UNICAST_LOCATOR => push_locator(&mut self.user, value.locator()?),
            pid::BUILTIN_ENDPOINT_SET => self.builtin = value.u32()?,
            pid::PARTICIPANT_LEASE_DURATION => self.lease = value.duration()?.finite(),
            _ => {}
        }
        Ok(())
    }
}

/// Adds a locator if there is room.
pub(super) fn push_locator(locators: &mut Vec<Locator>, locator: Locator) {
    if locators.len() < MOST_LOCATORS {
        locators.push(locator);
    }
}
