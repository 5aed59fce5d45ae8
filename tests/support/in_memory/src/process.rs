//! Interface between the program of a node and its environment.

use std::any::Any;
use std::sync::Arc;

use ros::bus::{ActionHandler, ActionNodes, Bus, Graph, ServiceHandler, ServiceType, TopicNodes};
use ros::schema::ActionDef;
use servant::engine::ServantHandle;
use servant::spec::NodeSpec;

use crate::servants::MemoryServant;

/// One run of a node.
pub struct Process {
    pub(crate) servant: Arc<MemoryServant>,
    pub(crate) node: NodeSpec,
    /// Counted from 1.
    pub(crate) start: u32,
}

impl Process {
    /// Returns how often the node was started, including this start.
    pub fn start(&self) -> u32 {
        self.start
    }

    /// Prints a line on standard output.
    pub fn print(&self, line: &str) {
        self.servant.print(&self.node.name, line);
    }

    /// Registers the node as publisher of a topic.
    pub fn advertise(&self, topic: &str, type_name: &str) {
        let name = self.node.name.clone();
        self.register(|graph| {
            let ends = graph.topics.entry(topic.to_owned()).or_default();
            *ends = TopicNodes { type_name: type_name.to_owned(), publishers: vec![name], ..std::mem::take(ends) };
        });
    }

    /// Serves a service until the returned value is dropped.
    pub async fn serve(
        &self,
        service: &str,
        type_name: &str,
        handler: Arc<dyn ServiceHandler>,
    ) -> Box<dyn Send + Sync> {
        let node = self.servant.system.join(&self.node.name);
        let of = ServiceType::new(type_name, "*");
        let served = node.serve(service, of, handler).await;
        let served = served.unwrap_or_else(|error| panic!("{error}"));
        let name = self.node.name.clone();
        self.register(|graph| {
            graph.services.insert(service.to_owned(), name);
        });
        Box::new((served, node))
    }

    /// Serves an action until the returned value is dropped.
    pub fn serve_action(
        &self,
        action: &str,
        of: &Arc<ActionDef>,
        handler: Arc<dyn ActionHandler>,
    ) -> Box<dyn Any + Send + Sync> {
        let node = self.servant.system.join(&self.node.name);
        let served = node.serve_action(action, of, handler);
        let served = served.unwrap_or_else(|error| panic!("{error}"));
        let server = self.node.name.clone();
        self.register(|graph| {
            let ends = ActionNodes { type_name: of.name.clone(), servers: vec![server], ..ActionNodes::default() };
            graph.actions.insert(action.to_owned(), ends);
        });
        Box::new((served, node))
    }

    /// Returns the id of its servant.
    pub fn servant(&self) -> &str {
        self.servant.id()
    }

    /// Allocates memory until the node ends. The node is killed if its servant has too little left.
    pub async fn allocate(&self, bytes: u64) {
        if !self.servant.allocate(&self.node.name, bytes) {
            std::future::pending::<()>().await;
        }
    }

    fn register(&self, change: impl FnOnce(&mut Graph)) {
        let name = self.node.name.clone();
        self.servant.graph.send_modify(|graph| {
            let mut next = Graph::clone(graph);
            next.generation += 1;
            next.nodes.insert(name, String::new());
            change(&mut next);
            *graph = Arc::new(next);
        });
    }
}
