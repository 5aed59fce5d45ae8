//! What a service of the node is to the promise: its own, or one of those that make up an action (ROS 2) or manage the node.

use std::sync::Arc;

use link::control::Served;
use ros::bus::RosVersion;

/// What stands between an action's name and those of its parts.
const ACTION: &str = "/_action/";

/// What a service is for.
#[derive(Debug, Clone, PartialEq, Eq)]
pub enum ServiceUse {
    /// Requests of the application, which are measured.
    Request,
    /// Asks about the node itself, whoever answers for it: parameters, state, types.
    Look,
    /// Sets parameters of the node, or the levels of its log.
    Set,
    /// Has the node go to another state of its life.
    Transition,
    /// Sends goals of this action.
    SendGoal(Arc<str>),
    /// Fetches results of this action.
    GetResult(Arc<str>),
    /// Cancels goals of this action.
    CancelGoal(Arc<str>),
}

impl ServiceUse {
    /// That of a service of a node of this ROS. Names may be remapped; types say what is meant.
    pub fn of(served: &Served, version: RosVersion) -> Self {
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
            let served = Served {
                name: name.to_owned(),
                type_name: type_name.to_owned(),
                ..Served::default()
            };
            ServiceUse::of(&served, version)
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
        // A name alone says nothing, and of ROS 1 one type alone is about the node.
        assert_eq!(two("/n/set_parameters", "a/srv/Set"), ServiceUse::Request);
        let one = of("/fib/_action/send_goal", "a/Send", RosVersion::One);
        assert_eq!(one, ServiceUse::Request);
        let reconfigure = "dynamic_reconfigure/Reconfigure";
        let one = of("/n/set_parameters", reconfigure, RosVersion::One);
        assert_eq!(one, ServiceUse::Set);
    }
}
