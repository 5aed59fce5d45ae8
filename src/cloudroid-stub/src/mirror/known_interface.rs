//! The mirror's record of the interface that the local original is to have.

use std::collections::{BTreeMap, BTreeSet};

use link::control::Graph;
use qos::TopicPair;
use ros::bus::{QosProfile, WireType};

use super::requests::{self, RequestPattern};
use crate::local;

/// The interface known so far; lazy inputs become known later, and stay.
#[derive(Default)]
pub struct KnownInterface {
    pub(super) inputs: BTreeMap<String, WireType>,
    /// Requested quality of service of the inputs, if reported.
    pub(super) asked: BTreeMap<String, QosProfile>,
    pub(super) outputs: BTreeMap<String, WireType>,
    /// Names below another node of the process → that node.
    pub(super) of_others: BTreeMap<String, String>,
    pub(super) told: BTreeSet<String>,
}

impl KnownInterface {
    /// Adds the interface listed by the graph of the node `own`. Once it is `settled`, names below other nodes that it
    /// does not list are removed: such nodes get a new name each time they start.
    pub(super) fn add_graph(
        &mut self,
        graph: &Graph,
        own: &str,
        settled: bool,
        wire_type: impl Fn(&str, &str) -> WireType,
    ) {
        let fed = graph.inputs.iter();
        for input in fed.filter(|input| input.feed && input.type_name != "*") {
            let found = wire_type(&input.type_name, &input.md5);
            self.inputs.insert(input.topic.clone(), found);
            if let Some(qos) = &input.qos {
                let asked = qos.to_bus(local::QUEUE);
                self.asked.insert(input.topic.clone(), asked);
            }
        }
        for output in &graph.outputs {
            let found = wire_type(&output.type_name, &output.md5);
            self.outputs.insert(output.topic.clone(), found);
        }
        let inputs = graph.inputs.iter().map(|input| &input.topic);
        let outputs = graph.outputs.iter().map(|output| &output.topic);
        let services = graph.services.iter().map(|service| &service.name);
        for name in inputs.chain(outputs).chain(services) {
            if is_private_name(name, own) {
                continue;
            }
            if let Some(other) = graph.nodes.keys().find(|node| is_private_name(name, node)) {
                self.of_others.insert(name.clone(), other.clone());
            }
        }
        if settled {
            self.of_others.retain(|name, node| {
                let stays = graph.nodes.contains_key(node);
                if !stays {
                    self.inputs.remove(name);
                    self.asked.remove(name);
                    self.outputs.remove(name);
                }
                stays
            });
        }
    }

    /// Returns the pairs of the requests whose topics exist, and of actions that no request names.
    pub(super) fn pairs(&self, requests: &[RequestPattern]) -> Vec<TopicPair> {
        let mut pairs: Vec<TopicPair> = Vec::new();
        for found in requests.iter().filter_map(|request| request.resolve(self)) {
            match pairs.iter_mut().find(|pair| pair.input == found.input) {
                // Several nodes of one program may answer the same input.
                Some(pair) => {
                    let outputs = found.outputs.into_iter();
                    let new: Vec<_> = outputs.filter(|name| !pair.outputs.contains(name)).collect();
                    pair.outputs.extend(new);
                }
                None => pairs.push(found),
            }
        }
        for action in requests::action_pairs(self) {
            if !pairs.iter().any(|pair| pair.input == action.input) {
                pairs.push(action);
            }
        }
        pairs
    }
}

/// Returns whether the name is a private one of the node (`~/get_parameters`).
fn is_private_name(name: &str, node: &str) -> bool {
    name.strip_prefix(node).is_some_and(|rest| rest.starts_with('/'))
}

#[cfg(test)]
mod tests {
    use link::control::{OutputChannel, RequestedInput, ServiceChannel};
    use ros::bus::NodeNames;

    use super::*;

    #[test]
    fn what_lies_below_further_nodes_is_of_a_life_of_theirs() {
        let graph = |nodes: &[&str], lies: &[&str]| {
            let names = lies.iter().map(ToString::to_string);
            let input = |topic| RequestedInput {
                topic,
                type_name: "std_msgs/msg/String".to_owned(),
                feed: true,
                ..RequestedInput::default()
            };
            let output = |topic| OutputChannel { topic, ..OutputChannel::default() };
            let service = |name: String| ServiceChannel {
                name: format!("{name}/get_type_description"),
                ..ServiceChannel::default()
            };
            let node = |name: &&str| ((*name).to_owned(), NodeNames::default());
            Graph {
                inputs: names.clone().map(input).collect(),
                outputs: names.clone().map(output).collect(),
                services: names.map(service).collect(),
                nodes: nodes.iter().map(node).collect(),
                ..Graph::default()
            }
        };
        let of = |name: &str, _: &str| WireType::with_name(name);
        let mut known = KnownInterface::default();
        let mut note = |nodes: &[&str], lies: &[&str], settled| {
            known.add_graph(&graph(nodes, lies), "/see", settled, of);
            let topics: Vec<_> = known.outputs.keys().cloned().collect();
            assert_eq!(topics, known.inputs.keys().cloned().collect::<Vec<_>>());
            (topics.join(" "), known.of_others.keys().cloned().collect::<Vec<_>>().join(" "))
        };
        let found = note(&["/see", "/see/eye", "/tf_1"], &["/see/eye/scan", "/tf", "/tf_1/x"], true);
        let others = "/tf_1/x /tf_1/x/get_type_description".to_owned();
        assert_eq!(found, ("/see/eye/scan /tf /tf_1/x".to_owned(), others));
        // Nothing is removed before all nodes had time to register again; lazy names stay.
        let found = note(&["/see", "/tf_2"], &["/tf_2/x"], false);
        assert_eq!(found.0, "/see/eye/scan /tf /tf_1/x /tf_2/x");
        let found = note(&["/see", "/tf_2"], &[], true);
        let others = "/tf_2/x /tf_2/x/get_type_description".to_owned();
        assert_eq!(found, ("/see/eye/scan /tf /tf_2/x".to_owned(), others));
    }
}
