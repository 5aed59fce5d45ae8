//! What clients are told of a definition that cannot be had.

use ros::bus::RosVersion;
use ros::schema::SchemaError;

/// Debian's packages of message definitions of ROS 1, without their `ros-` and with ROS's underscores.
const OF_DEBIAN: [&str; 16] = [
    "actionlib_msgs",
    "diagnostic_msgs",
    "geometry_msgs",
    "map_msgs",
    "move_base_msgs",
    "nav_msgs",
    "pcl_msgs",
    "rosgraph_msgs",
    "sensor_msgs",
    "shape_msgs",
    "std_msgs",
    "std_srvs",
    "stereo_msgs",
    "tf2_msgs",
    "trajectory_msgs",
    "visualization_msgs",
];

/// How names of the messages end that ROS 1's actions are made of.
const OF_ACTIONLIB: [&str; 3] = ["ActionGoal", "ActionResult", "ActionFeedback"];

/// The error, and what can be done about it by whoever deploys the service, or by the client itself.
pub(crate) fn explain(version: RosVersion, error: SchemaError) -> String {
    let (what, name) = match &error {
        SchemaError::Unknown(name) => (format!("no definition of {name} is known here"), name),
        SchemaError::Missing { name, needed_by } => (
            format!("{needed_by} needs {name}, of which no definition is known here"),
            name,
        ),
        _ => return error.to_string(),
    };
    let package = name.split('/').next().unwrap_or_default();
    if version == RosVersion::Two
        && (package == "actionlib_msgs" || OF_ACTIONLIB.iter().any(|end| name.ends_with(end)))
    {
        return format!(
            "{what}: actions of ROS 1 are made of topics with such messages, and this servant speaks ROS 2; use send_action_goal and advertise_action"
        );
    }
    if version == RosVersion::One && OF_DEBIAN.contains(&package) {
        let debian = package.replace('_', "-");
        return format!(
            "{what}; whoever deploys this service can add it: cloudroidctl push … --with ros-{debian}"
        );
    }
    format!(
        "{what}; whoever deploys this service can add it: cloudroidctl push … of a workspace that has {package}, too"
    )
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn who_deploys_is_told_what_to_add() {
        let of = |version, name: &str| explain(version, SchemaError::Unknown(name.to_owned()));
        assert_eq!(
            of(RosVersion::One, "nav_msgs/Path"),
            "no definition of nav_msgs/Path is known here; whoever deploys this service can add it: cloudroidctl push … --with ros-nav-msgs"
        );
        // Those are not the packages of any distribution of ROS 2.
        assert_eq!(
            of(RosVersion::Two, "nav_msgs/msg/Path"),
            "no definition of nav_msgs/msg/Path is known here; whoever deploys this service can add it: cloudroidctl push … of a workspace that has nav_msgs, too"
        );
        let missing = SchemaError::Missing {
            name: "arm_msgs/Joint".to_owned(),
            needed_by: "arm_msgs/Arm".to_owned(),
        };
        assert_eq!(
            explain(RosVersion::One, missing),
            "arm_msgs/Arm needs arm_msgs/Joint, of which no definition is known here; whoever deploys this service can add it: cloudroidctl push … of a workspace that has arm_msgs, too"
        );
        let other = SchemaError::BadName("x".to_owned());
        assert_eq!(explain(RosVersion::One, other.clone()), other.to_string());
    }

    #[test]
    fn who_uses_actions_by_topics_is_told_how_ros_2_has_them() {
        for name in ["x_msgs/msg/CountActionGoal", "actionlib_msgs/msg/GoalID"] {
            let two = explain(RosVersion::Two, SchemaError::Unknown(name.to_owned()));
            assert_eq!(
                two,
                format!(
                    "no definition of {name} is known here: actions of ROS 1 are made of topics with such messages, and this servant speaks ROS 2; use send_action_goal and advertise_action"
                )
            );
            let one = explain(RosVersion::One, SchemaError::Unknown(name.to_owned()));
            assert!(one.contains("cloudroidctl push"), "{one}");
        }
    }
}
