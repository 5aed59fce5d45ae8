//! Pairs of an input and the outputs that answer it, and how answers are matched.

use std::fmt;
use std::str::FromStr;

use serde::{Deserialize, Serialize};

use crate::request::CorrelationKey;

/// How an output is matched to the input that it answers.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum Correlation {
    /// By `header.stamp`, which both carry and the node copies.
    Stamp,
    /// By the goal id, which the goal of an action and its result carry.
    Goal,
    /// By order: one request per side is outstanding at a time, and the next output answers it; it is forgotten at
    /// T_max.
    Arrival,
}

/// Examples of the text form of a pair, for errors.
const FORMS: &str = "write it as \"/input -> /output\", \"/input -> /output, /other by stamp\" or \
                     \"/input -> /output by arrival\"";

/// The error of a text that is not a pair of an input and its outputs.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
pub enum ParsePairError {
    /// Nothing separates the input from the outputs.
    #[error("{0:?} has no arrow; {FORMS}")]
    NoArrow(
        /// The text.
        String,
    ),
    /// The way of correlation does not exist.
    #[error("{text:?} correlates by {by:?}, which is neither stamp nor goal nor arrival; {FORMS}")]
    UnknownCorrelation {
        /// The text.
        text: String,
        /// The way of correlation that it names.
        by: String,
    },
    /// A name cannot be that of a topic.
    #[error("{text:?} names {name:?}, which is not an absolute topic name; {FORMS}")]
    InvalidTopic {
        /// The text.
        text: String,
        /// The name.
        name: String,
    },
}

/// An input and the outputs that it triggers. Its text form is one line: `/image -> /found, /marked by stamp`.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
#[serde(try_from = "String", into = "String")]
pub struct TopicPair {
    /// Absolute name of the input topic.
    pub input: String,
    /// Absolute names of the output topics; the first one is the answer whose time counts. Never empty.
    pub outputs: Vec<String>,
    /// How answers are matched; `None` to derive it from the types.
    pub by: Option<Correlation>,
}

impl Correlation {
    /// Returns true if answers can be matched by this key.
    pub(crate) fn accepts_key(self, key: &CorrelationKey) -> bool {
        match (self, key) {
            (Self::Stamp, CorrelationKey::Stamp(stamp)) => !stamp.is_zero(),
            (Self::Goal, CorrelationKey::Goal(id)) => !id.is_empty(),
            _ => false,
        }
    }
}

impl TopicPair {
    /// Returns true if the name can be part of a pair: an absolute name of letters, digits, `_` and `/`.
    pub fn is_valid_topic(topic: &str) -> bool {
        let plain = |c: char| c.is_ascii_alphanumeric() || c == '_' || c == '/';
        topic.len() > 1 && topic.starts_with('/') && topic.chars().all(plain)
    }

    /// Returns the pair with each topic name mapped by `name`.
    pub fn map_names(&self, name: impl Fn(&str) -> String) -> Self {
        Self {
            input: name(&self.input),
            outputs: self.outputs.iter().map(|output| name(output)).collect(),
            by: self.by,
        }
    }
}

impl fmt::Display for Correlation {
    fn fmt(&self, out: &mut fmt::Formatter<'_>) -> fmt::Result {
        out.write_str(match self {
            Self::Stamp => "stamp",
            Self::Goal => "goal",
            Self::Arrival => "arrival",
        })
    }
}

impl fmt::Display for TopicPair {
    fn fmt(&self, out: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(out, "{} -> {}", self.input, self.outputs.join(", "))?;
        match self.by {
            Some(by) => write!(out, " by {by}"),
            None => Ok(()),
        }
    }
}

impl FromStr for TopicPair {
    type Err = ParsePairError;

    fn from_str(text: &str) -> Result<Self, ParsePairError> {
        let (input, rest) = text.split_once("->").ok_or_else(|| ParsePairError::NoArrow(text.to_owned()))?;
        let (outputs, by) = match rest.rsplit_once(" by ") {
            None => (rest, None),
            Some((outputs, by)) => match by.trim() {
                "stamp" => (outputs, Some(Correlation::Stamp)),
                "goal" => (outputs, Some(Correlation::Goal)),
                "arrival" => (outputs, Some(Correlation::Arrival)),
                other => {
                    return Err(ParsePairError::UnknownCorrelation { text: text.to_owned(), by: other.to_owned() });
                }
            },
        };
        let topic = |name: &str| {
            let name = name.trim();
            if Self::is_valid_topic(name) {
                Ok(name.to_owned())
            } else {
                Err(ParsePairError::InvalidTopic { text: text.to_owned(), name: name.to_owned() })
            }
        };
        Ok(Self { input: topic(input)?, outputs: outputs.split(',').map(topic).collect::<Result<_, _>>()?, by })
    }
}

impl TryFrom<String> for TopicPair {
    type Error = ParsePairError;

    fn try_from(text: String) -> Result<Self, ParsePairError> {
        text.parse()
    }
}

impl From<TopicPair> for String {
    fn from(pair: TopicPair) -> Self {
        pair.to_string()
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_pair_is_one_line() {
        let pair: TopicPair = "/image -> /found, /marked by stamp".parse().unwrap();
        assert_eq!(pair.input, "/image");
        assert_eq!(pair.outputs, ["/found", "/marked"]);
        assert_eq!(pair.by, Some(Correlation::Stamp));
        assert_eq!(pair.to_string(), "/image -> /found, /marked by stamp");
        let pair: TopicPair = "/scan->/pose".parse().unwrap();
        assert_eq!((pair.input.as_str(), pair.by), ("/scan", None));
    }

    #[test]
    fn what_is_wrong_is_named() {
        for (text, named) in [
            ("/image /found", "no arrow"),
            ("image -> /found", "\"image\""),
            ("/image -> ", "\"\""),
            ("/image -> /found by luck", "\"luck\""),
        ] {
            let error = text.parse::<TopicPair>().unwrap_err().to_string();
            assert!(error.contains(named), "{text}: {error}");
            assert!(error.contains("write it as"), "{text}: {error}");
        }
    }
}
