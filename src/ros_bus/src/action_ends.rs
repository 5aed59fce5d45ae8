//! Topics and services of an action, below its name: five topics in ROS 1, two topics and three services in ROS 2.

use ros_message::RosVersion;

use crate::hidden_names::{action_part, action_part_name};

/// A topic or service of an action.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash, PartialOrd, Ord)]
pub enum ActionEndpoint {
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

const ROS1_TOPICS: [(ActionEndpoint, &str); 5] = [
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
    /// Returns true if it is a topic published by clients.
    pub fn is_published_by_clients(self) -> bool {
        matches!(self, ActionEndpoint::Goal | ActionEndpoint::Cancel)
    }

    /// Returns true if it is a service.
    pub fn is_service(self) -> bool {
        matches!(self, ActionEndpoint::SendGoal | ActionEndpoint::CancelGoal | ActionEndpoint::GetResult)
    }

    /// Returns the type of the ROS 1 topic for an action of this type.
    pub fn type_name(self, action: &str) -> String {
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
pub fn action_endpoints(version: RosVersion, action: &str) -> Vec<(ActionEndpoint, String)> {
    let (ends, name): (_, fn(&str, &str) -> String) = match version {
        RosVersion::One => (ROS1_TOPICS, |action, end| format!("{action}/{end}")),
        RosVersion::Two => (OF_TWO, action_part_name),
    };
    ends.map(|(end, part)| (end, name(action, part))).into()
}

/// Splits the name of a topic or service that may be part of an action into the action and the part.
pub fn split_action_endpoint(version: RosVersion, name: &str) -> Option<(&str, ActionEndpoint)> {
    let (ends, (action, part)) = match version {
        RosVersion::One => (ROS1_TOPICS, name.rsplit_once('/').filter(|(action, _)| !action.is_empty())?),
        RosVersion::Two => (OF_TWO, action_part(name)?),
    };
    let (end, _) = ends.into_iter().find(|(_, known)| *known == part)?;
    Some((action, end))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn names_of_parts_are_split_as_they_are_made() {
        for version in [RosVersion::One, RosVersion::Two] {
            let ends = action_endpoints(version, "/arm/move");
            assert_eq!(ends.len(), 5);
            for (end, name) in ends {
                assert_eq!(split_action_endpoint(version, &name), Some(("/arm/move", end)), "{name}");
            }
        }
        for (version, name) in [
            (RosVersion::One, "/goal"),
            (RosVersion::One, "/arm/move/send_goal"),
            (RosVersion::One, "goal"),
            (RosVersion::Two, "/arm/move/goal"),
            (RosVersion::Two, "/arm/move/_action/goal"),
        ] {
            assert_eq!(split_action_endpoint(version, name), None, "{name}");
        }
    }
}
