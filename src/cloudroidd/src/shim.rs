//! `cloudroidd shim`: the process that a servant belongs to, composed of the container's shim and the servant's
//! ROS Master. It outlives the daemon. Runs before any thread or runtime is started, because libcontainer forks.

use std::collections::BTreeMap;
use std::future::Future;
use std::pin::Pin;
use std::sync::Arc;

use ros::bus::ParamValue;
use ros::net::LoopbackSockets;
use ros::ros1::master::{Master, MasterOptions};
use serde::{Deserialize, Serialize};
use servant::shim::{Resident, ResidentContext, ResidentError};
use tokio::net::TcpListener;

/// What the daemon hands to the Master through the servant's spec.
#[derive(Debug, Default, Serialize, Deserialize)]
struct ResidentConfig {
    /// Parameters set before the first node starts.
    #[serde(default)]
    parameters: BTreeMap<String, ParamValue>,
}

/// [`servant::spec::Spec::resident`] for a Master with these parameters.
pub fn resident_config(parameters: &BTreeMap<String, ParamValue>) -> serde_json::Value {
    serde_json::json!({ "parameters": parameters })
}

/// The ROS Master in the shim.
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
            let config: ResidentConfig = match &context.config {
                serde_json::Value::Null => ResidentConfig::default(),
                config => ResidentConfig::deserialize(config)?,
            };
            // The shim's thread is in the servant's network namespace.
            let listener = TcpListener::bind(crate::works::MASTER).await?;
            let master = Master::new(MasterOptions {
                parameters: config.parameters,
                ..MasterOptions::default()
            });
            self.master = Some(master.clone());
            tokio::task::spawn_local(async move {
                master.serve(listener, Arc::new(LoopbackSockets)).await
            });
            Ok(())
        })
    }

    fn process_exited(&mut self, _pid: i32) {
        if let Some(master) = self.master.clone() {
            tokio::task::spawn_local(async move { master.process_exited().await });
        }
    }
}
