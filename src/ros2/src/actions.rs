//! Actions of ROS 2 (<https://design.ros2.org/articles/actions.html>): services and topics under one name.
//!
//! ```text
//!   client                                              server
//!     │── NAME/_action/send_goal    goal id, goal ────────▶│   accepted or rejected
//!     │◀─ NAME/_action/feedback     goal id, feedback ─────│   while it executes
//!     │── NAME/_action/cancel_goal  goal id, stamp ───────▶│   which goals are cancelled
//!     │── NAME/_action/get_result   goal id ──────────────▶│   status, result: once it has ended
//!     │◀─ NAME/_action/status       all goals' statuses ───│   kept for late subscribers
//! ```
//! Goals are identified by UUIDs. A goal id that is a UUID in text form is used as it is; any other id is mapped to a
//! random UUID.

mod client;
pub mod goal_client;
mod goal_id;
pub mod goal_server;
pub mod goal_services;
mod messages;
mod server;
#[cfg(test)]
mod tests;

use ros_bus::{BusError, QosProfile, ServiceType, WireType};
use ros_message::schema::ActionDef;

use crate::{interfaces, names};

pub(super) use client::Ros2ActionClient;
use goal_id::GoalId;
pub(super) use server::Ros2ActionServer;

/// Queue depth for feedback to a slow receiver.
const QUEUE: usize = 100;

/// Services and topics of an action: names and types.
#[derive(Debug, Clone)]
pub struct ActionInterfaces {
    /// Accepts or rejects goals.
    pub send_goal: (String, ServiceType),
    /// Answers when a goal has ended.
    pub get_result: (String, ServiceType),
    /// Cancels goals.
    pub cancel_goal: (String, ServiceType),
    /// Carries the feedback of goals.
    pub feedback: (String, WireType),
    /// Carries the statuses of all goals.
    pub status: (String, WireType),
}

impl ActionInterfaces {
    /// Returns those of an action with this name and type; an error if it is an action of ROS 1.
    pub fn for_action(action: &str, of: &ActionDef) -> Result<Self, BusError> {
        let name = |part: &str| names::action_part_name(action, part);
        let Some(services) = &of.services else {
            return Err(BusError::Protocol {
                what: format!("action {action}"),
                reason: format!("{} is an action of ROS 1", of.name),
            });
        };
        let status = interfaces::message("action_msgs/msg/GoalStatusArray")?;
        Ok(Self {
            send_goal: (name("send_goal"), ServiceType::from_service(&services.send_goal)),
            get_result: (name("get_result"), ServiceType::from_service(&services.get_result)),
            cancel_goal: (name("cancel_goal"), interfaces::service("action_msgs/srv/CancelGoal")?),
            feedback: (name("feedback"), WireType::from_message(&of.action_feedback)),
            status: (name("status"), WireType::from_message(&status)),
        })
    }

    /// Returns the QoS that a server offers for feedback.
    pub fn feedback_qos() -> QosProfile {
        QosProfile::keep_last(QUEUE)
    }

    /// Returns the QoS that a server offers for statuses.
    pub fn status_qos() -> QosProfile {
        QosProfile::keep_last(1).latching(true)
    }
}
