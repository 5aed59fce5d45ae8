//! What can go wrong on a bus.

use std::time::Duration;

/// Whether a call that failed was carried out.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum CallFate {
    /// The server answered that it failed.
    Answered,
    /// The server did not take it.
    NotTaken,
    /// The server went away before it answered: nobody knows.
    Unknown,
}

/// What can go wrong on a bus.
#[derive(Debug, thiserror::Error)]
pub enum BusError {
    /// Nobody serves it.
    #[error("service {0} has no server")]
    NoService(String),
    /// Nobody publishes or subscribes to it.
    #[error("topic {0} has neither publisher nor subscriber")]
    NoTopic(String),
    /// This side serves it already.
    #[error("service {0} is already served by this side; drop the earlier guard first")]
    AlreadyServed(String),
    /// Both sides mean different definitions.
    #[error("{what} is {theirs} there and {ours} here")]
    TypeMismatch {
        /// Topic or service.
        what: String,
        /// Name and digest as the peer has it.
        theirs: String,
        /// Name and digest as we have it.
        ours: String,
    },
    /// The server said no.
    #[error("service {service} failed: {reason}")]
    CallFailed {
        /// The service's name.
        service: String,
        /// What the server said.
        reason: String,
        /// Whether it may have been carried out.
        fate: CallFate,
    },
    /// It is not shown to this robot, which shares the nodes with others.
    #[error(
        "{0} is not offered: robots share this service, and use its services and actions alone"
    )]
    NotShared(String),
    /// No answer in time.
    #[error("{what} did not answer within {after:?}")]
    Timeout {
        /// Topic, service or Master.
        what: String,
        /// How long was waited.
        after: Duration,
    },
    /// The Master refused.
    #[error("the ROS Master refused {call}: {reason}")]
    Master {
        /// Method called.
        call: String,
        /// Its status message.
        reason: String,
    },
    /// No such parameter.
    #[error("parameter {0} is not set")]
    NoParam(String),
    /// A name that ROS does not allow.
    #[error("{0} is not a valid ROS name")]
    BadName(String),
    /// A value that does not fit the wire.
    #[error("parameter {key} cannot be sent: {reason}")]
    BadParam {
        /// The parameter's key.
        key: String,
        /// What is wrong with its value.
        reason: String,
    },
    /// This ROS has no such thing.
    #[error("{0} are not offered by this ROS")]
    NotOffered(&'static str),
    /// The bus was closed.
    #[error("the connection to this ROS system was closed")]
    Closed,
    /// The connection failed.
    #[error("{what}: {source}")]
    Io {
        /// What was being done.
        what: String,
        /// Why it failed.
        source: std::io::Error,
    },
    /// The peer does not speak the protocol.
    #[error("{what} broke the protocol: {reason}")]
    Protocol {
        /// Topic, service or node that sent it.
        what: String,
        /// In which way it breaks the protocol.
        reason: String,
    },
}
