//! Encoding of the discovery data of endpoints (8.5.4.2, 9.6.3).

use bytes::Bytes;

use super::participant::push_locator;
use super::{EndpointData, policies};
use crate::wire::{ParameterWriter, WireError, list_header, next_parameter, parameter_list, pid};
use crate::{EntityId, Guid};

const KNOWN_PARAMETERS: [u16; 13] = {
    let [a, b, c, d, e, f, g] = policies::KNOWN_PARAMETERS;
    [
        pid::ENDPOINT_GUID,
        pid::TOPIC_NAME,
        pid::TYPE_NAME,
        pid::USER_DATA,
        pid::UNICAST_LOCATOR,
        pid::EXPECTS_INLINE_QOS,
        a,
        b,
        c,
        d,
        e,
        f,
        g,
    ]
};

/// Maximum length in bytes of names and user data. Those of ROS 2 have at most 255 and 72 bytes; many endpoints may be
/// announced.
const LONGEST: usize = 1024;

impl EndpointData {
    /// Encodes the data as the payload of a sample. Names or user data of more than 65,527 bytes are omitted.
    pub fn to_bytes(&self) -> Bytes {
        self.encode(None)
    }

    /// Encodes the data with a number that receivers skip (PID_PAD, 9.4.2.11.2): a server of Fast DDS ignores an
    /// announcement whose bytes are those of the one before.
    pub fn to_bytes_again(&self, repetition: u32) -> Bytes {
        self.encode(Some(repetition))
    }

    fn encode(&self, repetition: Option<u32>) -> Bytes {
        let mut bytes = list_header();
        let mut list = ParameterWriter::new(&mut bytes);
        list.guid(pid::ENDPOINT_GUID, self.guid);
        list.guid(pid::PARTICIPANT_GUID, Guid::new(self.guid.prefix, EntityId::PARTICIPANT));
        // Some implementations look up their existing data by this hash.
        list.guid(pid::KEY_HASH, self.guid);
        list.string(pid::TOPIC_NAME, &self.topic);
        list.string(pid::TYPE_NAME, &self.type_name);
        for locator in &self.unicast {
            list.locator(pid::UNICAST_LOCATOR, locator);
        }
        if self.expects_inline_qos {
            list.raw(pid::EXPECTS_INLINE_QOS, &[1]);
        }
        policies::write_qos(&self.qos, &mut list);
        if !self.user_data.is_empty() {
            list.byte_sequence(pid::USER_DATA, &self.user_data);
        }
        if let Some(repetition) = repetition {
            list.u32(pid::PAD, repetition);
        }
        list.end();
        bytes.into()
    }

    /// Decodes the payload of a sample in either byte order. Shares no memory with it and keeps the first 16 locators.
    /// QoS policies that are not announced have the defaults of DDS.
    pub fn from_payload(payload: &Bytes) -> Result<Self, WireError> {
        let guid = parse_guid(payload)?;
        let (mut topic, mut type_name) = (None, None);
        let mut data = Self {
            guid,
            topic: String::new(),
            type_name: String::new(),
            qos: policies::default_qos(guid.entity.is_writer()),
            user_data: Bytes::new(),
            unicast: Vec::new(),
            expects_inline_qos: false,
        };
        let mut input = parameter_list(payload)?;
        while let Some((number, mut value)) = next_parameter(&mut input, &KNOWN_PARAMETERS)? {
            match number {
                pid::TOPIC_NAME => topic = Some(check_length(number, value.text(number)?)?.to_owned()),
                pid::TYPE_NAME => type_name = Some(check_length(number, value.text(number)?)?.to_owned()),
                pid::USER_DATA => {
                    data.user_data = Bytes::copy_from_slice(check_length(number, value.byte_sequence()?)?)
                }
                pid::UNICAST_LOCATOR => push_locator(&mut data.unicast, value.locator()?),
                pid::EXPECTS_INLINE_QOS => data.expects_inline_qos = value.byte()? != 0,
                _ => policies::set_parameter(&mut data.qos, number, value)?,
            }
        }
        data.topic = topic.ok_or(WireError::Missing(pid::TOPIC_NAME))?;
        data.type_name = type_name.ok_or(WireError::Missing(pid::TYPE_NAME))?;
        Ok(data)
    }
}

fn check_length<T: AsRef<[u8]> + ?Sized>(number: u16, value: &T) -> Result<&T, WireError> {
    if value.as_ref().len() <= LONGEST { Ok(value) } else { Err(WireError::Value(number)) }
}

/// Decodes only the GUID, which must be known before the rest is read.
fn parse_guid(payload: &Bytes) -> Result<Guid, WireError> {
    let mut input = parameter_list(payload)?;
    let mut guid = None;
    while let Some((number, mut value)) = next_parameter(&mut input, &KNOWN_PARAMETERS)? {
        if number == pid::ENDPOINT_GUID {
            guid = Some(value.guid()?);
        }
    }
    guid.ok_or(WireError::Missing(pid::ENDPOINT_GUID))
}
