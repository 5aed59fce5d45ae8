//! The link between a robot's stub and the cloud: the protocol, and a session that outlives its connections. Both ends
//! share it.
//!
//! ```text
//!  records ─▶ Outgoing: control · calls and goals · answers · data · lines ─▶ frames ─▶ WebSocket
//!  WebSocket ─▶ frames ─▶ Incoming: pieces put together, doubles dropped ─▶ records
//! ```
//!
//! A [`Session`] lives as long as its node: connections come and go below it. What must not be lost (control, calls,
//! answers, small messages) is numbered, kept until the peer has it and sent again on the next connection; pictures
//! and the like are not, since a newer one comes.
//!
//! A session's connection:
//!
//! ```text
//!  (none) ──hello, welcome──▶ Up ──no pong in time──▶ Silent ──silent for long, socket lost──▶ (none)
//!                              ▲────anything came───────┘
//! ```

#![forbid(unsafe_code)]

mod bounded;
pub mod clock;
pub mod control;
mod declared;
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

pub use drops::Dropped;
pub use echoes::Echoes;
pub use limits::{Limits, MAX_CONTROL, MAX_FRAME, MAX_RECORD, MAX_TOLD};
pub use outgoing::Quality;
pub use session::{CloudSession, Handler, Lost, RobotSession, Session, SessionOptions};

/// The WebSocket subprotocol of this version. Both ends list those they speak, newest first.
///
/// Its number grows when an end of the version before would misread what an end of this one sends:
///
/// * the bytes of a [frame](frame) or a [record](record) change, or there is a new kind of either: the tests that pin
///   those bytes fail, and are changed together with this number;
/// * a field of [hello, welcome or what is told later](control) changes its name, its type or what it means, or one
///   that was optional must be there.
///
/// It stays when a field with a default is added to one of those, or something more is told: readers leave out what
/// they do not know, and what they do not find has its default, which must mean what it meant before. So it does when
/// a codec is added, since each end says which it decodes.
pub const SUBPROTOCOL: &str = "cloudroid-link.v2";
/// What all versions begin with.
pub const SUBPROTOCOLS: &str = "cloudroid-link.";
/// What can go wrong with a peer.
#[derive(Debug, thiserror::Error)]
pub enum Error {
    /// The peer sends what makes no sense.
    #[error("the other end broke the protocol: {0}")]
    Protocol(&'static str),
    /// More than can be kept.
    #[error("the other end sends {what} of {bytes} bytes, more than the limit of {limit}")]
    TooMuch {
        /// The kind of message.
        what: &'static str,
        /// Its size, bytes.
        bytes: u64,
        /// The greatest size, bytes.
        limit: u64,
    },
    /// An unfinished record does not fit into its memory budget.
    #[error("a record cannot be received: {0}")]
    Exceeded(#[from] budget::Exceeded),
    /// Its WebSocket frames are not taken.
    #[error("the other end's frames are refused: {reason}")]
    Refused {
        /// WebSocket close code.
        code: u16,
        /// The reason.
        reason: String,
    },
    /// JSON that is not what it should be.
    #[error("the other end sends a {what} that cannot be read: {reason}")]
    Json {
        /// The kind of message.
        what: &'static str,
        /// The reason.
        reason: String,
    },
}
