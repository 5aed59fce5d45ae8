//! Readiness of a servant: everything that its interface promises is registered. What only a deployer's supplement
//! promises, without a known node, is not awaited: the push did not see it, and it may appear with a robot or never.

use std::collections::BTreeSet;

use package::interface::{Direction, Interface};
use ros::bus::Graph;

/// Describes the endpoints of `interface` that are missing in `graph`.
pub fn missing_endpoints(interface: &Interface, graph: &Graph) -> Vec<String> {
    let mut missing = Vec::new();
    for topic in interface.topics.iter().filter(|topic| !topic.lazy) {
        let mut nodes = topic.nodes.iter();
        let (there, what) = match topic.direction {
            Direction::Output => (nodes.all(|node| graph.publishes(node, &topic.name)), "publisher"),
            Direction::Input => (nodes.all(|node| graph.subscribes(node, &topic.name)), "subscriber"),
        };
        if !there {
            missing.push(format!("the {what} of {}", topic.name));
        }
    }
    let awaited = |name: &String, node: &str| !node.is_empty() && !interface.late.contains(name);
    for service in &interface.services {
        if awaited(&service.name, &service.node) && !graph.serves(&service.name) {
            missing.push(format!("the service {}", service.name));
        }
    }
    for action in &interface.actions {
        if awaited(&action.name, &action.node) && !graph.serves_action(&action.name) {
            missing.push(format!("the action {}", action.name));
        }
    }
    missing
}

/// Returns the nodes of the interface that have registered nothing.
pub fn missing_nodes(interface: &Interface, graph: &Graph) -> Vec<String> {
    let topics = interface.topics.iter().flat_map(|topic| &topic.nodes);
    let services = interface.services.iter().map(|service| &service.node);
    let actions = interface.actions.iter().map(|action| &action.node);
    let expected: BTreeSet<&String> = topics.chain(services).chain(actions).collect();
    expected.into_iter().filter(|node| !node.is_empty() && !graph.has_node(node)).cloned().collect()
}

#[cfg(test)]
mod tests {
    use package::interface::{Action, Service, Topic};
    use ros::bus::{ActionNodes, NodeEntities, QosProfile, ServiceType, TopicNodes, WireType};

    use super::*;

    fn topic(name: &str, direction: Direction, lazy: bool) -> Topic {
        Topic {
            name: name.into(),
            type_name: "std_msgs/String".into(),
            md5: String::new(),
            direction,
            nodes: vec!["/node".into()],
            latched: false,
            lazy,
            qos: None,
        }
    }

    fn interface() -> Interface {
        Interface {
            topics: vec![
                topic("/out", Direction::Output, false),
                topic("/in", Direction::Input, false),
                topic("/lazy", Direction::Input, true),
            ],
            services: vec![Service {
                name: "/add".into(),
                type_name: "a/Add".into(),
                md5: String::new(),
                node: "/node".into(),
            }],
            actions: vec![Action { name: "/go".into(), type_name: "a/Go".into(), node: "/node".into() }],
            ..Interface::default()
        }
    }

    fn ends(publishers: &[&str], subscribers: &[&str]) -> TopicNodes {
        let owned = |names: &[&str]| names.iter().map(|name| (*name).to_owned()).collect();
        TopicNodes {
            type_name: "std_msgs/String".into(),
            publishers: owned(publishers),
            subscribers: owned(subscribers),
        }
    }

    #[test]
    fn everything_promised_must_be_there() {
        let mut graph = Graph::default();
        assert_eq!(
            missing_endpoints(&interface(), &graph),
            ["the publisher of /out", "the subscriber of /in", "the service /add", "the action /go"]
        );
        assert_eq!(missing_nodes(&interface(), &graph), ["/node"]);
        graph.topics.insert("/out".into(), ends(&["/node"], &[]));
        graph.topics.insert("/in".into(), ends(&["/node"], &["/other"]));
        let served = ActionNodes { servers: vec!["/node".into()], ..ActionNodes::default() };
        graph.actions.insert("/go".into(), served);
        graph.services.insert("/add".into(), "/node".into());
        graph.nodes.insert("/node".into(), "http://localhost:1".into());
        assert_eq!(
            missing_endpoints(&interface(), &graph),
            ["the subscriber of /in"],
            "another node's end does not count"
        );
        graph.topics.insert("/in".into(), ends(&[], &["/node"]));
        assert!(missing_endpoints(&interface(), &graph).is_empty(), "lazy inputs are not awaited");
        assert!(missing_nodes(&interface(), &graph).is_empty());
    }

    #[test]
    fn what_comes_only_with_a_robot_is_not_awaited() {
        let mut promised = interface();
        promised.late = vec!["/add".into(), "/go".into()];
        assert_eq!(missing_endpoints(&promised, &Graph::default()), ["the publisher of /out", "the subscriber of /in"]);
    }

    #[test]
    fn what_only_a_supplement_promises_is_not_awaited() {
        let mut promised = interface();
        promised.topics = vec![Topic { nodes: Vec::new(), ..topic("/later", Direction::Input, false) }];
        promised.services[0].node.clear();
        promised.actions[0].node.clear();
        assert!(missing_endpoints(&promised, &Graph::default()).is_empty());
        assert!(missing_nodes(&promised, &Graph::default()).is_empty());
    }

    /// Tools of ROS 2 show none of these names.
    #[test]
    fn hidden_names_are_found_by_the_endpoints_of_their_nodes() {
        let node = "/_box";
        let promised = Interface {
            topics: vec![
                Topic { nodes: vec![node.into()], ..topic("/_box/seen", Direction::Output, false) },
                Topic { nodes: vec![node.into()], ..topic("/_box/told", Direction::Input, false) },
            ],
            services: vec![Service {
                name: "/_box/load_node".into(),
                node: node.into(),
                ..interface().services.remove(0)
            }],
            actions: vec![Action { name: "/_box/go".into(), node: node.into(), ..interface().actions.remove(0) }],
            ..Interface::default()
        };
        let mut graph = Graph::default();
        assert_eq!(missing_endpoints(&promised, &graph).len(), 4);
        assert_eq!(missing_nodes(&promised, &graph), [node]);
        let of = || (WireType::any(), QosProfile::keep_last(1));
        let service = |name: &str| (name.to_owned(), ServiceType::new("a/srv/B", "*"));
        let ends = NodeEntities {
            publishers: [("/_box/seen".to_owned(), of())].into(),
            subscribers: [("/_box/told".to_owned(), of())].into(),
            services: [service("/_box/load_node"), service("/_box/go/_action/send_goal")].into(),
            ..NodeEntities::default()
        };
        graph.ends.insert(node.into(), ends);
        assert!(missing_endpoints(&promised, &graph).is_empty());
        assert!(missing_nodes(&promised, &graph).is_empty());
    }
}
