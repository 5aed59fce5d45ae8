//! Parameters: the robot's are copied to the servant when a link starts, and changes are synchronized in both
//! directions.

use std::collections::BTreeMap;
use std::sync::Arc;

use link::Echoes;
use parking_lot::Mutex;
use ros::bus::{Bus, BusError, ParamValue};
use ros::ros1::own_parameters::is_set_by_master;
use tokio::sync::OnceCell;
use tracing::Instrument;

use super::node_time::SIM_TIME;
use super::runs::RUNS;
use super::state::{Hub, ParameterMirror, PendingChange};
use link::control::{FromCloud, Hello, NodeLaunch};

/// Memory overhead of a pending change in bytes.
const UNTOLD: usize = 256;

/// Returns whether the parameter is set by the Master itself or stores the runs of nodes.
fn is_internal(name: &str) -> bool {
    is_set_by_master(name) || name == RUNS.trim_start_matches('/')
}

impl Drop for ParameterMirror {
    fn drop(&mut self) {
        if let Some(watching) = self.watching.get() {
            watching.abort();
        }
    }
}

impl ParameterMirror {
    pub(super) fn new(bus: Arc<dyn Bus>) -> Self {
        Self { bus, set: Echoes::default(), untold: Mutex::default(), watching: OnceCell::new() }
    }

    /// Copies all parameters of the robot, then those given by the deployer.
    pub(super) async fn copy_from_hello(&self, hub: &Hub, hello: &Hello) {
        if self.bus.parameters().is_ok() {
            let there = match self.bus.parameter("/").await {
                Ok(ParamValue::Map(there)) => there,
                _ => BTreeMap::new(),
            };
            for (name, value) in &hello.parameters {
                let value = translate_value(hub, &hello.node, value);
                if !is_internal(name) && there.get(name) != Some(&value) {
                    self.set_parameter(format!("/{name}"), value).await;
                }
            }
        }
        // They are the servant's, whatever the robot's ROS.
        let Ok(parameters) = hub.bus.parameters() else {
            return;
        };
        for (key, value) in hub.nodes.parameters(&hello.node) {
            // Reported to the robot, so that it sees the values that its node really has.
            let _ = parameters.set(&key, value).await;
        }
    }

    /// Applies changes made on the robot.
    pub(super) async fn apply_changes(&self, hub: &Hub, changes: Vec<(String, Option<ParamValue>)>) {
        for (key, value) in changes {
            if key.trim_start_matches('/') == SIM_TIME {
                hub.set_simulated(value == Some(ParamValue::Bool(true)));
            }
            match value {
                Some(value) => self.set_parameter(key, value).await,
                None => {
                    self.set.forget(&key);
                    if let Ok(parameters) = self.bus.parameters() {
                        let _ = parameters.delete(&key).await;
                    }
                }
            }
        }
    }

    async fn set_parameter(&self, key: String, value: ParamValue) {
        // Without global parameters, ignored settings were reported when the link started.
        let Ok(parameters) = self.bus.parameters() else {
            return;
        };
        self.set.expect(&key, &value);
        if let Err(error) = parameters.set(&key, value).await {
            self.set.forget(&key);
            tracing::warn!(key, %error, "a parameter of the robot cannot be set");
        }
    }

    /// Starts reporting parameters set by nodes to robots.
    pub(super) async fn watch(self: &Arc<Self>, hub: &Arc<Hub>) {
        let begun = self.watching.get_or_try_init(|| async {
            let mut changes = self.bus.parameters()?.watch().await?;
            let weak = (Arc::downgrade(self), Arc::downgrade(hub));
            let reporting = async move {
                while let Some((key, value)) = changes.recv().await {
                    let Some((mirror, hub)) = weak.0.upgrade().zip(weak.1.upgrade()) else { return };
                    mirror.report_change(&hub, key, value);
                }
            };
            let task = tokio::spawn(reporting.instrument(hub.log_span.clone()));
            Ok::<_, BusError>(task.abort_handle())
        });
        match begun.await {
            Ok(_) | Err(BusError::NotOffered(_) | BusError::NotShared(_)) => {}
            Err(error) => {
                tracing::warn!(%error, "parameters that nodes set do not reach the robot");
            }
        }
    }

    /// Reports a change to the link that owns the parameter, or to any, since all belong to one robot.
    pub(super) fn report_change(&self, hub: &Hub, key: String, value: Option<ParamValue>) {
        if key.starts_with(RUNS) || self.set.is_echo(&key, value.as_ref()) {
            return;
        }
        let links = hub.links.lock();
        let mut links = links.values().filter(|link| std::ptr::eq(&*link.view.parameters, self));
        let owner = links.clone().find(|link| key.starts_with(&link.node));
        match owner.or_else(|| links.next()) {
            Some(link) => link.session.send_control(&FromCloud::Parameters(vec![(key, value)])),
            None => self.keep_change(hub, key, value),
        }
    }

    /// Keeps a change until there is a link, if there is memory for it.
    fn keep_change(&self, hub: &Hub, key: String, value: Option<ParamValue>) {
        let mut untold = self.untold.lock();
        // The earlier value is obsolete in any case.
        untold.remove(&key);
        let bytes = UNTOLD + key.len() + value.as_ref().map_or(0, ParamValue::bytes_held);
        match hub.options.budget.take(bytes) {
            Ok(_held) => drop(untold.insert(key, PendingChange { value, _held })),
            Err(error) => tracing::warn!(
                servant = hub.servant,
                "the parameter {key} was set before a robot's node was linked, and will not reach the robot: {error}"
            ),
        }
    }

    /// Returns and clears the changes by nodes before there was a link.
    pub(super) fn take_pending(&self) -> Vec<(String, Option<ParamValue>)> {
        let untold = std::mem::take(&mut *self.untold.lock());
        let changes = untold.into_iter();
        changes.map(|(key, untold)| (key, untold.value)).collect()
    }
}

/// Replaces the robot's paths in a value with the servant's.
pub(super) fn translate_value(hub: &Hub, node: &NodeLaunch, value: &ParamValue) -> ParamValue {
    match value {
        ParamValue::String(text) => ParamValue::String(hub.nodes.translate(node, text)),
        ParamValue::List(items) => {
            ParamValue::List(items.iter().map(|item| translate_value(hub, node, item)).collect())
        }
        ParamValue::Map(members) => ParamValue::Map(
            members.iter().map(|(name, member)| (name.clone(), translate_value(hub, node, member))).collect(),
        ),
        other => other.clone(),
    }
}
