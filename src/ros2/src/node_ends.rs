//! Endpoints of each node, derived from DDS discovery.

use std::collections::BTreeMap;
use std::collections::btree_map::Entry;

use ros_bus::{Digest, NodeEntities, ServiceType, WireFormat};
use rtps::EndpointData;

use super::names::{self, RosTopicRole};
use super::quality;
use super::seen::{self, DiscoverySnapshot};
use super::type_hash;

/// Returns the endpoints by node. Endpoints whose node is unknown are left out, and so are topics that do not belong to
/// ROS.
pub(super) fn collect_endpoints(seen: &DiscoverySnapshot) -> BTreeMap<String, NodeEntities> {
    let mut nodes: BTreeMap<String, NodeEntities> = BTreeMap::new();
    let (writers, readers) = (seen.discovered.writers.values(), seen.discovered.readers.values());
    let sides = writers.map(|end| (end, true)).chain(readers.map(|end| (end, false)));
    for (end, writes) in sides {
        let Some(owner) = seen.owner(end.guid) else {
            continue;
        };
        let Some(named) = names::topic_role(&end.topic) else {
            continue;
        };
        let node = match nodes.get_mut(&**owner) {
            Some(node) => node,
            None => nodes.entry(owner.to_string()).or_default(),
        };
        match named {
            RosTopicRole::Topic(name) => {
                let topics = if writes { &mut node.publishers } else { &mut node.subscribers };
                let qos = quality::from_endpoint(&end.qos);
                match topics.entry(name) {
                    Entry::Vacant(free) => {
                        free.insert((seen::wire_type(end), qos));
                    }
                    Entry::Occupied(mut known) => {
                        let known = &mut known.get_mut().1;
                        *known = known.merge(qos, writes);
                    }
                }
            }
            RosTopicRole::Request(name) => {
                let services = if writes { &mut node.clients } else { &mut node.services };
                if let Some(of) = service_type(seen, end, &name, writes) {
                    services.entry(name).or_insert(of);
                }
            }
            // Servers and clients are found by the request topics.
            RosTopicRole::Reply(_) => {}
        }
    }
    nodes
}

/// Returns the type of the service whose requests this endpoint reads (a server) or writes (a client).
pub(super) fn service_type(
    seen: &DiscoverySnapshot,
    end: &EndpointData,
    service: &str,
    writes: bool,
) -> Option<ServiceType> {
    let reply = names::reply_name(service);
    let replies = if writes { seen.readers(&reply) } else { seen.writers(&reply) };
    let same = replies.iter().find(|it| it.guid.prefix == end.guid.prefix);
    let response = same.map(|reply| type_hash::message_hash(&reply.user_data));
    Some(ServiceType {
        name: names::service_type(&end.type_name)?,
        format: WireFormat::Cdr,
        digest: type_hash::service_hash(&end.user_data),
        request: type_hash::message_hash(&end.user_data),
        response: response.unwrap_or_else(Digest::any),
    })
}

#[cfg(test)]
mod tests {
    use std::collections::HashMap;
    use std::sync::Arc;

    use bytes::Bytes;
    use ros_bus::QosReliability;
    use rtps::{DiscoveredGraph, DurabilityKind, EndpointQos, EntityId, Guid, GuidPrefix, ReliabilityKind};

    use super::super::entities::{DiscoveredNode, GidSize, ParticipantEntities};
    use super::*;

    const PARTICIPANT: GuidPrefix = GuidPrefix([1; 12]);

    fn guid(end: u8, writes: bool) -> Guid {
        let kind = if writes { 3 } else { 4 };
        Guid::new(PARTICIPANT, EntityId([0, 0, end, kind]))
    }

    fn endpoint(guid: Guid, topic: &str, type_name: &str, qos: EndpointQos) -> Arc<EndpointData> {
        Arc::new(EndpointData {
            guid,
            topic: topic.to_owned(),
            type_name: type_name.to_owned(),
            qos,
            user_data: Bytes::new(),
            unicast: Vec::new(),
            expects_inline_qos: false,
        })
    }

    #[test]
    fn a_node_has_what_its_ends_are_named_after_with_what_tools_hide() {
        let weak = EndpointQos { reliability: ReliabilityKind::BestEffort, ..EndpointQos::default() };
        let latching = EndpointQos { durability: DurabilityKind::TransientLocal, ..EndpointQos::default() };
        let string = "std_msgs::msg::dds_::String_";
        let set_bool = "std_srvs::srv::dds_::SetBool_Request_";
        let reply = "std_srvs::srv::dds_::SetBool_Response_";
        let send = "test_msgs::action::dds_::Fibonacci_SendGoal_Request_";
        let ends = [
            endpoint(guid(1, true), "rt/map", string, weak),
            endpoint(guid(2, true), "rt/map", string, latching),
            endpoint(guid(3, false), "rt/scan", string, EndpointQos::default()),
            endpoint(guid(4, false), "rt/scan", string, weak),
            endpoint(guid(5, false), "rq/setRequest", set_bool, weak),
            endpoint(guid(6, true), "rr/setReply", reply, weak),
            endpoint(guid(7, true), "rq/fib/_action/send_goalRequest", send, weak),
            endpoint(guid(8, true), "other", string, weak),
            // The node has not been announced.
            endpoint(guid(9, true), "rt/early", string, weak),
        ];
        let mut discovered = DiscoveredGraph::default();
        let (mut readers, mut writers) = (Vec::new(), Vec::new());
        for end in ends {
            let writes = end.guid.entity.is_writer();
            if end.topic != "rt/early" {
                let owned = if writes { &mut writers } else { &mut readers };
                owned.push(end.guid);
            }
            let known = if writes { &mut discovered.writers } else { &mut discovered.readers };
            known.insert(end.guid, end);
        }
        let entities = ParticipantEntities {
            nodes: vec![DiscoveredNode { name: "/node".into(), readers, writers }],
            gids: GidSize::Sixteen,
        };
        let told = HashMap::from([(PARTICIPANT, Arc::new(entities))]);
        let all = collect_endpoints(&DiscoverySnapshot::new(Arc::new(discovered), &told));
        assert_eq!(all.len(), 1);
        let node = &all["/node"];
        let names = |topics: &BTreeMap<String, _>| topics.keys().cloned().collect::<Vec<_>>();
        assert_eq!(names(&node.publishers), ["/map"]);
        assert_eq!(names(&node.subscribers), ["/scan"]);
        // The strongest of what it offers, and the weakest of what it requests.
        let (of, map) = &node.publishers["/map"];
        assert_eq!(of.name, "std_msgs/msg/String");
        assert_eq!(map.reliability, QosReliability::Reliable);
        assert!(map.is_latching());
        let scan = node.subscribers["/scan"].1;
        assert_eq!(scan.reliability, QosReliability::BestEffort);
        let serves: Vec<_> = node.services.iter().map(|(name, of)| (&**name, &*of.name)).collect();
        assert_eq!(serves, [("/set", "std_srvs/srv/SetBool")]);
        let calls: Vec<_> = node.clients.iter().map(|(name, of)| (&**name, &*of.name)).collect();
        let send_goal = ("/fib/_action/send_goal", "test_msgs/action/Fibonacci_SendGoal");
        assert_eq!(calls, [send_goal]);
    }
}
