//! Parameters as viewers have them: those that all nodes share by their names (ROS 1), those of a node by its name, a dot and what
//! the node calls them (ROS 2, as other servers of the protocol name them): `/see.rate`.

use std::collections::BTreeMap;

use foxglove::ws_protocol::parameter::{Parameter, ParameterType, ParameterValue};
use ros::bus::{Bus, BusError, NodeParameters, ParamValue, RosVersion};

/// Parameters by name; all where none is named. What there is not is left out, and so is a node that does not answer.
pub async fn all(bus: &dyn Bus, names: Vec<String>) -> Result<Vec<Parameter>, BusError> {
    match bus.version() {
        RosVersion::One => shared(bus, names).await,
        RosVersion::Two => of_nodes(bus, names).await,
    }
}

/// Sets a parameter, or removes it where there is no value.
pub async fn set(bus: &dyn Bus, name: &str, value: Option<ParameterValue>) -> Result<(), BusError> {
    let value = value.map(read);
    if bus.version() == RosVersion::One {
        let parameters = bus.parameters()?;
        return match value {
            Some(value) => parameters.set(name, value).await,
            None => parameters.delete(name).await,
        };
    }
    let bad = |reason: &str| BusError::BadParam {
        key: name.to_owned(),
        reason: reason.to_owned(),
    };
    let (node, own) = name
        .split_once('.')
        .ok_or_else(|| bad("name a node and its parameter, such as /see.rate"))?;
    let changes = vec![(own.to_owned(), value)];
    let done = bus.node_parameters()?.set(node, changes).await?;
    match done.into_iter().next() {
        Some(Err(reason)) => Err(bad(&reason)),
        _ => Ok(()),
    }
}

async fn shared(bus: &dyn Bus, names: Vec<String>) -> Result<Vec<Parameter>, BusError> {
    let parameters = bus.parameters()?;
    let names = match names.is_empty() {
        true => parameters.names().await?,
        false => names,
    };
    let mut values = Vec::new();
    for name in names {
        if let Ok(value) = parameters.get(&name).await {
            values.extend(told(&name, &value));
        }
    }
    Ok(values)
}

async fn of_nodes(bus: &dyn Bus, names: Vec<String>) -> Result<Vec<Parameter>, BusError> {
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
            wanted
                .entry(node.to_owned())
                .or_default()
                .push(own.to_owned());
        }
    }
    let mut values = Vec::new();
    for (node, names) in wanted {
        values.extend(of_node(parameters, &node, &names).await);
    }
    Ok(values)
}

async fn of_node(parameters: &dyn NodeParameters, node: &str, names: &[String]) -> Vec<Parameter> {
    let values = parameters.get(node, names).await.unwrap_or_default();
    let known = names.iter().zip(values);
    let known = known.filter_map(|(name, value)| told(&format!("{node}.{name}"), &value?));
    known.collect()
}

/// As viewers have it; none for what they have no word for.
pub fn told(name: &str, value: &ParamValue) -> Option<Parameter> {
    let (value, hint) = match value {
        ParamValue::Double(_) => (written(value)?, Some(ParameterType::Float64)),
        ParamValue::List(all) if is_of_doubles(all) => {
            (written(value)?, Some(ParameterType::Float64Array))
        }
        // What viewers take for text is not told to be bytes.
        ParamValue::Binary(_) => return None,
        other => (written(other)?, None),
    };
    Some(Parameter {
        name: name.to_owned(),
        r#type: hint,
        value: Some(value),
    })
}

fn is_of_doubles(all: &[ParamValue]) -> bool {
    !all.is_empty() && all.iter().all(|one| matches!(one, ParamValue::Double(_)))
}

fn written(value: &ParamValue) -> Option<ParameterValue> {
    Some(match value {
        ParamValue::Bool(value) => ParameterValue::Bool(*value),
        ParamValue::Int(value) => ParameterValue::Integer(*value),
        ParamValue::Double(value) => ParameterValue::Float64(*value),
        ParamValue::String(value) => ParameterValue::String(value.clone()),
        ParamValue::Binary(_) | ParamValue::Nil => return None,
        ParamValue::List(all) => {
            ParameterValue::Array(all.iter().map(written).collect::<Option<_>>()?)
        }
        ParamValue::Map(all) => {
            let one = |(key, value): (&String, &ParamValue)| Some((key.clone(), written(value)?));
            ParameterValue::Dict(all.iter().map(one).collect::<Option<_>>()?)
        }
    })
}

/// As ROS has it.
pub fn read(value: ParameterValue) -> ParamValue {
    match value {
        ParameterValue::Integer(value) => ParamValue::Int(value),
        ParameterValue::Float64(value) => ParamValue::Double(value),
        ParameterValue::Bool(value) => ParamValue::Bool(value),
        ParameterValue::String(value) => ParamValue::String(value),
        ParameterValue::Array(all) => ParamValue::List(all.into_iter().map(read).collect()),
        ParameterValue::Dict(all) => {
            let all = all.into_iter();
            ParamValue::Map(all.map(|(key, value)| (key, read(value))).collect())
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn values_come_back_as_they_were() {
        let list = ParamValue::List(vec![ParamValue::Double(1.0), ParamValue::Double(2.5)]);
        let map = [
            ("a".to_owned(), list.clone()),
            ("b".to_owned(), ParamValue::Bool(true)),
        ];
        for value in [
            ParamValue::Int(3),
            ParamValue::Double(3.0),
            ParamValue::String("x".into()),
            list,
            ParamValue::Map(map.into()),
        ] {
            let told = told("/p", &value).expect("has a word");
            assert_eq!(read(told.value.expect("a value")), value);
        }
        assert_eq!(told("/p", &ParamValue::Nil), None);
        assert_eq!(told("/p", &ParamValue::Binary(vec![1])), None);
        let double = told("/p", &ParamValue::Double(3.0)).expect("has a word");
        assert_eq!(double.r#type, Some(ParameterType::Float64));
    }
}
