//! What the local original is given although it is given no requests.
//!
//! A node may wait for something before it listens to its requests: move_base subscribes to its goal once it knows where the robot is.
//! So while its process starts, it is given every input that is no request; once it is ready and the cloud answers, transforms and time
//! alone, which cost little, and without which it could not take over at once. What is latched it is given in any case.

use std::collections::BTreeSet;
use std::sync::Arc;

use qos::{LocalState, Pair, Side};
use ros::bus::Message;
use ros::ros1::actions;

use super::{Keeper, State};

/// Types of topics that tell of transforms and of time, as ROS 1 names them.
const OF_SPACE_AND_TIME: [&str; 3] = ["tf2_msgs/TFMessage", "tf/tfMessage", "rosgraph_msgs/Clock"];

/// How the local original's process is, and which inputs are requests.
pub(super) struct Context {
    local: LocalState,
    requests: BTreeSet<String>,
}

impl Context {
    /// The process does not run; the inputs of these pairs are requests.
    pub(super) fn of(pairs: &[Pair]) -> Self {
        let mut context = Self {
            local: LocalState::Stopped,
            requests: BTreeSet::new(),
        };
        context.learn(pairs);
        context
    }

    /// The inputs of these pairs are requests, too.
    pub(super) fn learn(&mut self, pairs: &[Pair]) {
        let inputs = pairs.iter().map(|pair| pair.input.clone());
        self.requests.extend(inputs);
    }

    /// The process has changed.
    pub(super) fn is_now(&mut self, local: LocalState) {
        self.local = local;
    }

    /// Whether there is a process, which may be told something.
    pub(super) fn runs(&self) -> bool {
        matches!(self.local, LocalState::Starting | LocalState::Ready)
    }

    /// Whether a message of this type on this topic is for a local original that is given no requests.
    fn takes(&self, topic: &str, type_name: &str) -> bool {
        let type_name = type_name.replacen("/msg/", "/", 1);
        match self.local {
            LocalState::Starting => {
                let is_command =
                    actions::carries_goal_id(&type_name) || actions::commands(&type_name);
                !is_command && !self.requests.contains(topic)
            }
            LocalState::Ready => OF_SPACE_AND_TIME.contains(&type_name.as_str()),
            LocalState::Stopped | LocalState::Missing => false,
        }
    }
}

impl Keeper {
    /// Gives the local original an input that it may be waiting for, unless it is given all inputs.
    pub(super) fn give_context(&self, state: &mut State, topic: &Arc<str>, message: &Message) {
        let is_due = !message.latching
            && !state.governor.sides().local
            && state.context.takes(topic, &message.wire_type.name);
        let Some(original) = self.original.as_ref().filter(|_| is_due) else {
            return;
        };
        original.feed(topic, message);
        state.ledger.given(Side::Local, topic);
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn requests_wait_until_it_is_ready_and_what_costs_much_until_it_is_needed() {
        let pair = "/move_base/goal -> /move_base/result".parse().unwrap();
        let mut context = Context::of(&[]);
        context.learn(&[pair]);
        let inputs = [
            ("/tf", "tf2_msgs/msg/TFMessage"),
            ("/clock", "rosgraph_msgs/Clock"),
            ("/scan", "sensor_msgs/LaserScan"),
            ("/move_base/goal", "move_base_msgs/MoveBaseActionGoal"),
            ("/move_base/cancel", "actionlib_msgs/GoalID"),
        ];
        let taken = |context: &Context| {
            let taken = inputs.iter().filter(|(topic, of)| context.takes(topic, of));
            taken.map(|(topic, _)| *topic).collect::<Vec<_>>().join(" ")
        };
        assert_eq!(taken(&context), "");
        context.is_now(LocalState::Starting);
        assert_eq!(taken(&context), "/tf /clock /scan");
        context.is_now(LocalState::Ready);
        assert_eq!(taken(&context), "/tf /clock");
        context.is_now(LocalState::Stopped);
        assert_eq!(taken(&context), "");
    }
}
