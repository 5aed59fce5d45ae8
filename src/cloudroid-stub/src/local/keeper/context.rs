//! Inputs for the local original while it is not fed requests.
//!
//! A node may wait for something before it subscribes to its requests: move_base subscribes to its goal when it knows
//! the robot's position. So while the process starts, it is fed every input that is not a request; when it is ready and
//! the cloud answers, only transforms and time, which cost little and without which it could not take over at once.
//! Latched messages are fed in any case.

use std::collections::BTreeSet;
use std::sync::Arc;

use qos::{LocalState, Responder, TopicPair};
use ros::bus::SerializedMessage;
use ros::ros1::actions;

use super::{Keeper, State};

/// Types of topics with transforms and time, as named in ROS 1.
const OF_SPACE_AND_TIME: [&str; 3] = ["tf2_msgs/TFMessage", "tf/tfMessage", "rosgraph_msgs/Clock"];

/// State of the local original's process, and the inputs that are requests.
pub(super) struct LocalContext {
    local: LocalState,
    requests: BTreeSet<String>,
}

impl LocalContext {
    /// Creates the context of a process that does not run; the inputs of these pairs are requests.
    pub(super) fn new(pairs: &[TopicPair]) -> Self {
        let mut context = Self { local: LocalState::Stopped, requests: BTreeSet::new() };
        context.learn(pairs);
        context
    }

    /// Adds the inputs of these pairs to the requests.
    pub(super) fn learn(&mut self, pairs: &[TopicPair]) {
        let inputs = pairs.iter().map(|pair| pair.input.clone());
        self.requests.extend(inputs);
    }

    /// Sets the state of the process.
    pub(super) fn set_state(&mut self, local: LocalState) {
        self.local = local;
    }

    /// Returns whether there is a process that can be called.
    pub(super) fn is_running(&self) -> bool {
        matches!(self.local, LocalState::Starting | LocalState::Ready)
    }

    /// Returns whether a message of this type on this topic is fed to a local original that is not fed requests.
    fn accepts(&self, topic: &str, type_name: &str) -> bool {
        let type_name = type_name.replacen("/msg/", "/", 1);
        match self.local {
            LocalState::Starting => {
                let is_command = actions::carries_goal_id(&type_name) || actions::is_command_type(&type_name);
                !is_command && !self.requests.contains(topic)
            }
            LocalState::Ready => OF_SPACE_AND_TIME.contains(&type_name.as_str()),
            LocalState::Stopped | LocalState::Missing => false,
        }
    }
}

impl Keeper {
    /// Feeds the local original an input that it may be waiting for, unless it is fed all inputs.
    pub(super) fn feed_context(&self, state: &mut State, topic: &Arc<str>, message: &SerializedMessage) {
        let is_due =
            !message.latching && !state.governor.sides().local && state.context.accepts(topic, &message.wire_type.name);
        let Some(original) = self.original.as_ref().filter(|_| is_due) else {
            return;
        };
        original.feed(topic, message);
        state.ledger.record_delivery(Responder::Local, topic);
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn requests_wait_until_it_is_ready_and_what_costs_much_until_it_is_needed() {
        let pair = "/move_base/goal -> /move_base/result".parse().unwrap();
        let mut context = LocalContext::new(&[]);
        context.learn(&[pair]);
        let inputs = [
            ("/tf", "tf2_msgs/msg/TFMessage"),
            ("/clock", "rosgraph_msgs/Clock"),
            ("/scan", "sensor_msgs/LaserScan"),
            ("/move_base/goal", "move_base_msgs/MoveBaseActionGoal"),
            ("/move_base/cancel", "actionlib_msgs/GoalID"),
        ];
        let taken = |context: &LocalContext| {
            let taken = inputs.iter().filter(|(topic, of)| context.accepts(topic, of));
            taken.map(|(topic, _)| *topic).collect::<Vec<_>>().join(" ")
        };
        assert_eq!(taken(&context), "");
        context.set_state(LocalState::Starting);
        assert_eq!(taken(&context), "/tf /clock /scan");
        context.set_state(LocalState::Ready);
        assert_eq!(taken(&context), "/tf /clock");
        context.set_state(LocalState::Stopped);
        assert_eq!(taken(&context), "");
    }
}
