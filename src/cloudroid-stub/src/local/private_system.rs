//! The private ROS system of the local original, of the robot's ROS: a Master of the stub's own, or a domain of its own. Only this
//! machine can reach it, and the stub's own node there is the only way in or out.

use std::collections::{BTreeMap, BTreeSet};
use std::ffi::OsString;
use std::sync::Arc;
use std::time::Duration;

use anyhow::Context;
use ros::bus::{
    Bus, BusError, Graph, NodeNames, ParamValue, Qos, RosVersion, ServiceType, WireType,
};
use tokio::sync::watch;
use tokio::time::timeout;

use super::lender::Robot;
use super::original::Interface;
use super::private_domain::PrivateDomain;
use super::private_master::PrivateMaster;
use crate::seen;

/// The stub's name in it.
pub(super) const NODE: &str = "/cloudroid_stub";
/// A topic of ROS 2 that every node publishes.
const EVENTS: &str = "/parameter_events";
/// For a node whose process has ended to be gone from the graph.
const GONE: Duration = Duration::from_secs(5);

/// A topic of a node, with its quality of service where ends tell that (ROS 2).
pub type RegisteredTopic = (String, WireType, Option<Qos>);

/// What a process has registered.
#[derive(Debug, Clone, Default)]
pub struct Registered {
    /// What it publishes.
    pub outputs: Vec<RegisteredTopic>,
    /// What it subscribes to.
    pub inputs: Vec<RegisteredTopic>,
    /// What it serves.
    pub services: Vec<(String, ServiceType)>,
    /// Which of all this is whose, where it is several nodes (ROS 2).
    pub nodes: BTreeMap<String, NodeNames>,
}

/// Variables of a process, each with its value, or none where it is to be unset.
pub type Variables = Vec<(&'static str, Option<OsString>)>;

/// A ROS system and a node in it; both end with it.
pub struct PrivateSystem {
    place: Place,
    bus: Arc<dyn Bus>,
}

enum Place {
    Master(PrivateMaster),
    Domain(PrivateDomain),
}

/// Tells of changes of a graph.
pub enum Changes {
    /// Of a Master.
    Generations(watch::Receiver<u64>),
    /// Of a domain.
    Graphs(watch::Receiver<Arc<Graph>>),
}

impl Changes {
    /// Returns with the next change; false where there will be none.
    pub async fn next(&mut self) -> bool {
        let changed = match self {
            Self::Generations(changes) => changes.changed().await,
            Self::Graphs(changes) => changes.changed().await,
        };
        changed.is_ok()
    }
}

impl PrivateSystem {
    /// Makes one for a robot of this ROS.
    pub async fn new(robot: &dyn Bus, taken: Option<u16>) -> anyhow::Result<Self> {
        match robot.version() {
            RosVersion::One => {
                let (master, bus) = PrivateMaster::new().await?;
                let place = Place::Master(master);
                Ok(Self { place, bus })
            }
            RosVersion::Two => {
                let (domain, bus) = PrivateDomain::new(taken).await?;
                let place = Place::Domain(domain);
                Ok(Self { place, bus })
            }
        }
    }

    /// The stub's node in it.
    pub fn bus(&self) -> &Arc<dyn Bus> {
        &self.bus
    }

    /// What a process is told by, so that its nodes are here.
    pub fn environment(&self) -> Variables {
        match &self.place {
            Place::Master(master) => master.environment(),
            Place::Domain(domain) => domain.environment(),
        }
    }

    /// What `node` calls that is served elsewhere on the robot.
    pub async fn lend(
        &self,
        node: &str,
        robot: &Arc<dyn Bus>,
        limit: Duration,
    ) -> anyhow::Result<()> {
        let lender = Arc::new(Robot::new(node, robot, limit));
        let lent = async { self.bus.lending()?.lend(lender).await };
        lent.await.context("lending services to the local original")
    }

    /// Takes over what nodes of the robot share, where its ROS has such a thing.
    pub async fn copy_parameters(&self, from: &dyn Bus) -> anyhow::Result<()> {
        match &self.place {
            Place::Master(master) => master.copy_parameters(from).await,
            Place::Domain(_) => Ok(()),
        }
    }

    /// A parameter that nodes of the robot share has changed, or was deleted.
    pub async fn change_parameter(
        &self,
        name: &str,
        value: Option<ParamValue>,
    ) -> Result<(), BusError> {
        let parameters = self.bus.parameters()?;
        match value {
            Some(value) => parameters.set(name, value).await,
            None => parameters.delete(name).await,
        }
    }

    /// What is registered.
    pub fn graph(&self) -> Arc<Graph> {
        match &self.place {
            Place::Master(master) => Arc::new(master.graph()),
            Place::Domain(_) => Arc::clone(&self.bus.graph().borrow()),
        }
    }

    /// Changes with whatever is registered.
    pub fn changes(&self) -> Changes {
        match &self.place {
            Place::Master(master) => Changes::Generations(master.generation()),
            Place::Domain(_) => Changes::Graphs(self.bus.graph()),
        }
    }

    /// Returns once the graph is as it is wanted.
    async fn until(&self, wanted: impl Fn(&Graph) -> bool) {
        let mut changes = self.changes();
        while !wanted(&self.graph()) {
            if !changes.next().await {
                std::future::pending::<()>().await;
            }
        }
    }

    /// Returns once a node of this name is registered.
    pub async fn registered(&self, node: &str) {
        self.until(|graph| seen::is_there(graph, node)).await;
    }

    /// The nodes that the process of `node` has become, which in ROS 2 may be several: nobody else is here.
    pub fn nodes_of(&self, graph: &Graph, node: &str) -> BTreeSet<String> {
        let mut nodes = BTreeSet::from([node.to_owned()]);
        if self.bus.version() == RosVersion::Two {
            let others = graph.ends.keys().filter(|other| *other != NODE);
            nodes.extend(others.cloned());
        }
        nodes
    }

    /// Returns once the process of `node` has registered all of this.
    pub async fn registers(&self, node: &str, all: &Interface) {
        self.until(|graph| has_all(graph, &self.nodes_of(graph, node), all))
            .await;
    }

    /// What the process of `node` has registered, as far as its types can be told.
    pub async fn registered_by(&self, node: &str) -> Registered {
        let graph = self.graph();
        if self.bus.version() == RosVersion::Two {
            return by_ends(&graph, node, &self.nodes_of(&graph, node));
        }
        let mut registered = Registered::default();
        for topic in graph.topics.keys() {
            let says = seen::publishes(&graph, node, topic);
            let listens = seen::subscribes(&graph, node, topic);
            if !says && !listens {
                continue;
            }
            let Ok(wire_type) = self.bus.topic_type(topic).await else {
                continue;
            };
            if says && !wire_type.digest.is_any() {
                let output = (topic.clone(), wire_type.clone(), None);
                registered.outputs.push(output);
            }
            if listens {
                registered.inputs.push((topic.clone(), wire_type, None));
            }
        }
        for service in graph.services.keys() {
            if !seen::serves(&graph, node, service) {
                continue;
            }
            if let Ok(service_type) = self.bus.service_type(service).await {
                registered.services.push((service.clone(), service_type));
            }
        }
        registered
    }

    /// The process of `node` has ended: returns once its registrations are gone.
    pub async fn process_exited(&self, node: &str) {
        match &self.place {
            Place::Master(master) => master.process_exited().await,
            // Its ports are free, which is seen in a moment.
            Place::Domain(_) => {
                let gone = self.until(|graph| !seen::is_there(graph, node));
                if timeout(GONE, gone).await.is_err() {
                    tracing::warn!(node, "its process has ended, and its node is still there");
                }
            }
        }
    }
}

/// Whether these nodes have what is waited for.
fn has_all(graph: &Graph, nodes: &BTreeSet<String>, all: &Interface) -> bool {
    let any = |has: fn(&Graph, &str, &str) -> bool, name: &str| {
        !all.waits_for(name) || nodes.iter().any(|node| has(graph, node, name))
    };
    let listens = |topic: &String| any(seen::subscribes, topic);
    let says = |topic: &String| any(seen::publishes, topic);
    let serves = |service: &String| any(seen::serves, service);
    all.inputs.keys().all(listens)
        && all.outputs.iter().all(says)
        && all.services.iter().all(serves)
}

/// What the ends of the process of `node` in ROS 2 tell. Parameter events are for everybody, and each node publishes its own.
fn by_ends(graph: &Graph, node: &str, nodes: &BTreeSet<String>) -> Registered {
    let ends = graph.ends_of(nodes);
    let names = nodes.iter().filter_map(|node| {
        let mut names = graph.ends.get(node)?.names();
        names.subscribes.remove(EVENTS);
        Some((node.clone(), names))
    });
    let names: BTreeMap<String, NodeNames> = names.collect();
    let topic =
        |(topic, (of, qos)): (&String, &(WireType, Qos))| (topic.clone(), of.clone(), Some(*qos));
    let inputs = ends.subscribers.iter();
    let services = ends.services.iter();
    Registered {
        outputs: ends.publishers.iter().map(topic).collect(),
        inputs: inputs
            .filter(|(topic, _)| *topic != EVENTS)
            .map(topic)
            .collect(),
        services: services
            .map(|(service, of)| (service.clone(), of.clone()))
            .collect(),
        nodes: match names.keys().all(|name| name == node) {
            true => BTreeMap::new(),
            false => names,
        },
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn what_has_a_name_of_one_life_is_not_waited_for() {
        let served = ["/see/set", "/tf_2/get_type_description"];
        let served = served.map(|name| (name.to_owned(), "/see".to_owned()));
        let graph = Graph {
            services: served.into(),
            ..Graph::default()
        };
        let nodes = BTreeSet::from(["/see".to_owned()]);
        let mut all = Interface {
            services: ["/see/set", "/tf_1/get_type_description"]
                .map(str::to_owned)
                .into(),
            ..Interface::default()
        };
        assert!(!has_all(&graph, &nodes, &all));
        all.of_others = [all.services[1].clone()].into();
        assert!(has_all(&graph, &nodes, &all));
        // But what is to be given to it is.
        let goal = "/see/goal".to_owned();
        all.inputs = [(goal.clone(), WireType::any())].into();
        all.of_others.insert(goal.clone());
        assert!(has_all(&graph, &nodes, &all));
        all.awaited = [goal].into();
        assert!(!has_all(&graph, &nodes, &all));
        all.awaited.clear();
        all.services.push("/see/more".to_owned());
        assert!(!has_all(&graph, &nodes, &all));
    }
}
