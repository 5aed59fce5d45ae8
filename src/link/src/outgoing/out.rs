//! A record on its way out, in the pieces in which it goes.

use bytes::{BufMut, Bytes, BytesMut};
use ros::ring::Held;
use ros::ros1::actions;

use super::SMALL;
use super::lanes::Lane;
use crate::record::Record;

/// How a message may be treated.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Quality {
    /// A newer one may take its place.
    Newest,
    /// Every one counts (latched messages, results): never dropped for its age.
    Each,
    /// Every one counts, and none comes before another one of any topic that was sent before it (goals, and what cancels them), nor before a
    /// call.
    InOrder,
}

impl Quality {
    /// How a message of this type is treated: goals, what cancels them, and what comes of them are no stream of which the newest would do.
    pub fn of(type_name: &str, is_latching: bool) -> Self {
        if actions::commands(type_name) {
            Self::InOrder
        } else if is_latching || actions::carries_goal_id(type_name) {
            Self::Each
        } else {
            Self::Newest
        }
    }
}

#[derive(Debug, Clone)]
pub(crate) struct Out {
    pub(super) head: BytesMut,
    pub(super) payload: Bytes,
    pub(super) born: i64,
    /// Every one counts.
    pub(super) each: bool,
    pub(super) lane: Lane,
    /// Counts all records of the session in the order in which they were pushed.
    pub(super) order: u64,
    /// Of a message, and of what closes its channel.
    pub(super) channel: Option<u32>,
    /// The message before it was encoded, where each one counts: it may come damaged.
    pub(super) plain: Option<Bytes>,
    /// No message: the last record of its channel, which tells that there will be no more.
    pub(super) closes: bool,
}

impl Held for Out {
    /// With the message before it was encoded.
    fn held(&self) -> usize {
        self.len() + self.plain.as_ref().map_or(0, Bytes::len)
    }
}

impl Out {
    pub(super) fn of(record: &Record, lane: Lane) -> Self {
        let (head, payload) = record.parts();
        let (channel, born) = match record {
            Record::Data(data) => (Some(data.channel), data.born),
            _ => (None, 0),
        };
        Self {
            head,
            payload,
            born,
            each: false,
            lane,
            order: 0,
            channel,
            plain: None,
            closes: false,
        }
    }

    /// Bytes of the record.
    pub(super) fn len(&self) -> usize {
        self.head.len() + self.payload.len()
    }

    pub(super) fn is_big(&self) -> bool {
        self.held() > SMALL
    }

    /// It must come, but for the limits of its lane.
    pub(super) fn must_come(&self) -> bool {
        match self.lane {
            Lane::Data => self.closes,
            // What tells of others that were left out.
            Lane::Lines => self.each,
            _ => true,
        }
    }

    /// Whether it may come before another record that is under way.
    pub(super) fn passes(&self, other: &Self) -> bool {
        match self.lane {
            _ if self.lane != other.lane => true,
            Lane::LongAnswers => true,
            Lane::Data => self.channel != other.channel,
            _ => false,
        }
    }

    /// Bytes from `at` on, at most `length`.
    pub(super) fn piece(&self, at: usize, length: usize) -> Bytes {
        let end = (at + length).min(self.len());
        let head = self.head.len();
        if at >= head {
            return self.payload.slice(at - head..end - head);
        }
        let mut piece = BytesMut::with_capacity(end - at);
        piece.put_slice(&self.head[at..end.min(head)]);
        piece.put_slice(&self.payload[..end.saturating_sub(head)]);
        piece.freeze()
    }
}
