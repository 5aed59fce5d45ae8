//! The link between a robot's stub and the cloud: the protocol, and a session that outlives its connections. Both ends
//! share this crate.
//!
//! ```text
//!  records ─▶ Outgoing: control · calls and goals · answers · data · lines ─▶ frames ─▶ WebSocket
//!  WebSocket ─▶ frames ─▶ Incoming: pieces joined, duplicates dropped ─▶ records
//! ```
//!
//! A [`Session`] lives as long as its node, over any number of connections. What must not be lost (control messages,
//! calls, responses, small messages) is numbered, kept until the peer has acknowledged it, and sent again on the next
//! connection. Images and the like are not, because a newer one will follow.
//!
//! States of a session's connection:
//!
//! ```text
//!  (none) ──hello, welcome──▶ Up ──no bytes in time─▶ Silent ──silence too long, socket lost──▶ (none)
//!                              ▲──anything received────┘
//! ```

#![forbid(unsafe_code)]

mod bounded;
pub mod clock;
pub mod control;
mod declared_types;
pub mod drops;
mod echoes;
pub mod frame;
mod incoming;
mod limits;
#[cfg(test)]
mod model;
mod outgoing;
pub mod packing;
pub mod record;
pub mod session;
pub mod skew;
mod values;

pub use echoes::Echoes;
pub use limits::{LinkLimits, MAX_CONTROL, MAX_FRAME, MAX_RECORD, MAX_TOLD};
pub use outgoing::DeliveryMode;
pub use session::{CloudSession, DisconnectReason, RobotSession, Session, SessionHandler, SessionOptions};

/// The WebSocket subprotocol of this version. Both ends list those they support, newest first.
///
/// The version number is increased when an end of the previous version would misread what an end of this version sends:
///
/// * the encoding of a [frame](frame) or a [record](record) changes, or a new kind of either is added: the tests that
///   pin the encoding fail and are changed together with this number;
/// * a field of [hello, welcome or a control message](control) changes its name, type or meaning, or an optional field
///   becomes required.
///
/// It stays the same when a field with a default or a new control message is added: readers ignore what they do not
/// know and use defaults for what they do not find, so the default must mean what absence meant before. It also stays
/// the same when a codec is added, because each end lists the codecs that it decodes.
pub const SUBPROTOCOL: &str = "cloudroid-link.v2";
/// Common prefix of the subprotocols of all versions.
pub const SUBPROTOCOLS: &str = "cloudroid-link.";
/// Errors of the protocol, caused by the peer.
#[derive(Debug, thiserror::Error)]
pub enum Error {
    /// Invalid data.
    #[error("the other end broke the protocol: {0}")]
    Protocol(&'static str),
    /// Data shorter than its header.
    #[error("the other end broke the protocol: a frame or record that ends in its head")]
    Cut(#[from] bytes::TryGetError),
    /// A size limit was exceeded.
    #[error("the other end sends {what} of {bytes} bytes, more than the limit of {limit}")]
    TooMuch {
        /// Kind of message.
        what: &'static str,
        /// Size in bytes.
        bytes: u64,
        /// Limit in bytes.
        limit: u64,
    },
    /// An incomplete record exceeds its memory budget.
    #[error("a record cannot be received: {0}")]
    Exceeded(#[from] budget::Exceeded),
    /// Invalid WebSocket frames.
    #[error("the other end's frames were refused: {reason}")]
    Refused {
        /// WebSocket close code.
        code: u16,
        /// Reason for the close.
        reason: String,
    },
    /// Invalid JSON.
    #[error("the other end sends a {what} that cannot be read: {reason}")]
    Json {
        /// Kind of message.
        what: &'static str,
        /// Reason from the JSON parser.
        reason: String,
    },
}
