//! The private ROS system of the local original: a Master on loopback, and the stub's own node there.

use std::net::{Ipv4Addr, SocketAddr};
use std::sync::Arc;

use anyhow::Context;
use ros::bus::{Bus, Graph};
use ros::net::{HostSockets, Sockets};
use ros::ros1::Ros1Bus;
use ros::ros1::master::{Master, MasterOptions};
use tokio::task::AbortHandle;

use super::lender::Robot;
use crate::parameters;

/// The stub's name in it.
const NODE: &str = "/cloudroid_stub";

/// A Master and a bus; both end with it.
pub struct Place {
    uri: String,
    master: Master,
    bus: Arc<Ros1Bus>,
    serving: AbortHandle,
}

impl Place {
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
    pub async fn lend(&self, node: &str, robot: &Arc<dyn Bus>) -> anyhow::Result<()> {
        let lender = Arc::new(Robot::new(node, robot));
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
            self.bus.set_param(&format!("/{name}"), value).await?;
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

    /// A process ended: its registrations are dropped.
    pub async fn process_exited(&self) {
        self.master.process_exited().await;
    }
}

impl Drop for Place {
    fn drop(&mut self) {
        self.serving.abort();
    }
}
