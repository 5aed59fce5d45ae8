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
    /// Robots on this machine that show no token, where tokens exist.
    pub loopback_robots: LoopbackRobots,
}

/// Handling of robots on this machine that show no token, where tokens or accounts exist.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum LoopbackRobots {
    /// They need a token, as all others do.
    #[default]
    Refused,
    /// They connect without, as they did before the first token.
    Allowed,
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
            loopback_robots: LoopbackRobots::default(),
        }
    }
}

impl PortalConfig {
    /// Checks the values; `is_behind_proxy` is true if a proxy in front of the portal is configured.
    pub(super) fn check(&self, is_behind_proxy: bool) -> anyhow::Result<()> {
        if self.loopback_robots == LoopbackRobots::Allowed && is_behind_proxy {
            bail!(
                "[portal] of the configuration: with loopback_robots = \"allowed\", what a proxy of trusted_proxies \
                    passes on without saying for whom would need no token; remove one of the two"
            );
        }
        if [self.max_encoded, self.max_message, self.max_frame].contains(&Size(0)) {
            bail!(
                "[portal] of the configuration: a limit of 0 would refuse every message; write a size such as \"64M\""
            );
        }
        check_nonzero("[portal] handshake", self.handshake, "10s")
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn robots_of_this_machine_are_not_told_from_a_proxys_clients() {
        for (loopback_robots, is_behind_proxy, is_accepted) in [
            (LoopbackRobots::Refused, true, true),
            (LoopbackRobots::Allowed, false, true),
            (LoopbackRobots::Allowed, true, false),
        ] {
            let config = PortalConfig { loopback_robots, ..PortalConfig::default() };
            assert_eq!(config.check(is_behind_proxy).is_ok(), is_accepted, "{loopback_robots:?} {is_behind_proxy}");
        }
    }
}
