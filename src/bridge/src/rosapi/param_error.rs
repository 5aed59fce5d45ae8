//! Reasons why a request for parameters is not answered.

use budget::Exceeded;
use ros::bus::{BusError, FailureReason};

use crate::names::ResolveNameError;

/// Maximum bytes of a default. A caller need not have a longer one sent back to itself.
pub(super) const LONGEST_DEFAULT: usize = 1 << 20;

/// Reasons why a request for parameters is not answered.
#[derive(Debug, thiserror::Error)]
pub(crate) enum ParamRequestError {
    #[error("field \"name\" is missing, a parameter's name is expected")]
    NoName,
    #[error("field \"name\" is missing, a node and its parameter such as \"/camera:exposure\" is expected")]
    NoNodeName,
    /// The name, shortened, is not of the form `node:parameter`.
    #[error("field \"name\" is {0:?}, a node and its parameter such as \"/camera:exposure\" is expected")]
    NotOfNode(String),
    #[error(transparent)]
    Name(#[from] ResolveNameError),
    #[error("field {field:?} has {length} bytes, at most {limit} are taken", limit = LONGEST_DEFAULT)]
    LongDefault { field: &'static str, length: usize },
    #[error("field \"value\" is null, which no ROS parameter can be; call delete_param to remove one")]
    Null,
    /// The value contains null at this path.
    #[error("field \"value\" holds null at {0}, which no ROS parameter can; leave it out")]
    NullInside(String),
    #[error("field \"value\" is {shown:?}, which no ROS parameter can be: {source}")]
    Unfit {
        /// The value, shortened.
        shown: String,
        source: serde_json::Error,
    },
    /// The value, shortened, is not JSON.
    #[error("field \"value\" is {0:?}, JSON text (a boolean, number, string, list or object) is expected")]
    NotJson(String),
    #[error("field \"value\": {0}")]
    NoRoom(#[from] Exceeded),
    /// The parameter's value cannot be written as JSON.
    #[error(transparent)]
    Print(serde_json::Error),
    #[error(transparent)]
    Bus(#[from] BusError),
    #[error("node {node} refuses {parameter}: {reason}")]
    Refused { node: String, parameter: String, reason: FailureReason },
    #[error("node {node} did not answer for {parameter}")]
    Unanswered { node: String, parameter: String },
}
