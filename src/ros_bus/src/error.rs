//! Errors of a bus.

use std::time::Duration;

/// Execution status of a failed call.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum CallFate {
    /// The server answered that the call failed.
    Answered,
    /// The server did not accept the request.
    NotTaken,
    /// The server went away before it answered; it is unknown whether the call was executed.
    Unknown,
}

/// Errors of a bus.
#[derive(Debug, thiserror::Error)]
pub enum BusError {
    /// No node serves the service.
    #[error("service {0} has no server")]
    NoService(String),
    /// No node publishes or subscribes to the topic.
    #[error("topic {0} has neither publisher nor subscriber")]
    NoTopic(String),
    /// This bus serves the service already.
    #[error("service {0} is already served by this side; drop the earlier guard first")]
    AlreadyServed(String),
    /// The two endpoints use different definitions.
    #[error("{what} is {theirs} there and {ours} here")]
    TypeMismatch {
        /// The topic or service.
        what: String,
        /// Name and digest at the peer.
        theirs: String,
        /// Name and digest expected here.
        ours: String,
    },
    /// The server reported a failure.
    #[error("service {service} failed: {reason}")]
    CallFailed {
        /// Name of the service.
        service: String,
        /// Reason given by the server.
        reason: String,
        /// Execution status of the call.
        fate: CallFate,
    },
    /// The item is not offered to this robot because it shares the nodes with other robots.
    #[error("{0} is not offered: robots share this service, and can use only its services and actions")]
    NotShared(String),
    /// The item cannot be carried between the two ROS versions.
    #[error("{what} is not carried to the other ROS: {reason}")]
    NotTranslated {
        /// The topic or service.
        what: String,
        /// The reason.
        reason: String,
    },
    /// No answer arrived in time.
    #[error("{what} did not answer within {after:?}")]
    Timeout {
        /// The topic, service or Master.
        what: String,
        /// Time waited.
        after: Duration,
    },
    /// The Master refused a call.
    #[error("the ROS Master refused {call}: {reason}")]
    Master {
        /// Name of the method.
        call: String,
        /// Status message of the Master.
        reason: String,
    },
    /// The parameter does not exist.
    #[error("parameter {0} is not set")]
    NoParam(String),
    /// The name is not allowed by ROS.
    #[error("{0} is not a valid ROS name")]
    BadName(String),
    /// The value cannot be represented on the wire.
    #[error("parameter {key} cannot be sent: {reason}")]
    BadParam {
        /// Key of the parameter.
        key: String,
        /// The problem with the value.
        reason: String,
    },
    /// This ROS version does not have the feature.
    #[error("{0} are not offered by this version of ROS")]
    NotOffered(&'static str),
    /// The bus was closed.
    #[error("the connection to this ROS system was closed")]
    Closed,
    /// The connection failed.
    #[error("{what}: {source}")]
    Io {
        /// The operation that failed.
        what: String,
        /// The cause.
        source: std::io::Error,
    },
    /// The peer does not speak the protocol.
    #[error("{what} broke the protocol: {reason}")]
    Protocol {
        /// The topic, service or node at fault.
        what: String,
        /// The violation.
        reason: String,
    },
}
