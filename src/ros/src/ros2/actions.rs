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
mod messages;
mod server;
#[cfg(test)]
mod tests;

use crate::bus::{BusError, ServiceType, WireType};
use crate::ros2::{interfaces, names};
use crate::schema::ActionDef;

pub(super) use client::Client;
use goal_id::GoalId;
pub(super) use server::{Retired, Server};

/// Feedback that is kept for a slow receiver.
const QUEUE: u32 = 100;

/// What an action is made of: names and types.
struct Parts {
    send_goal: (String, ServiceType),
    get_result: (String, ServiceType),
    cancel_goal: (String, ServiceType),
    feedback: (String, WireType),
    status: (String, WireType),
}

impl Parts {
    fn of(action: &str, of: &ActionDef) -> Result<Self, BusError> {
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
}
