//! The service's image as its servants run it: what the daemon told their shims.

use std::time::{Duration, Instant};

use anyhow::{Context, Result, ensure};
use package::interface::{Direction, Interface};
use ros::bus::Graph;
use servant::container::ContainerSpec;
use servant::launch::{self, Launch};
use servant::spec::NodeSpec;

use bench_servant::Daemon;

use crate::robot::Robot;

/// How long the record of a servant's nodes may take.
const PATIENCE: Duration = Duration::from_secs(30);

/// A service of one node.
pub(crate) struct Image {
    /// Its name.
    pub(crate) service: String,
    /// The spec of its servants: layers, environment, node, limits.
    pub(crate) spec: ContainerSpec,
    /// What its node registers.
    interface: Interface,
}

impl Image {
    /// Looks at a servant of the service; the daemon has none before and after.
    pub(crate) fn of(daemon: &Daemon, service: &str) -> Result<Self> {
        let mut robot = Robot::connect(&daemon.address, service)?;
        robot.nodes()?;
        let launch = started(daemon)?;
        robot.leave()?;
        daemon.until_servants(0)?;
        let interface = daemon.get(&format!("/api/v1/services/{service}/interface"))?;
        Ok(Self {
            service: service.to_owned(),
            spec: launch.spec,
            interface: serde_json::from_value(interface)?,
        })
    }

    /// Its node.
    pub(crate) fn node(&self) -> Result<&NodeSpec> {
        self.spec.nodes.first().context("a service with a node")
    }

    /// Whether the node has registered everything that a servant's readiness is told by.
    pub(crate) fn registered(&self, graph: &Graph) -> bool {
        let topic = |topic: &package::interface::Topic| {
            let ends = graph.topics.get(&topic.name);
            let there = ends.map(|ends| match topic.direction {
                Direction::Input => &ends.subscribers,
                Direction::Output => &ends.publishers,
            });
            topic
                .nodes
                .iter()
                .all(|node| there.is_some_and(|there| there.contains(node)))
        };
        let name = self.spec.nodes.first().map(|node| &node.name);
        name.is_some_and(|name| graph.nodes.contains_key(name))
            && self
                .interface
                .topics
                .iter()
                .filter(|topic| !topic.lazy)
                .all(topic)
            && self
                .interface
                .services
                .iter()
                .all(|service| graph.services.contains_key(&service.name))
    }
}

/// The record of the servant whose nodes were started. A container that was made ahead has one, too, without nodes; on a busy machine it is
/// the one that is seen first.
fn started(daemon: &Daemon) -> Result<Launch> {
    let deadline = Instant::now() + PATIENCE;
    loop {
        for id in daemon.servants()? {
            let path = daemon.home().join("servants").join(id).join(launch::SPEC);
            let record: Option<Launch> = launch::read(&path)?;
            if let Some(launch) = record.filter(|launch| !launch.spec.nodes.is_empty()) {
                return Ok(launch);
            }
        }
        ensure!(
            Instant::now() < deadline,
            "no servant has a record of its nodes"
        );
        std::thread::sleep(Duration::from_millis(20));
    }
}
