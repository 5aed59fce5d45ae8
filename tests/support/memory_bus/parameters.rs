//! Parameters of nodes: what is set that a node does not have it has from then on, but no value becomes one of another kind.

use async_trait::async_trait;
use ros::bus::{
    BusError, NodeParameters, ParamChange, ParamValue, ParameterDescription, ParameterEvents,
    ParameterKind, ParameterNames,
};

use super::MemoryBus;

/// The value as a parameter takes it that has another one.
fn fitting(held: &ParamValue, given: ParamValue) -> Result<ParamValue, String> {
    match (held, given) {
        // Nothing is lost by that.
        (ParamValue::Double(_), ParamValue::Int(given)) => Ok(ParamValue::Double(given as f64)),
        (held, given) if std::mem::discriminant(held) == std::mem::discriminant(&given) => {
            Ok(given)
        }
        _ => Err("it is of another kind".to_owned()),
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

    async fn set(
        &self,
        node: &str,
        changes: Vec<ParamChange>,
    ) -> Result<Vec<Result<(), String>>, BusError> {
        self.system.change(|state| {
            if !state.nodes.contains(node) {
                return Err(self.absent(node));
            }
            let held = state.parameters.entry(node.to_owned()).or_default();
            let mut done = Vec::new();
            for (name, value) in changes {
                let value = match (held.get(&name), value) {
                    (Some(before), Some(given)) => fitting(before, given).map(Some),
                    (_, given) => Ok(given),
                };
                done.push(value.map(|value| match value {
                    Some(value) => drop(held.insert(name, value)),
                    None => drop(held.remove(&name)),
                }));
            }
            Ok(done)
        })
    }

    async fn set_together(&self, _node: &str, _changes: Vec<ParamChange>) -> Result<(), BusError> {
        Err(BusError::NotOffered("changes of several parameters"))
    }

    async fn list(
        &self,
        node: &str,
        _prefixes: &[String],
        _depth: u64,
    ) -> Result<ParameterNames, BusError> {
        let state = self.system.state.lock();
        let held = state.parameters.get(node);
        let held = held.ok_or_else(|| self.absent(node))?;
        Ok(ParameterNames {
            names: held.keys().cloned().collect(),
            prefixes: Vec::new(),
        })
    }

    async fn describe(
        &self,
        node: &str,
        names: &[String],
    ) -> Result<Vec<Option<ParameterDescription>>, BusError> {
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

    async fn watch(&self, _node: Option<&str>) -> Result<Box<dyn ParameterEvents>, BusError> {
        Err(BusError::NotOffered("events of parameters"))
    }
}
