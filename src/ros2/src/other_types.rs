//! Detection of clients that use a service or an action of this node with another type. Endpoints with different type
//! names never match, and ROS 2 does not tell a client: it waits. So it is logged here, where the service is.

use std::collections::HashSet;

use ros_bus::ServiceType;
use rtps::Guid;

use super::names;
use super::seen::DiscoverySnapshot;

/// The mismatched clients that were logged.
#[derive(Default)]
pub(super) struct TypeMismatchLog {
    told: HashSet<Guid>,
}

/// One mismatched client.
#[derive(Debug, PartialEq)]
pub(super) struct MismatchedClient {
    /// `service /set` or `action /fib`.
    pub(super) what: String,
    /// Node of the client.
    pub(super) node: String,
    /// Type that the client requests.
    pub(super) theirs: String,
    /// Type that is served.
    pub(super) ours: String,
}

impl TypeMismatchLog {
    /// Logs new mismatches.
    pub(super) fn log_new<'a>(
        &mut self,
        served: impl Iterator<Item = (&'a str, &'a ServiceType)>,
        seen: &DiscoverySnapshot,
    ) {
        for told in self.new_mismatches(served, seen) {
            tracing::warn!(
                node = told.node,
                "{}: it asks for {} and waits forever, since {} is served; use that type there",
                told.what,
                told.theirs,
                told.ours
            );
        }
    }

    /// Returns new mismatches with the services served. A client that left is reported again if it comes back.
    fn new_mismatches<'a>(
        &mut self,
        served: impl Iterator<Item = (&'a str, &'a ServiceType)>,
        seen: &DiscoverySnapshot,
    ) -> Vec<MismatchedClient> {
        let mut there = HashSet::new();
        let mut news = Vec::new();
        for (service, of) in served {
            let Ok(request) = names::request(service, of) else {
                continue;
            };
            let clients = seen.writers(&request.name).iter();
            for client in clients.filter(|it| it.type_name != request.type_name) {
                // The node will be known in a moment.
                if !seen.is_named(client.guid) {
                    continue;
                }
                there.insert(client.guid);
                let Some(theirs) = names::service_type(&client.type_name) else {
                    continue;
                };
                if !self.told.contains(&client.guid) {
                    let node = seen.node(client.guid).to_string();
                    news.extend(mismatched_client(service, node, theirs, of.name.clone()));
                }
            }
        }
        self.told = there;
        news
    }
}

/// Describes a mismatch; an action is reported once, not for each of its parts.
fn mismatched_client(service: &str, node: String, theirs: String, ours: String) -> Option<MismatchedClient> {
    let told = match names::action_part(service) {
        None => MismatchedClient { what: format!("service {service}"), node, theirs, ours },
        Some((action, "send_goal")) => MismatchedClient {
            what: format!("action {action}"),
            node,
            theirs: action_type_name(theirs),
            ours: action_type_name(ours),
        },
        Some(_) => return None,
    };
    Some(told)
}

/// Returns the action type `test_msgs/action/Fibonacci` of its goal service's type.
fn action_type_name(send_goal: String) -> String {
    match send_goal.strip_suffix("_SendGoal") {
        Some(action) => action.to_owned(),
        None => send_goal,
    }
}

#[cfg(test)]
mod tests {
    use std::collections::HashMap;
    use std::sync::Arc;

    use bytes::Bytes;
    use rtps::{DiscoveredGraph, EndpointData, EndpointQos, EntityId, GuidPrefix};

    use super::super::entities::{DiscoveredNode, GidSize, ParticipantEntities};
    use super::*;

    const APP: GuidPrefix = GuidPrefix([1; 12]);

    /// The node `/app` has a client of each of these topics and types.
    fn snapshot(clients: &[(&str, &str)]) -> DiscoverySnapshot {
        let mut discovered = DiscoveredGraph::default();
        for (number, (topic, type_name)) in clients.iter().enumerate() {
            let guid = Guid::new(APP, EntityId([0, 0, number as u8, 3]));
            let end = EndpointData {
                guid,
                topic: (*topic).to_owned(),
                type_name: (*type_name).to_owned(),
                qos: EndpointQos::default(),
                user_data: Bytes::new(),
                unicast: Vec::new(),
                expects_inline_qos: false,
            };
            discovered.writers.insert(guid, Arc::new(end));
        }
        let app = DiscoveredNode {
            name: "/app".into(),
            readers: Vec::new(),
            writers: discovered.writers.keys().copied().collect(),
        };
        let entities = ParticipantEntities { nodes: vec![app], gids: GidSize::Sixteen };
        let told = HashMap::from([(APP, Arc::new(entities))]);
        DiscoverySnapshot::new(Arc::new(discovered), &told)
    }

    #[test]
    fn each_client_of_another_type_is_told_of_once_and_an_action_as_a_whole() {
        let of = |name: &str| ServiceType::new(name, "*");
        let set = of("std_srvs/srv/SetBool");
        let (send, result) = (of("test_msgs/action/Fibonacci_SendGoal"), of("test_msgs/action/Fibonacci_GetResult"));
        let served = [("/set", &set), ("/fib/_action/send_goal", &send), ("/fib/_action/get_result", &result)];
        let clients = snapshot(&[
            ("rq/setRequest", "std_srvs::srv::dds_::SetBool_Request_"),
            ("rq/setRequest", "std_srvs::srv::dds_::Trigger_Request_"),
            ("rq/fib/_action/send_goalRequest", "x::action::dds_::Count_SendGoal_Request_"),
            ("rq/fib/_action/get_resultRequest", "x::action::dds_::Count_GetResult_Request_"),
        ]);
        let mut all = TypeMismatchLog::default();
        let told = |what: &str, theirs: &str, ours: &str| MismatchedClient {
            what: what.to_owned(),
            node: "/app".to_owned(),
            theirs: theirs.to_owned(),
            ours: ours.to_owned(),
        };
        let expected = [
            told("service /set", "std_srvs/srv/Trigger", "std_srvs/srv/SetBool"),
            told("action /fib", "x/action/Count", "test_msgs/action/Fibonacci"),
        ];
        assert_eq!(all.new_mismatches(served.into_iter(), &clients), expected);
        assert_eq!(all.new_mismatches(served.into_iter(), &clients), []);
        assert_eq!(all.new_mismatches(served.into_iter(), &snapshot(&[])), []);
        assert_eq!(all.new_mismatches(served.into_iter(), &clients), expected);
    }
}
