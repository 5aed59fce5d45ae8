//! `[portal]`: what clients may do to the port.

use anyhow::bail;
use api::Size;
use serde::Deserialize;

use super::{Time, begins};

/// What clients may do to the port.
#[derive(Debug, Clone, PartialEq, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct Portal {
    /// Biggest WebSocket message, its frames together.
    pub max_message: Size,
    /// Biggest WebSocket frame.
    pub max_frame: Size,
    /// Time between pings; 0: none are sent.
    pub ping: Time,
    /// A connection from which nothing came for so long, not even a pong, is closed; 0: never.
    pub idle: Time,
    /// Bytes of JSON or CBOR that one message of a servant may become; a bigger one is not sent.
    pub max_encoded: Size,
    /// How NaN and infinities are written in JSON.
    pub non_finite: NonFinite,
    /// How long a request's header may take, and the `auth` message where one is awaited.
    pub handshake: Time,
    /// How long connections may take to end when the daemon ends.
    pub drain: Time,
}

/// What JSON has no word for.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum NonFinite {
    /// `null`, which every parser accepts.
    Null,
    /// `"NaN"`, `"Infinity"`, `"-Infinity"`.
    Text,
    /// `NaN`, `Infinity`, `-Infinity`: Python's words, refused by strict parsers.
    Bare,
}

impl Default for Portal {
    fn default() -> Self {
        Portal {
            max_message: Size(64 << 20),
            max_frame: Size(64 << 20),
            max_encoded: Size(64 << 20),
            ping: Time::seconds(15),
            idle: Time::seconds(90),
            non_finite: NonFinite::Null,
            handshake: Time::seconds(10),
            drain: Time::seconds(10),
        }
    }
}

impl Portal {
    pub(super) fn check(&self) -> anyhow::Result<()> {
        if [self.max_encoded, self.max_message, self.max_frame].contains(&Size(0)) {
            bail!(
                "[portal] of the configuration: a limit of 0 would refuse every message; write a size such as \"64M\""
            );
        }
        begins("[portal] handshake", self.handshake, "10s")
    }
}
