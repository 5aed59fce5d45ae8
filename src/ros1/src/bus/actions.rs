//! Clients and servers of actions on the bus: publishers and subscriptions of an action's topics.

mod answers;
mod client;
mod server;

use std::sync::Arc;

use ros_bus::{BusError, Publisher, QosProfile, Subscription, WireType};
use ros_message::schema::{ActionDef, MessageType, Registry, SchemaError};

use super::{EndpointOwner, Ros1BusState, publications, subscriptions};

pub(super) use client::Ros1ActionClient;
pub(super) use server::Ros1ActionServer;

/// Queue depth for a slow peer.
const QUEUE: usize = 100;

/// The topics of one action of this node.
struct ActionTopicSet<'a> {
    bus: &'a Arc<Ros1BusState>,
    name: &'a str,
    of: &'a ActionDef,
    goal_id: Arc<MessageType>,
    states: Arc<MessageType>,
}

impl<'a> ActionTopicSet<'a> {
    fn new(bus: &'a Arc<Ros1BusState>, name: &'a str, of: &'a ActionDef) -> Result<Self, BusError> {
        let known = Registry::new();
        let unusable =
            |error: SchemaError| BusError::Protocol { what: format!("action {name}"), reason: error.to_string() };
        Ok(Self {
            bus,
            name,
            of,
            goal_id: known.message("actionlib_msgs/GoalID").map_err(unusable)?,
            states: known.message("actionlib_msgs/GoalStatusArray").map_err(unusable)?,
        })
    }

    fn topic(&self, part: &str) -> (String, WireType) {
        let of = match part {
            "goal" => &self.of.action_goal,
            "cancel" => &self.goal_id,
            "status" => &self.states,
            "feedback" => &self.of.action_feedback,
            _ => &self.of.action_result,
        };
        (format!("{}/{part}", self.name), WireType::from_message(of))
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
