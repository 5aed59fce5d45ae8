//! Parameters that every ROS 1 system has.

/// Names that the Master or roslaunch sets, without the names below them.
const OF_MASTER: [&str; 4] = ["run_id", "rosdistro", "rosversion", "roslaunch"];

/// Names that every roscpp or rospy node reads.
const OF_NODES: [&str; 4] = ["use_sim_time", "tcp_keepalive", "enable_statistics", "rosout_disable_topics_generation"];

/// Returns true if the Master or roslaunch sets this parameter, or one above it. `name` may be absolute or not.
pub fn is_set_by_master(name: &str) -> bool {
    let first = name.trim_start_matches('/').split('/').next();
    first.is_some_and(|first| OF_MASTER.contains(&first))
}

/// Returns true if every node reads the parameter of this absolute name, so that a read says nothing about the node.
pub fn is_read_by_every_node(name: &str) -> bool {
    let Some(name) = name.strip_prefix('/') else {
        return false;
    };
    is_set_by_master(name) || OF_NODES.contains(&name) || name.starts_with("statistics_window_")
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn what_a_system_has_of_itself_is_told_from_what_nodes_are_given() {
        for (name, master, node) in [
            ("/run_id", true, true),
            ("run_id", true, false),
            ("/roslaunch/uris/host__1", true, true),
            ("/run_id_of_mine", false, false),
            ("/use_sim_time", false, true),
            ("/statistics_window_min_elements", false, true),
            ("/detector/run_id", false, false),
            ("/detector/use_sim_time", false, false),
        ] {
            assert_eq!((is_set_by_master(name), is_read_by_every_node(name)), (master, node), "{name}");
        }
    }
}
