//! What participants tell of themselves and of their ends (8.5), as data.

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

pub use key::{guid_of_key, key};

/// What a participant tells of itself (8.5.3.2).
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct ParticipantData {
    /// Which one it is.
    pub prefix: GuidPrefix,
    /// Which implementation it is of.
    pub vendor: VendorId,
    /// Of the protocol: major and minor.
    pub version: [u8; 2],
    /// The domain, where it says.
    pub domain: Option<u32>,
    /// Its name; may be empty.
    pub name: String,
    /// What its owner adds; ROS 2 puts `enclave=…;` there.
    pub user_data: Bytes,
    /// Where it hears of ends.
    pub discovery: Vec<Locator>,
    /// Where its ends receive that say nothing else.
    pub user: Vec<Locator>,
    /// Which ends of the protocol it has (9.3.2.12).
    pub builtin: u32,
    /// It is gone when it has said nothing for so long; none where it never is.
    pub lease: Option<Duration>,
}

/// What a participant tells of one of its writers or readers (8.5.4.2).
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct EndpointData {
    /// Which end it is.
    pub guid: Guid,
    /// The topic's name as DDS has it: `rt/chatter`.
    pub topic: String,
    /// The type's name as DDS has it: `std_msgs::msg::dds_::String_`.
    pub type_name: String,
    /// What it offers or asks for.
    pub qos: EndpointQos,
    /// What its owner adds; ROS 2 puts `typehash=RIHS01_…;` there.
    pub user_data: Bytes,
    /// Where it receives; where its participant's ends do, if empty.
    pub unicast: Vec<Locator>,
    /// A reader that wants each sample to tell its quality of service.
    pub expects_inline_qos: bool,
}
