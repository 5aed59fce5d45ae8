//! Answers from the graph of nodes, topics and services.

use std::collections::{BTreeMap, BTreeSet};
use std::sync::Arc;

use access::Grants;
use futures_util::StreamExt;
use futures_util::stream;
use ros::bus::{Graph, RosVersion, TopicNodes};
use ros::schema::Registry;
use serde_json::{Value, json};

use super::{NODE, RosapiService, find_with_own};
use crate::names::is_same_type;
use crate::shared::BridgeShared;
use crate::{presence, tf};

/// Number of services queried for their type concurrently.
const ASKED_AT_ONCE: usize = 16;

/// Topic of every node's log, including rosapi's.
const ROSOUT: &str = "/rosout";

/// Returns the type; empty if it is not announced yet, as in rosapi.
fn type_or_empty(type_name: &str) -> &str {
    if type_name == "*" { "" } else { type_name }
}

fn topic_type_name(nodes: &TopicNodes) -> &str {
    type_or_empty(&nodes.type_name)
}

/// Returns the graph with the topics that the bridge publishes itself, unless a node of the servant does.
pub(super) fn with_own_topics(version: RosVersion, graph: &Graph) -> Graph {
    let mut graph = graph.clone();
    let ours = TopicNodes::default;
    add_tf_action(version, &mut graph);
    let nodes = graph.topics.entry(ROSOUT.to_owned()).or_insert_with(ours);
    if matches!(nodes.type_name.as_str(), "" | "*") {
        let type_name = match version {
            RosVersion::One => "rosgraph_msgs/Log",
            RosVersion::Two => "rcl_interfaces/msg/Log",
        };
        nodes.type_name = type_name.to_owned();
    }
    nodes.publishers.push(NODE.to_owned());
    for topic in presence::TOPICS {
        let nodes = graph.topics.entry(topic.to_owned()).or_insert_with(ours);
        if nodes.publishers.is_empty() {
            let type_name = presence::type_name(version, topic);
            nodes.type_name = type_name.unwrap_or_default().to_owned();
            nodes.publishers.push(NODE.to_owned());
        }
    }
    graph
}

/// Adds the action that sends transforms, unless a node serves it; in ROS 1 with its topics.
fn add_tf_action(version: RosVersion, graph: &mut Graph) {
    let is_served = match version {
        RosVersion::One => {
            let status = graph.topics.get(tf::STATUS_TOPIC);
            status.is_some_and(|status| !status.publishers.is_empty())
        }
        RosVersion::Two => {
            let action = graph.actions.get(tf::ACTION);
            action.is_some_and(|action| !action.servers.is_empty())
        }
    };
    if is_served {
        return;
    }
    let nodes = graph.actions.entry(tf::ACTION.to_owned()).or_default();
    nodes.servers.push(NODE.to_owned());
    nodes.type_name = tf::action_name(version).to_owned();
    if version == RosVersion::Two {
        return;
    }
    for (topic, type_name, published) in tf::TOPICS {
        let nodes = graph.topics.entry(topic.to_owned()).or_default();
        nodes.type_name = type_name.to_owned();
        let end = if published { &mut nodes.publishers } else { &mut nodes.subscribers };
        end.push(NODE.to_owned());
    }
}

/// Filters the graph for a client with these grants: keeps the names that it may use, and the nodes behind them.
pub(super) fn filter_by_grants(mut graph: Graph, grants: &Grants) -> Graph {
    if grants.is_everything() {
        return graph;
    }
    graph.topics.retain(|topic, _| grants.permits_any(topic));
    graph.services.retain(|service, _| grants.permits_any(service));
    graph.actions.retain(|action, _| grants.permits_any(action));
    let ends = graph.topics.values().flat_map(|nodes| nodes.publishers.iter().chain(&nodes.subscribers));
    let servers = graph.actions.values().flat_map(|nodes| &nodes.servers);
    let behind: BTreeSet<String> = ends.chain(servers).chain(graph.services.values()).cloned().collect();
    graph.nodes.retain(|node, _| behind.contains(node));
    // Not part of any answer to clients.
    graph.ends.clear();
    graph
}

pub(super) fn topics(graph: &Graph) -> Value {
    let topics: Vec<_> = graph.topics.keys().collect();
    let types: Vec<_> = graph.topics.values().map(topic_type_name).collect();
    json!({ "topics": topics, "types": types })
}

pub(super) fn topics_for_type(graph: &Graph, type_name: &str) -> Value {
    let topics =
        graph.topics.iter().filter(|(_, nodes)| is_same_type(&nodes.type_name, type_name)).map(|(topic, _)| topic);
    json!({ "topics": topics.collect::<Vec<_>>() })
}

pub(super) fn topics_and_raw_types(graph: &Graph, version: RosVersion, registry: &Registry) -> Value {
    let mut answer = topics(graph);
    let texts = graph.topics.values().map(|nodes| {
        let found = find_with_own(version, registry, |registry| registry.message(topic_type_name(nodes)));
        found.map(|found| found.full_text().to_owned()).unwrap_or_default()
    });
    answer["typedefs_full_text"] = texts.collect::<Vec<_>>().into();
    answer
}

pub(super) fn topic_type(graph: &Graph, topic: &str) -> Value {
    json!({ "type": graph.topics.get(topic).map_or("", topic_type_name) })
}

pub(super) fn publishers(graph: &Graph, topic: &str) -> Value {
    json!({ "publishers": graph.topics.get(topic).map(|nodes| nodes.publishers.as_slice()).unwrap_or_default() })
}

pub(super) fn subscribers(graph: &Graph, topic: &str) -> Value {
    json!({ "subscribers": graph.topics.get(topic).map(|nodes| nodes.subscribers.as_slice()).unwrap_or_default() })
}

pub(super) fn nodes(graph: &Graph) -> Value {
    let mut nodes: BTreeSet<&str> = graph.nodes.keys().map(String::as_str).collect();
    nodes.insert(NODE);
    json!({ "nodes": nodes })
}

pub(super) fn node_details(graph: &Graph, node: &str) -> Value {
    let topics = |ends: fn(&TopicNodes) -> &Vec<String>| -> Vec<&String> {
        let of_node = graph.topics.iter().filter(|(_, nodes)| ends(nodes).iter().any(|end| end == node));
        of_node.map(|(topic, _)| topic).collect()
    };
    let served = graph.services.iter().filter(|(_, server)| *server == node);
    let mut services: Vec<String> = served.map(|(service, _)| service.clone()).collect();
    if node == NODE {
        services.extend(RosapiService::all().map(RosapiService::full_name));
    }
    json!({
        "subscribing": topics(|nodes| &nodes.subscribers),
        "publishing": topics(|nodes| &nodes.publishers),
        "services": services,
    })
}

pub(super) fn action_servers(graph: &Graph) -> Value {
    let served = graph.actions.iter();
    let served = served.filter(|(_, nodes)| !nodes.servers.is_empty());
    json!({ "action_servers": served.map(|(action, _)| action).collect::<Vec<_>>() })
}

pub(super) fn action_type(graph: &Graph, action: &str) -> Value {
    let known = graph.actions.get(action);
    json!({ "type": known.map_or("", |nodes| type_or_empty(&nodes.type_name)) })
}

fn all_services(graph: &Graph) -> BTreeSet<String> {
    graph.services.keys().cloned().chain(RosapiService::all().map(RosapiService::full_name)).collect()
}

pub(super) fn services(graph: &Graph) -> Value {
    json!({ "services": all_services(graph) })
}

fn service_server<'g>(graph: &'g Graph, service: &str) -> &'g str {
    match graph.services.get(service) {
        Some(node) => node,
        None if RosapiService::find(service).is_some() => NODE,
        None => "",
    }
}

pub(super) fn service_node(graph: &Graph, service: &str) -> Value {
    json!({ "node": service_server(graph, service) })
}

/// In ROS 2, which has no addresses, all nodes are on the servant's own host.
pub(super) fn service_host(graph: &Graph, version: RosVersion, service: &str) -> Value {
    let node = service_server(graph, service);
    let address = match (version, node) {
        (_, "") => "",
        (RosVersion::Two, _) | (_, NODE) => "localhost",
        (RosVersion::One, _) => graph.nodes.get(node).map_or("", String::as_str),
    };
    let host = address.split_once("://").map_or(address, |(_, rest)| rest);
    json!({ "host": host.split([':', '/']).next().unwrap_or_default() })
}

/// Looks up the type of a service; empty if it is not available, as in rosapi.
async fn find_type(shared: &Arc<BridgeShared>, service: &str) -> String {
    let served = shared.bus.graph().borrow().services.contains_key(service);
    match RosapiService::find(service) {
        Some(own) if !served => own.type_name(shared.bus.version()),
        _ => {
            let found = shared.service_types.find(shared.bus.as_ref(), service).await;
            found.map(|found| found.name).unwrap_or_default()
        }
    }
}

pub(super) async fn service_type(shared: &Arc<BridgeShared>, service: &str, grants: &Grants) -> Value {
    // The type is queried from the node, independently of the filtered graph.
    if RosapiService::find(service).is_none() && !grants.permits_any(service) {
        return json!({ "type": "" });
    }
    json!({ "type": find_type(shared, service).await })
}

/// Returns all services of a type, sorted.
async fn services_of_type(shared: &Arc<BridgeShared>, graph: &Graph, type_name: &str) -> Vec<String> {
    let asked = all_services(graph).into_iter().map(|service| {
        let shared = shared.clone();
        async move {
            let found = find_type(&shared, &service).await;
            (service, found)
        }
    });
    let answers: BTreeMap<String, String> = stream::iter(asked).buffer_unordered(ASKED_AT_ONCE).collect().await;
    answers.into_iter().filter(|(_, found)| is_same_type(found, type_name)).map(|(service, _)| service).collect()
}

pub(super) async fn services_for_type(shared: &Arc<BridgeShared>, graph: &Graph, type_name: &str) -> Value {
    json!({ "services": services_of_type(shared, graph, type_name).await })
}

pub(super) async fn service_providers(shared: &Arc<BridgeShared>, graph: &Graph, type_name: &str) -> Value {
    let services = services_of_type(shared, graph, type_name).await;
    let providers: Vec<_> = services.iter().map(|service| service_server(graph, service)).collect();
    json!({ "providers": providers })
}
