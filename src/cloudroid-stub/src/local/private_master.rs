//! Private system of a local original for ROS 1: a Master on loopback.

use std::net::{Ipv4Addr, SocketAddr};
use std::sync::Arc;

use anyhow::Context;
use ros::bus::{Bus, GlobalParameters, Graph};
use ros::net::{HostSockets, Sockets};
use ros::ros1::Ros1Bus;
use ros::ros1::master::{Master, MasterOptions};
use tokio::sync::watch;
use tokio::task::AbortHandle;

use super::private_system::{NODE, Variables};
use crate::parameters;

/// A Master, which ends when this is dropped.
pub struct PrivateMaster {
    uri: String,
    master: Master,
    bus: Arc<Ros1Bus>,
    serving: AbortHandle,
}

impl PrivateMaster {
    /// Starts the Master and joins it as a node. Only this machine can reach it.
    pub async fn new() -> anyhow::Result<(Self, Arc<dyn Bus>)> {
        let loopback = SocketAddr::from((Ipv4Addr::LOCALHOST, 0));
        let listener = HostSockets.listen(loopback).await.context("a private ROS Master")?;
        let address = listener.local_addr()?;
        let uri = format!("http://{address}/");
        let options = MasterOptions { uri: uri.clone(), ..MasterOptions::default() };
        let master = Master::new(options);
        let served = master.clone();
        let serving = tokio::spawn(async move { served.serve(listener, Arc::new(HostSockets)).await });
        let serving = serving.abort_handle();
        let bus = Ros1Bus::connect(Arc::new(HostSockets), address, NODE).await?;
        let made = Self { uri, master, bus: bus.clone(), serving };
        Ok((made, bus as Arc<dyn Bus>))
    }

    /// Returns the variables that put the nodes of a process into this system.
    pub fn environment(&self) -> Variables {
        vec![("ROS_MASTER_URI", Some((&self.uri).into())), ("ROS_HOSTNAME", Some("localhost".into())), ("ROS_IP", None)]
    }

    /// Copies the robot's parameters: all of them, because a node may read those of its neighbours (image_proc reads
    /// those of siblings).
    pub async fn copy_parameters(&self, from: &dyn Bus) -> anyhow::Result<()> {
        let all = parameters::read_all(from).await.context("the robot's parameters")?;
        for (name, value) in all {
            self.bus.set(&format!("/{name}"), value).await?;
        }
        Ok(())
    }

    /// Returns the current registrations.
    pub fn graph(&self) -> Graph {
        self.master.graph()
    }

    /// Returns a receiver of changes of the registrations.
    pub fn generation(&self) -> watch::Receiver<u64> {
        self.master.generation()
    }

    /// Drops the registrations of a process that has ended.
    pub async fn process_exited(&self) {
        self.master.on_process_exit().await;
    }
}

impl Drop for PrivateMaster {
    fn drop(&mut self) {
        self.serving.abort();
    }
}
