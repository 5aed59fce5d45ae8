//! ROS's built-in topics, services and parameters, which every node has and no robot asks for: they are not part of a
//! package's interface.

use crate::bus::{Graph, RosVersion};
use crate::ros1::own_parameters;
use crate::ros2::lifecycle::LifecycleNode;

/// Services of every ROS 2 node, below its name: parameters, types, loggers.
const OF_NODES: [&str; 9] = [
    "get_parameters",
    "set_parameters",
    "set_parameters_atomically",
    "list_parameters",
    "describe_parameters",
    "get_parameter_types",
    "get_type_description",
    "get_logger_levels",
    "set_logger_levels",
];

/// Services that control and query a node's lifecycle.
const OF_LIFECYCLES: [&str; 5] =
    ["change_state", "get_state", "get_available_states", "get_available_transitions", "get_transition_graph"];

/// Returns true for a built-in topic: logs, statistics, simulated time, heartbeats of nodelets (bond), changes of
/// parameters and of lifecycles.
pub fn is_builtin_topic(graph: &Graph, name: &str) -> bool {
    let everybodys = matches!(name, "/rosout" | "/rosout_agg" | "/statistics" | "/clock" | "/parameter_events");
    let of_type = graph.topics.get(name).map(|topic| topic.type_name.as_str());
    let of_lifecycle =
        name.strip_suffix("/transition_event").is_some_and(|node| LifecycleNode::has_lifecycle(graph, node));
    everybodys || of_lifecycle || matches!(of_type, Some("bond/Status" | "bond/msg/Status"))
}

/// Returns true for a built-in service.
pub fn is_builtin_service(version: RosVersion, graph: &Graph, name: &str) -> bool {
    let Some((above, last)) = name.rsplit_once('/') else {
        return false;
    };
    match version {
        RosVersion::One => matches!(last, "get_loggers" | "set_logger_level"),
        RosVersion::Two => {
            let own = graph.services.get(name).is_some_and(|node| node == above);
            let of_lifecycle = OF_LIFECYCLES.contains(&last) && LifecycleNode::has_lifecycle(graph, above);
            own && (OF_NODES.contains(&last) || of_lifecycle)
        }
    }
}

/// Returns true for a built-in parameter. `name` is absolute in ROS 1 and relative to the node in ROS 2.
pub fn is_builtin_parameter(name: &str) -> bool {
    own_parameters::is_read_by_every_node(name)
        || matches!(name, "use_sim_time" | "start_type_description_service")
        || name.starts_with("qos_overrides.")
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::bus::TopicNodes;

    fn graph(services: &[(&str, &str)]) -> Graph {
        let services = services.iter();
        Graph {
            services: services.map(|(name, node)| ((*name).to_owned(), (*node).to_owned())).collect(),
            ..Graph::default()
        }
    }

    #[test]
    fn what_every_node_of_ros_2_has_is_told_by_whose_it_is() {
        let graph = graph(&[
            ("/see/get_parameters", "/see"),
            ("/see/get_state", "/see"),
            ("/drive/change_state", "/drive"),
            ("/drive/get_state", "/drive"),
            ("/lamp/get_state", "/lamp"),
            ("/see/list_parameters", "/other"),
            ("/add", "/see"),
        ]);
        let two = |name: &str| is_builtin_service(RosVersion::Two, &graph, name);
        for own in ["/see/get_parameters", "/drive/change_state", "/drive/get_state"] {
            assert!(two(own), "{own}");
        }
        // A node without a lifecycle, a service of another node, a service of the package.
        for packages in ["/lamp/get_state", "/see/list_parameters", "/add"] {
            assert!(!two(packages), "{packages}");
        }
        assert!(is_builtin_topic(&graph, "/drive/transition_event"));
        assert!(!is_builtin_topic(&graph, "/see/transition_event"));
        assert!(is_builtin_topic(&graph, "/parameter_events"));
    }

    #[test]
    fn ros_1_has_others() {
        let mut graph = graph(&[("/adder/set_parameters", "/adder"), ("/adder/get_loggers", "/adder")]);
        let one = |name: &str| is_builtin_service(RosVersion::One, &graph, name);
        assert!(one("/adder/get_loggers") && !one("/adder/set_parameters"));
        let bond = TopicNodes { type_name: "bond/Status".to_owned(), ..TopicNodes::default() };
        graph.topics.insert("/bond".to_owned(), bond);
        assert!(is_builtin_topic(&graph, "/bond") && !is_builtin_topic(&graph, "/image"));
    }

    #[test]
    fn parameters_that_every_node_has_are_known() {
        for own in ["use_sim_time", "qos_overrides./parameter_events.publisher.depth", "/use_sim_time"] {
            assert!(is_builtin_parameter(own), "{own}");
        }
        assert!(!is_builtin_parameter("rate") && !is_builtin_parameter("/see/rate"));
    }
}
