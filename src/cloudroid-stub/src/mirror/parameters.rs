//! Parameters: the robot's go to the cloud at the beginning and as they change; what the real node sets comes back.

use std::collections::BTreeMap;
use std::sync::Arc;

use link::Echoes;
use link::control::FromRobot;
use ros::bus::{ParamChange, ParamValue};

use super::Mirror;
use crate::parameters;
use ros::ros1::own_parameters::is_of_master;

/// What was set here in the cloud's name: it does not go back.
#[derive(Default)]
pub struct Parameters {
    set: Echoes,
}

impl Parameters {
    fn is_news(&self, key: &str, value: Option<&ParamValue>) -> bool {
        let is_echo = self.set.is_echo(key, value) && value.is_some();
        !is_of_master(key) && !is_echo
    }
}

/// All parameters now, and from now on their changes go to the cloud.
pub async fn begin(mirror: &Arc<Mirror>) -> BTreeMap<String, ParamValue> {
    // Nodes of ROS 2 share no parameters, and are told their own on the command line.
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
                    if mirror.parameters.is_news(&key, value.as_ref())
                        && parameters::can_be_carried(key.trim_end_matches('/'), &mut value)
                    {
                        let changes = vec![(key, value)];
                        mirror.session().report(&FromRobot::Parameters(changes));
                    }
                }
            });
        }
        Err(error) => tracing::warn!(
            "parameters that change later do not reach the cloud: {error}; fix those that are named next, then start this node again"
        ),
    }
    all(mirror).await
}

/// All parameters now.
pub async fn all(mirror: &Arc<Mirror>) -> BTreeMap<String, ParamValue> {
    match parameters::all(&*mirror.bus).await {
        Ok(all) => all,
        Err(error) => {
            tracing::warn!(%error, "the robot's parameters cannot be read");
            BTreeMap::new()
        }
    }
}

/// What the real node has set.
pub async fn change(mirror: &Arc<Mirror>, changes: Vec<ParamChange>) {
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
            tracing::debug!(key, %error, "a parameter of the node cannot be set on the robot");
        }
    }
}
