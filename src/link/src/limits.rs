//! All limits of a link, in one place: what a receiver takes, which its peer keeps to as sender; and what a sender lets wait.

use ros::ring::Bounds;
use serde::{Deserialize, Serialize};

/// The longest WebSocket frame: a piece, or a hello with all of a robot's parameters.
pub const MAX_FRAME: usize = 32 << 20;
/// The longest record.
pub const MAX_RECORD: usize = 256 << 20;
/// The longest control record but those of parameters, which may be as long as a frame; and the longest hello, without its parameters.
pub const MAX_CONTROL: usize = 1 << 20;
/// What control records of one session take in memory at once, at most: those that were read and wait to be obeyed.
pub const MAX_TOLD: usize = 64 << 20;

/// What an end of a link takes. It says so in its opening frame; beyond, it ends the connection, so its peer stays below.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(default)]
pub struct Limits {
    /// Bytes of a record.
    pub record: usize,
    /// Records in several pieces that have begun to come and are not complete.
    pub under_way: usize,
    /// Bytes of those together, as they will be when they are complete.
    pub under_way_bytes: usize,
    /// Numbers that came before one that is still missing.
    pub ahead: usize,
}

impl Default for Limits {
    /// Those of this release, which are those of all earlier releases of this version of the protocol: they do not say them.
    fn default() -> Self {
        Self {
            record: MAX_RECORD,
            under_way: 256,
            under_way_bytes: MAX_RECORD + (64 << 20),
            ahead: 65_536,
        }
    }
}

impl Limits {
    /// With these no peer could send anything useful.
    const LEAST: Self = Self {
        record: MAX_CONTROL,
        under_way: 8,
        under_way_bytes: MAX_CONTROL,
        ahead: 256,
    };

    /// Makes limits usable that a peer has stated: each is at least so great that something goes.
    pub(crate) fn raise(self) -> Self {
        let record = self.record.max(Self::LEAST.record);
        Self {
            record,
            under_way: self.under_way.max(Self::LEAST.under_way),
            under_way_bytes: self.under_way_bytes.max(record),
            ahead: self.ahead.max(Self::LEAST.ahead),
        }
    }
}

/// Control records that wait, are under way and are kept until the peer has them; beyond, the session is given up. One may have any size.
pub(crate) const CONTROL: Bounds = Bounds {
    messages: 16_384,
    bytes: 128 << 20,
};
/// The same of calls and goals; what is beyond of goals is dropped and counted.
pub(crate) const CALLS: Bounds = Bounds {
    messages: 16_384,
    bytes: 256 << 20,
};
/// The same of answers.
pub(crate) const ANSWERS: Bounds = CALLS;
/// Lines that wait. The oldest give way.
pub(crate) const LINES: Bounds = Bounds {
    messages: 4096,
    bytes: 1 << 20,
};
/// Messages that wait on one topic. The oldest give way.
pub(crate) const WAITING: Bounds = Bounds {
    messages: 256,
    bytes: 2 << 20,
};
/// The same once a big message waits: only the newest counts.
pub(crate) const BIG_WAITING: Bounds = Bounds {
    messages: 1,
    ..WAITING
};
/// Bytes of messages that must all come (latched ones, actions), over all topics, beside the last one; and that are kept until the peer
/// has them.
pub(crate) const EACH: usize = 64 << 20;
/// Messages and lines that are kept in case they are lost. Those beyond are not sent again.
pub(crate) const KEPT: Bounds = Bounds {
    messages: 2048,
    bytes: 4 << 20,
};
