//! Records which run of a robot's node is active in the servant, beyond this process: a node that an earlier daemon
//! started for the same run continues. In ROS 1 it is stored in the servant's parameters; otherwise whoever started the
//! node remembers it.

use ros::bus::ParamValue;

use super::state::Hub;

/// Parameter below which runs are stored.
pub(super) const RUNS: &str = "/cloudroid_runs";

fn run_key(node: &str) -> String {
    format!("{RUNS}/{}", node.trim_start_matches('/').replace('/', "__"))
}

impl Hub {
    /// Returns whether the running node was started for this run.
    pub(super) async fn is_of_run(&self, node: &str, run: &str) -> bool {
        match self.bus.parameters() {
            Ok(parameters) => {
                let known = parameters.get(&run_key(node)).await.ok();
                known == Some(ParamValue::String(run.to_owned()))
            }
            Err(_) => self.nodes.last_run(node).as_deref() == Some(run),
        }
    }

    /// Records the run for which the node is about to be started.
    pub(super) async fn record_run(&self, node: &str, run: &str) {
        if let Ok(parameters) = self.bus.parameters() {
            let run = ParamValue::String(run.to_owned());
            let _ = parameters.set(&run_key(node), run).await;
        }
    }
}
