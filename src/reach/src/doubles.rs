//! Test doubles of the surroundings of a servant's nodes.

use std::time::SystemTime;

use async_trait::async_trait;
use link::control::{Exit, NodeLaunch};
use parking_lot::Mutex;
use ros::bus::{FailureReason, ParamValue};
use tokio::sync::mpsc;

use crate::Observer;
use crate::links::{MeasuredRequest, NodeController, NodeError};

/// Nodes started by stubs, and nothing else.
#[derive(Default)]
pub struct StubNodesDouble(Vec<NodeLaunch>);

impl StubNodesDouble {
    /// Creates a double with one node of this name.
    pub fn node(name: &str) -> Self {
        Self(vec![NodeLaunch { name: name.to_owned(), ..NodeLaunch::default() }])
    }
}

#[async_trait]
impl NodeController for StubNodesDouble {
    async fn start(&self, _node: &NodeLaunch, _run: &str) -> Result<(), NodeError> {
        Ok(())
    }
    async fn signal(&self, _node: &str, _signal: i32) -> Result<(), NodeError> {
        Ok(())
    }
    async fn wait_exit(&self, _node: &str) -> Exit {
        Exit::default()
    }
    async fn is_running(&self, _node: &str) -> bool {
        false
    }
    async fn running_nodes(&self) -> Vec<NodeLaunch> {
        self.0.clone()
    }
    fn parameters(&self, _node: &NodeLaunch) -> Vec<(String, ParamValue)> {
        Vec::new()
    }
    fn translate(&self, _node: &NodeLaunch, text: &str) -> String {
        text.to_owned()
    }
    fn output_lines(&self, _node: &str) -> mpsc::Receiver<(bool, String)> {
        mpsc::channel(1).1
    }
    fn warn(&self, _kind: &str, _text: &str) {}
}

/// Recorded events: kind and message.
#[derive(Default)]
pub struct RecordedEvents(pub Mutex<Vec<(String, String)>>);

#[async_trait]
impl Observer for RecordedEvents {
    async fn check_stub(&self, _made_of: Option<u64>, _image: &str) -> Result<(), FailureReason> {
        Ok(())
    }
    fn record_event(&self, _level: api::Level, kind: &str, message: &str, _robot: Option<&str>) {
        self.0.lock().push((kind.to_owned(), message.to_owned()));
    }
    fn on_served_locally(&self, _robot: &str, _node: &str, _at: SystemTime, _why: Option<&str>) {}
    fn on_request_measured(&self, _robot: Option<&str>, _request: &MeasuredRequest<'_>) {}
}
