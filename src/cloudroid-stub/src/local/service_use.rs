//! The use of a service of the node: its own, or one of those that make up an action (ROS 2) or manage the node.

use std::sync::Arc;

use link::control::ServiceChannel;
use ros::bus::RosVersion;

/// Separates an action's name from the names of its topics and services.
const ACTION: &str = "/_action/";

/// Use of a service.
#[derive(Debug, Clone, PartialEq, Eq)]
pub enum ServiceUse {
    /// Requests of the application, which are measured.
    Request,
    /// Queries about the node itself (parameters, state, types), which either side can answer.
    Look,
    /// Sets parameters of the node, or its log levels.
    Set,
    /// Changes the lifecycle state of the node.
    Transition,
    /// Sends goals to this action.
    SendGoal(Arc<str>),
    /// Fetches results of this action.
    GetResult(Arc<str>),
    /// Cancels goals of this action.
    CancelGoal(Arc<str>),
}

impl ServiceUse {
    /// Classifies a service of a node of this ROS version, by its type, since names may be remapped.
    pub fn classify(served: &ServiceChannel, version: RosVersion) -> Self {
        if version == RosVersion::One {
            return match served.type_name.as_str() {
                "dynamic_reconfigure/Reconfigure" => Self::Set,
                _ => Self::Request,
            };
        }
        if let Some((action, part)) = served.name.rsplit_once(ACTION) {
            let action: Arc<str> = action.into();
            match part {
                "send_goal" => return Self::SendGoal(action),
                "get_result" => return Self::GetResult(action),
                "cancel_goal" => return Self::CancelGoal(action),
                _ => {}
            }
        }
        match served.type_name.as_str() {
            "rcl_interfaces/srv/GetParameters"
            | "rcl_interfaces/srv/GetParameterTypes"
            | "rcl_interfaces/srv/ListParameters"
            | "rcl_interfaces/srv/DescribeParameters"
            | "rcl_interfaces/srv/GetLoggerLevels"
            | "type_description_interfaces/srv/GetTypeDescription"
            | "lifecycle_msgs/srv/GetState"
            | "lifecycle_msgs/srv/GetAvailableStates"
            | "lifecycle_msgs/srv/GetAvailableTransitions" => Self::Look,
            "rcl_interfaces/srv/SetParameters"
            | "rcl_interfaces/srv/SetParametersAtomically"
            | "rcl_interfaces/srv/SetLoggerLevels" => Self::Set,
            "lifecycle_msgs/srv/ChangeState" => Self::Transition,
            _ => Self::Request,
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn what_manages_a_node_is_no_request_of_its_application() {
        let of = |name: &str, type_name: &str, version| {
            let served =
                ServiceChannel { name: name.to_owned(), type_name: type_name.to_owned(), ..ServiceChannel::default() };
            ServiceUse::classify(&served, version)
        };
        let two = |name, type_name| of(name, type_name, RosVersion::Two);
        let fib: Arc<str> = "/ns/fib".into();
        let send = two("/ns/fib/_action/send_goal", "a/action/Fib_SendGoal");
        assert_eq!(send, ServiceUse::SendGoal(fib.clone()));
        let cancel = two("/ns/fib/_action/cancel_goal", "action_msgs/srv/CancelGoal");
        assert_eq!(cancel, ServiceUse::CancelGoal(fib));
        assert_eq!(two("/add", "a/srv/Add"), ServiceUse::Request);
        let set = "rcl_interfaces/srv/SetParameters";
        assert_eq!(two("/n/set_parameters", set), ServiceUse::Set);
        let change = two("/n/change_state", "lifecycle_msgs/srv/ChangeState");
        assert_eq!(change, ServiceUse::Transition);
        // A name alone means nothing, and in ROS 1 only one type manages the node.
        assert_eq!(two("/n/set_parameters", "a/srv/Set"), ServiceUse::Request);
        let one = of("/fib/_action/send_goal", "a/Send", RosVersion::One);
        assert_eq!(one, ServiceUse::Request);
        let reconfigure = "dynamic_reconfigure/Reconfigure";
        let one = of("/n/set_parameters", reconfigure, RosVersion::One);
        assert_eq!(one, ServiceUse::Set);
    }
}
