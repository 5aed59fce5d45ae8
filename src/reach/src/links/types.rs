//! Lookup of the definitions for declared types, among those of the image or their twins in the robot's ROS.

use std::sync::Arc;

use ros::bus::{Digest, ServiceType, WireType};
use ros::codec::Stamps;
use ros::schema::{MessageType, Registry, ServiceDef};
use translation::bus::TranslatedBus;

/// The definitions of the types on a bus.
pub(super) enum TypeDefinitions {
    /// Types of the image.
    Image(Arc<Registry>),
    /// Twins of the image's types.
    Twins(Arc<TranslatedBus>),
}

impl TypeDefinitions {
    /// Returns the definition of a message type, if it has the same digest.
    pub(super) fn find_message(&self, of: &WireType) -> Option<Arc<MessageType>> {
        match self {
            Self::Image(registry) => {
                let known = registry.message(&of.name).ok()?;
                let same = of.digest.is_compatible_with(&Digest::from(known.digest()));
                same.then_some(known)
            }
            Self::Twins(bus) => bus.message(of),
        }
    }

    /// Returns the definition of the message type of this name.
    pub(super) fn find_message_named(&self, name: &str) -> Option<Arc<MessageType>> {
        self.find_message(&WireType::with_name(name))
    }

    /// Returns the definition of a service type, if it has the same digests.
    pub(super) fn find_service(&self, of: &ServiceType) -> Option<Arc<ServiceDef>> {
        match self {
            Self::Image(registry) => {
                let known = registry.service(&of.name).ok()?;
                ServiceType::from_service(&known).is_compatible_with(of).then_some(known)
            }
            Self::Twins(bus) => bus.service(of),
        }
    }
}

/// Returns the positions of the stamps in requests and responses; none if the type is unknown.
pub(super) fn call_stamps(of: Option<&ServiceDef>) -> (Stamps, Stamps) {
    let known = of.map(|of| (Stamps::for_type(&of.request), Stamps::for_type(&of.response)));
    known.unwrap_or_default()
}
