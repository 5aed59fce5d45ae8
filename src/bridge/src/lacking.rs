//! Explanations for clients of definitions that are not available.

use ros::bus::RosVersion;
use ros::schema::SchemaError;

/// Debian's packages of ROS 1 message definitions, without the prefix `ros-` and with ROS's underscores.
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

/// Suffixes of the names of messages that actions of ROS 1 consist of.
const OF_ACTIONLIB: [&str; 3] = ["ActionGoal", "ActionResult", "ActionFeedback"];

/// A definition that is not available, explained with advice for the deployer of the service, or for the client itself.
#[derive(Debug, thiserror::Error)]
#[error("{}", explain_schema_error(.version, .source))]
pub(crate) struct DefinitionError {
    /// ROS version of the servant.
    version: RosVersion,
    source: Box<SchemaError>,
}

impl DefinitionError {
    pub(crate) fn new(version: RosVersion, error: SchemaError) -> Self {
        Self { version, source: Box::new(error) }
    }
}

fn explain_schema_error(version: &RosVersion, error: &SchemaError) -> String {
    let (what, name) = match error {
        SchemaError::Unknown(name) => (format!("no definition of {name} is known here"), name),
        SchemaError::Missing { name, needed_by } => {
            (format!("{needed_by} needs {name}, of which no definition is known here"), name)
        }
        _ => return error.to_string(),
    };
    let package = name.split('/').next().unwrap_or_default();
    if *version == RosVersion::Two
        && (package == "actionlib_msgs" || OF_ACTIONLIB.iter().any(|end| name.ends_with(end)))
    {
        return format!(
            "{what}: ROS 1 actions consist of topics with such messages, but this servant uses ROS 2; use \
                send_action_goal and advertise_action"
        );
    }
    if *version == RosVersion::One && OF_DEBIAN.contains(&package) {
        let debian = package.replace('_', "-");
        return format!("{what}; the deployer of this service can add it: cloudroidctl push … --with ros-{debian}");
    }
    format!(
        "{what}; the deployer of this service can add it: cloudroidctl push … of a workspace that also has {package}"
    )
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn who_deploys_is_told_what_to_add() {
        let of = |version, name: &str| DefinitionError::new(version, SchemaError::Unknown(name.to_owned())).to_string();
        assert_eq!(
            of(RosVersion::One, "nav_msgs/Path"),
            "no definition of nav_msgs/Path is known here; the deployer of this service can add it: cloudroidctl push \
                … --with ros-nav-msgs"
        );
        // These are not packages of a ROS 2 distribution.
        assert_eq!(
            of(RosVersion::Two, "nav_msgs/msg/Path"),
            "no definition of nav_msgs/msg/Path is known here; the deployer of this service can add it: cloudroidctl \
                push … of a workspace that also has nav_msgs"
        );
        let missing = SchemaError::Missing { name: "arm_msgs/Joint".to_owned(), needed_by: "arm_msgs/Arm".to_owned() };
        assert_eq!(
            DefinitionError::new(RosVersion::One, missing).to_string(),
            "arm_msgs/Arm needs arm_msgs/Joint, of which no definition is known here; the deployer of this service can \
                add it: cloudroidctl push … of a workspace that also has arm_msgs"
        );
        let other = SchemaError::BadName("x".to_owned());
        assert_eq!(DefinitionError::new(RosVersion::One, other.clone()).to_string(), other.to_string());
    }

    #[test]
    fn who_uses_actions_by_topics_is_told_how_ros_2_has_them() {
        let of = |version, name: &str| DefinitionError::new(version, SchemaError::Unknown(name.to_owned())).to_string();
        for name in ["x_msgs/msg/CountActionGoal", "actionlib_msgs/msg/GoalID"] {
            let two = of(RosVersion::Two, name);
            assert_eq!(
                two,
                format!(
                    "no definition of {name} is known here: ROS 1 actions consist of topics with such messages, but \
                        this servant uses ROS 2; use send_action_goal and advertise_action"
                )
            );
            let one = of(RosVersion::One, name);
            assert!(one.contains("cloudroidctl push"), "{one}");
        }
    }
}
