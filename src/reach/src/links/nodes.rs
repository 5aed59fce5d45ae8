//! Control of a servant's nodes by its links.

use std::sync::Weak;

use async_trait::async_trait;
use link::control::{Decision, Exit, Hello, NodeLaunch, RequestTiming};
use ros::bus::ParamValue;
use tokio::sync::mpsc;

use super::requests::RequestUpdate;
use crate::{StubNode, Tenant};

/// Starts, signals and observes the nodes of a servant on behalf of its links.
#[async_trait]
pub trait NodeController: Send + Sync + 'static {
    /// Returns the name of their service; may be empty.
    fn service(&self) -> &str {
        ""
    }
    /// Starts the node for this run of the robot's; returns once its program runs, or the reason why it cannot be
    /// started.
    async fn start(&self, node: &NodeLaunch, run: &str) -> Result<(), String>;
    /// Returns the run for which the node was last started, by any daemon, if that is recorded.
    fn last_run(&self, _node: &str) -> Option<String> {
        None
    }
    /// Sends a signal to the node.
    async fn signal(&self, node: &str, signal: i32) -> Result<(), String>;
    /// Waits for the node to exit; returns immediately if it is not running.
    async fn wait_exit(&self, node: &str) -> Exit;
    /// Returns whether the node is running.
    async fn is_running(&self, node: &str) -> bool;
    /// Returns the running nodes that stubs have started; empty if nodes are not started individually.
    async fn running_nodes(&self) -> Vec<StubNode> {
        Vec::new()
    }
    /// Returns the parameters that the deployer gave for this executable; they override the robot's.
    fn parameters(&self, node: &NodeLaunch) -> Vec<(String, ParamValue)>;
    /// Translates a path or text of the robot to the servant.
    fn translate(&self, node: &NodeLaunch, text: &str) -> String;
    /// Returns the lines that the node prints from now on, with whether they are on standard error.
    fn output_lines(&self, node: &str) -> mpsc::Receiver<(bool, String)>;
    /// Records a decision of the robot about the local original.
    fn on_decision(&self, _node: &str, _decision: &Decision) {}
    /// Records an update about a request; an answered one has the cloud's response time and phases.
    fn on_request_measured(&self, _request: &RequestTiming, _news: RequestUpdate) {}
    /// Reports a problem of this robot to the operator.
    fn warn(&self, kind: &str, text: &str);
    /// Describes settings of this robot for its node that the node answering in its place ignores.
    fn describe_unused_settings(&self, _hello: &Hello) -> Option<String> {
        None
    }
    /// Assigns the nodes to a tenant.
    fn bind_tenant(&self, _tenant: Weak<dyn Tenant>) {}
}
