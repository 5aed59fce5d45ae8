//! What the application publishes for the node.

use std::sync::Arc;

use qos::Side;
use ros::bus::{Message, PeerId};
use ros::ros1::actions;

use super::{Keeper, Payload};

impl Keeper {
    /// The application published an input. What is latched is for both sides, whoever answers now: one that begins later
    /// needs it, too.
    pub fn input(&self, topic: &Arc<str>, message: Message) {
        if message.latching {
            self.cloud.publish(topic, &message);
            if let Some(original) = &self.original {
                original.latch(topic, &message);
            }
        }
        self.with(|state, now| {
            if !message.latching && (state.is_stateful || is_goal(&message)) {
                state.ledger.told(now, topic);
            }
            self.give_context(state, topic, &message);
            let key = state.stamps.key(&message);
            let payload = Payload::Input(state.kept.keep(message));
            state.governor.input(now, topic, key, payload);
        });
    }

    /// The application published an input that the cloud has by another way: nodes of one servant hear each other inside,
    /// and one of them takes up what several listen to.
    pub fn overheard(&self, topic: &Arc<str>, message: Message) {
        if let Some(original) = self.original.as_ref().filter(|_| message.latching) {
            return original.latch(topic, &message);
        }
        self.with(|state, now| {
            let has = state.governor.sides().cloud;
            if state.is_stateful {
                state.ledger.told(now, topic);
                if has {
                    state.ledger.given(Side::Cloud, topic);
                }
            }
            self.give_context(state, topic, &message);
            let payload = Payload::Input(state.kept.keep(message));
            state.governor.overheard(now, topic, payload);
        });
    }

    /// A publisher of the robot has gone, and with it what it has latched on this topic.
    pub fn left(&self, topic: &Arc<str>, publisher: &PeerId) {
        if let Some(original) = &self.original {
            original.unlatch(topic, publisher);
        }
    }
}

/// Whether it sends a goal to an action that is made of topics (ROS 1).
fn is_goal(message: &Message) -> bool {
    let of = &message.wire_type.name;
    actions::carries_goal_id(of) && actions::commands(of)
}
