//! Parameters of nodes: setting an unknown parameter declares it, and a value never changes its type.

use async_trait::async_trait;
use ros::bus::{
    BusError, FailureReason, NodeParameters, ParamChange, ParamValue, ParameterDescription, ParameterEvent,
    ParameterEvents, ParameterKind, ParameterNames,
};
use tokio::sync::mpsc;

use super::MemoryBus;

/// Receivers of changes.
pub(super) type Watchers = Vec<mpsc::UnboundedSender<ParameterEvent>>;

/// Changes of one node, or of all.
struct Events {
    node: Option<String>,
    told: mpsc::UnboundedReceiver<ParameterEvent>,
}

#[async_trait]
impl ParameterEvents for Events {
    async fn next(&mut self) -> Option<ParameterEvent> {
        loop {
            let event = self.told.recv().await?;
            if self.node.as_ref().is_none_or(|node| *node == event.node) {
                return Some(event);
            }
        }
    }

    fn dropped_count(&self) -> u64 {
        0
    }
}

/// Converts a new value to the type of the present one.
fn fitting(held: &ParamValue, given: ParamValue) -> Result<ParamValue, FailureReason> {
    match (held, given) {
        // This conversion is lossless.
        (ParamValue::Double(_), ParamValue::Int(given)) => Ok(ParamValue::Double(given as f64)),
        (held, given) if std::mem::discriminant(held) == std::mem::discriminant(&given) => Ok(given),
        _ => Err(FailureReason::new("it is of another kind")),
    }
}

impl MemoryBus {
    fn absent(&self, node: &str) -> BusError {
        BusError::NoService(format!("{node}/get_parameters"))
    }
}

#[async_trait]
impl NodeParameters for MemoryBus {
    async fn get(&self, node: &str, names: &[String]) -> Result<Vec<Option<ParamValue>>, BusError> {
        let state = self.system.state.lock();
        let held = state.parameters.get(node);
        let held = held.ok_or_else(|| self.absent(node))?;
        Ok(names.iter().map(|name| held.get(name).cloned()).collect())
    }

    async fn set(&self, node: &str, changes: Vec<ParamChange>) -> Result<Vec<Result<(), FailureReason>>, BusError> {
        self.system.change(|state| {
            if !state.nodes.contains(node) {
                return Err(self.absent(node));
            }
            let held = state.parameters.entry(node.to_owned()).or_default();
            let mut done = Vec::new();
            let mut event = ParameterEvent { node: node.to_owned(), ..ParameterEvent::default() };
            for (name, value) in changes {
                let value = match (held.get(&name), value) {
                    (Some(before), Some(given)) => fitting(before, given).map(Some),
                    (_, given) => Ok(given),
                };
                done.push(value.map(|value| match value {
                    Some(value) => match held.insert(name.clone(), value.clone()) {
                        Some(_) => event.changed.push((name, value)),
                        None => event.new.push((name, value)),
                    },
                    None => {
                        held.remove(&name);
                        event.deleted.push(name);
                    }
                }));
            }
            let watchers = &mut state.watchers;
            watchers.retain(|watcher| watcher.send(event.clone()).is_ok());
            Ok(done)
        })
    }

    async fn set_atomically(&self, _node: &str, _changes: Vec<ParamChange>) -> Result<(), BusError> {
        Err(BusError::NotOffered("changes of several parameters"))
    }

    async fn list(&self, node: &str, _prefixes: &[String], _depth: u64) -> Result<ParameterNames, BusError> {
        let state = self.system.state.lock();
        let held = state.parameters.get(node);
        let held = held.ok_or_else(|| self.absent(node))?;
        Ok(ParameterNames { names: held.keys().cloned().collect(), prefixes: Vec::new() })
    }

    async fn describe(&self, node: &str, names: &[String]) -> Result<Vec<Option<ParameterDescription>>, BusError> {
        let values = self.get(node, names).await?;
        let described = names.iter().zip(values).map(|(name, value)| {
            value.map(|value| ParameterDescription {
                name: name.clone(),
                kind: match value {
                    ParamValue::Bool(_) => ParameterKind::Bool,
                    ParamValue::Int(_) => ParameterKind::Integer,
                    ParamValue::Double(_) => ParameterKind::Double,
                    ParamValue::String(_) => ParameterKind::String,
                    _ => ParameterKind::NotSet,
                },
                description: format!("{name} of {node}"),
                ..ParameterDescription::default()
            })
        });
        Ok(described.collect())
    }

    async fn watch(&self, node: Option<&str>) -> Result<Box<dyn ParameterEvents>, BusError> {
        let (watcher, told) = mpsc::unbounded_channel();
        self.system.state.lock().watchers.push(watcher);
        let node = node.map(str::to_owned);
        Ok(Box::new(Events { node, told }))
    }
}
