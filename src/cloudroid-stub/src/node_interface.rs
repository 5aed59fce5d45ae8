//! Interface of a node in the graph of either ROS version. Topics and services of the ROS 2 graph are those that its
//! tools show; topics and services of actions are listed only among the endpoints of nodes.

use ros::bus::Graph;

/// Returns whether a node of this name exists.
pub fn has_node(graph: &Graph, node: &str) -> bool {
    graph.nodes.contains_key(node) || graph.ends.contains_key(node)
}

/// Returns whether the node publishes this topic.
pub fn publishes(graph: &Graph, node: &str, topic: &str) -> bool {
    let shown = graph.topics.get(topic);
    let shown = shown.is_some_and(|ends| ends.publishers.iter().any(|name| name == node));
    let ends = graph.ends.get(node);
    shown || ends.is_some_and(|ends| ends.publishers.contains_key(topic))
}

/// Returns whether the node subscribes to this topic.
pub fn subscribes(graph: &Graph, node: &str, topic: &str) -> bool {
    let shown = graph.topics.get(topic);
    let shown = shown.is_some_and(|ends| ends.subscribers.iter().any(|name| name == node));
    let ends = graph.ends.get(node);
    shown || ends.is_some_and(|ends| ends.subscribers.contains_key(topic))
}

/// Returns whether the node serves this service.
pub fn serves(graph: &Graph, node: &str, service: &str) -> bool {
    let shown = graph.services.get(service);
    let ends = graph.ends.get(node);
    shown.is_some_and(|server| server == node) || ends.is_some_and(|ends| ends.services.contains_key(service))
}

#[cfg(test)]
mod tests {
    use std::collections::BTreeMap;

    use ros::bus::{NodeEntities, QosProfile, ServiceType, TopicNodes, WireType};

    use super::*;

    #[test]
    fn what_tools_hide_is_seen_too() {
        let of_two = NodeEntities {
            publishers: BTreeMap::from([(
                "/fib/_action/feedback".to_owned(),
                (WireType::any(), QosProfile::keep_last(1)),
            )]),
            services: BTreeMap::from([(
                "/fib/_action/send_goal".to_owned(),
                ServiceType::new("a/action/Fib_SendGoal", "*"),
            )]),
            ..NodeEntities::default()
        };
        let graph = Graph {
            topics: BTreeMap::from([(
                "/scan".to_owned(),
                TopicNodes { subscribers: vec!["/one".to_owned()], ..TopicNodes::default() },
            )]),
            services: BTreeMap::from([("/set".to_owned(), "/one".to_owned())]),
            ends: BTreeMap::from([("/two".to_owned(), of_two)]),
            ..Graph::default()
        };
        assert!(subscribes(&graph, "/one", "/scan") && serves(&graph, "/one", "/set"));
        assert!(publishes(&graph, "/two", "/fib/_action/feedback"));
        assert!(serves(&graph, "/two", "/fib/_action/send_goal"));
        assert!(has_node(&graph, "/two") && !has_node(&graph, "/three"));
        assert!(!publishes(&graph, "/one", "/scan") && !serves(&graph, "/two", "/set"));
    }
}
