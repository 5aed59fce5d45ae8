//! An outgoing record and the pieces in which it is sent.

use bytes::{Buf, Bytes, BytesMut};
use ros::ring::RingItem;
use ros::ros1::actions;

use super::lanes::RecordLane;
use crate::record::Record;

/// Records up to this size are kept until they are acknowledged, and sent in one piece where the link is not slow.
pub(super) const SMALL: usize = 32 * 1024;

/// Delivery guarantee of a message.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum DeliveryMode {
    /// A newer message may replace it.
    Newest,
    /// Every message is delivered (latched messages, results): it is never dropped because of its age.
    Each,
    /// Every message is delivered, in order with those of all topics of this mode (goals and their cancellations) and
    /// with calls.
    InOrder,
}

impl DeliveryMode {
    /// Returns the mode for messages of a type: goals, their cancellations and their results are not a stream of which
    /// only the newest message matters.
    pub fn for_type(type_name: &str, is_latching: bool) -> Self {
        if actions::is_command_type(type_name) {
            Self::InOrder
        } else if is_latching || actions::carries_goal_id(type_name) {
            Self::Each
        } else {
            Self::Newest
        }
    }
}

#[derive(Debug, Clone)]
pub(crate) struct OutgoingRecord {
    pub(super) head: BytesMut,
    pub(super) payload: Bytes,
    pub(super) born: i64,
    /// True if it must not be replaced by a newer message.
    pub(super) each: bool,
    pub(super) lane: RecordLane,
    /// Sequence number over all records of the session, in the order in which they were pushed.
    pub(super) order: u64,
    /// Channel of a message, or of the record that closes it.
    pub(super) channel: Option<u32>,
    /// The message before it was encoded, if it must be delivered: it may arrive damaged.
    pub(super) plain: Option<Bytes>,
    /// Not a message but the last record of its channel, which announces that it is closed.
    pub(super) closes: bool,
}

impl RingItem for OutgoingRecord {
    /// Includes the message before it was encoded.
    fn memory_size(&self) -> usize {
        self.len() + self.plain.as_ref().map_or(0, Bytes::len)
    }
}

impl OutgoingRecord {
    pub(super) fn new(record: &Record, lane: RecordLane) -> Self {
        let (head, payload) = record.to_parts();
        let (channel, born) = match record {
            Record::Data(data) => (Some(data.channel), data.born),
            _ => (None, 0),
        };
        Self { head, payload, born, each: false, lane, order: 0, channel, plain: None, closes: false }
    }

    /// Returns the length of the record in bytes.
    pub(super) fn len(&self) -> usize {
        self.head.len() + self.payload.len()
    }

    pub(super) fn is_big(&self) -> bool {
        self.memory_size() > SMALL
    }

    /// Returns whether it must be delivered, within the limits of its lane.
    pub(super) fn is_required(&self) -> bool {
        match self.lane {
            RecordLane::Data => self.closes,
            // The notice about omitted lines.
            RecordLane::Lines => self.each,
            _ => true,
        }
    }

    /// Returns whether it may arrive before another record that is in flight.
    pub(super) fn may_overtake(&self, other: &Self) -> bool {
        match self.lane {
            _ if self.lane != other.lane => true,
            RecordLane::LongAnswers => true,
            RecordLane::Data => self.channel != other.channel,
            _ => false,
        }
    }

    /// Returns the bytes from `at` on, at most `length`.
    pub(super) fn piece(&self, at: usize, length: usize) -> Bytes {
        let mut rest = self.head.clone().chain(self.payload.clone());
        rest.advance(at);
        rest.copy_to_bytes(length.min(rest.remaining()))
    }
}

/// A record of which a part has been sent.
#[derive(Debug)]
pub(super) struct InFlightRecord {
    pub(super) stream: u32,
    pub(super) number: u64,
    /// The record is sent again after a lost connection.
    pub(super) again: bool,
    pub(super) at: usize,
    pub(super) out: OutgoingRecord,
}
