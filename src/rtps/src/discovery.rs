//! Discovery data of participants and endpoints (8.5).

#![forbid(unsafe_code)]

mod endpoint;
mod key;
mod participant;
mod policies;
#[cfg(test)]
mod tests;

use std::time::Duration;

use bytes::Bytes;

use crate::locator::Locator;
use crate::qos::EndpointQos;
use crate::{Guid, GuidPrefix, VendorId};

pub use key::{guid_of_key, key_payload};

/// Discovery data of a participant (8.5.3.2).
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct ParticipantData {
    /// GUID prefix of the participant.
    pub prefix: GuidPrefix,
    /// Implementation of the participant.
    pub vendor: VendorId,
    /// Protocol version, major and minor.
    pub version: [u8; 2],
    /// Domain id, if announced.
    pub domain: Option<u32>,
    /// Name; may be empty.
    pub name: String,
    /// User data. ROS 2 stores `enclave=…;` here.
    pub user_data: Bytes,
    /// Metatraffic locators, at which it receives discovery data.
    pub discovery: Vec<Locator>,
    /// Default locators of its endpoints.
    pub user: Vec<Locator>,
    /// Set of its built-in endpoints (9.3.2.12).
    pub builtin: u32,
    /// Lease duration: the participant is gone after this time without a message; `None`: infinite.
    pub lease: Option<Duration>,
}

/// Discovery data of a writer or reader (8.5.4.2).
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct EndpointData {
    /// GUID of the endpoint.
    pub guid: Guid,
    /// DDS name of the topic: `rt/chatter`.
    pub topic: String,
    /// DDS name of the type: `std_msgs::msg::dds_::String_`.
    pub type_name: String,
    /// Offered or requested QoS.
    pub qos: EndpointQos,
    /// User data. ROS 2 stores `typehash=RIHS01_…;` here.
    pub user_data: Bytes,
    /// Locators at which it receives; if empty, the default locators of its participant.
    pub unicast: Vec<Locator>,
    /// The endpoint is a reader that expects each sample to carry inline QoS.
    pub expects_inline_qos: bool,
}
