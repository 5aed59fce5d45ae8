//! Actions of ROS 2 (<https://design.ros2.org/articles/actions.html>): services and topics of one name.
//!
//! ```text
//!   client                                              server
//!     │── NAME/_action/send_goal    goal id, goal ────────▶│   accepted or not
//!     │◀─ NAME/_action/feedback     goal id, feedback ─────│   while it is carried out
//!     │── NAME/_action/cancel_goal  goal id, stamp ───────▶│   which goals end now
//!     │── NAME/_action/get_result   goal id ──────────────▶│   status, result: once it has ended
//!     │◀─ NAME/_action/status       all goals' statuses ───│   kept for newcomers
//! ```
//! Goals are told apart by UUIDs. A goal's text that is a UUID is that one; another stands for a random one.

mod client;
mod goal_id;
pub mod goal_server;
mod messages;
mod server;
#[cfg(test)]
mod tests;

use crate::bus::{BusError, Qos, ServiceType, WireType};
use crate::ros2::{interfaces, names};
use crate::schema::ActionDef;

pub(super) use client::Client;
use goal_id::GoalId;
pub(super) use server::{Retired, Server};

/// Feedback that is kept for a slow receiver.
const QUEUE: u32 = 100;

/// What an action is made of: names and types.
#[derive(Debug, Clone)]
pub struct Parts {
    /// Takes goals, or not.
    pub send_goal: (String, ServiceType),
    /// Answers when a goal has ended.
    pub get_result: (String, ServiceType),
    /// Ends goals.
    pub cancel_goal: (String, ServiceType),
    /// Tells how goals get on.
    pub feedback: (String, WireType),
    /// Tells how all goals stand.
    pub status: (String, WireType),
}

impl Parts {
    /// Those of an action of this name and type; an error where it is one of ROS 1.
    pub fn of(action: &str, of: &ActionDef) -> Result<Self, BusError> {
        let name = |part: &str| names::part_of_action(action, part);
        let Some(services) = &of.services else {
            return Err(BusError::Protocol {
                what: format!("action {action}"),
                reason: format!("{} is an action of ROS 1", of.name),
            });
        };
        let status = interfaces::message("action_msgs/msg/GoalStatusArray")?;
        Ok(Self {
            send_goal: (name("send_goal"), ServiceType::of(&services.send_goal)),
            get_result: (name("get_result"), ServiceType::of(&services.get_result)),
            cancel_goal: (
                name("cancel_goal"),
                interfaces::service("action_msgs/srv/CancelGoal")?,
            ),
            feedback: (name("feedback"), WireType::of(&of.action_feedback)),
            status: (name("status"), WireType::of(&status)),
        })
    }

    /// What a server offers of its feedback.
    pub fn feedback_qos() -> Qos {
        Qos::keep_last(QUEUE as usize)
    }

    /// What a server offers of its statuses.
    pub fn status_qos() -> Qos {
        Qos::keep_last(1).latching(true)
    }
}
