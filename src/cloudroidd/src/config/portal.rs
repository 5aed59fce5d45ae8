//! `[portal]`: limits of clients' connections.

use anyhow::bail;
use api::Size;
use serde::Deserialize;

use super::{Time, check_nonzero};

/// Limits of clients' connections.
#[derive(Debug, Clone, PartialEq, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct PortalConfig {
    /// Largest WebSocket message, all frames together.
    pub max_message: Size,
    /// Largest WebSocket frame.
    pub max_frame: Size,
    /// Interval between pings; 0 sends none.
    pub ping: Time,
    /// Time without any data, not even a pong, after which a connection is closed; 0 disables this.
    pub idle: Time,
    /// Largest size of one message encoded as JSON or CBOR; a larger one is not sent.
    pub max_encoded: Size,
    /// Representation of NaN and infinities in JSON.
    pub non_finite: NonFinite,
    /// Longest time for a request's header, and for the `auth` message if one is expected.
    pub handshake: Time,
    /// Time that connections have to end when the daemon ends.
    pub drain: Time,
    /// Programs may be run in servants by callers with the permission `exec`.
    pub exec: bool,
}

/// Representation in JSON of numbers that it cannot express.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum NonFinite {
    /// `null`, which every parser accepts.
    Null,
    /// `"NaN"`, `"Infinity"`, `"-Infinity"`.
    Text,
    /// `NaN`, `Infinity`, `-Infinity`: as Python writes them, refused by strict parsers.
    Bare,
}

impl Default for PortalConfig {
    fn default() -> Self {
        PortalConfig {
            max_message: Size(64 << 20),
            max_frame: Size(64 << 20),
            max_encoded: Size(64 << 20),
            ping: Time::seconds(15),
            idle: Time::seconds(90),
            non_finite: NonFinite::Null,
            handshake: Time::seconds(10),
            drain: Time::seconds(10),
            exec: true,
        }
    }
}

impl PortalConfig {
    pub(super) fn check(&self) -> anyhow::Result<()> {
        if [self.max_encoded, self.max_message, self.max_frame].contains(&Size(0)) {
            bail!(
                "[portal] of the configuration: a limit of 0 would refuse every message; write a size such as \"64M\""
            );
        }
        check_nonzero("[portal] handshake", self.handshake, "10s")
    }
}
