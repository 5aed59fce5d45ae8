//! Stand-ins of what is beside a servant's nodes, for unit tests.

use std::time::SystemTime;

use async_trait::async_trait;
use link::control::{Exit, Node, Request};
use parking_lot::Mutex;
use ros::bus::ParamValue;
use tokio::sync::mpsc;

use crate::links::{Nodes, RequestNews};
use crate::{Linked, Observer};

/// The nodes that stubs have started, and nothing else.
#[derive(Default)]
pub struct Started(Vec<Linked>);

impl Started {
    /// The node of this name.
    pub fn node(name: &str) -> Self {
        let node = Node {
            name: name.to_owned(),
            ..Node::default()
        };
        let given = Vec::new();
        Self(vec![Linked { node, given }])
    }
}

#[async_trait]
impl Nodes for Started {
    async fn start(&self, _node: &Node, _run: &str) -> Result<(), String> {
        Ok(())
    }
    async fn signal(&self, _node: &str, _signal: i32) -> Result<(), String> {
        Ok(())
    }
    async fn ended(&self, _node: &str) -> Exit {
        Exit::default()
    }
    async fn is_running(&self, _node: &str) -> bool {
        false
    }
    async fn running(&self) -> Vec<Linked> {
        self.0.clone()
    }
    fn parameters(&self, _node: &Node) -> Vec<(String, ParamValue)> {
        Vec::new()
    }
    fn translate(&self, _node: &Node, text: &str) -> String {
        text.to_owned()
    }
    fn lines(&self, _node: &str) -> mpsc::Receiver<(bool, String)> {
        mpsc::channel(1).1
    }
    fn warn(&self, _kind: &str, _text: &str) {}
}

/// Events so far: kind and message.
#[derive(Default)]
pub struct Events(pub Mutex<Vec<(String, String)>>);

impl Observer for Events {
    fn fits(&self, _made_of: Option<u64>, _image: &str) -> Result<(), String> {
        Ok(())
    }
    fn event(&self, _level: api::Level, kind: &str, message: &str, _robot: Option<&str>) {
        self.0.lock().push((kind.to_owned(), message.to_owned()));
    }
    fn served_locally(&self, _robot: &str, _node: &str, _at: SystemTime, _why: Option<&str>) {}
    fn measured(&self, _request: &Request, _news: RequestNews) {}
}
