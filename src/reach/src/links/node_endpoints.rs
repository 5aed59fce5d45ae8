//! Endpoints of one node as shown in the graph of its servant, for either ROS version. In ROS 1 the Master knows topic
//! types by name and nothing about service types. In ROS 2 each endpoint announces everything, and hidden names are
//! included, because a stub needs the topics and services of the node's actions.

use std::collections::BTreeMap;

use ros::bus::{Graph, NodeNames, QosProfile, RosVersion, ServiceType, WireType};

/// Topic of ROS 2 that every node publishes, and on which a node receives only its own changes.
const OWN_EVENTS: &str = "/parameter_events";

/// Endpoints of a node.
#[derive(Debug, Default, PartialEq)]
pub(super) struct NodeEndpointSet {
    /// Topics that it publishes.
    pub(super) outputs: BTreeMap<String, DeclaredType>,
    /// Topics that it subscribes to.
    pub(super) inputs: BTreeMap<String, DeclaredType>,
    /// Services that it provides; the type is `None` if the server must be asked.
    pub(super) services: BTreeMap<String, Option<ServiceType>>,
}

/// Type of a topic, as far as it is announced.
#[derive(Debug, Clone, PartialEq)]
pub(super) enum DeclaredType {
    /// Name of the type (ROS 1).
    Named(String),
    /// Type and QoS as announced by the endpoint (ROS 2).
    Told(WireType, QosProfile),
}

impl DeclaredType {
    /// Returns the QoS, if it is announced.
    pub(super) fn qos(&self) -> Option<link::control::WireQos> {
        match self {
            DeclaredType::Named(_) => None,
            DeclaredType::Told(_, qos) => Some(link::control::WireQos::from_bus(qos)),
        }
    }
}

impl NodeEndpointSet {
    /// Returns the endpoints of this node; in ROS 2 those of all nodes of its process.
    pub(super) fn from_graph(graph: &Graph, node: &str, version: RosVersion) -> Self {
        match version {
            RosVersion::One => Self::from_ros1_graph(graph, node),
            RosVersion::Two => Self::from_ros2_graph(graph, node),
        }
    }

    fn from_ros1_graph(graph: &Graph, node: &str) -> Self {
        let mut seen = Self::default();
        let is_it = |other: &String| other == node;
        for (topic, ends) in &graph.topics {
            let declared = || DeclaredType::Named(ends.type_name.clone());
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

    fn from_ros2_graph(graph: &Graph, node: &str) -> Self {
        let ends = graph.merged_endpoints(&graph.process_nodes(node));
        let declared = |topics: &BTreeMap<String, (WireType, QosProfile)>| {
            let topics = topics.iter();
            topics.map(|(topic, (of, qos))| (topic.clone(), DeclaredType::Told(of.clone(), *qos))).collect()
        };
        let mut inputs: BTreeMap<String, DeclaredType> = declared(&ends.subscribers);
        inputs.remove(OWN_EVENTS);
        let services = ends.services.iter();
        Self {
            outputs: declared(&ends.publishers),
            inputs,
            services: services.map(|(name, of)| (name.clone(), Some(of.clone()))).collect(),
        }
    }
}

/// Returns the owners of the endpoints of a process, unless all belong to this node.
pub(super) fn owners(graph: &Graph, node: &str) -> BTreeMap<String, NodeNames> {
    let nodes = graph.process_nodes(node);
    if nodes.len() < 2 {
        return BTreeMap::new();
    }
    let there = nodes.into_iter();
    let has = there.filter_map(|node| {
        let mut names = graph.ends.get(&node)?.names();
        names.subscribes.remove(OWN_EVENTS);
        Some((node, names))
    });
    has.collect()
}

/// Returns services and actions that the node's process looks up and that have no server in the servant.
pub(super) fn unmet_lookups(graph: &Graph, node: &str) -> Vec<String> {
    let nodes = graph.process_nodes(node);
    let is_it = |other: &String| nodes.contains(other);
    let services = graph.sought.iter();
    let services = services
        .filter(|(service, nodes)| nodes.iter().any(is_it) && !graph.services.contains_key(*service))
        .map(|(service, _)| service.clone());
    // Actions of ROS 2, whose topics and services are hidden; those of ROS 1 consist of topics.
    let actions = graph
        .actions
        .iter()
        .filter(|(_, ends)| ends.topics.is_empty() && ends.servers.is_empty() && ends.clients.iter().any(is_it));
    services.chain(actions.map(|(action, _)| action.clone())).collect()
}

#[cfg(test)]
mod tests {
    use ros::bus::{ActionNodes, NodeEntities, TopicNodes};

    use super::*;

    fn topic_with_both(topic: &str) -> (String, TopicNodes) {
        let nodes = || vec!["/see".to_owned(), "/other".to_owned()];
        let ends = TopicNodes { type_name: "std_msgs/String".to_owned(), publishers: nodes(), subscribers: nodes() };
        (topic.to_owned(), ends)
    }

    #[test]
    fn a_node_of_ros_1_has_what_the_master_knows() {
        let graph = Graph {
            topics: [topic_with_both("/chatter"), topic_with_both("/fib/goal")].into(),
            services: [("/set".to_owned(), "/see".to_owned())].into(),
            ..Graph::default()
        };
        let seen = NodeEndpointSet::from_graph(&graph, "/see", RosVersion::One);
        let named = DeclaredType::Named("std_msgs/String".to_owned());
        assert_eq!(seen.outputs["/chatter"], named);
        assert_eq!(seen.inputs["/fib/goal"], named);
        assert_eq!(seen.services, [("/set".to_owned(), None)].into());
        assert_eq!(named.qos(), None);
        assert_eq!(NodeEndpointSet::from_graph(&graph, "/nobody", RosVersion::One), NodeEndpointSet::default());
    }

    #[test]
    fn a_node_of_ros_2_has_what_its_ends_tell_with_the_parts_of_its_actions() {
        let of = |name: &str| WireType::with_name(name).with_version(RosVersion::Two);
        let latching = QosProfile::keep_last(1).latching(true);
        let topic = |name: &str, qos| (name.to_owned(), (of("std_msgs/msg/String"), qos));
        let get_result = ServiceType::new("test_msgs/action/Fibonacci_GetResult", "*");
        let ends = NodeEntities {
            publishers: [topic("/map", latching), topic("/parameter_events", QosProfile::keep_last(10))].into(),
            subscribers: [
                topic("/scan", QosProfile::keep_last(5)),
                topic("/parameter_events", QosProfile::keep_last(10)),
            ]
            .into(),
            services: [("/fib/_action/get_result".to_owned(), get_result.clone())].into(),
            ..NodeEntities::default()
        };
        let graph = Graph {
            // Only its own endpoints count.
            topics: [topic_with_both("/chatter")].into(),
            ends: [("/see".to_owned(), ends)].into(),
            ..Graph::default()
        };
        let seen = NodeEndpointSet::from_graph(&graph, "/see", RosVersion::Two);
        let names = |topics: &BTreeMap<String, DeclaredType>| topics.keys().cloned().collect::<Vec<_>>();
        assert_eq!(names(&seen.outputs), ["/map", "/parameter_events"]);
        assert_eq!(names(&seen.inputs), ["/scan"]);
        let told = seen.outputs["/map"].qos().expect("it is told");
        assert!(told.transient_local && !told.best_effort);
        assert_eq!(seen.services["/fib/_action/get_result"], Some(get_result));
    }

    #[test]
    fn a_process_of_ros_2_has_what_its_nodes_have_and_it_is_said_whose_it_is() {
        let of = || WireType::with_name("std_msgs/msg/String").with_version(RosVersion::Two);
        let topics = |names: &[&str]| {
            let topic = |name: &&str| ((*name).to_owned(), (of(), QosProfile::keep_last(1)));
            names.iter().map(topic).collect()
        };
        let node = |publishes: &[&str], subscribes: &[&str]| NodeEntities {
            publishers: topics(publishes),
            subscribers: topics(subscribes),
            ..NodeEntities::default()
        };
        let nodes = || ["/see".to_owned(), "/tell".to_owned()];
        let graph = |process: &[String]| Graph {
            ends: [
                ("/see".to_owned(), node(&["/found"], &["/image"])),
                ("/tell".to_owned(), node(&["/said", "/found"], &[OWN_EVENTS])),
                ("/other".to_owned(), node(&["/others"], &[])),
            ]
            .into(),
            sought: [("/map".to_owned(), vec!["/tell".to_owned()])].into(),
            enclaves: [("/cloudroid_link/see".to_owned(), process.iter().cloned().collect())].into(),
            ..Graph::default()
        };
        let one = graph(&nodes()[..1]);
        assert!(owners(&one, "/see").is_empty() && unmet_lookups(&one, "/see").is_empty());
        let two = graph(&nodes());
        let seen = NodeEndpointSet::from_graph(&two, "/see", RosVersion::Two);
        let outputs: Vec<_> = seen.outputs.keys().collect();
        assert_eq!(outputs, ["/found", "/said"]);
        assert_eq!(seen.inputs.keys().collect::<Vec<_>>(), ["/image"]);
        assert_eq!(unmet_lookups(&two, "/see"), ["/map"]);
        let names = |names: &[&str]| names.iter().map(ToString::to_string).collect();
        let see = NodeNames { publishes: names(&["/found"]), subscribes: names(&["/image"]), ..NodeNames::default() };
        let tell = NodeNames { publishes: names(&["/found", "/said"]), ..NodeNames::default() };
        let [one, other] = nodes();
        assert_eq!(owners(&two, "/see"), [(one, see), (other, tell)].into());
    }

    #[test]
    fn unmet_lookups_are_services_and_actions() {
        let see = || vec!["/see".to_owned()];
        let action = |servers| ActionNodes { servers, clients: see(), ..ActionNodes::default() };
        let graph = Graph {
            sought: [
                ("/map".to_owned(), see()),
                ("/lent".to_owned(), see()),
                ("/others".to_owned(), vec!["/other".to_owned()]),
            ]
            .into(),
            services: [("/lent".to_owned(), "/cloudroid_bridge".to_owned())].into(),
            actions: [("/go".to_owned(), action(Vec::new())), ("/stay".to_owned(), action(see()))].into(),
            ..Graph::default()
        };
        assert_eq!(unmet_lookups(&graph, "/see"), ["/map", "/go"]);
    }
}
