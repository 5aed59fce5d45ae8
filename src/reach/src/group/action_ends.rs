//! Topics and services of an action, below its name: five topics in ROS 1, two topics and three services in ROS 2.

use ros::bus::RosVersion;
use ros::ros2::names::action_part_name;

/// A topic or service of an action.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash, PartialOrd, Ord)]
pub(super) enum ActionEndpoint {
    /// Topic published by clients (ROS 1).
    Goal,
    /// Topic published by clients (ROS 1).
    Cancel,
    /// Topic published by servers.
    Feedback,
    /// Topic published by servers (ROS 1).
    Result,
    /// Topic published by servers.
    Status,
    /// Service (ROS 2).
    SendGoal,
    /// Service (ROS 2).
    CancelGoal,
    /// Service (ROS 2).
    GetResult,
}

const OF_ONE: [(ActionEndpoint, &str); 5] = [
    (ActionEndpoint::Goal, "goal"),
    (ActionEndpoint::Cancel, "cancel"),
    (ActionEndpoint::Feedback, "feedback"),
    (ActionEndpoint::Result, "result"),
    (ActionEndpoint::Status, "status"),
];

const OF_TWO: [(ActionEndpoint, &str); 5] = [
    (ActionEndpoint::SendGoal, "send_goal"),
    (ActionEndpoint::CancelGoal, "cancel_goal"),
    (ActionEndpoint::GetResult, "get_result"),
    (ActionEndpoint::Feedback, "feedback"),
    (ActionEndpoint::Status, "status"),
];

impl ActionEndpoint {
    /// Returns whether it is a topic published by clients.
    pub(super) fn is_published_by_clients(self) -> bool {
        matches!(self, ActionEndpoint::Goal | ActionEndpoint::Cancel)
    }

    pub(super) fn is_service(self) -> bool {
        matches!(self, ActionEndpoint::SendGoal | ActionEndpoint::CancelGoal | ActionEndpoint::GetResult)
    }

    /// Returns the type of the ROS 1 topic for an action of this type.
    pub(super) fn type_name(self, action: &str) -> String {
        let of_action = |what: &str| format!("{action}Action{what}");
        match self {
            ActionEndpoint::Feedback => of_action("Feedback"),
            ActionEndpoint::Result => of_action("Result"),
            ActionEndpoint::Cancel => "actionlib_msgs/GoalID".to_owned(),
            ActionEndpoint::Status => "actionlib_msgs/GoalStatusArray".to_owned(),
            ActionEndpoint::Goal
            | ActionEndpoint::SendGoal
            | ActionEndpoint::CancelGoal
            | ActionEndpoint::GetResult => of_action("Goal"),
        }
    }
}

/// Returns the topics and services of an action with their names.
pub(super) fn action_endpoints(version: RosVersion, action: &str) -> Vec<(ActionEndpoint, String)> {
    let (ends, name): (_, fn(&str, &str) -> String) = match version {
        RosVersion::One => (OF_ONE, |action, end| format!("{action}/{end}")),
        RosVersion::Two => (OF_TWO, action_part_name),
    };
    ends.map(|(end, part)| (end, name(action, part))).into()
}
