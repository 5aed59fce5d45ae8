//! What clients are told of a definition that cannot be had.

use ros::schema::SchemaError;

/// Debian's packages of message definitions, without their `ros-` and with ROS's underscores.
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

/// The error, and what whoever deploys the service can do about it.
pub(crate) fn explain(error: SchemaError) -> String {
    let (what, name) = match &error {
        SchemaError::Unknown(name) => (format!("no definition of {name} is known here"), name),
        SchemaError::Missing { name, needed_by } => (
            format!("{needed_by} needs {name}, of which no definition is known here"),
            name,
        ),
        _ => return error.to_string(),
    };
    let package = name.split('/').next().unwrap_or_default();
    if OF_DEBIAN.contains(&package) {
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
        let unknown = explain(SchemaError::Unknown("nav_msgs/Path".to_owned()));
        assert_eq!(
            unknown,
            "no definition of nav_msgs/Path is known here; whoever deploys this service can add it: cloudroidctl push … --with ros-nav-msgs"
        );
        let missing = explain(SchemaError::Missing {
            name: "arm_msgs/Joint".to_owned(),
            needed_by: "arm_msgs/Arm".to_owned(),
        });
        assert_eq!(
            missing,
            "arm_msgs/Arm needs arm_msgs/Joint, of which no definition is known here; whoever deploys this service can add it: cloudroidctl push … of a workspace that has arm_msgs, too"
        );
        let other = SchemaError::BadName("x".to_owned());
        assert_eq!(explain(other.clone()), other.to_string());
    }
}
