//! Parameters: the robot's are copied into the servant when a link begins, and changes cross both ways.

use std::collections::BTreeMap;
use std::sync::Arc;

use budget::Permit;
use parking_lot::Mutex;
use ros::bus::{BusError, ParamValue};
use ros::ros1::own_parameters::is_of_master;
use tokio::sync::OnceCell;
use tokio::task::AbortHandle;

use super::Hub;
use super::node_time::SIMULATED;
use super::runs::RUNS;
use link::Echoes;
use link::control::{FromCloud, Hello, Node};

/// What a change takes that no robot was told of, besides its key and its value, in bytes.
const UNTOLD: usize = 256;

/// Whether the Master's side has it of itself, or keeps runs of nodes there.
fn is_own(name: &str) -> bool {
    is_of_master(name) || name == RUNS.trim_start_matches('/')
}

/// What was set here in the robot's name: it does not go back.
#[derive(Default)]
pub(super) struct Known {
    set: Echoes,
    /// Set by a node before there was a link to tell it.
    untold: Mutex<BTreeMap<String, Untold>>,
    watching: OnceCell<AbortHandle>,
}

/// A change that no robot was told of. It counts as the servant's.
struct Untold {
    value: Option<ParamValue>,
    _held: Permit,
}

impl Drop for Known {
    fn drop(&mut self) {
        if let Some(watching) = self.watching.get() {
            watching.abort();
        }
    }
}

impl Known {
    /// Takes over all of the robot's parameters, those that the deployer gave last.
    pub(super) async fn take(&self, hub: &Hub, hello: &Hello) {
        let Ok(parameters) = hub.bus.parameters() else {
            return;
        };
        let there = match hub.bus.parameter("/").await {
            Ok(ParamValue::Map(there)) => there,
            _ => BTreeMap::new(),
        };
        for (name, value) in &hello.parameters {
            let value = translated(hub, &hello.node, value);
            if !is_own(name) && there.get(name) != Some(&value) {
                self.set(hub, format!("/{name}"), value).await;
            }
        }
        for (key, value) in hub.nodes.parameters(&hello.node) {
            // The robot shall see what its node really has.
            let _ = parameters.set(&key, value).await;
        }
    }

    /// Parameters that changed on the robot.
    pub(super) async fn change(&self, hub: &Hub, changes: Vec<(String, Option<ParamValue>)>) {
        for (key, value) in changes {
            if key.trim_start_matches('/') == SIMULATED {
                hub.simulate(value == Some(ParamValue::Bool(true)));
            }
            match value {
                Some(value) => self.set(hub, key, value).await,
                None => {
                    self.set.forget(&key);
                    if let Ok(parameters) = hub.bus.parameters() {
                        let _ = parameters.delete(&key).await;
                    }
                }
            }
        }
    }

    async fn set(&self, hub: &Hub, key: String, value: ParamValue) {
        // Where there are none, what is given in vain was told when the link began.
        let Ok(parameters) = hub.bus.parameters() else {
            return;
        };
        self.set.expect(&key, &value);
        if let Err(error) = parameters.set(&key, value).await {
            self.set.forget(&key);
            tracing::warn!(key, %error, "a parameter of the robot cannot be set");
        }
    }

    /// Tells robots what nodes set, from now on.
    pub(super) async fn watch(&self, hub: &Arc<Hub>) {
        let begun = self.watching.get_or_try_init(|| async {
            let mut changes = hub.bus.parameters()?.watch().await?;
            let weak = Arc::downgrade(hub);
            let task = tokio::spawn(async move {
                while let Some((key, value)) = changes.recv().await {
                    let Some(hub) = weak.upgrade() else { return };
                    hub.parameters.report(&hub, key, value);
                }
            });
            Ok::<_, BusError>(task.abort_handle())
        });
        match begun.await {
            Ok(_) | Err(BusError::NotOffered(_) | BusError::NotShared(_)) => {}
            Err(error) => {
                tracing::warn!(%error, "parameters that nodes set do not reach the robot");
            }
        }
    }

    /// Tells the link whose node the parameter belongs to, or any: they are on one robot.
    pub(super) fn report(&self, hub: &Hub, key: String, value: Option<ParamValue>) {
        if key.starts_with(RUNS) || self.set.is_echo(&key, value.as_ref()) {
            return;
        }
        let links = hub.links.lock();
        let owner = links.values().find(|link| key.starts_with(&link.node));
        match owner.or_else(|| links.values().next()) {
            Some(link) => link
                .session
                .report(&FromCloud::Parameters(vec![(key, value)])),
            None => self.keep(hub, key, value),
        }
    }

    /// Keeps a change for when there is a link, where there is memory for it.
    fn keep(&self, hub: &Hub, key: String, value: Option<ParamValue>) {
        let mut untold = self.untold.lock();
        // It is of no use any more, whatever becomes of this one.
        untold.remove(&key);
        let bytes = UNTOLD + key.len() + value.as_ref().map_or(0, ParamValue::bytes_held);
        match hub.options.budget.take(bytes) {
            Ok(_held) => drop(untold.insert(key, Untold { value, _held })),
            Err(error) => tracing::warn!(
                servant = hub.servant,
                "the parameter {key} was set before a robot's node was linked, and will not reach the robot: {error}"
            ),
        }
    }

    /// What a node has set before there was a link to tell.
    pub(super) fn untold(&self) -> Vec<(String, Option<ParamValue>)> {
        let untold = std::mem::take(&mut *self.untold.lock());
        let changes = untold.into_iter();
        changes.map(|(key, untold)| (key, untold.value)).collect()
    }
}

/// A value with the robot's paths replaced by the servant's.
fn translated(hub: &Hub, node: &Node, value: &ParamValue) -> ParamValue {
    match value {
        ParamValue::String(text) => ParamValue::String(hub.nodes.translate(node, text)),
        ParamValue::List(items) => ParamValue::List(
            items
                .iter()
                .map(|item| translated(hub, node, item))
                .collect(),
        ),
        ParamValue::Map(members) => ParamValue::Map(
            members
                .iter()
                .map(|(name, member)| (name.clone(), translated(hub, node, member)))
                .collect(),
        ),
        other => other.clone(),
    }
}
