//! The graph as transferred from the Master to those who wait for its next generation.
//!
//! `cloudroid.waitGraph(caller_id, known_generation, timeout_s)` answers with `[1, "", graph]` as soon as the
//! generation differs from the known one, or after the time limit. The graph is a struct of
//! - `generation` int, `run_id` string,
//! - `topics` {name: [type, [publisher…], [subscriber…]]}, `services` {name: node}, `nodes` {name: uri},
//! - `parameters` {key: [[reading node…], [writing node…]]}, `sought` {service: [node…]}.

use std::collections::BTreeMap;

use ros_bus::{Graph, ParameterUse, TopicNodes};

use crate::xmlrpc::Value;

/// Name of the method; ordinary Masters do not have it.
pub(crate) const WAIT_GRAPH: &str = "cloudroid.waitGraph";

/// Reduces the generation to XML-RPC's 32 bits.
pub(crate) fn wire_generation(generation: u64) -> i32 {
    (generation & 0x7fff_ffff) as i32
}

pub(super) fn to_value(graph: &Graph, run_id: &str) -> Value {
    let topics = graph.topics.iter().map(|(name, topic)| {
        let ends = vec![
            Value::from(topic.type_name.as_str()),
            Value::strings(topic.publishers.iter().cloned()),
            Value::strings(topic.subscribers.iter().cloned()),
        ];
        (name.clone(), Value::Array(ends))
    });
    let parameters = graph.parameters.iter().map(|(key, used)| {
        let nodes = vec![Value::strings(used.read_by.iter().cloned()), Value::strings(used.written_by.iter().cloned())];
        (key.clone(), Value::Array(nodes))
    });
    let sought = graph.sought.iter().map(|(service, nodes)| {
        let nodes = Value::strings(nodes.iter().cloned());
        (service.clone(), nodes)
    });
    let members = [
        ("generation", Value::Int(wire_generation(graph.generation))),
        ("run_id", Value::from(run_id)),
        ("topics", Value::Struct(topics.collect())),
        ("services", text_map(&graph.services)),
        ("nodes", text_map(&graph.nodes)),
        ("parameters", Value::Struct(parameters.collect())),
        ("sought", Value::Struct(sought.collect())),
    ];
    Value::Struct(members.into_iter().map(|(name, value)| (name.to_owned(), value)).collect())
}

fn text_map(map: &BTreeMap<String, String>) -> Value {
    Value::Struct(map.iter().map(|(key, text)| (key.clone(), Value::from(text.as_str()))).collect())
}

/// Reads the output of [`to_value`]: the graph and the Master's run id.
pub(crate) fn from_value(value: &Value) -> Option<(Graph, String)> {
    let mut graph = Graph {
        generation: u64::try_from(value.get("generation")?.as_int()?).ok()?,
        services: read_texts(value.get("services")?)?,
        nodes: read_texts(value.get("nodes")?)?,
        ..Graph::default()
    };
    for (name, ends) in value.get("topics")?.as_struct()? {
        let [type_name, publishers, subscribers] = ends.as_array()? else {
            return None;
        };
        let topic = TopicNodes {
            type_name: type_name.as_str()?.to_owned(),
            publishers: publishers.to_strings(),
            subscribers: subscribers.to_strings(),
        };
        graph.topics.insert(name.clone(), topic);
    }
    for (key, nodes) in value.get("parameters")?.as_struct()? {
        let [read_by, written_by] = nodes.as_array()? else {
            return None;
        };
        let used = ParameterUse { read_by: read_by.to_strings(), written_by: written_by.to_strings() };
        graph.parameters.insert(key.clone(), used);
    }
    // A shim of an earlier version does not send it.
    if let Some(sought) = value.get("sought").and_then(Value::as_struct) {
        let owned = |(service, nodes): (&String, &Value)| (service.clone(), nodes.to_strings());
        graph.sought = sought.iter().map(owned).collect();
    }
    Some((graph, value.get("run_id")?.as_str()?.to_owned()))
}

fn read_texts(value: &Value) -> Option<BTreeMap<String, String>> {
    value.as_struct()?.iter().map(|(key, text)| Some((key.clone(), text.as_str()?.to_owned()))).collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_graph_survives_the_journey() {
        let graph = Graph {
            generation: 7,
            topics: [(
                "/t".to_owned(),
                TopicNodes {
                    type_name: "p/T".into(),
                    publishers: vec!["/a".into()],
                    subscribers: vec!["/b".into(), "/c".into()],
                },
            )]
            .into(),
            services: [("/s".to_owned(), "/a".to_owned())].into(),
            nodes: [("/a".to_owned(), "http://h:1/".to_owned())].into(),
            parameters: [("/k".to_owned(), ParameterUse { read_by: vec!["/a".into()], written_by: vec![] })].into(),
            actions: BTreeMap::new(),
            sought: [("/map".to_owned(), vec!["/b".to_owned()])].into(),
            ends: BTreeMap::new(),
            enclaves: BTreeMap::new(),
        };
        let (read, run_id) = from_value(&to_value(&graph, "r")).unwrap();
        assert_eq!((read, run_id.as_str()), (graph, "r"));
        assert_eq!(from_value(&Value::Int(1)), None);
    }
}
