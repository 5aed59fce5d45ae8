//! Catalogue of what a viewer was told about: topics (as channels) and services, each with an id that is never
//! reused.

use std::collections::{BTreeMap, BTreeSet};
use std::sync::Arc;

use ros::bus::{Graph, WireType};
use ros::schema::ServiceDef;

/// Limit on the topics, and on the services, advertised to one viewer.
const MAX_ADVERTISED: usize = 2_000;

/// Topics and services advertised to one viewer.
#[derive(Default)]
pub struct Catalogue {
    last: u32,
    channels: BTreeMap<u64, (String, Arc<WireType>)>,
    services: BTreeMap<u32, (String, Arc<ServiceDef>)>,
    /// Names whose types are being resolved.
    asked: BTreeSet<String>,
}

/// Changes in the graph since the last update.
#[derive(Debug, Default, PartialEq, Eq)]
pub struct Changes {
    /// New topics, with their types as registered.
    pub topics: Vec<(String, String)>,
    /// New services.
    pub services: Vec<String>,
    /// Ids of channels whose topics have disappeared.
    pub channels_gone: Vec<u64>,
    /// Ids of services that have disappeared.
    pub services_gone: Vec<u32>,
}

impl Catalogue {
    /// Compares `graph` with what was advertised: returns new topics that the viewer `may` subscribe to, new
    /// services, and everything that has disappeared. `own` is the name of this node, which is ignored.
    pub fn update(&mut self, graph: &Graph, own: &str, may: impl Fn(&str) -> bool) -> Changes {
        let published = |name: &str| {
            let topic = graph.topics.get(name);
            topic.is_some_and(|topic| topic.publishers.iter().any(|node| node != own))
        };
        let served = |name: &str| graph.services.get(name).is_some_and(|node| node != own);
        let mut changes = Changes::default();
        self.channels.retain(|id, (topic, _)| {
            let stays = published(topic) && may(topic);
            if !stays {
                changes.channels_gone.push(*id);
            }
            stays
        });
        self.services.retain(|id, (service, _)| {
            let stays = served(service);
            if !stays {
                changes.services_gone.push(*id);
            }
            stays
        });
        self.asked.retain(|name| published(name) || served(name));
        let known: BTreeSet<&String> = self.channels.values().map(|(topic, _)| topic).collect();
        let called: BTreeSet<&String> = self.services.values().map(|(name, _)| name).collect();
        for (name, topic) in &graph.topics {
            let is_new = !known.contains(name) && !self.asked.contains(name);
            if is_new && published(name) && may(name) && known.len() < MAX_ADVERTISED {
                changes.topics.push((name.clone(), topic.type_name.clone()));
            }
        }
        for name in graph.services.keys() {
            let is_new = !called.contains(name) && !self.asked.contains(name);
            if is_new && served(name) && called.len() < MAX_ADVERTISED {
                changes.services.push(name.clone());
            }
        }
        let asked = changes.topics.iter().map(|(name, _)| name);
        self.asked.extend(asked.chain(&changes.services).cloned());
        changes
    }

    /// Adds a topic whose type was resolved and returns its channel id; `None` if the topic has disappeared
    /// meanwhile.
    pub fn add_topic(&mut self, topic: &str, of: Arc<WireType>) -> Option<u64> {
        if !self.asked.remove(topic) {
            return None;
        }
        self.last += 1;
        let id = u64::from(self.last);
        self.channels.insert(id, (topic.to_owned(), of));
        Some(id)
    }

    /// Adds a service whose type was resolved and returns its id; `None` if the service has disappeared meanwhile.
    pub fn add_service(&mut self, service: &str, of: Arc<ServiceDef>) -> Option<u32> {
        if !self.asked.remove(service) {
            return None;
        }
        self.last += 1;
        self.services.insert(self.last, (service.to_owned(), of));
        Some(self.last)
    }

    /// Returns the topic of a channel and its type.
    pub fn channel(&self, id: u64) -> Option<&(String, Arc<WireType>)> {
        self.channels.get(&id)
    }

    /// Returns the name of a service and its type.
    pub fn service(&self, id: u32) -> Option<&(String, Arc<ServiceDef>)> {
        self.services.get(&id)
    }
}

#[cfg(test)]
mod tests {
    use ros::bus::TopicNodes;

    use super::*;

    fn graph(topics: &[(&str, &str)]) -> Graph {
        let topic = |(name, publisher): &(&str, &str)| {
            let ends = TopicNodes {
                type_name: "std_msgs/String".into(),
                publishers: vec![(*publisher).to_owned()],
                subscribers: Vec::new(),
            };
            ((*name).to_owned(), ends)
        };
        Graph { topics: topics.iter().map(topic).collect(), ..Graph::default() }
    }

    #[test]
    fn what_comes_and_goes_is_told_once_and_by_new_numbers() {
        let mut catalogue = Catalogue::default();
        let names =
            |changes: &Changes| -> Vec<String> { changes.topics.iter().map(|(name, _)| name.clone()).collect() };
        let all = graph(&[("/a", "/n"), ("/own", "/viewer"), ("/secret", "/n")]);
        let may = |name: &str| name != "/secret";
        let first = catalogue.update(&all, "/viewer", may);
        assert_eq!(names(&first), ["/a"]);
        assert_eq!(catalogue.update(&all, "/viewer", may), Changes::default(), "it is asked for");
        let of = Arc::new(WireType::with_name("std_msgs/String"));
        let id = catalogue.add_topic("/a", Arc::clone(&of)).expect("asked for");
        assert_eq!(catalogue.add_topic("/a", Arc::clone(&of)), None, "once");
        assert_eq!(catalogue.update(&all, "/viewer", may), Changes::default());
        let gone = catalogue.update(&graph(&[]), "/viewer", may);
        assert_eq!(gone.channels_gone, [id]);
        let again = catalogue.update(&all, "/viewer", may);
        assert_eq!(names(&again), ["/a"]);
        assert_ne!(catalogue.add_topic("/a", of), Some(id), "a number is given once");
        // A topic whose permission was revoked disappears, too.
        let refused = catalogue.update(&all, "/viewer", |_| false);
        assert_eq!(refused.channels_gone.len(), 1);
    }
}
