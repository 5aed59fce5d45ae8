//! Parameters as viewers see them: global parameters by name (ROS 1), or node parameters as node name, dot and
//! parameter name, as other servers of the protocol name them (ROS 2): `/see.rate`.

use std::collections::BTreeMap;

use foxglove::ws_protocol::parameter::{Parameter, ParameterType, ParameterValue};
use ros::bus::{Bus, BusError, NodeParameters, ParamValue, RosVersion};

/// Returns the named parameters, or all if none is named. Unknown parameters and nodes that do not respond are
/// skipped.
pub async fn get_parameters(bus: &dyn Bus, names: Vec<String>) -> Result<Vec<Parameter>, BusError> {
    match bus.version() {
        RosVersion::One => get_shared(bus, names).await,
        RosVersion::Two => get_from_nodes(bus, names).await,
    }
}

/// Sets a parameter, or deletes it if there is no value.
pub async fn set_parameter(bus: &dyn Bus, name: &str, value: Option<ParameterValue>) -> Result<(), BusError> {
    let value = value.map(from_parameter_value);
    if bus.version() == RosVersion::One {
        let parameters = bus.parameters()?;
        return match value {
            Some(value) => parameters.set(name, value).await,
            None => parameters.delete(name).await,
        };
    }
    let bad = |reason: &str| BusError::BadParam { key: name.to_owned(), reason: reason.to_owned() };
    let (node, own) = name.split_once('.').ok_or_else(|| bad("give a node and its parameter, such as /see.rate"))?;
    let changes = vec![(own.to_owned(), value)];
    let done = bus.node_parameters()?.set(node, changes).await?;
    match done.into_iter().next() {
        Some(Err(reason)) => Err(bad(reason.as_str())),
        _ => Ok(()),
    }
}

async fn get_shared(bus: &dyn Bus, names: Vec<String>) -> Result<Vec<Parameter>, BusError> {
    let parameters = bus.parameters()?;
    let names = if names.is_empty() { parameters.names().await? } else { names };
    let mut values = Vec::new();
    for name in names {
        if let Ok(value) = parameters.get(&name).await {
            values.extend(to_parameter(&name, &value));
        }
    }
    Ok(values)
}

async fn get_from_nodes(bus: &dyn Bus, names: Vec<String>) -> Result<Vec<Parameter>, BusError> {
    let parameters = bus.node_parameters()?;
    let mut wanted: BTreeMap<String, Vec<String>> = BTreeMap::new();
    if names.is_empty() {
        let graph = bus.graph().borrow().clone();
        let nodes = graph.nodes.keys().filter(|node| {
            let list = graph.services.get(&format!("{node}/list_parameters"));
            list == Some(*node) && **node != bus.node()
        });
        for node in nodes {
            if let Ok(listed) = parameters.list(node, &[], 0).await {
                wanted.insert(node.clone(), listed.names);
            }
        }
    }
    for name in &names {
        if let Some((node, own)) = name.split_once('.') {
            wanted.entry(node.to_owned()).or_default().push(own.to_owned());
        }
    }
    let mut values = Vec::new();
    for (node, names) in wanted {
        values.extend(get_from_node(parameters, &node, &names).await);
    }
    Ok(values)
}

async fn get_from_node(parameters: &dyn NodeParameters, node: &str, names: &[String]) -> Vec<Parameter> {
    let values = parameters.get(node, names).await.unwrap_or_default();
    let known = names.iter().zip(values);
    let known = known.filter_map(|(name, value)| to_parameter(&format!("{node}.{name}"), &value?));
    known.collect()
}

/// Converts a value to the protocol's parameter; `None` if the protocol has no representation for it.
pub fn to_parameter(name: &str, value: &ParamValue) -> Option<Parameter> {
    let (value, hint) = match value {
        ParamValue::Double(_) => (to_parameter_value(value)?, Some(ParameterType::Float64)),
        ParamValue::List(all) if is_double_list(all) => (to_parameter_value(value)?, Some(ParameterType::Float64Array)),
        // Viewers would take bytes for text.
        ParamValue::Binary(_) => return None,
        other => (to_parameter_value(other)?, None),
    };
    Some(Parameter { name: name.to_owned(), r#type: hint, value: Some(value) })
}

fn is_double_list(all: &[ParamValue]) -> bool {
    !all.is_empty() && all.iter().all(|one| matches!(one, ParamValue::Double(_)))
}

fn to_parameter_value(value: &ParamValue) -> Option<ParameterValue> {
    Some(match value {
        ParamValue::Bool(value) => ParameterValue::Bool(*value),
        ParamValue::Int(value) => ParameterValue::Integer(*value),
        ParamValue::Double(value) => ParameterValue::Float64(*value),
        ParamValue::String(value) => ParameterValue::String(value.clone()),
        ParamValue::Binary(_) | ParamValue::Nil => return None,
        ParamValue::List(all) => ParameterValue::Array(all.iter().map(to_parameter_value).collect::<Option<_>>()?),
        ParamValue::Map(all) => {
            let one = |(key, value): (&String, &ParamValue)| Some((key.clone(), to_parameter_value(value)?));
            ParameterValue::Dict(all.iter().map(one).collect::<Option<_>>()?)
        }
    })
}

/// Converts a value of the protocol to a ROS parameter value.
pub fn from_parameter_value(value: ParameterValue) -> ParamValue {
    match value {
        ParameterValue::Integer(value) => ParamValue::Int(value),
        ParameterValue::Float64(value) => ParamValue::Double(value),
        ParameterValue::Bool(value) => ParamValue::Bool(value),
        ParameterValue::String(value) => ParamValue::String(value),
        ParameterValue::Array(all) => ParamValue::List(all.into_iter().map(from_parameter_value).collect()),
        ParameterValue::Dict(all) => {
            let all = all.into_iter();
            ParamValue::Map(all.map(|(key, value)| (key, from_parameter_value(value))).collect())
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn values_come_back_as_they_were() {
        let list = ParamValue::List(vec![ParamValue::Double(1.0), ParamValue::Double(2.5)]);
        let map = [("a".to_owned(), list.clone()), ("b".to_owned(), ParamValue::Bool(true))];
        for value in [
            ParamValue::Int(3),
            ParamValue::Double(3.0),
            ParamValue::String("x".into()),
            list,
            ParamValue::Map(map.into()),
        ] {
            let told = to_parameter("/p", &value).expect("has a word");
            assert_eq!(from_parameter_value(told.value.expect("a value")), value);
        }
        assert_eq!(to_parameter("/p", &ParamValue::Nil), None);
        assert_eq!(to_parameter("/p", &ParamValue::Binary(vec![1])), None);
        let double = to_parameter("/p", &ParamValue::Double(3.0)).expect("has a word");
        assert_eq!(double.r#type, Some(ParameterType::Float64));
    }
}
