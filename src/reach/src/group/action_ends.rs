//! What an action is made of, below its name: of ROS 1 five topics, of ROS 2 two topics and three services.

use ros::bus::RosVersion;
use ros::ros2::names::part_of_action;

/// One of them.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash, PartialOrd, Ord)]
pub(super) enum End {
    /// A topic of clients (ROS 1).
    Goal,
    /// A topic of clients (ROS 1).
    Cancel,
    /// A topic of servers.
    Feedback,
    /// A topic of servers (ROS 1).
    Result,
    /// A topic of servers.
    Status,
    /// A service (ROS 2).
    SendGoal,
    /// A service (ROS 2).
    CancelGoal,
    /// A service (ROS 2).
    GetResult,
}

const OF_ONE: [(End, &str); 5] = [
    (End::Goal, "goal"),
    (End::Cancel, "cancel"),
    (End::Feedback, "feedback"),
    (End::Result, "result"),
    (End::Status, "status"),
];

const OF_TWO: [(End, &str); 5] = [
    (End::SendGoal, "send_goal"),
    (End::CancelGoal, "cancel_goal"),
    (End::GetResult, "get_result"),
    (End::Feedback, "feedback"),
    (End::Status, "status"),
];

impl End {
    /// Whether clients publish it.
    pub(super) fn is_of_clients(self) -> bool {
        matches!(self, End::Goal | End::Cancel)
    }

    pub(super) fn is_service(self) -> bool {
        matches!(self, End::SendGoal | End::CancelGoal | End::GetResult)
    }

    /// The type of a topic of ROS 1, of an action of this type.
    pub(super) fn type_name(self, action: &str) -> String {
        let of_action = |what: &str| format!("{action}Action{what}");
        match self {
            End::Feedback => of_action("Feedback"),
            End::Result => of_action("Result"),
            End::Cancel => "actionlib_msgs/GoalID".to_owned(),
            End::Status => "actionlib_msgs/GoalStatusArray".to_owned(),
            End::Goal | End::SendGoal | End::CancelGoal | End::GetResult => of_action("Goal"),
        }
    }
}

/// The parts of an action, with their names.
pub(super) fn ends_of(version: RosVersion, action: &str) -> Vec<(End, String)> {
    let (ends, name): (_, fn(&str, &str) -> String) = match version {
        RosVersion::One => (OF_ONE, |action, end| format!("{action}/{end}")),
        RosVersion::Two => (OF_TWO, part_of_action),
    };
    ends.map(|(end, part)| (end, name(action, part))).into()
}
