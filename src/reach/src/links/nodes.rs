//! The nodes of a servant as its links start, signal and await them.

use std::sync::Weak;

use async_trait::async_trait;
use link::control::{Decision, Exit, Hello, Node, Request};
use ros::bus::ParamValue;
use tokio::sync::mpsc;

use super::requests::RequestNews;
use crate::{Linked, Tenant};

/// What a servant does for its links.
#[async_trait]
pub trait Nodes: Send + Sync + 'static {
    /// Which service they are of; may be empty.
    fn service(&self) -> &str {
        ""
    }
    /// Starts the node for this run of the robot's; comes back when its program runs, or says why it cannot.
    async fn start(&self, node: &Node, run: &str) -> Result<(), String>;
    /// For which run the node was started last, by whichever daemon; none where that is not remembered.
    fn run(&self, _node: &str) -> Option<String> {
        None
    }
    /// Sends it a signal.
    async fn signal(&self, node: &str, signal: i32) -> Result<(), String>;
    /// Waits for its end; at once if it does not run.
    async fn ended(&self, node: &str) -> Exit;
    /// Whether it runs.
    async fn is_running(&self, node: &str) -> bool;
    /// Those that were started and run, as the robot's stubs said; none where they are not started one by one.
    async fn running(&self) -> Vec<Linked> {
        Vec::new()
    }
    /// Parameters that the deployer gave for this executable: they win over the robot's.
    fn parameters(&self, node: &Node) -> Vec<(String, ParamValue)>;
    /// A path or text of the robot as the servant knows it.
    fn translate(&self, node: &Node, text: &str) -> String;
    /// What the node prints from now on: on standard error or not, and the line.
    fn lines(&self, node: &str) -> mpsc::Receiver<(bool, String)>;
    /// Its robot has decided something about the local original.
    fn decided(&self, _node: &str, _decision: &Decision) {}
    /// This has become known of a request, of one that was answered with the cloud's time and its parts.
    fn measured(&self, _request: &Request, _news: RequestNews) {}
    /// Something that whoever looks after the server should know of this robot.
    fn warn(&self, kind: &str, text: &str);
    /// What this robot gives its node, and the node that answers in its place does not heed; in words.
    fn unheeded(&self, _hello: &Hello) -> Option<String> {
        None
    }
    /// From now on the nodes are this one's.
    fn bind(&self, _tenant: Weak<dyn Tenant>) {}
}
