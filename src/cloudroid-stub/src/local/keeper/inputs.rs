//! Messages that the application publishes for the node.

use std::sync::Arc;

use qos::Responder;
use ros::bus::{PeerId, SerializedMessage};
use ros::ros1::actions;

use super::{Keeper, Payload};

impl Keeper {
    /// Handles a message that the application has published. A latched message is for both sides, whichever answers
    /// now: one that starts later needs it, too.
    pub fn on_input(&self, topic: &Arc<str>, message: SerializedMessage) {
        if message.latching {
            self.cloud.publish(topic, &message);
            if let Some(original) = &self.original {
                original.latch(topic, &message);
            }
        }
        self.update(|state, now| {
            if !message.latching && (state.is_stateful || is_goal(&message)) {
                state.ledger.record_input(now, topic);
            }
            self.feed_context(state, topic, &message);
            let key = state.stamps.key(&message);
            let payload = Payload::Input(state.kept.insert(message));
            state.governor.input(now, topic, key, payload);
        });
    }

    /// Handles a message that the cloud receives by another path: nodes of one servant are connected inside it, and one
    /// of them forwards inputs that several subscribe to.
    pub fn on_overheard_input(&self, topic: &Arc<str>, message: SerializedMessage) {
        if let Some(original) = self.original.as_ref().filter(|_| message.latching) {
            return original.latch(topic, &message);
        }
        self.update(|state, now| {
            let has = state.governor.sides().cloud;
            if state.is_stateful {
                state.ledger.record_input(now, topic);
                if has {
                    state.ledger.record_delivery(Responder::Cloud, topic);
                }
            }
            self.feed_context(state, topic, &message);
            let payload = Payload::Input(state.kept.insert(message));
            state.governor.on_overheard_input(now, topic, payload);
        });
    }

    /// Handles the end of a publisher on the robot, whose latched message on this topic is discarded.
    pub fn on_publisher_left(&self, topic: &Arc<str>, publisher: &PeerId) {
        if let Some(original) = &self.original {
            original.unlatch(topic, publisher);
        }
    }
}

/// Returns whether a message sends a goal to an action that consists of topics (ROS 1).
fn is_goal(message: &SerializedMessage) -> bool {
    let of = &message.wire_type.name;
    actions::carries_goal_id(of) && actions::is_command_type(of)
}
