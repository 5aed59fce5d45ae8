//! What a participant tells of one of its writers or readers, as bytes (8.5.4.2, 9.6.3).

use bytes::Bytes;

use super::participant::keep;
use super::{EndpointData, policies};
use crate::wire::{ParameterWriter, WireError, list, list_header, parameter, pid};
use crate::{EntityId, Guid};

const KNOWN: [u16; 13] = {
    let [a, b, c, d, e, f, g] = policies::KNOWN;
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

/// Names and user data of more bytes are not understood. ROS 2's are at most 255 and 72 long; many such ends may be told.
const LONGEST: usize = 1024;

impl EndpointData {
    /// As the payload of a sample. Names or user data of more than 65,527 bytes are left out.
    pub fn to_bytes(&self) -> Bytes {
        let mut bytes = list_header();
        let mut list = ParameterWriter::new(&mut bytes);
        list.guid(pid::ENDPOINT_GUID, self.guid);
        list.guid(
            pid::PARTICIPANT_GUID,
            Guid::new(self.guid.prefix, EntityId::PARTICIPANT),
        );
        // By this some find what they know of it already.
        list.guid(pid::KEY_HASH, self.guid);
        list.string(pid::TOPIC_NAME, &self.topic);
        list.string(pid::TYPE_NAME, &self.type_name);
        for locator in &self.unicast {
            list.locator(pid::UNICAST_LOCATOR, locator);
        }
        if self.expects_inline_qos {
            list.raw(pid::EXPECTS_INLINE_QOS, &[1]);
        }
        policies::write(&self.qos, &mut list);
        if !self.user_data.is_empty() {
            list.counted(pid::USER_DATA, &self.user_data);
        }
        list.end();
        bytes.into()
    }

    /// Of the payload of a sample, in either byte order. Shares no memory with it; the first 16 locators are kept. What is
    /// not told of its quality of service is as DDS says.
    pub fn from_payload(payload: &Bytes) -> Result<Self, WireError> {
        let guid = guid(payload)?;
        let (mut topic, mut type_name) = (None, None);
        let mut data = Self {
            guid,
            topic: String::new(),
            type_name: String::new(),
            qos: policies::unsaid(guid.entity.is_writer()),
            user_data: Bytes::new(),
            unicast: Vec::new(),
            expects_inline_qos: false,
        };
        let mut input = list(payload)?;
        while let Some((number, mut value)) = parameter(&mut input, &KNOWN)? {
            match number {
                pid::TOPIC_NAME => topic = Some(short(number, value.text(number)?)?.to_owned()),
                pid::TYPE_NAME => type_name = Some(short(number, value.text(number)?)?.to_owned()),
                pid::USER_DATA => {
                    data.user_data = Bytes::copy_from_slice(short(number, value.counted()?)?)
                }
                pid::UNICAST_LOCATOR => keep(&mut data.unicast, value.locator()?),
                pid::EXPECTS_INLINE_QOS => data.expects_inline_qos = value.byte()? != 0,
                _ => policies::take(&mut data.qos, number, value)?,
            }
        }
        data.topic = topic.ok_or(WireError::Missing(pid::TOPIC_NAME))?;
        data.type_name = type_name.ok_or(WireError::Missing(pid::TYPE_NAME))?;
        Ok(data)
    }
}

fn short<T: AsRef<[u8]> + ?Sized>(number: u16, value: &T) -> Result<&T, WireError> {
    match value.as_ref().len() <= LONGEST {
        true => Ok(value),
        false => Err(WireError::Value(number)),
    }
}

/// Which end it is: that has to be known before the rest is read.
fn guid(payload: &Bytes) -> Result<Guid, WireError> {
    let mut input = list(payload)?;
    let mut guid = None;
    while let Some((number, mut value)) = parameter(&mut input, &KNOWN)? {
        if number == pid::ENDPOINT_GUID {
            guid = Some(value.guid()?);
        }
    }
    guid.ok_or(WireError::Missing(pid::ENDPOINT_GUID))
}
