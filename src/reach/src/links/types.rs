//! Definitions of types as the ends of links declare them, by what the image holds.

use std::sync::Arc;

use ros::bus::{Digest, ServiceType, WireType};
use ros::codec::Stamps;
use ros::schema::{MessageType, Registry, ServiceDef};

/// The definition of a type of messages, if the image has the same.
pub(super) fn message(registry: &Registry, of: &WireType) -> Option<Arc<MessageType>> {
    let known = registry.message(&of.name).ok()?;
    let same = of.digest.agrees(&Digest::from(known.digest()));
    same.then_some(known)
}

/// The definition of a type of services, if the image has the same.
pub(super) fn service(registry: &Registry, of: &ServiceType) -> Option<Arc<ServiceDef>> {
    let known = registry.service(&of.name).ok()?;
    ServiceType::of(&known).agrees(of).then_some(known)
}

/// Where the stamps of requests and responses stand; nowhere where the type is not known.
pub(super) fn stamps_of_calls(of: Option<&ServiceDef>) -> (Stamps, Stamps) {
    let known = of.map(|of| (Stamps::of(&of.request), Stamps::of(&of.response)));
    known.unwrap_or_default()
}
