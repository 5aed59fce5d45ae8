//! Request pairs: which input of a service is answered by which outputs. They are decided once, at the push, when the
//! interface is complete; robots do not guess.
//!
//! ```text
//!   --request ─────────────────▶ apply_stated ────┐
//!   stamps seen in the push ─┬─▶ decide_requests ─┴─▶ Vec<Request> with reasons ──▶ interface ──▶ stubs, CLI output
//!   names and types ─────────┘
//! ```
//! Each node of the package is considered separately, since a stub stands for one node. Goals of actions are not
//! covered, since their results carry the goal's id.

mod rules;

use std::collections::{BTreeMap, BTreeSet};

use qos::{Correlation, TopicPair};
use ros::bus::RosVersion;
use ros::schema::Registry;

use crate::Error;
use crate::interface::{Direction, Interface, Topic};
pub use crate::request::{Reason, Request};
use rules::TopicEnd;

/// An answer observed by the push: a message of the output with the stamp of a message sent to the input.
#[derive(Debug, Clone, PartialEq, Eq, PartialOrd, Ord)]
pub struct ObservedAnswer {
    /// Absolute name of the input.
    pub input: String,
    /// Absolute name of the output.
    pub output: String,
}

impl Interface {
    /// Returns the request pairs decided by the push, or decides them now for an interface recorded by an earlier
    /// version.
    pub fn decided_requests(&self, ros: RosVersion) -> Vec<Request> {
        match &self.requests {
            Some(requests) => requests.clone(),
            None => decide_requests(ros, self, &BTreeSet::new()),
        }
    }
}

/// Decides the request pairs of each node.
///
/// Pairs in `watched` take precedence; the rest is decided by rules. An output answers a single input, since its
/// messages are matched with that only.
pub fn decide_requests(ros: RosVersion, interface: &Interface, watched: &BTreeSet<ObservedAnswer>) -> Vec<Request> {
    let ends = TopicEnds::from_interface(ros, interface);
    let nodes: BTreeSet<&str> =
        interface.topics.iter().flat_map(|topic| topic.nodes.iter().map(String::as_str)).collect();
    // A supplement may leave the nodes of its topics unspecified.
    let nodes = if nodes.is_empty() { BTreeSet::from([""]) } else { nodes };
    let of_node = |node: &str| -> Vec<Request> {
        let (inputs, outputs) =
            (ends.topics_of_node(node, Direction::Input), ends.topics_of_node(node, Direction::Output));
        let found = rules::pair_topics(&inputs, &outputs, watched).into_iter();
        let request = |(pair, reason)| Request { node: node.to_owned(), pair, reason };
        found.map(request).collect()
    };
    nodes.into_iter().flat_map(of_node).collect()
}

/// Replaces the decided pairs of a node by those that the deployer states.
///
/// # Errors
/// An unknown topic, with the existing ones; matching by stamp without a stamp; topics that are named twice.
pub fn apply_stated(
    ros: RosVersion,
    interface: &Interface,
    stated: &[TopicPair],
    decided: Vec<Request>,
) -> Result<Vec<Request>, Error> {
    let ends = TopicEnds::from_interface(ros, interface);
    let mut requests = Vec::new();
    for pair in stated {
        let input = ends.find(Direction::Input, &pair.input)?;
        let outputs = pair.outputs.iter().map(|name| ends.find(Direction::Output, name));
        let outputs = outputs.collect::<Result<Vec<_>, _>>()?;
        let all = || std::iter::once(&input).chain(&outputs);
        let unstamped = all().find(|end| end.is_known && !end.is_stamped);
        let is_known = all().all(|end| end.is_known);
        let by = match (pair.by, unstamped) {
            (Some(Correlation::Goal), _) => {
                return Err(Error::GoalIsNoTopic { input: pair.input.clone() });
            }
            (Some(Correlation::Stamp), Some(end)) => {
                return Err(Error::NoStamp { topic: end.name.clone(), type_name: end.type_name.clone() });
            }
            (Some(by), _) => Some(by),
            (None, None) => is_known.then_some(Correlation::Stamp),
            (None, Some(_)) => Some(Correlation::Arrival),
        };
        let named =
            |name: &String, request: &Request| request.pair.input == *name || request.pair.outputs.contains(name);
        let names = std::iter::once(&pair.input).chain(&pair.outputs);
        if let Some(twice) = names.into_iter().find(|name| requests.iter().any(|request| named(name, request))) {
            return Err(Error::NamedTwice { topic: twice.clone() });
        }
        requests.push(Request {
            node: ends.find_node(&input.name, &outputs),
            pair: TopicPair { by, ..pair.clone() },
            reason: Reason::Stated,
        });
    }
    let is_stated = |node: &String| requests.iter().any(|request| request.node == *node);
    let others: Vec<Request> = decided.into_iter().filter(|other| !is_stated(&other.node)).collect();
    requests.extend(others);
    Ok(requests)
}

/// Topics of an interface, with the relevant properties of their types.
struct TopicEnds<'a> {
    topics: Vec<(&'a Topic, TopicEnd)>,
}

impl<'a> TopicEnds<'a> {
    fn from_interface(ros: RosVersion, interface: &'a Interface) -> Self {
        let registry = Registry::for_version(ros);
        for (key, text) in &interface.definitions {
            // Messages of an unusable type cannot be matched.
            let _ = registry.insert(key, text);
        }
        let end = |topic: &'a Topic| {
            let of_type = registry.message(&topic.type_name);
            let end = TopicEnd {
                name: topic.name.clone(),
                type_name: topic.type_name.replacen("/msg/", "/", 1),
                is_known: of_type.is_ok(),
                is_stamped: of_type.is_ok_and(|of_type| of_type.has_header()),
                is_latched: topic.latched,
            };
            (topic, end)
        };
        Self { topics: interface.topics.iter().map(end).collect() }
    }

    fn topics_in_direction(&self, direction: Direction) -> impl Iterator<Item = &(&'a Topic, TopicEnd)> {
        self.topics.iter().filter(move |(topic, _)| topic.direction == direction)
    }

    /// Returns the topics of a node; topics without known nodes belong to every node.
    fn topics_of_node(&self, node: &str, direction: Direction) -> Vec<TopicEnd> {
        let is_of = |topic: &Topic| topic.nodes.is_empty() || topic.nodes.iter().any(|name| name == node);
        let ends = self.topics_in_direction(direction).filter(|(topic, _)| is_of(topic));
        ends.map(|(_, end)| end.clone()).collect()
    }

    fn find(&self, direction: Direction, name: &str) -> Result<TopicEnd, Error> {
        let found = self.topics_in_direction(direction).find(|(topic, _)| topic.name == name);
        found.map(|(_, end)| end.clone()).ok_or_else(|| Error::NoSuchTopic {
            topic: name.to_owned(),
            direction: match direction {
                Direction::Input => "input",
                Direction::Output => "output",
            },
            topics: self.topics_in_direction(direction).map(|(topic, _)| topic.name.clone()).collect(),
        })
    }

    /// Returns the node with both the input and the answer; if there is none, that of the input.
    fn find_node(&self, input: &str, outputs: &[TopicEnd]) -> String {
        let mut nodes: BTreeMap<&str, usize> = BTreeMap::new();
        for (topic, end) in &self.topics {
            let is_input = topic.direction == Direction::Input && end.name == input;
            let is_answer =
                topic.direction == Direction::Output && outputs.first().is_some_and(|first| first.name == end.name);
            for node in topic.nodes.iter().filter(|_| is_input || is_answer) {
                // The input's node has a higher weight than the output's; a node with both has the highest.
                *nodes.entry(node).or_default() += if is_input { 2 } else { 1 };
            }
        }
        let most = nodes.into_iter().rev().max_by_key(|(_, count)| *count);
        most.map(|(node, _)| node.to_owned()).unwrap_or_default()
    }
}

#[cfg(test)]
mod tests;
