//! The parameters of a servant of ROS 1 as a robot of ROS 2 sees them: those of each node, with descriptions.
//!
//! ```text
//!  gains.p of /camera/see         /camera/see/gains/p at the Master
//!  filter.gain of /camera/see     gain of the dynamic_reconfigure server at /camera/see/filter, described by it
//!  use_sim_time of any node       /use_sim_time at the Master
//! ```
//! A Master takes whatever is set; whether the node reads it again is not known. Parameters of dynamic_reconfigure are
//! set at their server, which applies them, and have its types and ranges.

mod events;
mod known_values;
#[cfg(test)]
mod tests;

use std::collections::{BTreeMap, BTreeSet};
use std::sync::Arc;

use async_trait::async_trait;
use ros::bus::parameter_names::{spell_in_ros1, spell_in_ros2};
use ros::bus::{
    Bus, BusError, FailureReason, NodeParameters, ParamChange, ParamValue, ParameterDescription, ParameterEvents,
    ParameterKind, ParameterNames,
};
use tokio::sync::Mutex;

use super::names::{SIM_TIME, SIM_TIME_KEY, shown_key, to_key};
use super::reconfigure::{Config, ReconfigureRefusal, ReconfigureServer};
use super::values::{ParameterRefusal, Tree, check_for_ros1, value_at};
use events::MasterWatch;
use known_values::KnownValues;

/// Maximum size of the values or descriptions of one answer, in bytes: a request may name a parameter a million times.
const MAX_ANSWER: usize = 64 << 20;
/// Bytes counted for each parameter of an answer beside its texts.
const PARAMETER_OVERHEAD: usize = 64;

/// The parameters of nodes, over the Master of a ROS 1 bus.
pub struct NodeParameterView {
    inner: Arc<dyn Bus>,
    /// The watch of the Master that all receivers of events share.
    watch: Mutex<Option<MasterWatch>>,
}

/// Reasons why a parameter of a node is not set.
#[derive(Debug, Clone, PartialEq, thiserror::Error)]
enum SetRefusal {
    #[error(transparent)]
    Value(#[from] ParameterRefusal),
    #[error(transparent)]
    Reconfigure(#[from] ReconfigureRefusal),
    #[error("nodes of ROS 1 read use_sim_time only when they start; start the node with it")]
    SimTime,
    #[error("it is not set")]
    NotSet,
}

/// A checked change.
enum PlannedChange {
    /// Parameter of the server with this index, by the server's name for it.
    Reconfigure(usize, String, ParamValue),
    /// At the Master.
    Set(String, ParamValue),
    Delete(String),
    /// It has this value.
    Nothing,
}

/// The parameters of a node, as far as changes depend on them.
struct NodeState {
    tree: Tree,
    servers: Vec<ReconfigureServer>,
    simulated: bool,
}

impl NodeParameterView {
    /// Creates the view.
    pub fn new(inner: Arc<dyn Bus>) -> Self {
        Self { inner, watch: Mutex::default() }
    }

    /// Returns the bus of the servant.
    pub(super) fn bus(&self) -> &Arc<dyn Bus> {
        &self.inner
    }

    /// Returns the error for a node that does not exist, as a bus of ROS 2 has it.
    fn check_node(&self, node: &str) -> Result<(), BusError> {
        if self.inner.graph().borrow().has_node(node) {
            return Ok(());
        }
        Err(BusError::NoService(format!("{node}/get_parameters")))
    }

    /// Reads the parameters below the node's name.
    async fn read_tree(&self, node: &str) -> Result<Tree, BusError> {
        self.check_node(node)?;
        match self.inner.parameters()?.get(node).await {
            Ok(ParamValue::Map(tree)) => Ok(tree),
            Ok(_) | Err(BusError::NoParam(_)) => Ok(Tree::new()),
            Err(error) => Err(error),
        }
    }

    async fn read_sim_time(&self) -> Result<bool, BusError> {
        match self.inner.parameters()?.get(SIM_TIME_KEY).await {
            Ok(value) => Ok(value == ParamValue::Bool(true)),
            Err(BusError::NoParam(_)) => Ok(false),
            Err(error) => Err(error),
        }
    }

    async fn read_state(&self, node: &str) -> Result<NodeState, BusError> {
        Ok(NodeState {
            tree: self.read_tree(node).await?,
            servers: ReconfigureServer::find_all(&*self.inner, node).await,
            simulated: self.read_sim_time().await?,
        })
    }

    /// Makes checked changes; returns for each whether it was made. Those of one dynamic_reconfigure server are made at
    /// once.
    async fn make(
        &self,
        state: &NodeState,
        planned: Vec<Result<PlannedChange, SetRefusal>>,
    ) -> Result<Vec<Result<(), FailureReason>>, BusError> {
        let mut results: Vec<Result<(), FailureReason>> = Vec::with_capacity(planned.len());
        let mut configs: BTreeMap<usize, (Config, Vec<(usize, String)>)> = BTreeMap::new();
        let master = self.inner.parameters()?;
        for (at, change) in planned.into_iter().enumerate() {
            let made = match change {
                Err(refusal) => Err(FailureReason::new(refusal.to_string())),
                Ok(PlannedChange::Nothing) => Ok(()),
                Ok(PlannedChange::Set(key, value)) => to_failure(master.set(&key, value).await)?,
                Ok(PlannedChange::Delete(key)) => to_failure(master.delete(&key).await)?,
                Ok(PlannedChange::Reconfigure(server, name, value)) => {
                    let (config, places) = configs.entry(server).or_default();
                    config.values.insert(name.clone(), value);
                    places.push((at, name));
                    Ok(())
                }
            };
            results.push(made);
        }
        for (server, (config, places)) in configs {
            let chosen = to_failure(state.servers[server].change(&*self.inner, &config).await)?;
            for (at, name) in places {
                results[at] = match &chosen {
                    Err(reason) => Err(reason.clone()),
                    Ok(chosen) => check_chosen(config.values.get(&name), chosen.values.get(&name)),
                };
            }
        }
        Ok(results)
    }
}

/// Separates what one parameter is refused for from what ends the whole request.
fn to_failure<T>(done: Result<T, BusError>) -> Result<Result<T, FailureReason>, BusError> {
    match done {
        Ok(done) => Ok(Ok(done)),
        Err(error @ (BusError::BadParam { .. } | BusError::NoParam(_) | BusError::Master { .. })) => {
            Ok(Err(FailureReason::new(error.to_string())))
        }
        Err(BusError::CallFailed { reason, .. }) => Ok(Err(FailureReason::new(reason))),
        Err(error) => Err(error),
    }
}

/// Checks that a server has chosen what was asked for.
fn check_chosen(asked: Option<&ParamValue>, chosen: Option<&ParamValue>) -> Result<(), FailureReason> {
    if asked == chosen {
        return Ok(());
    }
    let refusal = match chosen {
        Some(chosen) => ReconfigureRefusal::Other(ros::ros2::process::yaml(chosen)),
        None => ReconfigureRefusal::Untold,
    };
    Err(FailureReason::new(refusal.to_string()))
}

impl NodeState {
    /// Checks a change.
    fn plan(&self, node: &str, (name, value): ParamChange) -> Result<PlannedChange, SetRefusal> {
        let value = value.filter(|value| *value != ParamValue::Nil);
        if name == SIM_TIME {
            let is_so = value == Some(ParamValue::Bool(self.simulated));
            return if is_so { Ok(PlannedChange::Nothing) } else { Err(SetRefusal::SimTime) };
        }
        let mut servers = self.servers.iter().enumerate();
        if let Some((at, (own, described))) = servers.find_map(|(at, server)| Some((at, server.find(&name)?))) {
            let value = value.ok_or(ReconfigureRefusal::Deleted)?;
            return Ok(PlannedChange::Reconfigure(at, own.to_owned(), described.check(&value)?));
        }
        let key = to_key(node, &name).ok_or_else(|| ParameterRefusal::Key(shown_key("~", &name)))?;
        let path = spell_in_ros1(&name);
        let there = value_at(&self.tree, &path);
        let Some(value) = value else {
            return match there {
                Some(ParamValue::Map(_)) | None => Err(SetRefusal::NotSet),
                Some(_) => Ok(PlannedChange::Delete(key)),
            };
        };
        check_for_ros1(&value)?;
        if matches!(there, Some(ParamValue::Map(below)) if !below.is_empty()) {
            return Err(ParameterRefusal::HasParametersBelow.into());
        }
        let mut ends = path.match_indices('/').map(|(at, _)| &path[..at]);
        if let Some(above) = ends.find(|above| !matches!(value_at(&self.tree, above), None | Some(ParamValue::Map(_))))
        {
            return Err(ParameterRefusal::BelowValue(spell_in_ros2(above)).into());
        }
        Ok(PlannedChange::Set(key, value))
    }
}

/// Returns the value of a parameter but `use_sim_time`. A dictionary is no value, but has parameters below it.
fn find_value<'t>(tree: &'t Tree, name: &str) -> Option<&'t ParamValue> {
    to_key("", name)?;
    let value = value_at(tree, &spell_in_ros1(name))?;
    (!matches!(value, ParamValue::Map(_) | ParamValue::Nil)).then_some(value)
}

/// Room for an answer.
struct AnswerRoom {
    left: usize,
}

impl AnswerRoom {
    fn new() -> Self {
        Self { left: MAX_ANSWER }
    }

    /// Takes the room for one parameter.
    fn take(&mut self, node: &str, bytes: usize) -> Result<(), BusError> {
        let left = self.left.checked_sub(bytes.saturating_add(PARAMETER_OVERHEAD));
        self.left = left.ok_or_else(|| BusError::Protocol {
            what: format!("a request for parameters of {node}"),
            reason: format!("the answer takes more than {MAX_ANSWER} bytes; ask for fewer parameters at once"),
        })?;
        Ok(())
    }
}

/// Returns the type that a value has in ROS 2.
fn kind_of(value: &ParamValue) -> ParameterKind {
    match value {
        ParamValue::Bool(_) => ParameterKind::Bool,
        ParamValue::Int(_) => ParameterKind::Integer,
        ParamValue::Double(_) => ParameterKind::Double,
        ParamValue::String(_) => ParameterKind::String,
        ParamValue::Binary(_) => ParameterKind::Bytes,
        ParamValue::List(items) => match items.first() {
            Some(ParamValue::Bool(_)) => ParameterKind::Bools,
            Some(ParamValue::String(_)) => ParameterKind::Strings,
            Some(ParamValue::Int(_)) if items.iter().all(|item| matches!(item, ParamValue::Int(_))) => {
                ParameterKind::Integers
            }
            Some(ParamValue::Int(_) | ParamValue::Double(_)) => ParameterKind::Doubles,
            _ => ParameterKind::NotSet,
        },
        ParamValue::Nil | ParamValue::Map(_) => ParameterKind::NotSet,
    }
}

/// Collects the names of all parameters that ROS 2 can have.
fn collect_names(above: &str, tree: &Tree, into: &mut BTreeSet<String>) {
    for (entry, value) in tree {
        // Such an entry has no name in ROS 2 that leads back to it.
        if entry.is_empty() || entry.contains(['.', '/']) {
            continue;
        }
        let name = format!("{above}{entry}");
        match value {
            ParamValue::Map(below) => collect_names(&format!("{name}."), below, into),
            ParamValue::Nil => {}
            _ => drop(into.insert(name)),
        }
    }
}

/// Selects names as the nodes of ROS 2 do: below one of the prefixes, and of at most so many levels beyond it.
fn select_names(all: BTreeSet<String>, prefixes: &[String], depth: u64) -> ParameterNames {
    let is_within = |rest: &str| depth == 0 || (rest.matches('.').count() as u64) < depth;
    // A request may have as many prefixes as a node has parameters.
    let wanted: BTreeSet<&str> = prefixes.iter().map(String::as_str).collect();
    let is_meant = |name: &String| {
        if wanted.is_empty() {
            return is_within(name);
        }
        let mut above = name.match_indices('.').map(|(at, _)| (&name[..at], &name[at + 1..]));
        wanted.contains(name.as_str()) || above.any(|(prefix, rest)| wanted.contains(prefix) && is_within(rest))
    };
    let names: Vec<String> = all.into_iter().filter(is_meant).collect();
    let prefixes = names.iter().filter_map(|name| Some(name.rsplit_once('.')?.0.to_owned()));
    let prefixes: BTreeSet<String> = prefixes.collect();
    ParameterNames { names, prefixes: prefixes.into_iter().collect() }
}

#[async_trait]
impl NodeParameters for NodeParameterView {
    async fn get(&self, node: &str, names: &[String]) -> Result<Vec<Option<ParamValue>>, BusError> {
        let tree = self.read_tree(node).await?;
        let simulated = names.iter().any(|name| name == SIM_TIME) && self.read_sim_time().await?;
        let mut room = AnswerRoom::new();
        let mut values = Vec::with_capacity(names.len());
        for name in names {
            let value = match &**name {
                SIM_TIME => Some(&ParamValue::Bool(simulated)),
                name => find_value(&tree, name),
            };
            room.take(node, value.map_or(0, ParamValue::bytes_held))?;
            values.push(value.cloned());
        }
        Ok(values)
    }

    async fn set(&self, node: &str, changes: Vec<ParamChange>) -> Result<Vec<Result<(), FailureReason>>, BusError> {
        let state = self.read_state(node).await?;
        let planned = changes.into_iter().map(|change| state.plan(node, change)).collect();
        self.make(&state, planned).await
    }

    /// Sets parameters after all of them were checked. The changes of one dynamic_reconfigure server are made at once.
    async fn set_atomically(&self, node: &str, changes: Vec<ParamChange>) -> Result<(), BusError> {
        let state = self.read_state(node).await?;
        let mut planned = Vec::new();
        let mut names = Vec::new();
        for change in changes {
            let key = change.0.clone();
            match state.plan(node, change) {
                Ok(change) => planned.push(Ok(change)),
                Err(refusal) => return Err(BusError::BadParam { key, reason: refusal.to_string() }),
            }
            names.push(key);
        }
        for (key, made) in names.into_iter().zip(self.make(&state, planned).await?) {
            if let Err(reason) = made {
                return Err(BusError::BadParam { key, reason: reason.into_string() });
            }
        }
        Ok(())
    }

    async fn list(&self, node: &str, prefixes: &[String], depth: u64) -> Result<ParameterNames, BusError> {
        let mut all = BTreeSet::from([SIM_TIME.to_owned()]);
        collect_names("", &self.read_tree(node).await?, &mut all);
        Ok(select_names(all, prefixes, depth))
    }

    async fn describe(&self, node: &str, names: &[String]) -> Result<Vec<Option<ParameterDescription>>, BusError> {
        let state = self.read_state(node).await?;
        let mut room = AnswerRoom::new();
        let mut all = Vec::with_capacity(names.len());
        for name in names {
            let described = state.servers.iter().find_map(|server| Some(server.find(name)?.1));
            let value = find_value(&state.tree, name);
            let texts = described.map_or(0, |described| described.description.len() + described.choices.len());
            room.take(node, name.len() + texts + value.map_or(0, ParamValue::bytes_held))?;
            all.push(match (described, value) {
                (Some(described), _) => Some(described.describe(name)),
                (None, _) if name == SIM_TIME => Some(ParameterDescription {
                    name: name.clone(),
                    kind: ParameterKind::Bool,
                    read_only: true,
                    ..ParameterDescription::default()
                }),
                // What is at a Master may change its type at any time.
                (None, Some(value)) => Some(ParameterDescription {
                    name: name.clone(),
                    kind: kind_of(value),
                    dynamic_typing: true,
                    ..ParameterDescription::default()
                }),
                (None, None) => None,
            });
        }
        Ok(all)
    }

    async fn watch(&self, node: Option<&str>) -> Result<Box<dyn ParameterEvents>, BusError> {
        if let Some(node) = node {
            self.check_node(node)?;
        }
        let mut watch = self.watch.lock().await;
        if let Some(events) = watch.as_ref().and_then(|running| running.subscribe(node)) {
            return Ok(Box::new(events));
        }
        let master = self.inner.parameters()?;
        let changes = master.watch().await?;
        let known = KnownValues::new("/", &master.get("/").await?);
        let (running, events) = MasterWatch::start(changes, known, self.inner.graph(), node);
        *watch = Some(running);
        Ok(Box::new(events))
    }
}
