//! The parameters of a servant of ROS 2 as a robot of ROS 1 sees them: one tree, as at a Master.
//!
//! ```text
//!  /camera/see/gains/p   of the node /camera/see, which runs: its parameter gains.p
//!  /camera/see/gains/p   of the node /camera/see, which does not run: kept, and given to it when it starts
//!  /use_sim_time         kept, and set at every node
//!  /map_frame            of no node: kept, for the robot's own nodes
//! ```
//! A node that runs has the last word on its parameters: what it refuses is not kept, and the reason goes to who has
//! set it. Nodes declare their parameters, so one that a dictionary does not mention stays, where a Master would delete
//! it.

mod changes;
#[cfg(test)]
mod tests;

use std::collections::BTreeMap;
use std::sync::Arc;

use async_trait::async_trait;
use budget::Budget;
use futures_util::{StreamExt, stream};
use parking_lot::Mutex;
use ros::bus::parameter_names::spell_in_ros2;
use ros::bus::{
    Bus, BusError, FailureReason, GlobalParameters, ParamChange, ParamChangeReceiver, ParamValue, param_change_channel,
};
use ros::ros1::names::canonical;

use super::kept::KeptParameters;
use super::names::{ParameterNodes, SIM_TIME, SIM_TIME_KEY, join, shown_key, strip_parent, to_key};
use super::refusals::RefusedParameters;
use super::values::{NodeValues, ParameterRefusal, Tree, check_for_ros1, is_too_deep, put_at, value_at};
use changes::Watcher;

/// Number of nodes queried for their parameters concurrently.
const ASKED_AT_ONCE: usize = 8;
/// Maximum number of parameters read of one node.
const MAX_PARAMETERS: usize = 10_000;
/// Maximum size of all parameters read at once, in bytes.
const MAX_BYTES: usize = 64 << 20;

/// A Master's parameters, over the nodes of a ROS 2 bus.
pub struct ParameterServerView {
    inner: Arc<dyn Bus>,
    budget: Budget,
    kept: Arc<KeptParameters>,
    watcher: Arc<Mutex<Option<Watcher>>>,
}

/// Effects of a change of one key.
#[derive(Default)]
struct PlannedChanges {
    /// Parameters of running nodes.
    nodes: BTreeMap<String, NodeValues>,
    /// Values of no running node.
    kept: Vec<(String, ParamValue)>,
    refused: RefusedParameters,
}

impl PlannedChanges {
    /// Adds the values of a key, by where they belong.
    fn add(&mut self, nodes: &ParameterNodes, key: String, value: ParamValue) {
        if is_too_deep(&key) {
            return self.refused.add(&key, &ParameterRefusal::TooDeep);
        }
        let owner = nodes.owner(&key);
        if let Some((node, rest)) = owner.filter(|(_, rest)| !rest.is_empty()) {
            return self.nodes.entry(node.to_owned()).or_default().add(spell_in_ros2(rest), value);
        }
        let is_node = owner.is_some();
        match value {
            // A node, or a namespace with nodes.
            ParamValue::Map(entries) if is_node || !nodes.at_or_below(&key).is_empty() => {
                for (entry, value) in entries {
                    let below = canonical(&join(&key, &entry));
                    if below != key {
                        self.add(nodes, below, value);
                    }
                }
            }
            ParamValue::Nil => self.refused.add(&key, &ParameterRefusal::Nil),
            _ if is_node => self.refused.add(&key, &"it is the name of a node, which has parameters below it"),
            value => self.kept.push((key, value)),
        }
    }
}

impl ParameterServerView {
    /// Creates the view. What is kept, and what waits for a watcher, is charged to `budget`.
    pub fn new(inner: Arc<dyn Bus>, budget: Budget) -> Self {
        Self { inner, kept: Arc::new(KeptParameters::new(budget.clone())), budget, watcher: Arc::default() }
    }

    /// Returns the parameters that a node is to be started with: those below its name, as a tree, and whether time is
    /// simulated if that is known for all nodes.
    pub(super) fn launch_parameters(&self, node: &str) -> (Tree, Option<bool>) {
        let private = match self.kept.get(&canonical(node)) {
            Some(ParamValue::Map(private)) => private,
            _ => Tree::new(),
        };
        let simulated = match self.kept.get(SIM_TIME_KEY) {
            Some(ParamValue::Bool(simulated)) => Some(simulated),
            _ => None,
        };
        (private, simulated)
    }

    /// Returns the bus of the servant.
    pub(super) fn bus(&self) -> &Arc<dyn Bus> {
        &self.inner
    }

    fn nodes(&self) -> ParameterNodes {
        ParameterNodes::of_bus(&*self.inner)
    }

    /// Reads parameters of a node: that of a name and those below it, or all.
    async fn read_node(&self, node: &str, name: &str) -> Result<Tree, BusError> {
        let parameters = self.inner.node_parameters()?;
        let prefixes: Vec<String> = (!name.is_empty()).then(|| name.to_owned()).into_iter().collect();
        let mut names = parameters.list(node, &prefixes, 0).await?.names;
        // Not every node heeds prefixes, nor returns the parameter itself.
        if !name.is_empty() {
            names.retain(|other| other.strip_prefix(name).is_some_and(|rest| rest.starts_with('.')));
            names.push(name.to_owned());
        }
        names.truncate(MAX_PARAMETERS);
        let values = parameters.get(node, &names).await?;
        let mut tree = Tree::new();
        for (name, value) in names.iter().zip(values) {
            let (Some(value), Some(key)) = (value, to_key("", name)) else { continue };
            match check_for_ros1(&value) {
                Ok(()) => put_at(&mut tree, &key[1..], value),
                Err(reason) => tracing::debug!(node, name, %reason, "a parameter is not shown to ROS 1"),
            }
        }
        Ok(tree)
    }

    /// Reads the value of a key: that of running nodes and, where they have none, what is kept.
    async fn read(&self, key: &str) -> Result<Option<ParamValue>, BusError> {
        let nodes = self.nodes();
        let kept = self.kept.get(key);
        if let Some((node, rest)) = nodes.owner(key).filter(|(_, rest)| !rest.is_empty()) {
            let tree = self.read_node(node, &spell_in_ros2(rest)).await?;
            return Ok(match (kept, value_at(&tree, rest)) {
                (Some(ParamValue::Map(mut kept)), Some(ParamValue::Map(live))) => {
                    live.iter().for_each(|(entry, value)| put_at(&mut kept, entry, value.clone()));
                    Some(ParamValue::Map(kept))
                }
                (_, Some(live)) => Some(live.clone()),
                (kept, None) => kept,
            });
        }
        let mut tree = match kept {
            Some(ParamValue::Map(kept)) => kept,
            Some(value) => return Ok(Some(value)),
            None => Tree::new(),
        };
        let reads = nodes.at_or_below(key).into_iter().map(|node| async move {
            let read = self.read_node(&node, "").await;
            (node, read)
        });
        let mut reads = stream::iter(reads).buffered(ASKED_AT_ONCE);
        let mut bytes = 0;
        while let Some((node, read)) = reads.next().await {
            match read {
                Ok(values) => {
                    let values = ParamValue::Map(values);
                    bytes += values.bytes_held();
                    if bytes > MAX_BYTES {
                        let reason = format!("all parameters together take more than {MAX_BYTES} bytes");
                        return Err(BusError::Protocol { what: format!("parameters below {key}"), reason });
                    }
                    match (strip_parent(&node, key), values) {
                        (Some(path), values) => put_at(&mut tree, path, values),
                        (None, ParamValue::Map(values)) => {
                            values.into_iter().for_each(|(entry, value)| put_at(&mut tree, &entry, value));
                        }
                        _ => {}
                    }
                }
                // A node that has just ended, or does not answer, hides no others.
                Err(error) => tracing::debug!(node, %error, "a node does not tell its parameters"),
            }
        }
        let is_there = !tree.is_empty() || key == "/" || nodes.has(key);
        Ok(is_there.then_some(ParamValue::Map(tree)))
    }

    /// Sets parameters of a running node.
    pub(super) async fn set_at_node(&self, node: &str, values: NodeValues, refused: &mut RefusedParameters) {
        for (name, refusal) in &values.refused {
            refused.add(&shown_key(node, name), refusal);
        }
        if values.values.is_empty() {
            return;
        }
        let changes = values.values.iter().map(|(name, value)| (name.clone(), Some(value.clone()))).collect();
        let answers = match self.change_node(node, changes).await {
            Ok(answers) => answers,
            // It has just ended, or does not answer: then it is started with them.
            Err(error) => {
                tracing::warn!(node, %error, "parameters of the robot are kept until the node is started again");
                values.values.iter().map(|_| Ok(())).collect()
            }
        };
        for ((name, value), answer) in values.values.into_iter().zip(answers) {
            match (answer, to_key(node, &name)) {
                (Err(reason), _) => refused.add(&shown_key(node, &name), &reason),
                // Kept for when it is started again.
                (Ok(()), Some(key)) => {
                    if let Err(error) = self.kept.set(&key, value) {
                        tracing::warn!(key, %error, "a parameter will be forgotten when its node is started again");
                    }
                }
                (Ok(()), None) => {}
            }
        }
    }

    async fn change_node(
        &self,
        node: &str,
        changes: Vec<ParamChange>,
    ) -> Result<Vec<Result<(), FailureReason>>, BusError> {
        self.inner.node_parameters()?.set(node, changes).await
    }

    /// Sets simulated time at every node. One that refuses does not keep the others from it.
    async fn set_sim_time(&self, value: ParamValue) -> Result<(), BusError> {
        let ParamValue::Bool(_) = value else {
            let reason = "it is true or false".to_owned();
            return Err(BusError::BadParam { key: SIM_TIME_KEY.to_owned(), reason });
        };
        self.keep(SIM_TIME_KEY, value.clone())?;
        let value = &value;
        let sets = self.nodes().at_or_below("/").into_iter().map(|node| async move {
            let set = self.change_node(&node, vec![(SIM_TIME.to_owned(), Some(value.clone()))]).await;
            let reason = match set.map(|answers| answers.into_iter().find_map(Result::err)) {
                Ok(None) => return,
                Ok(Some(reason)) => reason.into_string(),
                Err(error) => error.to_string(),
            };
            tracing::warn!(node, reason, "a node does not take its time from the robot");
        });
        stream::iter(sets).buffer_unordered(ASKED_AT_ONCE).collect::<()>().await;
        Ok(())
    }

    /// Keeps a value of no node, and tells the watcher.
    fn keep(&self, key: &str, value: ParamValue) -> Result<(), BusError> {
        self.kept
            .set(key, value.clone())
            .map_err(|full| BusError::BadParam { key: key.to_owned(), reason: full.to_string() })?;
        self.tell(key, Some(value));
        Ok(())
    }

    fn tell(&self, key: &str, value: Option<ParamValue>) {
        if let Some(watcher) = &*self.watcher.lock() {
            watcher.tell(key.to_owned(), value);
        }
    }
}

#[async_trait]
impl GlobalParameters for ParameterServerView {
    async fn get(&self, key: &str) -> Result<ParamValue, BusError> {
        let key = canonical(key);
        self.read(&key).await?.ok_or(BusError::NoParam(key))
    }

    async fn set(&self, key: &str, value: ParamValue) -> Result<(), BusError> {
        let key = canonical(key);
        if key == SIM_TIME_KEY {
            return self.set_sim_time(value).await;
        }
        let mut planned = PlannedChanges::default();
        planned.add(&self.nodes(), key.clone(), value);
        let PlannedChanges { nodes, kept, mut refused } = planned;
        for (key, value) in kept {
            if let Err(error) = self.keep(&key, value) {
                refused.add(&key, &error);
            }
        }
        for (node, values) in nodes {
            self.set_at_node(&node, values, &mut refused).await;
        }
        refused.into_result(&key)
    }

    async fn delete(&self, key: &str) -> Result<(), BusError> {
        let key = canonical(key);
        if is_too_deep(&key) {
            return Err(BusError::NoParam(key));
        }
        let nodes = self.nodes();
        let was_kept = self.kept.remove(&key);
        let Some((node, rest)) = nodes.owner(&key).filter(|(_, rest)| !rest.is_empty()) else {
            if was_kept {
                self.tell(&key, None);
                return Ok(());
            }
            return Err(match nodes.at_or_below(&key).first() {
                Some(node) => BusError::BadParam {
                    reason: format!("the parameters of {node} are declared by it, and stay while it runs"),
                    key,
                },
                None => BusError::NoParam(key),
            });
        };
        let name = spell_in_ros2(rest);
        let tree = self.read_node(node, &name).await?;
        let mut values = NodeValues::default();
        match value_at(&tree, rest) {
            Some(value) => values.add(name, value.clone()),
            None if was_kept => return Ok(()),
            None => return Err(BusError::NoParam(key)),
        }
        let changes: Vec<ParamChange> = values.values.into_iter().map(|(name, _)| (name, None)).collect();
        let names: Vec<String> = changes.iter().map(|(name, _)| name.clone()).collect();
        let mut refused = RefusedParameters::default();
        for (name, answer) in names.iter().zip(self.change_node(node, changes).await?) {
            if let Err(reason) = answer {
                refused.add(&shown_key(node, name), &reason);
            }
        }
        refused.into_result(&key)
    }

    async fn has(&self, key: &str) -> Result<bool, BusError> {
        let there = self.read(&canonical(key)).await?;
        Ok(there.is_some())
    }

    async fn search(&self, namespace: &str, key: &str) -> Result<Option<String>, BusError> {
        if key.starts_with('/') {
            let key = canonical(key);
            return Ok(self.has(&key).await?.then_some(key));
        }
        let rest = canonical(key);
        let Some(first) = rest[1..].split('/').next().filter(|first| !first.is_empty()) else {
            return Ok(None);
        };
        // As a Master: the namespace in which the first part of the name exists decides.
        let mut namespace = canonical(namespace);
        loop {
            if self.has(&join(&namespace, first)).await? {
                return Ok(Some(join(&namespace, &rest[1..])));
            }
            if namespace == "/" {
                return Ok(None);
            }
            namespace = canonical(namespace.rsplit_once('/').map_or("/", |(above, _)| above));
        }
    }

    async fn names(&self) -> Result<Vec<String>, BusError> {
        let all = self.read("/").await?.unwrap_or(ParamValue::Map(Tree::new()));
        let mut names = Vec::new();
        collect_names("", &all, &mut names);
        Ok(names)
    }

    async fn watch(&self) -> Result<ParamChangeReceiver, BusError> {
        let (teller, changes) = param_change_channel(&self.budget);
        let events = self.inner.node_parameters()?.watch(None).await?;
        Watcher::start(&self.watcher, teller, events, Arc::clone(&self.kept));
        Ok(changes)
    }
}

/// Collects the keys of all values that are not dictionaries.
fn collect_names(key: &str, value: &ParamValue, into: &mut Vec<String>) {
    match value {
        ParamValue::Map(entries) => {
            entries.iter().for_each(|(entry, value)| collect_names(&format!("{key}/{entry}"), value, into));
        }
        _ => into.push(key.to_owned()),
    }
}
