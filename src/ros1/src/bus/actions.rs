//! Clients and servers of actions on the bus: publishers and subscriptions of an action's topics.

mod answers;
mod client;
mod server;

use std::sync::Arc;

use ros_bus::{BusError, Publisher, QosProfile, Subscription, WireType};
use ros_message::schema::ActionDef;

use super::{EndpointOwner, Ros1BusState, publications, subscriptions};
use crate::actions::{ActionTopicTypes, QUEUE};

pub(super) use client::Ros1ActionClient;
pub(super) use server::Ros1ActionServer;

/// The topics of one action of this node.
struct ActionTopicSet<'a> {
    bus: &'a Arc<Ros1BusState>,
    name: &'a str,
    types: ActionTopicTypes,
}

impl<'a> ActionTopicSet<'a> {
    fn new(bus: &'a Arc<Ros1BusState>, name: &'a str, of: &ActionDef) -> Result<Self, BusError> {
        Ok(Self { bus, name, types: ActionTopicTypes::for_action(name, of)? })
    }

    fn topic(&self, part: &str) -> (String, WireType) {
        let types = &self.types;
        let of = match part {
            "goal" => &types.goal,
            "cancel" => &types.cancel,
            "status" => &types.status,
            "feedback" => &types.feedback,
            _ => &types.result,
        };
        (format!("{}/{part}", self.name), WireType::clone(of))
    }

    async fn subscribe(&self, part: &str) -> Result<Subscription, BusError> {
        let (topic, of) = self.topic(part);
        let qos = QosProfile::keep_last(QUEUE).latching(true);
        subscriptions::subscribe(self.bus, &topic, of, qos, EndpointOwner::Action).await
    }

    async fn advertise(&self, part: &str, latch: bool) -> Result<Box<dyn Publisher>, BusError> {
        let (topic, of) = self.topic(part);
        let qos = QosProfile::keep_last(QUEUE).latching(latch);
        publications::advertise(self.bus, &topic, of, qos, EndpointOwner::Action).await
    }
}
