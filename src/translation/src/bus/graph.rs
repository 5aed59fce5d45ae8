//! A servant's graph in the terms of the robot's ROS.
//!
//! * For a robot of ROS 1 a process of ROS 2 is one node, the one that the robot has started; what belongs to ROS 2
//!   itself (parameter services and events) is not shown. Nodes that have parameters have dynamic_reconfigure.
//! * For a robot of ROS 2 each endpoint announces its type and quality of service. In ROS 1 only the node itself knows
//!   the type of a service and whether a topic is latched, so it is asked, and shown once it has answered. Each node
//!   has the services about parameters, and publishes the events, that nodes of ROS 2 have.
//!
//! Actions consist of other parts in each ROS; `actions` adds them.

use std::collections::{BTreeMap, BTreeSet};
use std::sync::Arc;

use ros::bus::{
    Graph, NodeEntities, Offer, QosProfile, RosVersion, ServiceType, TopicNodes, TypeInquiries, WireType, hidden_names,
};
use ros::ros2::names;
use tokio::sync::watch;

use super::actions::add_actions;
use super::parameters::{ParameterServices, event_topic, reconfigurable};
use super::state::{LeftOut, TranslatedGraph, Translation};
use super::twins::{KnownTwins, Untranslatable};

/// Packages of ROS 2 whose services every node provides.
const OF_ROS_2: [&str; 2] = ["rcl_interfaces/", "type_description_interfaces/"];
/// Package of ROS 1 whose services every node provides.
const OF_ROS_1: &str = "roscpp/";
/// Type of the services by which nodes of ROS 1 change parameters: robots of ROS 2 use the services about parameters.
const RECONFIGURE: &str = "dynamic_reconfigure/Reconfigure";
/// Topic of ROS 1 on which rosout repeats all messages.
const AGGREGATED_LOG: &str = "/rosout_agg";
/// Topic that subscribers of ROS 2 always request with its last messages.
const FIXED_TRANSFORMS: &str = "/tf_static";
/// History depth of a publisher of ROS 1, which announces none.
const DEPTH: usize = 10;

/// Keeps a robot's graph up to date until the servant's bus is closed.
pub(super) async fn follow(
    translation: Arc<Translation>,
    graph: watch::Sender<Arc<Graph>>,
    left_out: watch::Sender<Arc<LeftOut>>,
) {
    let mut graphs = translation.inner.graph();
    let mut inquiries = TypeInquiries::default();
    let mut generation = 0;
    loop {
        let now = graphs.borrow_and_update().clone();
        let translated = match translation.version {
            RosVersion::One => for_ros1(&now, translation.inner.node(), &translation.twins),
            RosVersion::Two => {
                let topics = now.topics.iter().filter(|(_, ends)| !ends.publishers.is_empty());
                inquiries.retain(&now.services.keys().collect(), &topics.map(|(topic, _)| topic).collect());
                let asked = inquiries.count();
                ask_nodes(&translation, &now, &mut inquiries);
                if inquiries.count() > asked {
                    inquiries.settle().await;
                }
                ask_nodes(&translation, &now, &mut inquiries)
            }
        };
        left_out.send_if_modified(|before| replace_if_other(before, translated.left_out));
        graph.send_if_modified(|before| {
            let same = Graph { generation: before.generation, ..translated.graph };
            if **before == same {
                return false;
            }
            generation += 1;
            *before = Arc::new(Graph { generation, ..same });
            true
        });
        tokio::select! {
            changed = graphs.changed() => if changed.is_err() { return },
            () = inquiries.next() => {}
        }
    }
}

fn replace_if_other<T: PartialEq>(before: &mut Arc<T>, after: T) -> bool {
    let differs = **before != after;
    if differs {
        *before = Arc::new(after);
    }
    differs
}

/// Returns the graph for a robot of ROS 2 from what nodes have answered so far; those that were not asked are.
fn ask_nodes(translation: &Translation, now: &Graph, inquiries: &mut TypeInquiries) -> TranslatedGraph {
    let (bus, asked) = (&translation.inner, std::cell::RefCell::new(inquiries));
    let offer = |topic: &str| asked.borrow_mut().topic(bus, topic);
    let service = |name: &str| asked.borrow_mut().service(bus, name);
    for_ros2(now, bus.node(), &translation.twins, offer, service)
}

/// Returns the graph of a servant of ROS 2 for a robot of ROS 1. `own` is the bus itself.
pub(super) fn for_ros1(inner: &Graph, own: &str, twins: &KnownTwins) -> TranslatedGraph {
    let mut out = TranslatedGraph::default();
    let owner = |node: &str| inner.process_owner(node).to_owned();
    let owners = |nodes: &[String]| {
        let owners: BTreeSet<String> = nodes.iter().map(|node| owner(node)).collect();
        owners.into_iter().collect::<Vec<_>>()
    };
    for (topic, ends) in &inner.topics {
        if topic == event_topic::TOPIC {
            continue;
        }
        let translated = TopicNodes {
            type_name: ends.type_name.clone(),
            publishers: owners(&ends.publishers),
            subscribers: owners(&ends.subscribers),
        };
        let type_name = match &*ends.type_name {
            "*" => Ok("*".to_owned()),
            _ => twins.message(&announced_type(inner, topic, ends)).map(|twin| twin.twin.name().to_owned()),
        };
        match type_name {
            Ok(type_name) => drop(out.graph.topics.insert(topic.clone(), TopicNodes { type_name, ..translated })),
            Err(reason) => {
                let nodes = translated.publishers.iter().chain(&translated.subscribers);
                out.leave_out(format!("topic {topic}"), nodes.map(String::as_str), &reason);
            }
        }
    }
    for (service, server) in &inner.services {
        let of = inner.ends.get(server).and_then(|ends| ends.services.get(service));
        if of.is_some_and(|of| OF_ROS_2.iter().any(|package| of.name.starts_with(package))) {
            continue;
        }
        match of.map(|of| twins.service(of)) {
            Some(Err(reason)) => {
                out.leave_out(format!("service {service}"), [&*owner(server)].into_iter(), &reason);
            }
            // The type of a service that announces none is found when it is used.
            Some(Ok(_)) | None => drop(out.graph.services.insert(service.clone(), owner(server))),
        }
    }
    reconfigurable::add_to_graph(inner, own, &mut out.graph);
    add_actions(RosVersion::One, inner, own, twins, &mut out);
    let sought = inner.sought.iter().filter(|(service, _)| !hidden_names::is_hidden(service));
    out.graph.sought = sought.map(|(service, nodes)| (service.clone(), owners(nodes))).collect();
    out.graph.nodes = inner.nodes.iter().map(|(node, address)| (owner(node), address.clone())).collect();
    out
}

/// Returns the type that the topic's nodes announce, or as much of it as the graph shows.
fn announced_type(inner: &Graph, topic: &str, ends: &TopicNodes) -> WireType {
    let nodes = ends.publishers.iter().chain(&ends.subscribers);
    let mut told = nodes.filter_map(|node| {
        let has = inner.ends.get(node)?;
        has.publishers.get(topic).or_else(|| has.subscribers.get(topic))
    });
    let announced = told.next().map(|(of, _)| of.clone());
    announced.unwrap_or_else(|| WireType::with_name(&ends.type_name).with_version(RosVersion::Two))
}

/// Adds a topic to its nodes' endpoints. Until it is known whether they latch, publishers are not announced.
fn announce_topic(
    ends: &mut BTreeMap<String, NodeEntities>,
    topic: &str,
    nodes: &TopicNodes,
    of: &WireType,
    latching: Option<bool>,
) {
    for node in nodes.publishers.iter().filter(|_| latching.is_some()) {
        let latching = topic == FIXED_TRANSFORMS || latching == Some(true);
        let qos = QosProfile::keep_last(if latching { 1 } else { DEPTH }).latching(latching);
        let publishers = &mut ends.entry(node.clone()).or_default().publishers;
        publishers.insert(topic.to_owned(), (of.clone(), qos));
    }
    for node in &nodes.subscribers {
        // As in ROS 1: what publishers have latched is given to every subscriber.
        let qos = QosProfile::keep_last(DEPTH).latching(true);
        let subscribers = &mut ends.entry(node.clone()).or_default().subscribers;
        subscribers.insert(topic.to_owned(), (of.clone(), qos));
    }
}

/// Returns the graph of a servant of ROS 1 for a robot of ROS 2. `offer` and `service_type` return what the nodes have
/// answered; `own` is the bus itself, whose endpoints are not asked for.
pub(super) fn for_ros2(
    inner: &Graph,
    own: &str,
    twins: &KnownTwins,
    mut offer: impl FnMut(&str) -> Option<Offer>,
    mut service_type: impl FnMut(&str) -> Option<ServiceType>,
) -> TranslatedGraph {
    let mut out = TranslatedGraph::default();
    let mut ends: BTreeMap<String, NodeEntities> =
        inner.nodes.keys().map(|node| (node.clone(), NodeEntities::default())).collect();
    let parts: BTreeSet<&String> = inner.actions.values().flat_map(|action| &action.topics).collect();
    for (topic, nodes) in inner.topics.iter().filter(|(topic, _)| *topic != AGGREGATED_LOG && !parts.contains(topic)) {
        let of_others = nodes.publishers.iter().any(|node| node != own);
        let offered = of_others.then(|| offer(topic)).flatten();
        let of = match &offered {
            Some(offered) => WireType::clone(&offered.wire_type),
            None => WireType::with_name(&nodes.type_name),
        };
        let twin = match &*of.name {
            "*" => None,
            _ if !names::is_global(topic) => Some(Err(Untranslatable::Name)),
            _ => Some(twins.message(&of)),
        };
        let mut shown = nodes.clone();
        match twin {
            // A subscriber of any type.
            None => {}
            Some(Ok(twin)) => {
                shown.type_name = twin.twin.name().to_owned();
                let of = WireType { definition: String::new(), ..WireType::from_message(&twin.twin) };
                announce_topic(&mut ends, topic, nodes, &of, offered.map(|offered| offered.latching));
            }
            Some(Err(reason)) => {
                let has = nodes.publishers.iter().chain(&nodes.subscribers).map(String::as_str);
                out.leave_out(format!("topic {topic}"), has, &reason);
                continue;
            }
        }
        out.graph.topics.insert(topic.clone(), shown);
    }
    for (service, server) in &inner.services {
        let told = (server != own).then(|| service_type(service)).flatten();
        let Some(of) = told.filter(|of| !of.name.starts_with(OF_ROS_1) && of.name != RECONFIGURE) else {
            continue;
        };
        let twin = if names::is_global(service) { twins.service(&of) } else { Err(Untranslatable::Name) };
        match twin {
            Ok(twin) => {
                let services = &mut ends.entry(server.clone()).or_default().services;
                services.insert(service.clone(), ServiceType::from_service(&twin.twin));
                out.graph.services.insert(service.clone(), server.clone());
            }
            Err(reason) => out.leave_out(format!("service {service}"), [&**server].into_iter(), &reason),
        }
    }
    for node in inner.nodes.keys().filter(|node| event_topic::is_shown(node, own)) {
        // The definitions are built in.
        let all = ParameterServices::of_node(node).unwrap_or_default();
        out.graph.services.extend(all.keys().map(|service| (service.clone(), node.clone())));
        ends.entry(node.clone()).or_default().services.extend(all);
    }
    out.graph.sought = inner
        .sought
        .iter()
        .filter(|(service, _)| names::is_global(service))
        .map(|(service, nodes)| (service.clone(), nodes.clone()))
        .collect();
    out.graph.nodes = inner.nodes.clone();
    out.graph.ends = ends;
    event_topic::add_to_graph(own, &mut out.graph);
    add_actions(RosVersion::Two, inner, own, twins, &mut out);
    out
}
