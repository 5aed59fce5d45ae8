//! Lookup of the type definitions for declared types in the image.

use std::sync::Arc;

use ros::bus::{Digest, ServiceType, WireType};
use ros::codec::Stamps;
use ros::schema::{MessageType, Registry, ServiceDef};

/// Returns the definition of a message type, if the image has the same type.
pub(super) fn find_message(registry: &Registry, of: &WireType) -> Option<Arc<MessageType>> {
    let known = registry.message(&of.name).ok()?;
    let same = of.digest.is_compatible_with(&Digest::from(known.digest()));
    same.then_some(known)
}

/// Returns the definition of a service type, if the image has the same type.
pub(super) fn find_service(registry: &Registry, of: &ServiceType) -> Option<Arc<ServiceDef>> {
    let known = registry.service(&of.name).ok()?;
    ServiceType::from_service(&known).is_compatible_with(of).then_some(known)
}

/// Returns the positions of the stamps in requests and responses; none if the type is unknown.
pub(super) fn call_stamps(of: Option<&ServiceDef>) -> (Stamps, Stamps) {
    let known = of.map(|of| (Stamps::for_type(&of.request), Stamps::for_type(&of.response)));
    known.unwrap_or_default()
}
