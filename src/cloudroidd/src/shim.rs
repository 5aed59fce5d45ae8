//! `cloudroidd shim`: the process of a servant, with the container's shim and, for ROS 1, its ROS Master. It outlives
//! the daemon. Runs before any thread or runtime is started, because libcontainer forks.

use std::future::Future;
use std::pin::Pin;
use std::sync::Arc;

use reach::master::{self, MasterConfig};
use ros::net::LoopbackSockets;
use ros::ros1::master::{Master, MasterOptions};
use serde::Deserialize;
use servant::shim::{Resident, ResidentContext, ResidentError};
use tokio::net::TcpListener;

/// The ROS Master in the shim, if there is one.
#[derive(Default)]
pub struct MasterResident {
    master: Option<Master>,
}

impl Resident for MasterResident {
    fn start<'a>(
        &'a mut self,
        context: &'a ResidentContext,
    ) -> Pin<Box<dyn Future<Output = Result<(), ResidentError>> + 'a>> {
        Box::pin(async move {
            let config: MasterConfig = match &context.config {
                serde_json::Value::Null => MasterConfig::default(),
                config => MasterConfig::deserialize(config)?,
            };
            if !config.master {
                return Ok(());
            }
            // The shim's thread is in the servant's network namespace.
            let listener = TcpListener::bind(master::ADDRESS).await?;
            let master = Master::new(MasterOptions { parameters: config.parameters, ..MasterOptions::default() });
            self.master = Some(master.clone());
            tokio::task::spawn_local(async move { master.serve(listener, Arc::new(LoopbackSockets)).await });
            Ok(())
        })
    }

    fn process_exited(&mut self, _pid: i32) {
        if let Some(master) = self.master.clone() {
            tokio::task::spawn_local(async move { master.on_process_exit().await });
        }
    }
}
