//! When a servant can be used: when what its interface promises is registered.

use std::collections::BTreeSet;

use package::interface::{Direction, Interface};
use ros::bus::Graph;

/// What of `interface` is not in `graph`, in words.
pub fn missing(interface: &Interface, graph: &Graph) -> Vec<String> {
    let mut missing = Vec::new();
    for topic in interface
        .topics
        .iter()
        .filter(|topic| !topic.lazy && !topic.nodes.is_empty())
    {
        let ends = graph.topics.get(&topic.name);
        let (there, what) = match topic.direction {
            Direction::Output => (
                ends.is_some_and(|ends| covers(&ends.publishers, &topic.nodes)),
                "publisher",
            ),
            Direction::Input => (
                ends.is_some_and(|ends| covers(&ends.subscribers, &topic.nodes)),
                "subscriber",
            ),
        };
        if !there {
            missing.push(format!("the {what} of {}", topic.name));
        }
    }
    let late = |name: &String| interface.late.contains(name);
    for service in &interface.services {
        if !late(&service.name) && !graph.services.contains_key(&service.name) {
            missing.push(format!("the service {}", service.name));
        }
    }
    for action in &interface.actions {
        let ends = graph.actions.get(&action.name);
        if !late(&action.name) && ends.is_none_or(|ends| ends.servers.is_empty()) {
            missing.push(format!("the action {}", action.name));
        }
    }
    missing
}

/// Nodes of the interface that have registered nothing.
pub fn missing_nodes(interface: &Interface, graph: &Graph) -> Vec<String> {
    let topics = interface.topics.iter().flat_map(|topic| &topic.nodes);
    let services = interface.services.iter().map(|service| &service.node);
    let actions = interface.actions.iter().map(|action| &action.node);
    let expected: BTreeSet<&String> = topics.chain(services).chain(actions).collect();
    expected
        .into_iter()
        .filter(|node| !graph.nodes.contains_key(*node))
        .cloned()
        .collect()
}

fn covers(there: &[String], expected: &[String]) -> bool {
    expected.iter().all(|node| there.contains(node))
}

#[cfg(test)]
mod tests {
    use package::interface::{Action, Service, Topic};
    use ros::bus::{ActionNodes, TopicNodes};

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
            actions: vec![Action {
                name: "/go".into(),
                type_name: "a/Go".into(),
                node: "/node".into(),
            }],
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
            missing(&interface(), &graph),
            [
                "the publisher of /out",
                "the subscriber of /in",
                "the service /add",
                "the action /go"
            ]
        );
        assert_eq!(missing_nodes(&interface(), &graph), ["/node"]);
        graph.topics.insert("/out".into(), ends(&["/node"], &[]));
        graph
            .topics
            .insert("/in".into(), ends(&["/node"], &["/other"]));
        let served = ActionNodes {
            servers: vec!["/node".into()],
            ..ActionNodes::default()
        };
        graph.actions.insert("/go".into(), served);
        graph.services.insert("/add".into(), "/node".into());
        graph
            .nodes
            .insert("/node".into(), "http://localhost:1".into());
        assert_eq!(
            missing(&interface(), &graph),
            ["the subscriber of /in"],
            "another node's end does not count"
        );
        graph.topics.insert("/in".into(), ends(&[], &["/node"]));
        assert!(
            missing(&interface(), &graph).is_empty(),
            "lazy inputs are not awaited"
        );
        assert!(missing_nodes(&interface(), &graph).is_empty());
    }

    #[test]
    fn what_comes_only_with_a_robot_is_not_awaited() {
        let mut promised = interface();
        promised.late = vec!["/add".into(), "/go".into()];
        assert_eq!(
            missing(&promised, &Graph::default()),
            ["the publisher of /out", "the subscriber of /in"]
        );
    }

    #[test]
    fn what_only_a_supplement_promises_is_not_awaited() {
        let mut promised = interface();
        promised.topics = vec![Topic {
            nodes: Vec::new(),
            ..topic("/later", Direction::Input, false)
        }];
        promised.services.clear();
        promised.actions.clear();
        assert!(missing(&promised, &Graph::default()).is_empty());
    }
}
