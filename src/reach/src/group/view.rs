//! The part of a group that one robot's bus shows, with its names.

use std::collections::BTreeMap;

use package::interface::Interface;
use ros::bus::{ActionEndpoint, ActionNodes, Graph, RosVersion, TopicNodes, action_endpoints};

use super::names::{NameKind, NameResolver};

/// Name of a node that is missing in the interface.
const SOMEBODY: &str = "/shared";

/// Services and actions by their names on the robot.
#[derive(Debug, Clone, Default, PartialEq)]
pub(super) struct GroupView {
    pub(super) services: BTreeMap<String, ViewEntry>,
    pub(super) actions: BTreeMap<String, ViewAction>,
}

/// A service.
#[derive(Debug, Clone, PartialEq)]
pub(super) struct ViewEntry {
    /// Name in the interface, and therefore at every servant.
    pub(super) of: String,
    /// Name of its node on the robot.
    pub(super) node: String,
}

/// An action.
#[derive(Debug, Clone, PartialEq)]
pub(super) struct ViewAction {
    pub(super) shown: ViewEntry,
    pub(super) type_name: String,
    pub(super) ends: Vec<(ActionEndpoint, String)>,
}

/// A node of the group under the name of a robot's stub.
pub(super) struct NodeAlias<'a> {
    /// Name in the group.
    pub(super) node: &'a str,
    /// It is the only node, so that it owns what the interface attributes to no node.
    pub(super) only: bool,
    pub(super) deployed: NameResolver,
    /// Name on the robot.
    pub(super) name: &'a str,
    pub(super) robot: NameResolver,
}

impl GroupView {
    /// Creates the view of a complete interface as it was deployed.
    pub(super) fn from_interface(version: RosVersion, interface: &Interface) -> GroupView {
        let named = |node: &str| match node {
            "" => SOMEBODY.to_owned(),
            node => node.to_owned(),
        };
        let services = interface.services.iter().map(|service| {
            let shown = ViewEntry { of: service.name.clone(), node: named(&service.node) };
            (service.name.clone(), shown)
        });
        let actions = interface.actions.iter().map(|action| {
            let shown = ViewAction {
                shown: ViewEntry { of: action.name.clone(), node: named(&action.node) },
                type_name: action.type_name.clone(),
                ends: action_endpoints(version, &action.name),
            };
            (action.name.clone(), shown)
        });
        GroupView { services: services.collect(), actions: actions.collect() }
    }

    /// Creates the view of one of its nodes under the names that it would have on the robot.
    pub(super) fn for_node(version: RosVersion, interface: &Interface, alias: &NodeAlias<'_>) -> GroupView {
        let NodeAlias { deployed, robot, .. } = alias;
        let its = |node: &str| node == alias.node || (alias.only && node.is_empty());
        let shown = |name: &str| ViewEntry { of: name.to_owned(), node: alias.name.to_owned() };
        let services = interface.services.iter();
        let services = services.filter(|service| its(&service.node)).map(|service| {
            let name = deployed.service_name_on(robot, &service.name);
            (name, shown(&service.name))
        });
        let actions = interface.actions.iter();
        let actions = actions.filter(|action| its(&action.node)).map(|action| {
            let ends = action_endpoints(version, &action.name).into_iter();
            let ends = ends.map(|(end, name)| {
                let suffix = &name[action.name.len()..];
                let what = if end.is_service() { NameKind::Service } else { NameKind::Topic };
                (end, deployed.endpoint_name_on(robot, &action.name, suffix, what))
            });
            let shown =
                ViewAction { shown: shown(&action.name), type_name: action.type_name.clone(), ends: ends.collect() };
            (deployed.action_name_on(robot, &action.name), shown)
        });
        GroupView { services: services.collect(), actions: actions.collect() }
    }

    /// Adds another view. Its entries win, like those of the node that registers last.
    pub(super) fn merge(&mut self, other: GroupView) {
        self.services.extend(other.services);
        self.actions.extend(other.actions);
    }

    /// Finds the action to which a topic belongs, and the part that it is.
    pub(super) fn find_topic(&self, name: &str) -> Option<(&ViewAction, ActionEndpoint)> {
        self.find_part(name).filter(|(_, end)| !end.is_service())
    }

    /// Finds the action to which a service belongs, and the part that it is.
    pub(super) fn find_action_service(&self, name: &str) -> Option<(&ViewAction, ActionEndpoint)> {
        self.find_part(name).filter(|(_, end)| end.is_service())
    }

    fn find_part(&self, name: &str) -> Option<(&ViewAction, ActionEndpoint)> {
        self.actions.values().find_map(|action| {
            let mut ends = action.ends.iter();
            let (end, _) = ends.find(|(_, part)| part == name)?;
            Some((action, *end))
        })
    }

    /// Returns the view as a graph; for ROS 2 without the endpoints of nodes, which require types.
    pub(super) fn graph(&self, version: RosVersion, generation: u64) -> Graph {
        let services = self.services.iter();
        let services: BTreeMap<String, String> =
            services.map(|(name, shown)| (name.clone(), shown.node.clone())).collect();
        // In ROS 2 they are hidden from the graph.
        let topics_of = |action: &ViewAction| -> Vec<(ActionEndpoint, String)> {
            match version {
                RosVersion::One => action.ends.clone(),
                RosVersion::Two => Vec::new(),
            }
        };
        let actions = self.actions.iter().map(|(name, action)| {
            let topics = topics_of(action).into_iter();
            let nodes = ActionNodes {
                type_name: action.type_name.clone(),
                servers: vec![action.shown.node.clone()],
                topics: topics.map(|(_, topic)| topic).collect(),
                ..ActionNodes::default()
            };
            (name.clone(), nodes)
        });
        let topics = self.actions.values().flat_map(|action| {
            topics_of(action).into_iter().map(|(end, topic)| {
                let mut ends = TopicNodes { type_name: end.type_name(&action.type_name), ..TopicNodes::default() };
                let here = if end.is_published_by_clients() { &mut ends.subscribers } else { &mut ends.publishers };
                here.push(action.shown.node.clone());
                (topic, ends)
            })
        });
        let nodes = services.values().chain(self.actions.values().map(|action| &action.shown.node));
        Graph {
            generation,
            nodes: nodes.map(|node| (node.clone(), String::new())).collect(),
            topics: topics.collect(),
            actions: actions.collect(),
            services,
            ..Graph::default()
        }
    }
}
