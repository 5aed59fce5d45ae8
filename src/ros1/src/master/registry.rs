//! Registrations of publishers, subscribers, services and parameters. Pure state: notifications for other nodes are
//! returned as [`Notice`]s.

use std::collections::{BTreeMap, BTreeSet};

use ros_bus::TopicNodes;

use super::graph::GraphPart;
use super::notify::Notice;

/// Maximum number of registrations of all nodes together: a node gone wild must not exhaust the host's memory.
const MAX_REGISTRATIONS: usize = 50_000;
/// Maximum number of former addresses recorded per node name.
const MAX_FORMER_ADDRESSES: usize = 16;
/// Type of a topic whose type is still unknown.
pub(crate) const ANY_TYPE: &str = "*";

/// Kind of a registration.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum Kind {
    Publisher,
    Subscriber,
    Service,
    Parameter,
}

#[derive(Debug, Clone, PartialEq)]
struct RegisteredNode {
    api: String,
    publishes: BTreeSet<String>,
    subscribes: BTreeSet<String>,
    serves: BTreeSet<String>,
    watches: BTreeSet<String>,
    /// Addresses of earlier nodes of this name that were told to shut down.
    replaced: Vec<String>,
}

impl RegisteredNode {
    fn new(api: &str) -> Self {
        Self {
            api: api.to_owned(),
            publishes: BTreeSet::new(),
            subscribes: BTreeSet::new(),
            serves: BTreeSet::new(),
            watches: BTreeSet::new(),
            replaced: Vec::new(),
        }
    }

    fn names_mut(&mut self, kind: Kind) -> &mut BTreeSet<String> {
        match kind {
            Kind::Publisher => &mut self.publishes,
            Kind::Subscriber => &mut self.subscribes,
            Kind::Service => &mut self.serves,
            Kind::Parameter => &mut self.watches,
        }
    }

    fn is_idle(&self) -> bool {
        self.publishes.is_empty() && self.subscribes.is_empty() && self.serves.is_empty() && self.watches.is_empty()
    }
}

#[derive(Debug, Clone, PartialEq)]
struct RegisteredService {
    node: String,
    api: String,
}

impl Kind {
    /// Returns the part of the graph that shows such a registration.
    fn graph_part(self, name: &str) -> Option<GraphPart> {
        match self {
            Kind::Publisher | Kind::Subscriber => Some(GraphPart::Topic(name.to_owned())),
            Kind::Service => Some(GraphPart::Service(name.to_owned())),
            Kind::Parameter => None,
        }
    }
}

/// All registrations.
#[derive(Debug, Clone, Default, PartialEq)]
pub(super) struct Registry {
    nodes: BTreeMap<String, RegisteredNode>,
    /// Topics with their nodes in the order registered. Kept without nodes too: ROS remembers types.
    topics: BTreeMap<String, TopicRegistration>,
    services: BTreeMap<String, RegisteredService>,
    count: usize,
    /// Number of actual changes.
    version: u64,
    /// Parts of the graph that changed since they were last taken.
    changed: BTreeSet<GraphPart>,
}

#[derive(Debug, Clone, PartialEq)]
struct TopicRegistration {
    type_name: String,
    publishers: Vec<String>,
    subscribers: Vec<String>,
}

impl TopicRegistration {
    /// Returns its nodes and type; `None` if it has no nodes now.
    fn nodes(&self) -> Option<TopicNodes> {
        let is_used = !self.publishers.is_empty() || !self.subscribers.is_empty();
        is_used.then(|| TopicNodes {
            type_name: self.type_name.clone(),
            publishers: self.publishers.clone(),
            subscribers: self.subscribers.clone(),
        })
    }
}

/// Reason for refusing a registration.
#[derive(Debug, Clone, Copy, PartialEq, Eq, thiserror::Error)]
pub(super) enum RegistrationError {
    #[error("this Master holds no more than {MAX_REGISTRATIONS} registrations")]
    Full,
    #[error("a new node registered with the same name, and this one was asked to shut down")]
    Replaced,
}

impl Registry {
    /// Registers `node` under `name`. For services `service_api` is the address at which it is served.
    pub(super) fn register(
        &mut self,
        kind: Kind,
        name: &str,
        type_name: &str,
        (node, api): (&str, &str),
        service_api: &str,
        notices: &mut Vec<Notice>,
    ) -> Result<(), RegistrationError> {
        if self.count >= MAX_REGISTRATIONS || self.topics.len() >= MAX_REGISTRATIONS {
            return Err(RegistrationError::Full);
        }
        let mut replaced = Vec::new();
        if let Some(before) = self.nodes.get(node).filter(|before| before.api != api) {
            // A roscpp node registers once more while it shuts down; that must not end its successor.
            if before.replaced.iter().any(|old| old == api) {
                return Err(RegistrationError::Replaced);
            }
            replaced.clone_from(&before.replaced);
            replaced.push(before.api.clone());
            if replaced.len() > MAX_FORMER_ADDRESSES {
                replaced.remove(0);
            }
            let reason = "new node registered with same name";
            notices.push(Notice::shutdown(&before.api, reason));
            self.drop_node(node, notices);
        }
        let entry = self.nodes.entry(node.to_owned()).or_insert_with(|| RegisteredNode::new(api));
        if !replaced.is_empty() {
            entry.replaced = replaced;
        }
        let new = entry.names_mut(kind).insert(name.to_owned());
        self.count += usize::from(new);
        self.version += u64::from(new);
        if new {
            self.changed.insert(GraphPart::Node(node.to_owned()));
            self.changed.extend(kind.graph_part(name));
        }
        match kind {
            Kind::Publisher | Kind::Subscriber => {
                let topic = self.topics.entry(name.to_owned()).or_insert_with(|| TopicRegistration {
                    type_name: ANY_TYPE.to_owned(),
                    publishers: Vec::new(),
                    subscribers: Vec::new(),
                });
                // As in rosmaster: a publisher's type takes effect, a subscriber's only fills the gap.
                let counts = kind == Kind::Publisher || topic.type_name == ANY_TYPE;
                if counts && type_name != ANY_TYPE && type_name != topic.type_name {
                    topic.type_name = type_name.to_owned();
                    self.version += 1;
                    self.changed.insert(GraphPart::Topic(name.to_owned()));
                }
                if new {
                    let ends = match kind {
                        Kind::Publisher => &mut topic.publishers,
                        _ => &mut topic.subscribers,
                    };
                    ends.push(node.to_owned());
                }
                if kind == Kind::Publisher {
                    self.report_subscribers(name, notices);
                }
            }
            Kind::Service => {
                let service = RegisteredService { node: node.to_owned(), api: service_api.to_owned() };
                let before = self.services.insert(name.to_owned(), service);
                if let Some(other) = before.filter(|before| before.node != node) {
                    self.release(&other.node, Kind::Service, name);
                }
            }
            Kind::Parameter => {}
        }
        Ok(())
    }

    /// Removes a registration; returns false if `node` at `api` holds none.
    pub(super) fn unregister(
        &mut self,
        kind: Kind,
        name: &str,
        node: &str,
        api: &str,
        notices: &mut Vec<Notice>,
    ) -> bool {
        let held_at = match kind {
            Kind::Service => {
                self.services.get(name).filter(|service| service.node == node).map(|service| service.api.as_str())
            }
            _ => self.nodes.get(node).map(|found| found.api.as_str()),
        };
        if held_at != Some(api) || !self.holds(kind, name, node) {
            return false;
        }
        self.detach(kind, name, node, notices);
        self.release(node, kind, name);
        true
    }

    /// Removes every registration of `node`.
    pub(super) fn drop_node(&mut self, node: &str, notices: &mut Vec<Notice>) {
        let Some(gone) = self.nodes.remove(node) else {
            return;
        };
        self.version += 1;
        self.changed.insert(GraphPart::Node(node.to_owned()));
        let kinds = [
            (Kind::Publisher, gone.publishes),
            (Kind::Subscriber, gone.subscribes),
            (Kind::Service, gone.serves),
            (Kind::Parameter, gone.watches),
        ];
        for (kind, names) in kinds {
            self.count -= names.len();
            for name in names {
                self.detach(kind, &name, node, notices);
            }
        }
    }

    /// Forgets a former address at which nobody is any more, so that the next node that registers with it is a
    /// newcomer.
    pub(super) fn forget_replaced_address(&mut self, api: &str) {
        for node in self.nodes.values_mut() {
            node.replaced.retain(|old| old != api);
        }
    }

    fn holds(&self, kind: Kind, name: &str, node: &str) -> bool {
        self.nodes.get(node).is_some_and(|found| match kind {
            Kind::Publisher => found.publishes.contains(name),
            Kind::Subscriber => found.subscribes.contains(name),
            Kind::Service => found.serves.contains(name),
            Kind::Parameter => found.watches.contains(name),
        })
    }

    /// Removes a registration from the node's side, and the node with its last one.
    fn release(&mut self, node: &str, kind: Kind, name: &str) {
        let Some(entry) = self.nodes.get_mut(node) else {
            return;
        };
        self.count -= usize::from(entry.names_mut(kind).remove(name));
        self.version += 1;
        if entry.is_idle() {
            self.nodes.remove(node);
            self.changed.insert(GraphPart::Node(node.to_owned()));
        }
    }

    /// Removes a registration from the topic's or service's side.
    fn detach(&mut self, kind: Kind, name: &str, node: &str, notices: &mut Vec<Notice>) {
        self.changed.extend(kind.graph_part(name));
        match kind {
            Kind::Publisher => {
                if let Some(topic) = self.topics.get_mut(name) {
                    topic.publishers.retain(|other| other != node);
                }
                self.report_subscribers(name, notices);
            }
            Kind::Subscriber => {
                if let Some(topic) = self.topics.get_mut(name) {
                    topic.subscribers.retain(|other| other != node);
                }
            }
            Kind::Service => {
                if self.services.get(name).is_some_and(|s| s.node == node) {
                    self.services.remove(name);
                }
            }
            Kind::Parameter => {}
        }
    }

    fn report_subscribers(&self, name: &str, notices: &mut Vec<Notice>) {
        let publishers = self.publisher_apis(name);
        for api in self.subscriber_apis(name) {
            notices.push(Notice::publishers(&api, name, &publishers));
        }
    }

    /// Returns the addresses of a topic's publishers.
    pub(super) fn publisher_apis(&self, topic: &str) -> Vec<String> {
        let topic = self.topics.get(topic);
        self.apis(topic.map_or(&[], |topic| &topic.publishers))
    }

    /// Returns the addresses of a topic's subscribers.
    pub(super) fn subscriber_apis(&self, topic: &str) -> Vec<String> {
        let topic = self.topics.get(topic);
        self.apis(topic.map_or(&[], |topic| &topic.subscribers))
    }

    fn apis(&self, nodes: &[String]) -> Vec<String> {
        let known = nodes.iter().filter_map(|name| self.nodes.get(name));
        known.map(|node| node.api.clone()).collect()
    }

    /// Takes the parts of the graph that changed since the last call.
    pub(super) fn take_changed(&mut self) -> BTreeSet<GraphPart> {
        std::mem::take(&mut self.changed)
    }

    /// Returns the number of actual changes.
    pub(super) fn version(&self) -> u64 {
        self.version
    }

    /// Returns a node's address.
    pub(super) fn node_api(&self, node: &str) -> Option<&str> {
        self.nodes.get(node).map(|found| found.api.as_str())
    }

    /// Returns true if any node is registered at `api`.
    pub(super) fn is_known(&self, api: &str) -> bool {
        self.nodes.values().any(|node| node.api == api)
    }

    /// Returns the address of a service.
    pub(super) fn service_api(&self, service: &str) -> Option<&str> {
        self.services.get(service).map(|found| found.api.as_str())
    }

    /// Iterates over all nodes with their addresses.
    pub(super) fn nodes(&self) -> impl Iterator<Item = (&str, &str)> {
        self.nodes.iter().map(|(name, node)| (name.as_str(), node.api.as_str()))
    }

    /// Iterates over all services with the nodes that serve them.
    pub(super) fn services(&self) -> impl Iterator<Item = (&str, &str)> {
        self.services.iter().map(|(name, service)| (name.as_str(), service.node.as_str()))
    }

    /// Iterates over all topics whose type was ever declared.
    pub(super) fn types(&self) -> impl Iterator<Item = (&str, &str)> {
        self.topics.iter().map(|(name, topic)| (name.as_str(), topic.type_name.as_str()))
    }

    /// Iterates over the topics that have publishers or subscribers now.
    pub(super) fn topics(&self) -> impl Iterator<Item = (&str, TopicNodes)> {
        self.topics.iter().filter_map(|(name, topic)| Some((name.as_str(), topic.nodes()?)))
    }

    /// Returns a topic that has publishers or subscribers now.
    pub(super) fn topic(&self, name: &str) -> Option<TopicNodes> {
        self.topics.get(name)?.nodes()
    }

    /// Returns the node that serves a service.
    pub(super) fn service_node(&self, service: &str) -> Option<&str> {
        self.services.get(service).map(|found| found.node.as_str())
    }

    /// Returns the addresses of parameter subscribers, by the key they subscribed to.
    pub(super) fn parameter_watchers(&self) -> BTreeMap<String, Vec<String>> {
        let mut watchers: BTreeMap<String, Vec<String>> = BTreeMap::new();
        for node in self.nodes.values() {
            for key in &node.watches {
                watchers.entry(key.clone()).or_default().push(node.api.clone());
            }
        }
        watchers
    }
}
