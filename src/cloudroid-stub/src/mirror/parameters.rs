//! Parameters: the robot's are sent to the cloud at the start and when they change; those that the real node sets come
//! back.

use std::collections::BTreeMap;
use std::sync::Arc;

use link::control::FromRobot;
use ros::bus::{ParamChange, ParamValue};

use super::state::{Mirror, Parameters};
use crate::parameters;
use ros::ros1::own_parameters::is_set_by_master;

impl Parameters {
    fn should_send(&self, key: &str, value: Option<&ParamValue>) -> bool {
        let is_echo = self.set.is_echo(key, value) && value.is_some();
        !is_set_by_master(key) && !is_echo
    }
}

/// Returns all parameters and starts to forward their changes to the cloud.
pub async fn start_sync(mirror: &Arc<Mirror>) -> BTreeMap<String, ParamValue> {
    // ROS 2 nodes share no parameters; theirs are on the command line.
    if mirror.bus.parameters().is_err() {
        return BTreeMap::new();
    }
    let watching = async { mirror.bus.parameters()?.watch().await };
    match watching.await {
        Ok(mut changes) => {
            let mirror = Arc::downgrade(mirror);
            tokio::spawn(async move {
                while let Some((key, mut value)) = changes.recv().await {
                    let Some(mirror) = mirror.upgrade() else {
                        return;
                    };
                    if let Some(original) = mirror.keeper().and_then(|keeper| keeper.original()) {
                        original.change_parameter(&key, value.clone()).await;
                    }
                    if mirror.parameters.should_send(&key, value.as_ref())
                        && parameters::make_transferable(key.trim_end_matches('/'), &mut value)
                    {
                        let changes = vec![(key, value)];
                        mirror.session().send_control(&FromRobot::Parameters(changes));
                    }
                }
            });
        }
        Err(error) => tracing::warn!(
            "later parameter changes do not reach the cloud: {error}; correct the parameters named next, then restart \
                this node"
        ),
    }
    read_all(mirror).await
}

/// Returns all parameters.
pub async fn read_all(mirror: &Arc<Mirror>) -> BTreeMap<String, ParamValue> {
    match parameters::read_all(&*mirror.bus).await {
        Ok(all) => all,
        Err(error) => {
            tracing::warn!(%error, "cannot read the robot's parameters");
            BTreeMap::new()
        }
    }
}

/// Applies changes that the real node has made.
pub async fn apply_changes(mirror: &Arc<Mirror>, changes: Vec<ParamChange>) {
    let Ok(parameters) = mirror.bus.parameters() else {
        return;
    };
    for (key, value) in changes {
        let done = match value {
            Some(value) => {
                mirror.parameters.set.expect(&key, &value);
                let done = parameters.set(&key, value).await;
                if done.is_err() {
                    mirror.parameters.set.forget(&key);
                }
                done
            }
            None => parameters.delete(&key).await,
        };
        if let Err(error) = done {
            tracing::debug!(key, %error, "cannot set a parameter of the node on the robot");
        }
    }
}
