//! A request pair: an input of a node and the outputs that answer it.

use std::fmt;

use qos::TopicPair;
use serde::{Deserialize, Serialize};

/// An input of a node and the outputs that answer it.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
pub struct Request {
    /// Name of the node; empty if unknown.
    #[serde(default, skip_serializing_if = "String::is_empty")]
    pub node: String,
    /// Topics, as named at the push, and how an answer is matched.
    pub pair: TopicPair,
    /// Way in which the pair was determined.
    pub reason: Reason,
}

/// Way in which a request pair was determined.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum Reason {
    /// Stated by the deployer.
    Stated,
    /// Observed: the push sent a message to the input, and the output answered it.
    Watched,
    /// Unambiguous: the node has no other eligible input and output.
    Alone,
    /// Guessed from types and names.
    Guessed,
}

impl fmt::Display for Request {
    fn fmt(&self, out: &mut fmt::Formatter<'_>) -> fmt::Result {
        let TopicPair { input, outputs, .. } = &self.pair;
        let answer = outputs.first().map_or("", String::as_str);
        let why = match self.reason {
            Reason::Stated => {
                return write!(out, "answers on {answer} count for {input}, as set by --request");
            }
            Reason::Watched => "it carried the stamp of the test input",
            Reason::Alone => "its node has no other topics",
            Reason::Guessed => "a guess by types and names, because no answer was seen",
        };
        write!(out, "answers on {answer} count for {input} ({why}); change it with --request INPUT=OUTPUT")
    }
}
