//! Auxiliary parameters in a robot's configuration.

use std::collections::BTreeMap;

use serde::{Deserialize, Serialize};

/// A number or a text.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(untagged, expecting = "a number or a string")]
pub enum Scalar {
    /// A number.
    Number(f64),
    /// A text.
    Text(String),
}

impl std::fmt::Display for Scalar {
    fn fmt(&self, out: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        match self {
            Self::Number(number) => write!(out, "{number}"),
            Self::Text(text) => out.write_str(text.trim()),
        }
    }
}

/// Auxiliary parameters: a table, or text such as `width=640 model=big`, as the environment gives it.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(untagged, expecting = "a table such as { width = 640 }, or a string such as \"width=640\"")]
pub enum Aux {
    /// Values by name.
    Table(BTreeMap<String, Scalar>),
    /// Pairs separated by spaces.
    Text(String),
}

/// Error of a text that is not a list of auxiliary parameters. Its own text continues a sentence that begins with the
/// key `aux`.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
#[error("is {0:?}; write KEY=VALUE, such as width=640")]
pub struct ParseAuxError(String);

impl Aux {
    /// Returns names and values; an error if a part of the text is not a pair.
    pub fn pairs(&self) -> Result<Vec<(String, String)>, ParseAuxError> {
        match self {
            Self::Table(table) => Ok(table.iter().map(|(key, value)| (key.clone(), value.to_string())).collect()),
            Self::Text(text) => text
                .split_whitespace()
                .map(|pair| match pair.split_once('=') {
                    Some((key, value)) => Ok((key.to_owned(), value.to_owned())),
                    None => Err(ParseAuxError(text.clone())),
                })
                .collect(),
        }
    }
}
