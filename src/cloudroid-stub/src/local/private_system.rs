//! Private ROS system of the local original, of the robot's ROS version: a Master of the stub, or a domain of its own.
//! Only this machine can reach it, and the stub's own node is the only connection to it.

use std::collections::{BTreeMap, BTreeSet};
use std::ffi::OsString;
use std::sync::Arc;
use std::time::Duration;

use anyhow::Context;
use ros::bus::{Bus, BusError, Graph, NodeNames, ParamValue, QosProfile, RosVersion, ServiceType, WireType};
use tokio::sync::watch;
use tokio::time::timeout;

use super::expected::ExpectedInterface;
use super::lender::RobotLender;
use super::private_domain::PrivateDomain;
use super::private_master::PrivateMaster;
use crate::node_interface;

/// Name of the stub's node in it.
pub(super) const NODE: &str = "/cloudroid_stub";
/// Topic that every ROS 2 node publishes.
const EVENTS: &str = "/parameter_events";
/// Time allowed for a node to disappear from the graph after its process has ended.
const DISAPPEARANCE_TIMEOUT: Duration = Duration::from_secs(5);

/// A topic of a node, with its quality of service if known (ROS 2).
pub type RegisteredTopic = (String, WireType, Option<QosProfile>);

/// Registrations of a process.
#[derive(Debug, Clone, Default)]
pub struct RegisteredInterface {
    /// Topics that it publishes.
    pub outputs: Vec<RegisteredTopic>,
    /// Topics that it subscribes to.
    pub inputs: Vec<RegisteredTopic>,
    /// Services that it offers.
    pub services: Vec<(String, ServiceType)>,
    /// Names by node, if there are several nodes (ROS 2).
    pub nodes: BTreeMap<String, NodeNames>,
}

/// Environment variables of a process with their values; `None` unsets a variable.
pub type Variables = Vec<(&'static str, Option<OsString>)>;

/// A private ROS system and a node in it; both end when this is dropped.
pub struct PrivateSystem {
    place: SystemBackend,
    bus: Arc<dyn Bus>,
}

enum SystemBackend {
    Master(PrivateMaster),
    Domain(PrivateDomain),
}

/// Receiver of changes of a graph.
pub enum GraphChanges {
    /// Changes of a Master's registrations.
    Generations(watch::Receiver<u64>),
    /// Changes of a domain's graph.
    Graphs(watch::Receiver<Arc<Graph>>),
}

impl GraphChanges {
    /// Waits for the next change; false if there will be none.
    pub async fn next(&mut self) -> bool {
        let changed = match self {
            Self::Generations(changes) => changes.changed().await,
            Self::Graphs(changes) => changes.changed().await,
        };
        changed.is_ok()
    }
}

impl PrivateSystem {
    /// Creates a system for a robot of this ROS version.
    pub async fn new(robot: &dyn Bus, taken: Option<u16>) -> anyhow::Result<Self> {
        match robot.version() {
            RosVersion::One => {
                let (master, bus) = PrivateMaster::new().await?;
                let place = SystemBackend::Master(master);
                Ok(Self { place, bus })
            }
            RosVersion::Two => {
                let (domain, bus) = PrivateDomain::new(taken).await?;
                let place = SystemBackend::Domain(domain);
                Ok(Self { place, bus })
            }
        }
    }

    /// Returns the stub's node in it.
    pub fn bus(&self) -> &Arc<dyn Bus> {
        &self.bus
    }

    /// Returns the variables that put the nodes of a process into this system.
    pub fn environment(&self) -> Variables {
        match &self.place {
            SystemBackend::Master(master) => master.environment(),
            SystemBackend::Domain(domain) => domain.environment(),
        }
    }

    /// Lends `node` the services that it calls and that others offer on the robot.
    pub async fn lend(&self, node: &str, robot: &Arc<dyn Bus>, limit: Duration) -> anyhow::Result<()> {
        let lender = Arc::new(RobotLender::new(node, robot, limit));
        let lent = async { self.bus.lending()?.lend(lender).await };
        lent.await.context("lending services to the local original")
    }

    /// Copies the parameters that nodes of the robot share, if its ROS version has such.
    pub async fn copy_parameters(&self, from: &dyn Bus) -> anyhow::Result<()> {
        match &self.place {
            SystemBackend::Master(master) => master.copy_parameters(from).await,
            SystemBackend::Domain(_) => Ok(()),
        }
    }

    /// Changes or deletes a parameter that nodes of the robot share.
    pub async fn change_parameter(&self, name: &str, value: Option<ParamValue>) -> Result<(), BusError> {
        let parameters = self.bus.parameters()?;
        match value {
            Some(value) => parameters.set(name, value).await,
            None => parameters.delete(name).await,
        }
    }

    /// Returns the current registrations.
    pub fn graph(&self) -> Arc<Graph> {
        match &self.place {
            SystemBackend::Master(master) => Arc::new(master.graph()),
            SystemBackend::Domain(_) => Arc::clone(&self.bus.graph().borrow()),
        }
    }

    /// Returns a receiver of changes of the registrations.
    pub fn changes(&self) -> GraphChanges {
        match &self.place {
            SystemBackend::Master(master) => GraphChanges::Generations(master.generation()),
            SystemBackend::Domain(_) => GraphChanges::Graphs(self.bus.graph()),
        }
    }

    /// Waits until the graph satisfies a condition.
    async fn wait_until(&self, wanted: impl Fn(&Graph) -> bool) {
        let mut changes = self.changes();
        while !wanted(&self.graph()) {
            if !changes.next().await {
                std::future::pending::<()>().await;
            }
        }
    }

    /// Waits until a node of this name is registered.
    pub async fn wait_for_node(&self, node: &str) {
        self.wait_until(|graph| node_interface::has_node(graph, node)).await;
    }

    /// Returns the nodes of the process of `node`, in ROS 2 possibly several: no other process is here.
    pub fn nodes_of(&self, graph: &Graph, node: &str) -> BTreeSet<String> {
        let mut nodes = BTreeSet::from([node.to_owned()]);
        if self.bus.version() == RosVersion::Two {
            let others = graph.ends.keys().filter(|other| *other != NODE);
            nodes.extend(others.cloned());
        }
        nodes
    }

    /// Waits until the process of `node` has registered the whole interface.
    pub async fn wait_for_interface(&self, node: &str, all: &ExpectedInterface) {
        self.wait_until(|graph| has_interface(graph, &self.nodes_of(graph, node), all)).await;
    }

    /// Returns the registered interface of the process of `node`, as far as its types are known.
    pub async fn registered_interface(&self, node: &str) -> RegisteredInterface {
        let graph = self.graph();
        if self.bus.version() == RosVersion::Two {
            return interface_from_ends(&graph, node, &self.nodes_of(&graph, node));
        }
        let mut registered = RegisteredInterface::default();
        for topic in graph.topics.keys() {
            let says = node_interface::publishes(&graph, node, topic);
            let listens = node_interface::subscribes(&graph, node, topic);
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
            if !node_interface::serves(&graph, node, service) {
                continue;
            }
            if let Ok(service_type) = self.bus.service_type(service).await {
                registered.services.push((service.clone(), service_type));
            }
        }
        registered
    }

    /// Waits until the registrations of `node` are gone, after its process has ended.
    pub async fn process_exited(&self, node: &str) {
        match &self.place {
            SystemBackend::Master(master) => master.process_exited().await,
            // Its ports are closed, which is detected after a moment.
            SystemBackend::Domain(_) => {
                let gone = self.wait_until(|graph| !node_interface::has_node(graph, node));
                if timeout(DISAPPEARANCE_TIMEOUT, gone).await.is_err() {
                    tracing::warn!(node, "its process has ended, but its node is still visible");
                }
            }
        }
    }
}

/// Returns whether these nodes have registered everything that is expected.
fn has_interface(graph: &Graph, nodes: &BTreeSet<String>, all: &ExpectedInterface) -> bool {
    let any = |has: fn(&Graph, &str, &str) -> bool, name: &str| {
        !all.is_expected(name) || nodes.iter().any(|node| has(graph, node, name))
    };
    let listens = |topic: &String| any(node_interface::subscribes, topic);
    let says = |topic: &String| any(node_interface::publishes, topic);
    let serves = |service: &String| any(node_interface::serves, service);
    all.inputs.keys().all(listens) && all.outputs.iter().all(says) && all.services.iter().all(serves)
}

/// Returns the interface of the process of `node` from its ROS 2 endpoints. Parameter events are left out: every node
/// publishes its own, and they are for all nodes.
fn interface_from_ends(graph: &Graph, node: &str, nodes: &BTreeSet<String>) -> RegisteredInterface {
    let ends = graph.merged_endpoints(nodes);
    let names = nodes.iter().filter_map(|node| {
        let mut names = graph.ends.get(node)?.names();
        names.subscribes.remove(EVENTS);
        Some((node.clone(), names))
    });
    let names: BTreeMap<String, NodeNames> = names.collect();
    let topic = |(topic, (of, qos)): (&String, &(WireType, QosProfile))| (topic.clone(), of.clone(), Some(*qos));
    let inputs = ends.subscribers.iter();
    let services = ends.services.iter();
    RegisteredInterface {
        outputs: ends.publishers.iter().map(topic).collect(),
        inputs: inputs.filter(|(topic, _)| *topic != EVENTS).map(topic).collect(),
        services: services.map(|(service, of)| (service.clone(), of.clone())).collect(),
        nodes: if names.keys().all(|name| name == node) { BTreeMap::new() } else { names },
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn what_has_a_name_of_one_life_is_not_waited_for() {
        let served = ["/see/set", "/tf_2/get_type_description"];
        let served = served.map(|name| (name.to_owned(), "/see".to_owned()));
        let graph = Graph { services: served.into(), ..Graph::default() };
        let nodes = BTreeSet::from(["/see".to_owned()]);
        let mut all = ExpectedInterface {
            services: ["/see/set", "/tf_1/get_type_description"].map(str::to_owned).into(),
            ..ExpectedInterface::default()
        };
        assert!(!has_interface(&graph, &nodes, &all));
        all.of_others = [all.services[1].clone()].into();
        assert!(has_interface(&graph, &nodes, &all));
        // A request is waited for.
        let goal = "/see/goal".to_owned();
        all.inputs = [(goal.clone(), WireType::any())].into();
        all.of_others.insert(goal.clone());
        assert!(has_interface(&graph, &nodes, &all));
        all.awaited = [goal].into();
        assert!(!has_interface(&graph, &nodes, &all));
        all.awaited.clear();
        all.services.push("/see/more".to_owned());
        assert!(!has_interface(&graph, &nodes, &all));
    }
}
