//! The graph as transferred from the Master to those who wait for its next generation.
//!
//! `cloudroid.waitGraph(caller_id, known_generation, timeout_s, run_id)` answers with `[1, "", graph]` as soon as the
//! generation differs from the known one, or after the time limit. The graph is a struct of
//! - `generation` int, `run_id` string,
//! - `topics` {name: [type, [publisher…], [subscriber…]]}, `services` {name: node}, `nodes` {name: uri},
//! - `parameters` {key: [[reading node…], [writing node…]]}, `sought` {service: [node…]}.
//!
//! To a caller that gives this Master's `run_id` (earlier versions give none) it answers, if it can, with the parts
//! that changed since the known generation. Two members more then say so:
//! - `since` int: the generation that the caller knows,
//! - `gone` {member: [name…]}: the parts that are there no more.

use std::collections::{BTreeMap, BTreeSet};

use ros_bus::{Graph, ParameterUse, TopicNodes};

use crate::xmlrpc::Value;

/// Name of the method; ordinary Masters do not have it.
pub(crate) const WAIT_GRAPH: &str = "cloudroid.waitGraph";

/// Reduces the generation to XML-RPC's 32 bits.
pub(crate) fn wire_generation(generation: u64) -> i32 {
    (generation & 0x7fff_ffff) as i32
}

/// A part of the graph that changes as a whole.
#[derive(Debug, Clone, PartialEq, Eq, PartialOrd, Ord)]
pub(crate) enum GraphPart {
    Topic(String),
    Service(String),
    Node(String),
    Parameter(String),
    /// Service that nodes looked up in vain.
    Sought(String),
}

impl GraphPart {
    /// Returns the member of the graph that has the part, and its name there.
    fn place(&self) -> (&'static str, &str) {
        match self {
            GraphPart::Topic(name) => (TOPICS, name),
            GraphPart::Service(name) => (SERVICES, name),
            GraphPart::Node(name) => (NODES, name),
            GraphPart::Parameter(name) => (PARAMETERS, name),
            GraphPart::Sought(name) => (SOUGHT, name),
        }
    }

    /// Returns the part that a member of the graph has under this name.
    fn from_member(member: &str, name: String) -> Option<GraphPart> {
        Some(match member {
            TOPICS => GraphPart::Topic(name),
            SERVICES => GraphPart::Service(name),
            NODES => GraphPart::Node(name),
            PARAMETERS => GraphPart::Parameter(name),
            SOUGHT => GraphPart::Sought(name),
            _ => return None,
        })
    }
}

/// Members of the graph.
const TOPICS: &str = "topics";
const SERVICES: &str = "services";
const NODES: &str = "nodes";
const PARAMETERS: &str = "parameters";
const SOUGHT: &str = "sought";

/// The answer to [`WAIT_GRAPH`].
#[derive(Debug, Clone, PartialEq)]
pub(crate) struct GraphAnswer {
    pub(crate) run_id: String,
    /// The whole graph, or its parts that changed since a generation.
    pub(crate) graph: Graph,
    /// Generation since which changes are listed; `None` if the graph is whole.
    pub(crate) since: Option<i32>,
    /// Parts that are there no more.
    pub(crate) gone: BTreeSet<GraphPart>,
}

impl GraphAnswer {
    pub(super) fn to_value(&self) -> Value {
        let mut value = graph_to_value(&self.graph, &self.run_id);
        if let (Value::Struct(members), Some(since)) = (&mut value, self.since) {
            let mut gone: BTreeMap<String, Vec<&str>> = BTreeMap::new();
            for (member, name) in self.gone.iter().map(GraphPart::place) {
                gone.entry(member.to_owned()).or_default().push(name);
            }
            let gone = gone.into_iter().map(|(member, names)| (member, Value::strings(names)));
            members.insert("since".to_owned(), Value::Int(since));
            members.insert("gone".to_owned(), Value::Struct(gone.collect()));
        }
        value
    }

    /// Reads the output of [`to_value`](Self::to_value).
    pub(crate) fn from_value(value: &Value) -> Option<Self> {
        let (graph, run_id) = graph_from_value(value)?;
        let mut answer = Self { run_id, graph, since: None, gone: BTreeSet::new() };
        // A shim of an earlier version always sends the whole graph.
        if let Some(since) = value.get("since") {
            answer.since = Some(since.as_int()?);
            for (member, names) in value.get("gone")?.as_struct()? {
                for name in names.to_strings() {
                    answer.gone.insert(GraphPart::from_member(member, name)?);
                }
            }
        }
        Some(answer)
    }

    /// Returns the whole graph, given the one that the caller knows; `None` if the differences do not belong to that.
    pub(crate) fn into_whole(self, known: &Graph) -> Option<Graph> {
        let Some(since) = self.since else {
            return Some(self.graph);
        };
        if since != wire_generation(known.generation) {
            return None;
        }
        let mut whole = Graph { generation: self.graph.generation, ..known.clone() };
        for part in &self.gone {
            match part {
                GraphPart::Topic(name) => drop(whole.topics.remove(name)),
                GraphPart::Service(name) => drop(whole.services.remove(name)),
                GraphPart::Node(name) => drop(whole.nodes.remove(name)),
                GraphPart::Parameter(name) => drop(whole.parameters.remove(name)),
                GraphPart::Sought(name) => drop(whole.sought.remove(name)),
            }
        }
        whole.topics.extend(self.graph.topics);
        whole.services.extend(self.graph.services);
        whole.nodes.extend(self.graph.nodes);
        whole.parameters.extend(self.graph.parameters);
        whole.sought.extend(self.graph.sought);
        Some(whole)
    }
}

fn graph_to_value(graph: &Graph, run_id: &str) -> Value {
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
        (TOPICS, Value::Struct(topics.collect())),
        (SERVICES, text_map(&graph.services)),
        (NODES, text_map(&graph.nodes)),
        (PARAMETERS, Value::Struct(parameters.collect())),
        (SOUGHT, Value::Struct(sought.collect())),
    ];
    Value::Struct(members.into_iter().map(|(name, value)| (name.to_owned(), value)).collect())
}

fn text_map(map: &BTreeMap<String, String>) -> Value {
    Value::Struct(map.iter().map(|(key, text)| (key.clone(), Value::from(text.as_str()))).collect())
}

/// Reads the output of [`graph_to_value`]: the graph and the Master's run id.
fn graph_from_value(value: &Value) -> Option<(Graph, String)> {
    let mut graph = Graph {
        generation: u64::try_from(value.get("generation")?.as_int()?).ok()?,
        services: read_texts(value.get(SERVICES)?)?,
        nodes: read_texts(value.get(NODES)?)?,
        ..Graph::default()
    };
    for (name, ends) in value.get(TOPICS)?.as_struct()? {
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
    for (key, nodes) in value.get(PARAMETERS)?.as_struct()? {
        let [read_by, written_by] = nodes.as_array()? else {
            return None;
        };
        let used = ParameterUse { read_by: read_by.to_strings(), written_by: written_by.to_strings() };
        graph.parameters.insert(key.clone(), used);
    }
    // A shim of an earlier version does not send it.
    if let Some(sought) = value.get(SOUGHT).and_then(Value::as_struct) {
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
        let whole = GraphAnswer { run_id: "r".to_owned(), graph, since: None, gone: BTreeSet::new() };
        assert_eq!(GraphAnswer::from_value(&whole.to_value()).as_ref(), Some(&whole));
        let gone = [GraphPart::Topic("/u".to_owned()), GraphPart::Sought("/v".to_owned())].into();
        let differences = GraphAnswer { since: Some(6), gone, ..whole };
        assert_eq!(GraphAnswer::from_value(&differences.to_value()), Some(differences));
        assert_eq!(GraphAnswer::from_value(&Value::Int(1)), None);
    }
}
