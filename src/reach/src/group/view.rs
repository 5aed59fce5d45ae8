//! What one robot's bus shows of a group, and under which names.

use std::collections::BTreeMap;

use package::interface::Interface;
use ros::bus::{ActionNodes, Graph, RosVersion, TopicNodes};

use super::action_ends::{End, ends_of};
use super::names::{Names, What};

/// The name of a node that the interface does not tell.
const SOMEBODY: &str = "/shared";

/// Services and actions by the names that the robot has for them.
#[derive(Debug, Clone, Default, PartialEq)]
pub(super) struct View {
    pub(super) services: BTreeMap<String, Shown>,
    pub(super) actions: BTreeMap<String, ShownAction>,
}

/// A service.
#[derive(Debug, Clone, PartialEq)]
pub(super) struct Shown {
    /// Its name in the interface, and so at every servant.
    pub(super) of: String,
    /// The node that serves it, as the robot knows it.
    pub(super) node: String,
}

/// An action.
#[derive(Debug, Clone, PartialEq)]
pub(super) struct ShownAction {
    pub(super) shown: Shown,
    pub(super) type_name: String,
    pub(super) ends: Vec<(End, String)>,
}

/// A node of the group under the name that a robot's stub has for it.
pub(super) struct Alias<'a> {
    /// Its name in the group.
    pub(super) node: &'a str,
    /// Whether it is the only node, so that what the interface ascribes to no node is its own.
    pub(super) only: bool,
    pub(super) deployed: Names,
    /// Its name on the robot.
    pub(super) name: &'a str,
    pub(super) robot: Names,
}

impl View {
    /// All of an interface, as it was deployed.
    pub(super) fn whole(version: RosVersion, interface: &Interface) -> View {
        let named = |node: &str| match node {
            "" => SOMEBODY.to_owned(),
            node => node.to_owned(),
        };
        let services = interface.services.iter().map(|service| {
            let shown = Shown {
                of: service.name.clone(),
                node: named(&service.node),
            };
            (service.name.clone(), shown)
        });
        let actions = interface.actions.iter().map(|action| {
            let shown = ShownAction {
                shown: Shown {
                    of: action.name.clone(),
                    node: named(&action.node),
                },
                type_name: action.type_name.clone(),
                ends: ends_of(version, &action.name),
            };
            (action.name.clone(), shown)
        });
        View {
            services: services.collect(),
            actions: actions.collect(),
        }
    }

    /// What one of its nodes serves, under the names that it would have on the robot.
    pub(super) fn of_node(version: RosVersion, interface: &Interface, alias: &Alias<'_>) -> View {
        let Alias {
            deployed, robot, ..
        } = alias;
        let its = |node: &str| node == alias.node || (alias.only && node.is_empty());
        let shown = |name: &str| Shown {
            of: name.to_owned(),
            node: alias.name.to_owned(),
        };
        let services = interface.services.iter();
        let services = services
            .filter(|service| its(&service.node))
            .map(|service| {
                let name = deployed.on(robot, &service.name);
                (name, shown(&service.name))
            });
        let actions = interface.actions.iter();
        let actions = actions.filter(|action| its(&action.node)).map(|action| {
            let ends = ends_of(version, &action.name).into_iter();
            let ends = ends.map(|(end, name)| {
                let suffix = &name[action.name.len()..];
                let what = match end.is_service() {
                    true => What::Service,
                    false => What::Topic,
                };
                (end, deployed.end_on(robot, &action.name, suffix, what))
            });
            let shown = ShownAction {
                shown: shown(&action.name),
                type_name: action.type_name.clone(),
                ends: ends.collect(),
            };
            (deployed.action_on(robot, &action.name), shown)
        });
        View {
            services: services.collect(),
            actions: actions.collect(),
        }
    }

    /// With what another shows, too; of one name the other's stays, as that of the node that registers last does.
    pub(super) fn add(&mut self, other: View) {
        self.services.extend(other.services);
        self.actions.extend(other.actions);
    }

    /// The action that a topic belongs to, and which of its parts that is.
    pub(super) fn topic(&self, name: &str) -> Option<(&ShownAction, End)> {
        self.part(name).filter(|(_, end)| !end.is_service())
    }

    /// The action that a service belongs to, and which of its parts that is.
    pub(super) fn action_service(&self, name: &str) -> Option<(&ShownAction, End)> {
        self.part(name).filter(|(_, end)| end.is_service())
    }

    fn part(&self, name: &str) -> Option<(&ShownAction, End)> {
        self.actions.values().find_map(|action| {
            let mut ends = action.ends.iter();
            let (end, _) = ends.find(|(_, part)| part == name)?;
            Some((action, *end))
        })
    }

    /// As a graph; of ROS 2 without what each node has, which its types are needed for.
    pub(super) fn graph(&self, version: RosVersion, generation: u64) -> Graph {
        let services = self.services.iter();
        let services: BTreeMap<String, String> = services
            .map(|(name, shown)| (name.clone(), shown.node.clone()))
            .collect();
        // In ROS 2 they are no topics to who looks at the graph.
        let topics_of = |action: &ShownAction| -> Vec<(End, String)> {
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
                let mut ends = TopicNodes {
                    type_name: end.type_name(&action.type_name),
                    ..TopicNodes::default()
                };
                let here = match end.is_of_clients() {
                    true => &mut ends.subscribers,
                    false => &mut ends.publishers,
                };
                here.push(action.shown.node.clone());
                (topic, ends)
            })
        });
        let nodes = services
            .values()
            .chain(self.actions.values().map(|action| &action.shown.node));
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
