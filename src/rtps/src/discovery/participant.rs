//! What a participant tells of itself, as bytes (8.5.3.2, 9.6.3).

use std::time::Duration;

use bytes::Bytes;

use super::ParticipantData;
use crate::locator::Locator;
use crate::wire::{Input, ParameterWriter, WireError, list, list_header, parameter, pid};
use crate::{EntityId, Guid, VendorId};

/// After which a participant that does not say so itself is gone (8.5.3.2).
const LEASE: Duration = Duration::from_secs(100);

/// Of a participant that does not say which it has: those that each must have (8.5.1).
const BUILTIN: u32 = 0x3f;

/// More locators of one kind are not kept.
pub(super) const MOST_LOCATORS: usize = 16;

const KNOWN: [u16; 11] = [
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
    /// As the payload of a sample. A name or user data of more than 65,527 bytes is left out.
    pub fn to_bytes(&self) -> Bytes {
        self.to_bytes_with(&[])
    }

    /// The same, with properties: names and their values.
    pub fn to_bytes_with(&self, properties: &[(&str, &str)]) -> Bytes {
        let mut bytes = list_header();
        let mut list = ParameterWriter::new(&mut bytes);
        list.raw(pid::PROTOCOL_VERSION, &self.version);
        list.raw(pid::VENDOR_ID, &self.vendor.0);
        list.guid(
            pid::PARTICIPANT_GUID,
            Guid::new(self.prefix, EntityId::PARTICIPANT),
        );
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
            list.counted(pid::USER_DATA, &self.user_data);
        }
        if !properties.is_empty() {
            list.properties(pid::PROPERTY_LIST, properties);
        }
        list.end();
        bytes.into()
    }

    /// Of the payload of a sample, in either byte order. Shares no memory with it. Locators of multicast are not kept, and of
    /// each other kind the first 16. A participant in a part of its domain (`PID_DOMAIN_TAG`) is not understood.
    pub fn from_payload(payload: &Bytes) -> Result<Self, WireError> {
        let mut input = list(payload)?;
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
        while let Some((number, mut value)) = parameter(&mut input, &KNOWN)? {
            match number {
                pid::PARTICIPANT_GUID => guid = Some(value.guid()?),
                _ => data.take(number, value)?,
            }
        }
        data.prefix = guid
            .ok_or(WireError::Missing(pid::PARTICIPANT_GUID))?
            .prefix;
        Ok(data)
    }

    fn take(&mut self, number: u16, mut value: Input) -> Result<(), WireError> {
        match number {
            pid::PROTOCOL_VERSION => self.version = value.array()?,
            pid::VENDOR_ID => self.vendor = VendorId(value.array()?),
            pid::DOMAIN_ID => self.domain = Some(value.u32()?),
            pid::DOMAIN_TAG if !value.text(number)?.is_empty() => {
                return Err(WireError::NotUnderstood(
                    pid::DOMAIN_TAG | pid::MUST_BE_UNDERSTOOD,
                ));
            }
            pid::ENTITY_NAME => self.name = String::from_utf8_lossy(value.string()?).into_owned(),
            pid::USER_DATA => self.user_data = Bytes::copy_from_slice(value.counted()?),
            pid::METATRAFFIC_UNICAST_LOCATOR => keep(&mut self.discovery, value.locator()?),
            pid::DEFAULT_UNICAST_LOCATOR => keep(&mut self.user, value.locator()?),
            pid::BUILTIN_ENDPOINT_SET => self.builtin = value.u32()?,
            pid::PARTICIPANT_LEASE_DURATION => self.lease = value.duration()?.finite(),
            _ => {}
        }
        Ok(())
    }
}

/// Adds one where there is room.
pub(super) fn keep(locators: &mut Vec<Locator>, locator: Locator) {
    if locators.len() < MOST_LOCATORS {
        locators.push(locator);
    }
}
