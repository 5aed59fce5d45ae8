//! Which input of a service is answered by which outputs. It is decided once, at the push, when the interface is
//! complete; the robot is told and guesses nothing.
//!
//! ```text
//!   --request ──────────────▶ state ─┐
//!   stamps that the push saw ─▶ decide ─┴─▶ Vec<Request>, each with its reason ──▶ interface ──▶ stubs, words for the deployer
//!   names and types ──────────▶
//! ```
//! Each node of the package is looked at by itself, since a stub stands for one. Goals of actions are none of this:
//! their results carry the goal's id, whatever else there is.

mod rules;

use std::collections::{BTreeMap, BTreeSet};
use std::fmt;

use qos::{Correlation, Pair};
use ros::bus::RosVersion;
use ros::schema::Registry;
use serde::{Deserialize, Serialize};

use crate::Error;
use crate::interface::{Direction, Interface, Topic};
use rules::End;

/// An input of a node and the outputs that answer it.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
pub struct Request {
    /// The node whose topics they are; empty where it is not known.
    #[serde(default, skip_serializing_if = "String::is_empty")]
    pub node: String,
    /// The topics, by their names at the push, and by what an answer is recognised.
    pub pair: Pair,
    /// Why it is these.
    pub reason: Reason,
}

/// Why an output is taken for the answer to an input.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum Reason {
    /// The deployer says so.
    Stated,
    /// The push gave the input a message, and the output answered it.
    Watched,
    /// The node has no other input and no other output that it could be.
    Alone,
    /// It is the likeliest by types and names.
    Guessed,
}

/// An answer that the push saw: a message of the output with the stamp of the one that the input was given.
#[derive(Debug, Clone, PartialEq, Eq, PartialOrd, Ord)]
pub struct Watched {
    /// Absolute name of the input.
    pub input: String,
    /// Absolute name of the output.
    pub output: String,
}

impl fmt::Display for Request {
    fn fmt(&self, out: &mut fmt::Formatter<'_>) -> fmt::Result {
        let Pair { input, outputs, .. } = &self.pair;
        let answer = outputs.first().map_or("", String::as_str);
        let why = match self.reason {
            Reason::Stated => {
                return write!(
                    out,
                    "an answer on {answer} is counted against {input}, as --request says"
                );
            }
            Reason::Watched => "it carried the stamp of what the push gave",
            Reason::Alone => "its node has no others",
            Reason::Guessed => "a guess by types and names, since no answer was seen",
        };
        write!(
            out,
            "an answer on {answer} is counted against {input} ({why}); change it with --request INPUT=OUTPUT"
        )
    }
}

impl Interface {
    /// The requests that the push has decided; decided now for an interface that was recorded before pushes did.
    pub fn decided_requests(&self, ros: RosVersion) -> Vec<Request> {
        match &self.requests {
            Some(requests) => requests.clone(),
            None => decide(ros, self, &BTreeSet::new()),
        }
    }
}

/// Decides which input of each node is answered by which outputs.
///
/// What was `watched` counts first; the rest is decided by rules. An output answers one input, since its messages are
/// counted against that alone.
pub fn decide(ros: RosVersion, interface: &Interface, watched: &BTreeSet<Watched>) -> Vec<Request> {
    let ends = Ends::of(ros, interface);
    let nodes: BTreeSet<&str> = interface
        .topics
        .iter()
        .flat_map(|topic| topic.nodes.iter().map(String::as_str))
        .collect();
    // A supplement may leave out whose its topics are.
    let nodes = if nodes.is_empty() {
        BTreeSet::from([""])
    } else {
        nodes
    };
    let of_node = |node: &str| -> Vec<Request> {
        let (inputs, outputs) = (
            ends.of_node(node, Direction::Input),
            ends.of_node(node, Direction::Output),
        );
        let found = rules::pairs(&inputs, &outputs, watched).into_iter();
        let request = |(pair, reason)| Request {
            node: node.to_owned(),
            pair,
            reason,
        };
        found.map(request).collect()
    };
    nodes.into_iter().flat_map(of_node).collect()
}

/// Puts what the deployer says in the place of what was decided for the same nodes.
///
/// # Errors
/// A topic that the interface does not have, with those that it has; a stamp where there is none; topics that are named
/// twice.
pub fn state(
    ros: RosVersion,
    interface: &Interface,
    stated: &[Pair],
    decided: Vec<Request>,
) -> Result<Vec<Request>, Error> {
    let ends = Ends::of(ros, interface);
    let mut requests = Vec::new();
    for pair in stated {
        let input = ends.find(Direction::Input, &pair.input)?;
        let outputs = pair
            .outputs
            .iter()
            .map(|name| ends.find(Direction::Output, name));
        let outputs = outputs.collect::<Result<Vec<_>, _>>()?;
        let all = || std::iter::once(&input).chain(&outputs);
        let unstamped = all().find(|end| end.is_known && !end.is_stamped);
        let is_known = all().all(|end| end.is_known);
        let by = match (pair.by, unstamped) {
            (Some(Correlation::Goal), _) => {
                return Err(Error::GoalIsNoTopic {
                    input: pair.input.clone(),
                });
            }
            (Some(Correlation::Stamp), Some(end)) => {
                return Err(Error::NoStamp {
                    topic: end.name.clone(),
                    type_name: end.type_name.clone(),
                });
            }
            (Some(by), _) => Some(by),
            (None, None) => is_known.then_some(Correlation::Stamp),
            (None, Some(_)) => Some(Correlation::Arrival),
        };
        let named = |name: &String, request: &Request| {
            request.pair.input == *name || request.pair.outputs.contains(name)
        };
        let names = std::iter::once(&pair.input).chain(&pair.outputs);
        if let Some(twice) = names
            .into_iter()
            .find(|name| requests.iter().any(|request| named(name, request)))
        {
            return Err(Error::NamedTwice {
                topic: twice.clone(),
            });
        }
        requests.push(Request {
            node: ends.node_of(&input.name, &outputs),
            pair: Pair { by, ..pair.clone() },
            reason: Reason::Stated,
        });
    }
    let is_stated = |node: &String| requests.iter().any(|request| request.node == *node);
    let others: Vec<Request> = decided
        .into_iter()
        .filter(|other| !is_stated(&other.node))
        .collect();
    requests.extend(others);
    Ok(requests)
}

/// The topics of an interface, with what is to be known of their types.
struct Ends<'a> {
    topics: Vec<(&'a Topic, End)>,
}

impl<'a> Ends<'a> {
    fn of(ros: RosVersion, interface: &'a Interface) -> Self {
        let registry = Registry::of(ros);
        for (key, text) in &interface.definitions {
            // Of a type that is not usable no message is recognised.
            let _ = registry.insert(key, text);
        }
        let end = |topic: &'a Topic| {
            let of_type = registry.message(&topic.type_name);
            let end = End {
                name: topic.name.clone(),
                type_name: topic.type_name.replacen("/msg/", "/", 1),
                is_known: of_type.is_ok(),
                is_stamped: of_type.is_ok_and(|of_type| of_type.has_header()),
                is_latched: topic.latched,
            };
            (topic, end)
        };
        Self {
            topics: interface.topics.iter().map(end).collect(),
        }
    }

    fn of_direction(&self, direction: Direction) -> impl Iterator<Item = &(&'a Topic, End)> {
        self.topics
            .iter()
            .filter(move |(topic, _)| topic.direction == direction)
    }

    /// Those at which a node is; topics of which that is not known are every node's.
    fn of_node(&self, node: &str, direction: Direction) -> Vec<End> {
        let is_of =
            |topic: &Topic| topic.nodes.is_empty() || topic.nodes.iter().any(|name| name == node);
        let ends = self
            .of_direction(direction)
            .filter(|(topic, _)| is_of(topic));
        ends.map(|(_, end)| end.clone()).collect()
    }

    fn find(&self, direction: Direction, name: &str) -> Result<End, Error> {
        let found = self
            .of_direction(direction)
            .find(|(topic, _)| topic.name == name);
        found
            .map(|(_, end)| end.clone())
            .ok_or_else(|| Error::NoSuchTopic {
                topic: name.to_owned(),
                direction: match direction {
                    Direction::Input => "input",
                    Direction::Output => "output",
                },
                topics: self
                    .of_direction(direction)
                    .map(|(topic, _)| topic.name.clone())
                    .collect(),
            })
    }

    /// The node that has the input and the answer; where none has both, the input's.
    fn node_of(&self, input: &str, outputs: &[End]) -> String {
        let mut nodes: BTreeMap<&str, usize> = BTreeMap::new();
        for (topic, end) in &self.topics {
            let is_input = topic.direction == Direction::Input && end.name == input;
            let is_answer = topic.direction == Direction::Output
                && outputs.first().is_some_and(|first| first.name == end.name);
            for node in topic.nodes.iter().filter(|_| is_input || is_answer) {
                // An input's node counts more than an output's, and one that has both the most.
                *nodes.entry(node).or_default() += if is_input { 2 } else { 1 };
            }
        }
        let most = nodes.into_iter().rev().max_by_key(|(_, count)| *count);
        most.map(|(node, _)| node.to_owned()).unwrap_or_default()
    }
}

#[cfg(test)]
mod tests;
