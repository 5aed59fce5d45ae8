//! Nodes that have a client of a service or an action of this node by another type. Ends of types with other names never meet, and
//! ROS 2 tells a client nothing of that: it waits. So it is logged here, where the service is.

use std::collections::HashSet;

use rtps::Guid;

use super::names;
use super::seen::Seen;
use crate::bus::ServiceType;

/// The clients that were told of.
#[derive(Default)]
pub(super) struct OtherTypes {
    told: HashSet<Guid>,
}

/// One such client.
#[derive(Debug, PartialEq)]
pub(super) struct Told {
    /// `service /set` or `action /fib`.
    pub(super) what: String,
    /// Whose client it is.
    pub(super) node: String,
    /// The type that it asks for.
    pub(super) theirs: String,
    /// The type that is served.
    pub(super) ours: String,
}

impl OtherTypes {
    /// Logs those that are new.
    pub(super) fn look<'a>(
        &mut self,
        served: impl Iterator<Item = (&'a str, &'a ServiceType)>,
        seen: &Seen,
    ) {
        for told in self.news(served, seen) {
            tracing::warn!(
                node = told.node,
                "{}: it asks for {} and waits for ever, {} is served; use that type there",
                told.what,
                told.theirs,
                told.ours
            );
        }
    }

    /// Those that are new, of what is served. Who has left is told of again should it come back.
    fn news<'a>(
        &mut self,
        served: impl Iterator<Item = (&'a str, &'a ServiceType)>,
        seen: &Seen,
    ) -> Vec<Told> {
        let mut there = HashSet::new();
        let mut news = Vec::new();
        for (service, of) in served {
            let Ok(request) = names::request(service, of) else {
                continue;
            };
            let clients = seen.writers(&request.name).iter();
            for client in clients.filter(|it| it.type_name != request.type_name) {
                // Whose it is will be told in a moment.
                if !seen.is_named(client.guid) {
                    continue;
                }
                there.insert(client.guid);
                let Some(theirs) = names::service_type_of(&client.type_name) else {
                    continue;
                };
                if !self.told.contains(&client.guid) {
                    let node = seen.node(client.guid).to_string();
                    news.extend(told(service, node, theirs, of.name.clone()));
                }
            }
        }
        self.told = there;
        news
    }
}

/// Of an action it is told once, not for each of its parts.
fn told(service: &str, node: String, theirs: String, ours: String) -> Option<Told> {
    let told = match names::action_part(service) {
        None => Told {
            what: format!("service {service}"),
            node,
            theirs,
            ours,
        },
        Some((action, "send_goal")) => Told {
            what: format!("action {action}"),
            node,
            theirs: of_action(theirs),
            ours: of_action(ours),
        },
        Some(_) => return None,
    };
    Some(told)
}

/// `test_msgs/action/Fibonacci` of the type of its goals' service.
fn of_action(send_goal: String) -> String {
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
    use rtps::{Discovered, EndpointData, EndpointQos, EntityId, GuidPrefix};

    use super::super::entities::{Entities, GidSize, Node};
    use super::*;

    const APP: GuidPrefix = GuidPrefix([1; 12]);

    /// The node `/app` has a client of each of these topics and types.
    fn seen(clients: &[(&str, &str)]) -> Seen {
        let mut discovered = Discovered::default();
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
        let app = Node {
            name: "/app".into(),
            readers: Vec::new(),
            writers: discovered.writers.keys().copied().collect(),
        };
        let entities = Entities {
            nodes: vec![app],
            gids: GidSize::Sixteen,
        };
        let told = HashMap::from([(APP, Arc::new(entities))]);
        Seen::new(Arc::new(discovered), &told)
    }

    #[test]
    fn each_client_of_another_type_is_told_of_once_and_an_action_as_a_whole() {
        let of = |name: &str| ServiceType::new(name, "*");
        let set = of("std_srvs/srv/SetBool");
        let (send, result) = (
            of("test_msgs/action/Fibonacci_SendGoal"),
            of("test_msgs/action/Fibonacci_GetResult"),
        );
        let served = [
            ("/set", &set),
            ("/fib/_action/send_goal", &send),
            ("/fib/_action/get_result", &result),
        ];
        let clients = seen(&[
            ("rq/setRequest", "std_srvs::srv::dds_::SetBool_Request_"),
            ("rq/setRequest", "std_srvs::srv::dds_::Trigger_Request_"),
            (
                "rq/fib/_action/send_goalRequest",
                "x::action::dds_::Count_SendGoal_Request_",
            ),
            (
                "rq/fib/_action/get_resultRequest",
                "x::action::dds_::Count_GetResult_Request_",
            ),
        ]);
        let mut all = OtherTypes::default();
        let told = |what: &str, theirs: &str, ours: &str| Told {
            what: what.to_owned(),
            node: "/app".to_owned(),
            theirs: theirs.to_owned(),
            ours: ours.to_owned(),
        };
        let expected = [
            told(
                "service /set",
                "std_srvs/srv/Trigger",
                "std_srvs/srv/SetBool",
            ),
            told(
                "action /fib",
                "x/action/Count",
                "test_msgs/action/Fibonacci",
            ),
        ];
        assert_eq!(all.news(served.into_iter(), &clients), expected);
        assert_eq!(all.news(served.into_iter(), &clients), []);
        assert_eq!(all.news(served.into_iter(), &seen(&[])), []);
        assert_eq!(all.news(served.into_iter(), &clients), expected);
    }
}
