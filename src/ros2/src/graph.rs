//! The ROS graph derived from DDS discovery: topics, services and actions with the nodes at both ends.

use std::collections::BTreeMap;

use ros_bus::{Graph, TopicNodes};
use rtps::Guid;

use super::ends::LocalEndpoints;
use super::names::{self, RosTopicRole};
use super::node_ends;
use super::seen::DiscoverySnapshot;

/// One endpoint, of this node or of another.
struct GraphEndpoint<'a> {
    topic: &'a str,
    type_name: &'a str,
    node: String,
    writes: bool,
}

/// Builds the graph of all nodes; `own` are the endpoints of the node with this name and participant. Names with a part
/// that begins with `_` are left out of what is shown, and so are endpoints whose node is not known yet.
pub(super) fn build(seen: &DiscoverySnapshot, own: &LocalEndpoints, (node, participant): (&str, Guid)) -> Graph {
    let mut building = GraphBuilder::default();
    for end in all_endpoints(seen, own, node) {
        building.add(&end);
    }
    let mut graph = building.graph;
    graph.ends = node_ends::collect_endpoints(seen);
    let served = &graph.services;
    let sought = building.sought.into_iter();
    graph.sought = sought.filter(|(service, _)| !served.contains_key(service)).collect();
    let nodes = seen.nodes.iter().map(|(name, participant)| (&**name, *participant));
    let nodes = nodes.chain([(node, participant)]);
    let shown = nodes.filter(|(name, _)| !names::is_hidden(name));
    graph.nodes = shown.map(|(name, participant)| (name.to_owned(), participant.to_string())).collect();
    let enclaves = seen.enclaves.iter();
    graph.enclaves = enclaves
        .map(|(enclave, nodes)| (enclave.clone(), nodes.iter().map(|name| name.to_string()).collect()))
        .collect();
    graph
}

/// Returns all endpoints, writers first, because they determine a topic's type.
fn all_endpoints<'a>(seen: &'a DiscoverySnapshot, own: &'a LocalEndpoints, node: &'a str) -> Vec<GraphEndpoint<'a>> {
    let (writers, readers) = (seen.discovered.writers.values(), seen.discovered.readers.values());
    let sides = [(true, &own.writers), (false, &own.readers)];
    let theirs = writers.map(|end| (true, end)).chain(readers.map(|end| (false, end)));
    let named = theirs.filter(|(_, end)| seen.is_named(end.guid));
    let theirs = named.map(|(writes, end)| GraphEndpoint {
        topic: &end.topic,
        type_name: &end.type_name,
        node: seen.node(end.guid).to_string(),
        writes,
    });
    let ours = sides.into_iter().flat_map(move |(writes, ends)| {
        ends.values().map(move |end| GraphEndpoint {
            topic: &end.topic,
            type_name: &end.type_name,
            node: node.to_owned(),
            writes,
        })
    });
    let mut all: Vec<GraphEndpoint<'a>> = theirs.chain(ours).collect();
    all.sort_by_key(|end| !end.writes);
    all
}

#[derive(Default)]
struct GraphBuilder {
    graph: Graph,
    /// Services for which nodes have clients.
    sought: BTreeMap<String, Vec<String>>,
}

impl GraphBuilder {
    fn add(&mut self, end: &GraphEndpoint<'_>) {
        match names::topic_role(end.topic) {
            Some(RosTopicRole::Topic(name)) if !names::is_hidden(&name) => self.topic(name, end),
            Some(RosTopicRole::Request(name)) => match names::action_part(&name) {
                Some((action, "send_goal")) => self.action(action, end),
                _ if !names::is_hidden(&name) => self.service(name, end),
                _ => {}
            },
            // Servers and clients are found by the request topics.
            _ => {}
        }
    }

    fn topic(&mut self, name: String, end: &GraphEndpoint<'_>) {
        let topic = self
            .graph
            .topics
            .entry(name)
            .or_insert_with(|| TopicNodes { type_name: names::ros_type(end.type_name), ..TopicNodes::default() });
        let nodes = if end.writes { &mut topic.publishers } else { &mut topic.subscribers };
        add(nodes, &end.node);
    }

    fn service(&mut self, name: String, end: &GraphEndpoint<'_>) {
        if end.writes {
            add(self.sought.entry(name).or_default(), &end.node);
        } else {
            let server = self.graph.services.entry(name);
            server.or_insert_with(|| end.node.clone());
        }
    }

    /// Adds an endpoint of an action. Servers determine the action's type: a client may be mistaken, although clients
    /// come first here.
    fn action(&mut self, name: &str, end: &GraphEndpoint<'_>) {
        let type_name = names::action_type(end.type_name);
        let type_name = type_name.unwrap_or_else(|| "*".to_owned());
        let action = self.graph.actions.entry(name.to_owned()).or_default();
        let is_first_server = !end.writes && action.servers.is_empty();
        if is_first_server || action.type_name.is_empty() {
            action.type_name = type_name;
        }
        let nodes = if end.writes { &mut action.clients } else { &mut action.servers };
        add(nodes, &end.node);
    }
}

/// Adds a node unless present; a node may have several endpoints of one topic.
fn add(nodes: &mut Vec<String>, node: &str) {
    if !nodes.iter().any(|known| known == node) {
        nodes.push(node.to_owned());
    }
}

#[cfg(test)]
mod tests {
    use std::collections::HashMap;
    use std::sync::Arc;

    use bytes::Bytes;
    use ros_bus::ActionNodes;
    use rtps::{DiscoveredGraph, EndpointData, EndpointQos, EntityId, GuidPrefix, ParticipantData, VendorId};

    use super::super::ends::LocalEndpoint;
    use super::super::entities::{DiscoveredNode, GidSize, ParticipantEntities};
    use super::*;

    /// An endpoint with this number in the participant with this number.
    fn guid(participant: u8, end: u8, writes: bool) -> Guid {
        let kind = if writes { 3 } else { 4 };
        Guid::new(GuidPrefix([participant; 12]), EntityId([0, 0, end, kind]))
    }

    fn participant(number: u8, user_data: &'static [u8]) -> Arc<ParticipantData> {
        Arc::new(ParticipantData {
            prefix: GuidPrefix([number; 12]),
            vendor: VendorId::FAST_DDS,
            version: [2, 3],
            domain: None,
            name: String::new(),
            user_data: Bytes::from_static(user_data),
            discovery: Vec::new(),
            user: Vec::new(),
            builtin: 0,
            lease: None,
        })
    }

    fn endpoint(guid: Guid, topic: &str, type_name: &str) -> Arc<EndpointData> {
        Arc::new(EndpointData {
            guid,
            topic: topic.to_owned(),
            type_name: type_name.to_owned(),
            qos: EndpointQos::default(),
            user_data: Bytes::new(),
            unicast: Vec::new(),
            expects_inline_qos: false,
        })
    }

    const STRING: &str = "std_msgs::msg::dds_::String_";
    const SET_BOOL: &str = "std_srvs::srv::dds_::SetBool_Request_";
    const SEND_GOAL: &str = "test_msgs::action::dds_::Fibonacci_SendGoal_Request_";

    /// Participant 1 belongs to ROS and has a node that serves; participant 2 does not.
    fn snapshot(owned: &[Guid], ends: Vec<Arc<EndpointData>>) -> DiscoverySnapshot {
        let mut discovered = DiscoveredGraph::default();
        for told in [participant(1, b"enclave=/;"), participant(2, b"")] {
            discovered.participants.insert(told.prefix, told);
        }
        for end in ends {
            let known = if end.guid.entity.is_writer() { &mut discovered.writers } else { &mut discovered.readers };
            known.insert(end.guid, end);
        }
        let (writers, readers) = owned.iter().copied().partition(|end: &Guid| end.entity.is_writer());
        let node = |name: &str, readers, writers| DiscoveredNode { name: name.into(), readers, writers };
        let entities = ParticipantEntities {
            nodes: vec![node("/server", readers, writers), node("/_ros2cli_1", Vec::new(), Vec::new())],
            gids: GidSize::Sixteen,
        };
        let told = HashMap::from([(GuidPrefix([1; 12]), Arc::new(entities))]);
        DiscoverySnapshot::new(Arc::new(discovered), &told)
    }

    #[test]
    fn topics_services_and_actions_are_what_ends_are_named_after() {
        let owned = [guid(1, 1, true), guid(1, 2, false), guid(1, 3, false), guid(1, 4, true), guid(1, 5, true)];
        let seen = snapshot(
            &owned,
            vec![
                endpoint(owned[0], "rt/chatter", STRING),
                endpoint(owned[1], "rq/set_boolRequest", SET_BOOL),
                endpoint(owned[2], "rq/fib/_action/send_goalRequest", SEND_GOAL),
                endpoint(owned[3], "rt/fib/_action/feedback", "x"),
                endpoint(owned[4], "rq/neededRequest", SET_BOOL),
                // Not announced yet.
                endpoint(guid(1, 9, true), "rt/early", STRING),
                endpoint(guid(2, 1, false), "rt/chatter", "Other::Type"),
                endpoint(guid(2, 2, true), "rt/_hidden", STRING),
                endpoint(guid(2, 3, true), "not_ros", STRING),
            ],
        );
        let mut own = LocalEndpoints::default();
        let asked = LocalEndpoint { topic: "rq/set_boolRequest".to_owned(), type_name: SET_BOOL.to_owned() };
        own.writers.insert(guid(3, 1, true), asked);
        let sends =
            LocalEndpoint { topic: "rq/fib/_action/send_goalRequest".to_owned(), type_name: SEND_GOAL.to_owned() };
        own.writers.insert(guid(3, 2, true), sends);
        let us = Guid::new(GuidPrefix([3; 12]), EntityId::PARTICIPANT);
        let graph = build(&seen, &own, ("/us", us));

        let server = || vec!["/server".to_owned()];
        let stranger = Guid::new(GuidPrefix([2; 12]), EntityId::PARTICIPANT).to_string();
        let chatter = TopicNodes {
            type_name: "std_msgs/msg/String".to_owned(),
            publishers: server(),
            subscribers: vec![stranger],
        };
        assert_eq!(graph.topics, [("/chatter".to_owned(), chatter)].into());
        assert_eq!(graph.services, [("/set_bool".to_owned(), "/server".to_owned())].into());
        assert_eq!(graph.sought, [("/needed".to_owned(), server())].into());
        let fib = ActionNodes {
            type_name: "test_msgs/action/Fibonacci".to_owned(),
            servers: server(),
            clients: vec!["/us".to_owned()],
            topics: Vec::new(),
        };
        assert_eq!(graph.actions, [("/fib".to_owned(), fib)].into());
        let nodes: Vec<&str> = graph.nodes.keys().map(String::as_str).collect();
        assert_eq!(nodes, ["/server", "/us"]);
        assert_eq!(graph.nodes["/us"], us.to_string());
    }

    #[test]
    fn an_action_is_what_its_server_says() {
        let server = guid(1, 1, false);
        let fib = "rq/fib/_action/send_goalRequest";
        let other = "test_msgs::action::dds_::NestedMessage_SendGoal_Request_";
        let seen = snapshot(
            &[server],
            vec![
                endpoint(guid(2, 1, true), fib, other),
                endpoint(server, fib, SEND_GOAL),
                endpoint(guid(2, 2, false), fib, other),
            ],
        );
        let graph = build(&seen, &LocalEndpoints::default(), ("/us", guid(3, 0, true)));
        let fib = &graph.actions["/fib"];
        assert_eq!(fib.type_name, "test_msgs/action/Fibonacci");
    }

    #[test]
    fn nodes_of_one_name_are_told_apart_by_their_enclaves() {
        let participants = [
            participant(1, b"enclave=/;"),
            participant(2, b"enclave=/a/b;"),
            participant(3, b"x=y;enclave=/c;;"),
            participant(4, b"enclave=/c;"),
            participant(5, b"enclave=\xff;"),
            participant(6, b""),
        ];
        let mut discovered = DiscoveredGraph::default();
        let mut told = HashMap::new();
        for told_of in participants {
            let node = |name: String| DiscoveredNode { name: name.into(), readers: Vec::new(), writers: Vec::new() };
            let own = format!("/own_{}", told_of.prefix.0[0]);
            let entities = ParticipantEntities {
                nodes: vec![node("/see".into()), node(own), node("/_hidden".into())],
                gids: GidSize::Sixteen,
            };
            told.insert(told_of.prefix, Arc::new(entities));
            discovered.participants.insert(told_of.prefix, told_of);
        }
        let seen = DiscoverySnapshot::new(Arc::new(discovered), &told);
        let graph = build(&seen, &LocalEndpoints::default(), ("/us", guid(9, 0, true)));
        let nodes = |names: &[&str]| names.iter().map(|&name| name.to_owned()).collect();
        let expected = [
            ("/a/b".to_owned(), nodes(&["/_hidden", "/own_2", "/see"])),
            ("/c".to_owned(), nodes(&["/_hidden", "/own_3", "/own_4", "/see"])),
        ];
        assert_eq!(graph.enclaves, expected.into());
    }

    #[test]
    fn nobody_tells_of_the_ends_of_others() {
        let theirs = guid(2, 1, true);
        let seen = snapshot(&[theirs], vec![endpoint(theirs, "rt/chatter", STRING)]);
        let graph = build(&seen, &LocalEndpoints::default(), ("/us", guid(3, 0, true)));
        let stranger = Guid::new(GuidPrefix([2; 12]), EntityId::PARTICIPANT).to_string();
        assert_eq!(graph.topics["/chatter"].publishers, [stranger]);
    }
}
