//! The private ROS system of the local original: a Master on loopback, and the stub's own node there.

use std::net::{Ipv4Addr, SocketAddr};
use std::sync::Arc;
use std::time::Duration;

use anyhow::Context;
use ros::bus::{Bus, GlobalParameters, Graph, Lending, ServiceType, WireType};
use ros::net::{HostSockets, Sockets};
use ros::ros1::Ros1Bus;
use ros::ros1::master::{Master, MasterOptions};
use tokio::sync::watch;
use tokio::task::AbortHandle;

use super::lender::Robot;
use super::original::Interface;
use crate::parameters;

/// The stub's name in it.
const NODE: &str = "/cloudroid_stub";

/// What a node has registered.
#[derive(Debug, Clone, Default)]
pub struct Registered {
    /// What it publishes.
    pub outputs: Vec<(String, WireType)>,
    /// What it subscribes to.
    pub inputs: Vec<(String, WireType)>,
    /// What it serves.
    pub services: Vec<(String, ServiceType)>,
}

/// A Master and a bus; both end with it.
pub struct PrivateMaster {
    uri: String,
    master: Master,
    bus: Arc<Ros1Bus>,
    serving: AbortHandle,
}

impl PrivateMaster {
    /// Makes it. Only this machine can reach it.
    pub async fn new() -> anyhow::Result<Self> {
        let loopback = SocketAddr::from((Ipv4Addr::LOCALHOST, 0));
        let listener = HostSockets
            .listen(loopback)
            .await
            .context("a private ROS Master")?;
        let address = listener.local_addr()?;
        let uri = format!("http://{address}/");
        let options = MasterOptions {
            uri: uri.clone(),
            ..MasterOptions::default()
        };
        let master = Master::new(options);
        let served = master.clone();
        let serving =
            tokio::spawn(async move { served.serve(listener, Arc::new(HostSockets)).await });
        let serving = serving.abort_handle();
        let bus = Ros1Bus::connect(Arc::new(HostSockets), address, NODE).await?;
        Ok(Self {
            uri,
            master,
            bus,
            serving,
        })
    }

    /// ROS_MASTER_URI.
    pub fn uri(&self) -> &str {
        &self.uri
    }

    /// The stub's node in it.
    pub fn bus(&self) -> &Arc<Ros1Bus> {
        &self.bus
    }

    /// What `node` calls that is served elsewhere on the robot.
    pub async fn lend(
        &self,
        node: &str,
        robot: &Arc<dyn Bus>,
        limit: Duration,
    ) -> anyhow::Result<()> {
        let lender = Arc::new(Robot::new(node, robot, limit));
        let lent = self.bus.lend(lender).await;
        lent.context("lending services to the local original")
    }

    /// Takes the robot's parameters over: all of them, because a node reads those of its neighbours, too
    /// (image_proc's are siblings).
    pub async fn copy_parameters(&self, from: &dyn Bus) -> anyhow::Result<()> {
        let all = parameters::all(from)
            .await
            .context("the robot's parameters")?;
        for (name, value) in all {
            self.bus.set(&format!("/{name}"), value).await?;
        }
        Ok(())
    }

    /// What is registered.
    pub fn graph(&self) -> Graph {
        self.master.graph()
    }

    /// Returns once a node of this name is registered.
    pub async fn registered(&self, node: &str) {
        let mut generation = self.master.generation();
        while !self.graph().nodes.contains_key(node) {
            if generation.changed().await.is_err() {
                std::future::pending::<()>().await;
            }
        }
    }

    /// Returns once `node` has registered all of this.
    pub async fn registers(&self, node: &str, all: &Interface) {
        let node = node.to_owned();
        let mut generation = self.master.generation();
        loop {
            let graph = self.graph();
            let listens = |topic: &String| {
                let ends = graph.topics.get(topic);
                ends.is_some_and(|ends| ends.subscribers.contains(&node))
            };
            let says = |topic: &String| {
                let ends = graph.topics.get(topic);
                ends.is_some_and(|ends| ends.publishers.contains(&node))
            };
            let serves = |service: &String| graph.services.get(service) == Some(&node);
            if all.inputs.keys().all(listens)
                && all.outputs.iter().all(says)
                && all.services.iter().all(serves)
            {
                return;
            }
            if generation.changed().await.is_err() {
                std::future::pending::<()>().await;
            }
        }
    }

    /// Changes with whatever is registered.
    pub fn changes(&self) -> watch::Receiver<u64> {
        self.master.generation()
    }

    /// What `node` has registered, as far as its types can be told.
    pub async fn registered_by(&self, node: &str) -> Registered {
        let graph = self.graph();
        let mut registered = Registered::default();
        for (topic, ends) in &graph.topics {
            let says = ends.publishers.iter().any(|name| name == node);
            let listens = ends.subscribers.iter().any(|name| name == node);
            if !says && !listens {
                continue;
            }
            let Ok(wire_type) = self.bus.topic_type(topic).await else {
                continue;
            };
            if says && !wire_type.digest.is_any() {
                registered.outputs.push((topic.clone(), wire_type.clone()));
            }
            if listens {
                registered.inputs.push((topic.clone(), wire_type));
            }
        }
        for service in graph.services.iter().filter(|(_, server)| *server == node) {
            if let Ok(service_type) = self.bus.service_type(service.0).await {
                registered.services.push((service.0.clone(), service_type));
            }
        }
        registered
    }

    /// A process ended: its registrations are dropped.
    pub async fn process_exited(&self) {
        self.master.process_exited().await;
    }
}

impl Drop for PrivateMaster {
    fn drop(&mut self) {
        self.serving.abort();
    }
}
