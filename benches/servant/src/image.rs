//! The image of a service as its servants run it, from the specification that the daemon gives to their shims.

use anyhow::{Context, Result};
use bench_report::BenchDaemon;
use package::interface::{Direction, Interface};
use ros::bus::Graph;
use servant::container::ContainerSpec;
use servant::launch::{self, LaunchRecord};
use servant::spec::NodeSpec;

use crate::starts::list_nodes;

/// A service with one node.
pub(crate) struct ServiceImage {
    /// Name of the service.
    pub(crate) service: String,
    /// Specification of its servants: layers, environment, node, limits.
    pub(crate) spec: ContainerSpec,
    /// Topics and services that its node registers.
    interface: Interface,
}

impl ServiceImage {
    /// Starts the only servant of the daemon, reads its specification, and waits until it has ended.
    pub(crate) fn inspect(daemon: &BenchDaemon, service: &str) -> Result<Self> {
        let mut robot = daemon.robot(service)?;
        list_nodes(&mut robot)?;
        let launch = find_started(daemon)?;
        robot.leave()?;
        daemon.wait_for_servants(0)?;
        let interface = daemon.api(&format!("/api/v1/services/{service}/interface"))?;
        Ok(Self { service: service.to_owned(), spec: launch.spec, interface: serde_json::from_value(interface)? })
    }

    /// Returns its node.
    pub(crate) fn node(&self) -> Result<&NodeSpec> {
        self.spec.nodes.first().context("a service with a node")
    }

    /// Returns whether the node has registered everything that makes a servant ready.
    pub(crate) fn is_registered(&self, graph: &Graph) -> bool {
        let topic = |topic: &package::interface::Topic| {
            let ends = graph.topics.get(&topic.name);
            let there = ends.map(|ends| match topic.direction {
                Direction::Input => &ends.subscribers,
                Direction::Output => &ends.publishers,
            });
            topic.nodes.iter().all(|node| there.is_some_and(|there| there.contains(node)))
        };
        let name = self.spec.nodes.first().map(|node| &node.name);
        name.is_some_and(|name| graph.nodes.contains_key(name))
            && self.interface.topics.iter().filter(|topic| !topic.lazy).all(topic)
            && self.interface.services.iter().all(|service| graph.services.contains_key(&service.name))
    }
}

/// Returns the record of the servant whose nodes were started: a container of the warm pool has none.
fn find_started(daemon: &BenchDaemon) -> Result<LaunchRecord> {
    support::wait_until("a servant with a record of its nodes", || {
        for id in daemon.servants()? {
            let path = daemon.home.join("servants").join(id).join(launch::SPEC);
            let record: Option<LaunchRecord> = launch::read_record(&path)?;
            if let Some(launch) = record.filter(|launch| !launch.spec.nodes.is_empty()) {
                return Ok(Ok(launch));
            }
        }
        Ok(Err("no servant has one".to_owned()))
    })
}
