//! What a mirror knows of the interface that the local original is to have.

use std::collections::{BTreeMap, BTreeSet};

use link::control::Graph;
use qos::Pair;
use ros::bus::{Qos, WireType};

use super::requests::{self, Request};
use crate::local;

/// What is known of the interface so far: lazy inputs become known later, and do not go again.
#[derive(Default)]
pub struct Known {
    pub(super) inputs: BTreeMap<String, WireType>,
    /// The quality of service that the node asks for, where that is told.
    pub(super) asked: BTreeMap<String, Qos>,
    pub(super) outputs: BTreeMap<String, WireType>,
    /// What lies below a further node of the process → that node.
    pub(super) of_others: BTreeMap<String, String>,
    pub(super) told: BTreeSet<String>,
}

impl Known {
    /// Adds what the graph of the node `own` lists. Once it is `settled`, what lies below a further node that it does not list is forgotten: it had a name
    /// of one life, and the next one has another.
    pub(super) fn note(
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
                let asked = qos.to_qos(local::QUEUE);
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
            if is_below(name, own) {
                continue;
            }
            if let Some(other) = graph.nodes.keys().find(|node| is_below(name, node)) {
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

    /// The pairs of those requests whose topics exist, and of actions that none of them names.
    pub(super) fn pairs(&self, requests: &[Request]) -> Vec<Pair> {
        let mut pairs: Vec<Pair> = Vec::new();
        for found in requests.iter().filter_map(|request| request.pair(self)) {
            match pairs.iter_mut().find(|pair| pair.input == found.input) {
                // Nodes of one program may answer the same input.
                Some(pair) => {
                    let outputs = found.outputs.into_iter();
                    let new: Vec<_> = outputs
                        .filter(|name| !pair.outputs.contains(name))
                        .collect();
                    pair.outputs.extend(new);
                }
                None => pairs.push(found),
            }
        }
        for action in requests::actions(self) {
            if !pairs.iter().any(|pair| pair.input == action.input) {
                pairs.push(action);
            }
        }
        pairs
    }
}

/// Whether the name is a private one of the node (`~/get_parameters`).
fn is_below(name: &str, node: &str) -> bool {
    name.strip_prefix(node)
        .is_some_and(|rest| rest.starts_with('/'))
}

#[cfg(test)]
mod tests {
    use link::control::{Has, Output, Served, Wanted};

    use super::*;

    #[test]
    fn what_lies_below_further_nodes_is_of_a_life_of_theirs() {
        let graph = |nodes: &[&str], lies: &[&str]| {
            let names = lies.iter().map(ToString::to_string);
            let input = |topic| Wanted {
                topic,
                type_name: "std_msgs/msg/String".to_owned(),
                feed: true,
                ..Wanted::default()
            };
            let output = |topic| Output {
                topic,
                ..Output::default()
            };
            let service = |name: String| Served {
                name: format!("{name}/get_type_description"),
                ..Served::default()
            };
            let node = |name: &&str| ((*name).to_owned(), Has::default());
            Graph {
                inputs: names.clone().map(input).collect(),
                outputs: names.clone().map(output).collect(),
                services: names.map(service).collect(),
                nodes: nodes.iter().map(node).collect(),
                ..Graph::default()
            }
        };
        let of = |name: &str, _: &str| WireType::named(name);
        let mut known = Known::default();
        let mut note = |nodes: &[&str], lies: &[&str], settled| {
            known.note(&graph(nodes, lies), "/see", settled, of);
            let topics: Vec<_> = known.outputs.keys().cloned().collect();
            assert_eq!(topics, known.inputs.keys().cloned().collect::<Vec<_>>());
            (
                topics.join(" "),
                known
                    .of_others
                    .keys()
                    .cloned()
                    .collect::<Vec<_>>()
                    .join(" "),
            )
        };
        let found = note(
            &["/see", "/see/eye", "/tf_1"],
            &["/see/eye/scan", "/tf", "/tf_1/x"],
            true,
        );
        let others = "/tf_1/x /tf_1/x/get_type_description".to_owned();
        assert_eq!(found, ("/see/eye/scan /tf /tf_1/x".to_owned(), others));
        // Not before all had time to come again; what is lazy stays.
        let found = note(&["/see", "/tf_2"], &["/tf_2/x"], false);
        assert_eq!(found.0, "/see/eye/scan /tf /tf_1/x /tf_2/x");
        let found = note(&["/see", "/tf_2"], &[], true);
        let others = "/tf_2/x /tf_2/x/get_type_description".to_owned();
        assert_eq!(found, ("/see/eye/scan /tf /tf_2/x".to_owned(), others));
    }
}
