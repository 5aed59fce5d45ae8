//! Which run of a robot's node is at work in the servant, known beyond this process: a node that an earlier daemon started for the
//! same run goes on. In ROS 1 it stands among the parameters of the servant; elsewhere whoever started the node remembers it.

use ros::bus::ParamValue;

use super::Hub;

/// Runs stand below this key of a servant's parameters.
pub(super) const RUNS: &str = "/cloudroid_runs";

fn key(node: &str) -> String {
    format!("{RUNS}/{}", node.trim_start_matches('/').replace('/', "__"))
}

impl Hub {
    /// Whether the node that runs was started for this run.
    pub(super) async fn is_of_run(&self, node: &str, run: &str) -> bool {
        match self.bus.parameters() {
            Ok(parameters) => {
                let known = parameters.get(&key(node)).await.ok();
                known == Some(ParamValue::String(run.to_owned()))
            }
            Err(_) => self.nodes.run(node).as_deref() == Some(run),
        }
    }

    /// The node is about to be started for this run.
    pub(super) async fn note_run(&self, node: &str, run: &str) {
        if let Ok(parameters) = self.bus.parameters() {
            let run = ParamValue::String(run.to_owned());
            let _ = parameters.set(&key(node), run).await;
        }
    }
}
