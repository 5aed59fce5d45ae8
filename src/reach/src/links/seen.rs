//! What one node has, as the graph of its servant shows it in either ROS. ROS 1 is told by the Master, which knows types of topics by
//! their names and of services nothing. In ROS 2 each end tells all of itself, and what tools hide is shown, too: whoever stands
//! in for the node needs the parts of its actions.

use std::collections::BTreeMap;

use link::control::Has;
use ros::bus::{Graph, Qos, RosVersion, ServiceType, WireType};

/// A node hears only its own changes by this topic of ROS 2, which every node publishes.
const OWN_EVENTS: &str = "/parameter_events";

/// What a node has.
#[derive(Debug, Default, PartialEq)]
pub(super) struct Seen {
    /// Topics that it publishes.
    pub(super) outputs: BTreeMap<String, Declared>,
    /// Topics that it listens to.
    pub(super) inputs: BTreeMap<String, Declared>,
    /// Services that it serves; without a type where the server has to be asked.
    pub(super) services: BTreeMap<String, Option<ServiceType>>,
}

/// How a topic's type is known.
#[derive(Debug, Clone, PartialEq)]
pub(super) enum Declared {
    /// By its name (ROS 1).
    Named(String),
    /// As the node's end tells it, with its quality of service (ROS 2).
    Told(WireType, Qos),
}

impl Declared {
    /// The quality of service, where ends tell it.
    pub(super) fn qos(&self) -> Option<link::control::Qos> {
        match self {
            Declared::Named(_) => None,
            Declared::Told(_, qos) => Some(link::control::Qos::of(qos)),
        }
    }
}

impl Seen {
    /// What the node of this name has; in ROS 2 all nodes of its process.
    pub(super) fn of(graph: &Graph, node: &str, version: RosVersion) -> Self {
        match version {
            RosVersion::One => Self::of_one(graph, node),
            RosVersion::Two => Self::of_two(graph, node),
        }
    }

    fn of_one(graph: &Graph, node: &str) -> Self {
        let mut seen = Self::default();
        let is_it = |other: &String| other == node;
        for (topic, ends) in &graph.topics {
            let declared = || Declared::Named(ends.type_name.clone());
            if ends.publishers.iter().any(is_it) {
                seen.outputs.insert(topic.clone(), declared());
            }
            if ends.subscribers.iter().any(is_it) {
                seen.inputs.insert(topic.clone(), declared());
            }
        }
        let served = graph.services.iter().filter(|(_, server)| is_it(server));
        seen.services = served.map(|(name, _)| (name.clone(), None)).collect();
        seen
    }

    fn of_two(graph: &Graph, node: &str) -> Self {
        let ends = graph.ends_of(&graph.of_process(node));
        let declared = |topics: &BTreeMap<String, (WireType, Qos)>| {
            let topics = topics.iter();
            topics
                .map(|(topic, (of, qos))| (topic.clone(), Declared::Told(of.clone(), *qos)))
                .collect()
        };
        let mut inputs: BTreeMap<String, Declared> = declared(&ends.subscribers);
        inputs.remove(OWN_EVENTS);
        let services = ends.services.iter();
        Self {
            outputs: declared(&ends.publishers),
            inputs,
            services: services
                .map(|(name, of)| (name.clone(), Some(of.clone())))
                .collect(),
        }
    }
}

/// Which of what a process has is whose, where it is not all the node's of this name.
pub(super) fn owners(graph: &Graph, node: &str) -> BTreeMap<String, Has> {
    let nodes = graph.of_process(node);
    if nodes.len() < 2 {
        return BTreeMap::new();
    }
    let there = nodes.into_iter();
    let has = there.filter_map(|node| {
        let mut names = graph.ends.get(&node)?.names();
        names.subscribes.remove(OWN_EVENTS);
        Some((node, names.into()))
    });
    has.collect()
}

/// Services and actions that the node's process looks for and nobody in the servant has.
pub(super) fn sought(graph: &Graph, node: &str) -> Vec<String> {
    let nodes = graph.of_process(node);
    let is_it = |other: &String| nodes.contains(other);
    let services = graph.sought.iter();
    let services = services
        .filter(|(service, nodes)| {
            nodes.iter().any(is_it) && !graph.services.contains_key(*service)
        })
        .map(|(service, _)| service.clone());
    // Of ROS 2, where their parts are hidden; those of ROS 1 are made of topics.
    let actions = graph.actions.iter().filter(|(_, ends)| {
        ends.topics.is_empty() && ends.servers.is_empty() && ends.clients.iter().any(is_it)
    });
    services
        .chain(actions.map(|(action, _)| action.clone()))
        .collect()
}

#[cfg(test)]
mod tests {
    use ros::bus::{ActionNodes, NodeEnds, TopicNodes};

    use super::*;

    fn both(topic: &str) -> (String, TopicNodes) {
        let nodes = || vec!["/see".to_owned(), "/other".to_owned()];
        let ends = TopicNodes {
            type_name: "std_msgs/String".to_owned(),
            publishers: nodes(),
            subscribers: nodes(),
        };
        (topic.to_owned(), ends)
    }

    #[test]
    fn a_node_of_ros_1_has_what_the_master_knows() {
        let graph = Graph {
            topics: [both("/chatter"), both("/fib/goal")].into(),
            services: [("/set".to_owned(), "/see".to_owned())].into(),
            ..Graph::default()
        };
        let seen = Seen::of(&graph, "/see", RosVersion::One);
        let named = Declared::Named("std_msgs/String".to_owned());
        assert_eq!(seen.outputs["/chatter"], named);
        assert_eq!(seen.inputs["/fib/goal"], named);
        assert_eq!(seen.services, [("/set".to_owned(), None)].into());
        assert_eq!(named.qos(), None);
        assert_eq!(
            Seen::of(&graph, "/nobody", RosVersion::One),
            Seen::default()
        );
    }

    #[test]
    fn a_node_of_ros_2_has_what_its_ends_tell_with_the_parts_of_its_actions() {
        let of = |name: &str| WireType::named(name).written_by(RosVersion::Two);
        let latching = Qos::keep_last(1).latching(true);
        let topic = |name: &str, qos| (name.to_owned(), (of("std_msgs/msg/String"), qos));
        let get_result = ServiceType::new("test_msgs/action/Fibonacci_GetResult", "*");
        let ends = NodeEnds {
            publishers: [
                topic("/map", latching),
                topic("/parameter_events", Qos::keep_last(10)),
            ]
            .into(),
            subscribers: [
                topic("/scan", Qos::keep_last(5)),
                topic("/parameter_events", Qos::keep_last(10)),
            ]
            .into(),
            services: [("/fib/_action/get_result".to_owned(), get_result.clone())].into(),
            ..NodeEnds::default()
        };
        let graph = Graph {
            // Its ends alone count.
            topics: [both("/chatter")].into(),
            ends: [("/see".to_owned(), ends)].into(),
            ..Graph::default()
        };
        let seen = Seen::of(&graph, "/see", RosVersion::Two);
        let names =
            |topics: &BTreeMap<String, Declared>| topics.keys().cloned().collect::<Vec<_>>();
        assert_eq!(names(&seen.outputs), ["/map", "/parameter_events"]);
        assert_eq!(names(&seen.inputs), ["/scan"]);
        let told = seen.outputs["/map"].qos().expect("it is told");
        assert!(told.transient_local && !told.best_effort);
        assert_eq!(seen.services["/fib/_action/get_result"], Some(get_result));
    }

    #[test]
    fn a_process_of_ros_2_has_what_its_nodes_have_and_it_is_said_whose_it_is() {
        let of = || WireType::named("std_msgs/msg/String").written_by(RosVersion::Two);
        let topics = |names: &[&str]| {
            let topic = |name: &&str| ((*name).to_owned(), (of(), Qos::keep_last(1)));
            names.iter().map(topic).collect()
        };
        let node = |publishes: &[&str], subscribes: &[&str]| NodeEnds {
            publishers: topics(publishes),
            subscribers: topics(subscribes),
            ..NodeEnds::default()
        };
        let nodes = || ["/see".to_owned(), "/tell".to_owned()];
        let graph = |process: &[String]| Graph {
            ends: [
                ("/see".to_owned(), node(&["/found"], &["/image"])),
                (
                    "/tell".to_owned(),
                    node(&["/said", "/found"], &[OWN_EVENTS]),
                ),
                ("/other".to_owned(), node(&["/others"], &[])),
            ]
            .into(),
            sought: [("/map".to_owned(), vec!["/tell".to_owned()])].into(),
            enclaves: [(
                "/cloudroid_link/see".to_owned(),
                process.iter().cloned().collect(),
            )]
            .into(),
            ..Graph::default()
        };
        let one = graph(&nodes()[..1]);
        assert!(owners(&one, "/see").is_empty() && sought(&one, "/see").is_empty());
        let two = graph(&nodes());
        let seen = Seen::of(&two, "/see", RosVersion::Two);
        let outputs: Vec<_> = seen.outputs.keys().collect();
        assert_eq!(outputs, ["/found", "/said"]);
        assert_eq!(seen.inputs.keys().collect::<Vec<_>>(), ["/image"]);
        assert_eq!(sought(&two, "/see"), ["/map"]);
        let names = |names: &[&str]| names.iter().map(ToString::to_string).collect();
        let see = Has {
            outputs: names(&["/found"]),
            inputs: names(&["/image"]),
            ..Has::default()
        };
        let tell = Has {
            outputs: names(&["/found", "/said"]),
            ..Has::default()
        };
        let [one, other] = nodes();
        assert_eq!(owners(&two, "/see"), [(one, see), (other, tell)].into());
    }

    #[test]
    fn what_is_looked_for_in_vain_is_a_service_or_an_action() {
        let see = || vec!["/see".to_owned()];
        let action = |servers| ActionNodes {
            servers,
            clients: see(),
            ..ActionNodes::default()
        };
        let graph = Graph {
            sought: [
                ("/map".to_owned(), see()),
                ("/lent".to_owned(), see()),
                ("/others".to_owned(), vec!["/other".to_owned()]),
            ]
            .into(),
            services: [("/lent".to_owned(), "/cloudroid_bridge".to_owned())].into(),
            actions: [
                ("/go".to_owned(), action(Vec::new())),
                ("/stay".to_owned(), action(see())),
            ]
            .into(),
            ..Graph::default()
        };
        assert_eq!(sought(&graph, "/see"), ["/map", "/go"]);
    }
}
