//! Control of a servant's nodes by its links.

use std::sync::Weak;

use async_trait::async_trait;
use link::control::{Decision, Exit, Hello, NodeLaunch};
use package::interface::Interface;
use ros::bus::{BusError, FailureReason, ParamValue};
use tokio::sync::mpsc;

use super::requests::MeasuredRequest;
use crate::observer::Tenant;

/// Error of starting or signalling a node of a servant.
#[derive(Debug, thiserror::Error)]
pub enum NodeError {
    /// The servant has no tenant any more.
    #[error("the servant has ended")]
    ServantEnded,
    /// The daemon does not let this stub use the servant.
    #[error(transparent)]
    StubRefused(#[from] FailureReason),
    /// The push did not record the program.
    #[error(
        "service {service} was not pushed with the executable {executable} of package {package}: a stub starts what \
         its push recorded; push it with that node"
    )]
    NotPushed {
        /// Name of the service.
        service: String,
        /// Name of the executable.
        executable: String,
        /// Package of the executable.
        package: String,
    },
    /// No node of a shared service runs the program.
    #[error(
        "robots share service {service}, whose servants do not run {executable}: a stub uses what runs there; push \
         the service with that node"
    )]
    NotRun {
        /// Name of the service.
        service: String,
        /// Name of the executable.
        executable: String,
    },
    /// Several nodes of a shared service run the program, and none of them has the name of the stub's node.
    #[error(
        "robots share service {service}, whose servants run {executable} as {}: which of them {node} stands for is \
         decided by its name; give it one of these names", .candidates.join(" and ")
    )]
    Ambiguous {
        /// Name of the service.
        service: String,
        /// Name of the executable.
        executable: String,
        /// Names of the service's nodes that run it.
        candidates: Vec<String>,
        /// Name of the stub's node.
        node: String,
    },
    /// The node's parameters cannot be set.
    #[error(transparent)]
    Parameters(#[from] BusError),
    /// The engine does not start the program.
    #[error("{node} cannot be started: {source}")]
    Start {
        /// Name of the node.
        node: String,
        /// Error of the engine.
        source: servant::Error,
    },
    /// The engine does not send the signal.
    #[error(transparent)]
    Signal(servant::Error),
}

/// Starts, signals and observes the nodes of a servant on behalf of its links.
#[async_trait]
pub trait NodeController: Send + Sync + 'static {
    /// Returns the name of their service; may be empty.
    fn service(&self) -> &str {
        ""
    }
    /// Returns the interface of the service as its push has recorded it, if that is known.
    fn interface(&self) -> Option<&Interface> {
        None
    }
    /// Starts the node for this run of the robot's; returns once its program runs, or cannot be started.
    async fn start(&self, node: &NodeLaunch, run: &str) -> Result<(), NodeError>;
    /// Returns the run for which the node was last started, by any daemon, if that is recorded.
    fn last_run(&self, _node: &str) -> Option<String> {
        None
    }
    /// Sends a signal to the node.
    async fn signal(&self, node: &str, signal: i32) -> Result<(), NodeError>;
    /// Waits for the node to exit; returns immediately if it is not running.
    async fn wait_exit(&self, node: &str) -> Exit;
    /// Returns whether the node is running.
    async fn is_running(&self, node: &str) -> bool;
    /// Returns the running nodes that stubs have started; empty if nodes are not started individually.
    async fn running_nodes(&self) -> Vec<NodeLaunch> {
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
    fn on_request_measured(&self, _request: &MeasuredRequest<'_>) {}
    /// Reports a problem of this robot to the operator.
    fn warn(&self, kind: &str, text: &str);
    /// Describes settings of this robot for its node that the node answering in its place ignores.
    fn describe_unused_settings(&self, _hello: &Hello) -> Option<String> {
        None
    }
    /// Assigns the nodes to a tenant.
    fn bind_tenant(&self, _tenant: Weak<dyn Tenant>) {}
}
