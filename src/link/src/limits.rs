//! All limits of a link: what a receiver accepts, which the peer observes as sender, and what a sender queues.

use ros::ring::RingBounds;
use serde::{Deserialize, Serialize};

/// Maximum length of a WebSocket frame: a piece of a record, or a hello with all parameters of a robot.
pub const MAX_FRAME: usize = 32 << 20;
/// Maximum length of a record.
pub const MAX_RECORD: usize = 256 << 20;
/// Maximum length of a control record (parameters may be as long as a frame), and of a hello without its parameters.
pub const MAX_CONTROL: usize = 1 << 20;
/// Maximum memory for control records of one session that were parsed and wait to be processed.
pub const MAX_TOLD: usize = 64 << 20;

/// Limits on what an end of a link accepts. Each end announces them in its opening frame and closes the connection if
/// they are exceeded; the peer stays below them.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(default)]
pub struct LinkLimits {
    /// Bytes of a record.
    pub record: usize,
    /// Incomplete records, received in pieces.
    pub under_way: usize,
    /// Total length of the incomplete records in bytes.
    pub under_way_bytes: usize,
    /// Record numbers received ahead of a missing one.
    pub ahead: usize,
    /// Memory in bytes for control records that were parsed and wait to be processed, by the estimate of
    /// [`budget::JsonWeight`].
    pub told: usize,
}

impl Default for LinkLimits {
    /// Returns the limits of this release, which all earlier releases of this protocol version use without announcing
    /// them.
    fn default() -> Self {
        Self {
            record: MAX_RECORD,
            under_way: 256,
            under_way_bytes: MAX_RECORD + (64 << 20),
            ahead: 65_536,
            told: MAX_TOLD,
        }
    }
}

impl LinkLimits {
    /// Minimum values below which a peer could send nothing useful.
    const MINIMUM: Self =
        Self { record: MAX_CONTROL, under_way: 8, under_way_bytes: MAX_CONTROL, ahead: 256, told: MAX_CONTROL };

    /// Raises limits announced by a peer to the minimum values.
    pub(crate) fn with_minimums(self) -> Self {
        let record = self.record.max(Self::MINIMUM.record);
        Self {
            record,
            under_way: self.under_way.max(Self::MINIMUM.under_way),
            under_way_bytes: self.under_way_bytes.max(record),
            ahead: self.ahead.max(Self::MINIMUM.ahead),
            told: self.told.max(Self::MINIMUM.told),
        }
    }
}

/// Control records that are queued, in flight or unacknowledged. If the limit is exceeded, the session is closed. A
/// single record may have any size.
pub(crate) const CONTROL: RingBounds = RingBounds { messages: 16_384, bytes: 128 << 20 };
/// Limit for calls and goals, as [`CONTROL`]; goals beyond it are dropped and counted.
pub(crate) const CALLS: RingBounds = RingBounds { messages: 16_384, bytes: 256 << 20 };
/// Limit for responses, as [`CONTROL`].
pub(crate) const ANSWERS: RingBounds = CALLS;
/// Queued lines; the oldest are dropped first.
pub(crate) const LINES: RingBounds = RingBounds { messages: 4096, bytes: 1 << 20 };
/// Lines that are sent ahead of a node's exit status, the newest ones.
pub(crate) const LAST_LINES: RingBounds = RingBounds { messages: 128, bytes: 64 << 10 };
/// Messages queued for one topic; the oldest are dropped first.
pub(crate) const WAITING: RingBounds = RingBounds { messages: 256, bytes: 2 << 20 };
/// Limit for a topic on which a big message is queued: only the newest is kept.
pub(crate) const BIG_WAITING: RingBounds = RingBounds { messages: 1, ..WAITING };
/// Records of messages up to this size are sent however old they are: they take little from newer ones, and commands,
/// each of which counts, are small.
pub(crate) const CHEAP: usize = 1024;
/// Bytes of messages that must all be delivered (latched messages, messages of actions), over all topics, in addition
/// to the last one; and of those kept until they are acknowledged.
pub(crate) const MAX_EACH_BYTES: usize = 64 << 20;
/// Messages and lines kept for retransmission. Those beyond the limit are not sent again.
pub(crate) const RETRANSMIT_BOUNDS: RingBounds = RingBounds { messages: 2048, bytes: 4 << 20 };
