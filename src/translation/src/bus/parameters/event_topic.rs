//! `/parameter_events` of a servant of ROS 1, for robots of ROS 2, where each node publishes the changes of its
//! parameters there, whoever makes them.
//!
//! What changes at the Master becomes an event of the node that the parameter belongs to: what the node sets, what the
//! robot has set, and what dynamic_reconfigure has chosen. Its servers write to the Master what they publish as
//! `parameter_updates`.

use std::sync::Arc;
use std::time::SystemTime;

use bytes::Bytes;
use ros::bus::{
    BusError, Graph, NodeParameters, Offer, ParameterEvent, QosProfile, Retry, Subscription, TopicNodes, WireType,
};
use ros::codec::put::CdrWriter;
use ros::ros2::parameters::values::{self, TypedValue};
use ros::ros2::{interfaces, names};
use ros::schema::MessageType;

use super::nodes::NodeParameterView;
use super::topics::TopicFeed;
use super::values::write_typed;

/// Name of the topic.
pub(in crate::bus) const TOPIC: &str = "/parameter_events";
/// Depth of its queues; as in rmw.
const DEPTH: usize = 1000;

/// Returns the type of the messages.
pub(super) fn message_type() -> Result<Arc<MessageType>, BusError> {
    interfaces::message("rcl_interfaces/msg/ParameterEvent")
}

/// Returns whether a robot of ROS 2 sees parameters of this node of ROS 1. `own` is the bus itself.
pub(in crate::bus) fn is_shown(node: &str, own: &str) -> bool {
    node != own && names::is_global(node)
}

/// Adds the topic to the graph of a robot, which shows these nodes. `own` is the bus itself.
pub(in crate::bus) fn add_to_graph(own: &str, out: &mut Graph) {
    // The definition is built in.
    let Ok(of) = message_type() else { return };
    let wire_type = WireType { definition: String::new(), ..WireType::from_message(&of) };
    let nodes: Vec<String> = out.nodes.keys().filter(|node| is_shown(node, own)).cloned().collect();
    if nodes.is_empty() {
        return;
    }
    for node in &nodes {
        let publishers = &mut out.ends.entry(node.clone()).or_default().publishers;
        publishers.insert(TOPIC.to_owned(), (wire_type.clone(), QosProfile::keep_last(DEPTH)));
    }
    let shown = TopicNodes { type_name: of.name().to_owned(), publishers: nodes, subscribers: Vec::new() };
    out.topics.insert(TOPIC.to_owned(), shown);
}

/// Subscribes to the events of all nodes.
pub(super) fn subscribe(
    view: &Arc<NodeParameterView>,
    offer: Offer,
    of: &WireType,
    qos: QosProfile,
) -> Result<Subscription, BusError> {
    let view = Arc::clone(view);
    TopicFeed::open((TOPIC, offer), of, qos.depth, |feed| feed_events(view, feed))
}

async fn feed_events(view: Arc<NodeParameterView>, feed: TopicFeed) {
    let mut retry = Retry::default();
    loop {
        if let Err(error) = send_events(&view, &feed).await {
            tracing::debug!(%error, "changes of parameters do not reach the robot; trying again");
        }
        retry.pause().await;
    }
}

/// Sends events until the watch ends.
async fn send_events(view: &NodeParameterView, feed: &TopicFeed) -> Result<(), BusError> {
    let mut events = view.watch(None).await?;
    let bus = view.bus();
    let mut graphs = bus.graph();
    loop {
        let graph = graphs.borrow_and_update().clone();
        feed.set_publishers(graph.nodes.keys().map(String::as_str).filter(|node| is_shown(node, bus.node())));
        tokio::select! {
            event = events.next() => match event {
                Some(event) => feed.send(&event.node.clone(), serialize(event)),
                None => return Ok(()),
            },
            changed = graphs.changed() => if changed.is_err() { return Ok(()) },
        }
    }
}

/// Returns the message about an event that has happened just now.
fn serialize(event: ParameterEvent) -> Bytes {
    let mut put = CdrWriter::new();
    let now = SystemTime::now().duration_since(SystemTime::UNIX_EPOCH).unwrap_or_default();
    put.number((now.as_secs() as u32).to_le_bytes());
    put.number(now.subsec_nanos().to_le_bytes());
    put.text(&event.node);
    for changes in [event.new, event.changed] {
        put.length(changes.len());
        for (name, value) in changes {
            put.text(&name);
            write_typed(Some(value), &mut put);
        }
    }
    put.length(event.deleted.len());
    for name in event.deleted {
        put.text(&name);
        values::write(&TypedValue::NotSet, &mut put);
    }
    put.finish()
}

#[cfg(test)]
mod tests {
    use ros::bus::ParamValue;
    use ros::codec::validate;

    use super::*;

    #[test]
    fn an_event_is_the_message_that_nodes_of_ros_2_publish() {
        let event = ParameterEvent {
            node: "/camera/see".to_owned(),
            new: vec![("rate".to_owned(), ParamValue::Double(0.5))],
            changed: vec![
                ("gains.p".to_owned(), ParamValue::Int(3)),
                ("names".to_owned(), ParamValue::List(vec![ParamValue::String("a".to_owned())])),
                ("none".to_owned(), ParamValue::List(Vec::new())),
            ],
            deleted: vec!["old".to_owned()],
        };
        let of = message_type().expect("a type");
        validate(&of, &serialize(event)).expect("a message");
        validate(&of, &serialize(ParameterEvent::default())).expect("a message");
    }

    #[test]
    fn each_shown_node_publishes_events() {
        let mut graph = Graph::default();
        for node in ["/bridge", "/see", "/2d"] {
            graph.nodes.insert(node.to_owned(), String::new());
        }
        add_to_graph("/bridge", &mut graph);
        assert_eq!(graph.topics[TOPIC].publishers, ["/see"]);
        let (of, qos) = &graph.ends["/see"].publishers[TOPIC];
        assert_eq!((&*of.name, qos.is_latching()), ("rcl_interfaces/msg/ParameterEvent", false));
        assert!(!graph.ends.contains_key("/bridge") && !graph.ends.contains_key("/2d"));
    }
}
