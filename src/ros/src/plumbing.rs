//! What ROS itself gives to every node, and no robot asks for: it is no part of a package's interface.

use crate::bus::{Graph, RosVersion};
use crate::ros1::own_parameters;
use crate::ros2::lifecycle::LifecycleNode;

/// Services below each node of ROS 2: its parameters, its types, its loggers.
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

/// Services by which a node's lifecycle is driven and asked for.
const OF_LIFECYCLES: [&str; 5] = [
    "change_state",
    "get_state",
    "get_available_states",
    "get_available_transitions",
    "get_transition_graph",
];

/// Whether a topic is ROS's own: logs, statistics, simulated time, the life lines of nodelets, changes of parameters and of
/// lifecycles.
pub fn topic(graph: &Graph, name: &str) -> bool {
    let everybodys = matches!(
        name,
        "/rosout" | "/rosout_agg" | "/statistics" | "/clock" | "/parameter_events"
    );
    let of_type = graph.topics.get(name).map(|topic| topic.type_name.as_str());
    let of_lifecycle = name
        .strip_suffix("/transition_event")
        .is_some_and(|node| LifecycleNode::is_one(graph, node));
    everybodys || of_lifecycle || matches!(of_type, Some("bond/Status" | "bond/msg/Status"))
}

/// Whether a service is ROS's own.
pub fn service(version: RosVersion, graph: &Graph, name: &str) -> bool {
    let Some((above, last)) = name.rsplit_once('/') else {
        return false;
    };
    match version {
        RosVersion::One => matches!(last, "get_loggers" | "set_logger_level"),
        RosVersion::Two => {
            let own = graph.services.get(name).is_some_and(|node| node == above);
            let of_lifecycle = OF_LIFECYCLES.contains(&last) && LifecycleNode::is_one(graph, above);
            own && (OF_NODES.contains(&last) || of_lifecycle)
        }
    }
}

/// Whether a parameter is ROS's own: of ROS 1 by its absolute name, of ROS 2 by the name that its node has for it.
pub fn parameter(name: &str) -> bool {
    own_parameters::every_node_asks_for(name)
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
            services: services
                .map(|(name, node)| ((*name).to_owned(), (*node).to_owned()))
                .collect(),
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
        let two = |name: &str| service(RosVersion::Two, &graph, name);
        for own in [
            "/see/get_parameters",
            "/drive/change_state",
            "/drive/get_state",
        ] {
            assert!(two(own), "{own}");
        }
        // Of a node without a lifecycle, of somebody else, of the package.
        for packages in ["/lamp/get_state", "/see/list_parameters", "/add"] {
            assert!(!two(packages), "{packages}");
        }
        assert!(topic(&graph, "/drive/transition_event"));
        assert!(!topic(&graph, "/see/transition_event"));
        assert!(topic(&graph, "/parameter_events"));
    }

    #[test]
    fn ros_1_has_others() {
        let mut graph = graph(&[
            ("/adder/set_parameters", "/adder"),
            ("/adder/get_loggers", "/adder"),
        ]);
        let one = |name: &str| service(RosVersion::One, &graph, name);
        assert!(one("/adder/get_loggers") && !one("/adder/set_parameters"));
        let bond = TopicNodes {
            type_name: "bond/Status".to_owned(),
            ..TopicNodes::default()
        };
        graph.topics.insert("/bond".to_owned(), bond);
        assert!(topic(&graph, "/bond") && !topic(&graph, "/image"));
    }

    #[test]
    fn parameters_that_every_node_has_are_known() {
        for own in [
            "use_sim_time",
            "qos_overrides./parameter_events.publisher.depth",
            "/use_sim_time",
        ] {
            assert!(parameter(own), "{own}");
        }
        assert!(!parameter("rate") && !parameter("/see/rate"));
    }
}
