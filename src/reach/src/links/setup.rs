//! What a robot's stubs have set up in its servant, so that another servant can be set up in the same way.

use std::collections::BTreeSet;

use link::control::NodeLaunch;
use ros::bus::{BusError, ParamValue};
use ros::ros1::own_parameters::is_set_by_master;

use super::nodes::NodeError;
use super::runs::RUNS;
use super::state::Hub;

/// Nodes and parameters of a robot's stubs.
#[derive(Debug, Clone, Default)]
pub struct StubSetup {
    /// Running nodes that stubs have started.
    pub nodes: Vec<NodeLaunch>,
    /// Parameters by absolute name, except those that the push has given to the nodes.
    pub parameters: Vec<(String, ParamValue)>,
}

impl Hub {
    /// Returns what the robot's stubs have set up; nothing if none of their nodes is running.
    pub(crate) async fn read_setup(&self) -> Result<StubSetup, BusError> {
        let nodes = self.nodes.running_nodes().await;
        let mut parameters = Vec::new();
        if nodes.is_empty() {
            return Ok(StubSetup { nodes, parameters });
        }
        let given = nodes.iter().flat_map(|node| self.nodes.parameters(node));
        let given: BTreeSet<String> = given.map(|(key, _)| key).collect();
        let all = self.bus.parameters()?;
        for key in all.names().await? {
            if is_set_by_master(&key) || key.starts_with(RUNS) || given.contains(&key) {
                continue;
            }
            // It may have been deleted meanwhile.
            if let Ok(value) = all.get(&key).await {
                parameters.push((key, value));
            }
        }
        Ok(StubSetup { nodes, parameters })
    }

    /// Sets parameters and starts nodes as stubs have done in another servant. Parameters from the push are those of
    /// this servant's revision.
    pub(crate) async fn apply_setup(&self, setup: &StubSetup) -> Result<(), NodeError> {
        for (key, value) in &setup.parameters {
            self.bus.parameters()?.set(key, value.clone()).await?;
        }
        for node in &setup.nodes {
            // Without global parameters, those of the node are on its command line.
            if let Ok(parameters) = self.bus.parameters() {
                for (key, value) in self.nodes.parameters(node) {
                    parameters.set(&key, value).await?;
                }
            }
            self.nodes.start(node, "").await?;
        }
        Ok(())
    }
}
